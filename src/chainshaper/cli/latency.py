"""`chainshaper latency`: the end-to-end latency of a chain in a recording or a trace."""

from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import ChainOption, JsonOption, TraceArgument
from chainshaper.values.errors import InputError

__all__ = ["latency"]


def latency(
    trace: TraceArgument,
    chain: ChainOption = None,
    chains: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A CARET architecture file: --chain then names one of its named_paths.",
        ),
    ] = None,
    json: JsonOption = False,
    instances: Annotated[
        bool, typer.Option("--instances", help="With --json: every traversal, one by one.")
    ] = False,
) -> None:
    """Show the end-to-end latency of a chain: average, maximum, jitter, percentiles.

    Each traversal is followed from the start of the first callback to the publication of the
    last topic, message by message. A second table shows in which hop the time went.
    """
    from chainshaper.cli.output import late_progress, notes, print_json, show, show_line
    from chainshaper.flow.exploration import lost_events, named_chain
    from chainshaper.reporting.latency import (
        breakdown_json,
        breakdown_table,
        latency_json,
        latency_table,
    )
    from chainshaper.sources import open_source
    from chainshaper.verify.measure import measure_latency
    from chainshaper.verify.overruns import dropped_text, overruns_text

    if instances and not json:
        raise InputError("--instances goes with --json: add it")
    if chains is not None:
        chain = named_chain(chains, chain)
    with late_progress("latency") as report:
        opened = open_source(*trace, progress=report)
        measurement = measure_latency(opened, chain)
    analysis = measurement.analysis
    if json:
        found = latency_json(measurement, instances=instances)
        print_json({**found, **breakdown_json(analysis)})
        return
    show(latency_table(measurement), breakdown_table(analysis))
    counts = f"{analysis.statistics.disturbed} cycles disturbed by the machine"
    if measurement.longest_stall_ns is None:
        counts = "stalls of the machine not watched"
    if analysis.incomplete:
        reasons = ", ".join(f"{count} {reason}" for reason, count in analysis.incomplete.items())
        counts += f"; incomplete: {reasons}"
    if measurement.overruns:
        counts += f"; {overruns_text(measurement.overruns)}"
    if measurement.dropped:
        counts += f"; {dropped_text(measurement.dropped)}"
    show_line(f"{counts}; {lost_events(opened.info)}")
    notes(analysis.notes)
