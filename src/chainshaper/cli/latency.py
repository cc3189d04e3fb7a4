"""`chainshaper latency`: the end-to-end latency of a chain in a recording."""

from typing import Annotated

import typer

from chainshaper.cli.options import ChainOption, JsonOption, RecordingArgument
from chainshaper.errors import InputError

__all__ = ["latency"]


def latency(
    recording: RecordingArgument,
    chain: ChainOption = None,
    json: JsonOption = False,
    instances: Annotated[
        bool, typer.Option("--instances", help="With --json: every traversal, one by one.")
    ] = False,
) -> None:
    """Show the end-to-end latency of a chain: average, maximum, jitter, percentiles.

    Each traversal is followed from the start of the first callback to the publication of the
    last topic, message by message.
    """
    from chainshaper.cli.output import notes, print_json, show, show_line
    from chainshaper.reporting.tables import latency_json, latency_table
    from chainshaper.steps import measure_latency

    if instances and not json:
        raise InputError("--instances goes with --json: add it")
    measurement = measure_latency(recording, chain)
    if json:
        print_json(latency_json(measurement, instances=instances))
        return
    analysis = measurement.analysis
    show(latency_table(analysis))
    counts = f"{analysis.statistics.disturbed} cycles disturbed by the machine"
    if analysis.incomplete:
        reasons = ", ".join(f"{count} {reason}" for reason, count in analysis.incomplete.items())
        counts += f"; incomplete: {reasons}"
    if measurement.overruns:
        counts += f"; {measurement.overruns} outputs were too late for their slot"
    show_line(counts)
    notes(analysis.notes)
