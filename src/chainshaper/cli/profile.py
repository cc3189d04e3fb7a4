"""`chainshaper profile`: record under the paper's profiling condition."""

from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import JsonOption, RecordingOutput
from chainshaper.cli.record import (
    BufferOption,
    CommandArgument,
    DurationOption,
    SourceOption,
    record_and_show,
)
from chainshaper.values.errors import InputError

__all__ = ["profile"]


def profile(
    output: RecordingOutput,
    command: CommandArgument = None,
    chain: Annotated[
        str | None,
        typer.Option(
            metavar="FIRST..LAST",
            help="The chain whose nodes get the priority; --like tells which those are.",
        ),
    ] = None,
    like: Annotated[
        Path | None,
        typer.Option(
            metavar="REC",
            help="An earlier recording of the application: it knows the chain's nodes, components "
            "of containers, and executors with several threads.",
        ),
    ] = None,
    node: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A node that gets the priority (may be repeated). Default: the chain's, or all.",
        ),
    ] = None,
    core: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Where executors run. Default: the last core. DDS threads run on the others.",
        ),
    ] = None,
    source: SourceOption = "lttng",
    duration: DurationOption = None,
    buffer: BufferOption = None,
    json: JsonOption = False,
) -> None:
    """Record with the chain's threads under SCHED_FIFO, DDS threads on another core.

    This is how the latencies are measured that a plan is computed from. Whatever ends it, all
    threads are as before. What happened before the priorities were in force is left out.
    """
    from chainshaper.flow.profiling import chain_nodes, check_profiling, profiling_condition
    from chainshaper.linux.own_processes import check_command
    from chainshaper.sources import open_source
    from chainshaper.values.recording import refuse_existing

    if not command:
        raise InputError("no command given: `chainshaper profile -o REC -- ros2 launch …`")
    if chain is not None and like is None and not node:
        raise InputError(
            f"which nodes {chain} has, an earlier recording knows: name it with --like REC "
            "(`chainshaper record`), or name the nodes with --node"
        )
    refuse_existing(output)
    check_command(command)
    core = check_profiling(core)
    names = [f"/{name.strip('/')}" for name in node or ()]
    earlier = None if like is None else open_source(like)
    if earlier is not None and chain is not None:
        names += chain_nodes(earlier, chain)
    condition = profiling_condition(names, core, like=earlier)
    record_and_show(
        *(output, command, source, duration, buffer),
        json=json,
        chain=chain,
        scheduling=condition,
        watch_stalls=True,
    )
