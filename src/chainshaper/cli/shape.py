"""`chainshaper shape`: run an application with its output shaped, live or launched by ROS 2."""

import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from chainshaper.cli.options import (
    ChainOption,
    CyclesOption,
    JsonOption,
    RealtimeOption,
    UsersOption,
    duration_option,
)
from chainshaper.cli.plan_options import (
    BandsOption,
    DepthOption,
    EpsilonOption,
    FallbackOption,
    IdealMachineOption,
    MessagesOption,
    ModesOption,
    OverrunOption,
    ReceiversOption,
    modes_of,
)
from chainshaper.cli.record import Source, SourceOption
from chainshaper.cli.splice import NodeKind
from chainshaper.values.errors import InputError

if TYPE_CHECKING:
    from chainshaper.analysis import ChainEnumeration
    from chainshaper.flow.launch_shaping import ShapedLaunch
    from chainshaper.planning import PlanRequest
    from chainshaper.values.application import ApplicationGraph

__all__ = ["shape"]

DESCRIPTIONS = (".yaml", ".yml")
DURATION_NS = 60_000_000_000


def shape(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="APP.yaml plan.yaml | -- ros2 launch ...",
            help="A described application and the plan in force; or what launches a real one, "
            "which is then measured and planned first.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="REC",
            help="Folder for the recording; of a launched application, for everything.",
            show_default=False,
        ),
    ],
    cycles: CyclesOption = 320,
    realtime: RealtimeOption = None,
    chain: ChainOption = None,
    duration: Annotated[
        int | None,
        duration_option("--duration", "How long to measure, before and after. Default: 60s."),
    ] = None,
    source: SourceOption = "lttng",
    node: Annotated[
        NodeKind,
        typer.Option(help="A script; a package for all types; or one generated for the type."),
    ] = "python",
    backend: Annotated[
        str, typer.Option("--backend", metavar="NAME", help="As for `chainshaper apply`.")
    ] = "auto",
    bands: BandsOption = "1",
    modes: ModesOption = None,
    epsilon: EpsilonOption = None,
    ideal_machine: IdealMachineOption = False,
    overrun: OverrunOption = None,
    messages: MessagesOption = "all-in-order",
    depth: DepthOption = None,
    receivers: ReceiversOption = True,
    fallback: FallbackOption = None,
    user: UsersOption = None,
    json: JsonOption = False,
) -> None:
    """Run an application with its output shaped as planned, and record it.

    The publisher's output topic is remapped, and the shaping node republishes it in its slots.
    Behind `--`, `ros2 launch` does the whole flow: record, choose a chain, profile, plan, splice,
    apply, record again, compare. Every file in between is kept; --chain, --duration, --source,
    --node, --backend, --bands, --modes, --epsilon, --ideal-machine, --overrun, --messages, --depth,
    --no-receivers, --fallback and --user are for this, and mean what they mean for
    `chainshaper plan` and `apply`.
    """
    if len(words) == 2 and words[0].endswith(DESCRIPTIONS):
        _shape_described(Path(words[0]), Path(words[1]), output, cycles, realtime)
        return
    if Path(words[0]).suffix in DESCRIPTIONS:
        raise InputError(
            "a described application is shaped with its plan, and nothing else: `chainshaper shape "
            "APP.yaml plan.yaml -o REC`"
        )
    from chainshaper.planning import PlanRequest

    _shape_launched(
        words,
        output,
        chain=chain,
        duration_ns=duration or DURATION_NS,
        source=source,
        node=node,
        back_end=backend,
        request=PlanRequest(
            bands="auto" if bands == "auto" else int(bands),
            modes=modes_of(modes, None),
            epsilon_ns=epsilon,
            ideal_machine=ideal_machine,
            overrun=overrun,
            messages=messages,
            depth=depth,
            with_receivers=receivers,
            fallback=fallback or "bypass",
        ),
        users=user or (),
        json=json,
    )


def _shape_described(
    application: Path, plan: Path, output: Path, cycles: int, realtime: bool | None
) -> None:
    from chainshaper.cli.output import notes, progress, show_line
    from chainshaper.flow.steps import shape_application
    from chainshaper.planning import load_plan, plan_warnings
    from chainshaper.verify.overruns import dropped_in, dropped_text, overruns_in, overruns_text
    from chainshaper.workload.description import load_application

    description, planned = load_application(application), load_plan(plan)
    notes(plan_warnings(planned))
    with progress(f"shaping {description.name}") as report:
        recording = shape_application(
            description,
            planned,
            output,
            cycles=cycles,
            realtime=realtime,
            command=sys.argv,
            progress=report,
        )
    overruns = overruns_in(recording, planned)
    if overruns:
        notes([overruns_text(overruns)])
    dropped = dropped_in(recording)
    if dropped:
        notes([dropped_text(dropped)])
    notes(recording.info.notes)
    show_line(str(recording.path))


def _shape_launched(
    command: list[str],
    folder: Path,
    *,
    chain: str | None,
    duration_ns: int,
    source: Source,
    node: NodeKind,
    back_end: str,
    request: "PlanRequest",
    users: Sequence[str],
    json: bool,
) -> None:
    from chainshaper.cli.output import notes, print_json, stage_lines
    from chainshaper.cli.signals import stop_on_signals
    from chainshaper.flow.launch_shaping import shape_launch
    from chainshaper.planning import plan_warnings
    from chainshaper.reporting.latency import comparison_json

    stop = threading.Event()
    with stop_on_signals(stop):
        shaped = shape_launch(
            command,
            folder,
            chain=chain,
            choose=_ask if sys.stdin.isatty() and not json else None,
            request=request,
            duration_ns=duration_ns,
            source=source,
            node=node,
            back_end=back_end,
            users=users,
            stop=stop,
            planned=lambda plan: notes(plan_warnings(plan)),
            progress=stage_lines("shape"),
        )
    if json:
        print_json(comparison_json(shaped.comparison) | {"folder": str(shaped.folder)})
    else:
        _show(shaped)


def _show(shaped: "ShapedLaunch") -> None:
    from chainshaper.cli.output import notes, show, show_line
    from chainshaper.reporting.latency import comparison_table, prediction_table

    held = [one.held for one in shaped.comparison.measurements]
    show(
        comparison_table(shaped.comparison),
        *(prediction_table(one) for one in held if one is not None),
    )
    notes(shaped.notes)
    show_line(str(shaped.folder))


def _ask(graph: "ApplicationGraph", found: "ChainEnumeration") -> str:
    from chainshaper.cli.output import show
    from chainshaper.reporting.recordings import chain_table
    from chainshaper.values.safe_text import shown

    show(chain_table(graph, found))
    default = (found.heaviest or found.chains[0]).spec
    question = f"Which chain, FIRST..LAST? [{shown(default)}]"
    return str(typer.prompt(question, default=default, show_default=False, err=True))
