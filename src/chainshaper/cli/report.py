"""`chainshaper report`: everything about a chain in one HTML page."""

from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import ChainOption, JsonOption, PlanInForceOption

__all__ = ["report"]


def report(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="REC...", help="Recordings' or LTTng traces' folders.")
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE.html", help="File to write; must not exist."),
    ],
    chain: ChainOption = None,
    plan: PlanInForceOption = None,
    cycles: Annotated[
        list[int] | None,
        typer.Option(
            "--cycle",
            metavar="N",
            min=0,
            help="A cycle that the timeline has to show, where there are too many to show all. "
            "May be given several times.",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write one self-contained HTML page about a chain, usually before and after shaping.

    It has the figures, latency over time, histogram and distribution, the hops, the callbacks, a
    timeline of single cycles, overruns, stalls, the plan, and how all of it was recorded. The page
    needs no network.
    """
    from chainshaper.cli.output import late_progress, print_json, show_line
    from chainshaper.planning import load_plan
    from chainshaper.reporting.latency import comparison_json
    from chainshaper.reporting.page import ENDINGS, write_report
    from chainshaper.sources import open_source
    from chainshaper.values.whole_file import new_file
    from chainshaper.verify.measure import Comparison, measure_latency

    new_file(output, ENDINGS)
    in_force = None if plan is None else load_plan(plan)
    measurements = []
    with late_progress("report") as progress:
        for number, path in enumerate(recordings, start=1):
            progress((number - 1) / (len(recordings) + 1), f"analysing {path}")
            used = in_force if number == len(recordings) else None
            measurements.append(measure_latency(open_source(path), chain, used))
        progress(len(recordings) / (len(recordings) + 1), "drawing")
        written = write_report(measurements, output, cycles or ())
    if json:
        compared = Comparison(measurements[0].analysis.chain.spec, tuple(measurements))
        print_json({"report": str(written.absolute()), **comparison_json(compared)})
        return
    show_line(str(written.absolute()))
