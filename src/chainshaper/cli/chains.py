"""`chainshaper chains`: which computation chains there are."""

from typing import Annotated

import typer

from chainshaper.cli.options import JsonOption, TraceArgument

__all__ = ["chains"]


def chains(
    trace: TraceArgument,
    start: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="X",
            help="Topic or node where they begin. Default: callbacks that nothing triggers.",
        ),
    ] = None,
    end: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="Y",
            help="Topic or node where they end. Default: topics from which nothing goes on.",
        ),
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="How many to list.")] = 100,
    json: JsonOption = False,
) -> None:
    """List the computation chains, count them, and show the heaviest.

    The heaviest chain has the largest sum of its callbacks' mean response times.
    """
    from chainshaper.analysis import data_flow, graph_of
    from chainshaper.cli.output import late_progress, notes, print_json, show, show_line
    from chainshaper.flow.exploration import list_chains, lost_events
    from chainshaper.reporting.recordings import chain_table, chains_json, count_text
    from chainshaper.sources import open_source

    with late_progress("chains") as report:
        opened = open_source(*trace, progress=report)
        flow = data_flow(opened.events, opened.info.clock_offset_ns)
        report(0.9, "searching chains")
        graph = graph_of(flow)
        found = list_chains(flow, start, end, limit)
    if json:
        lost = {"lost": opened.info.lost, "notes": [*opened.info.notes, *flow.notes]}
        print_json({**chains_json(graph, found), **lost})
        return
    show(chain_table(graph, found))
    show_line(f"{count_text(found)}; {lost_events(opened.info)}")
    notes((*opened.info.notes, *flow.notes))
