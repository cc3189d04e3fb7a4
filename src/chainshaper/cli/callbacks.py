"""`chainshaper callbacks`: execution and response times of every callback."""

from chainshaper.cli.options import JsonOption, TraceArgument

__all__ = ["callbacks"]


def callbacks(trace: TraceArgument, json: JsonOption = False) -> None:
    """Show every callback of a recording or trace: kind, count, execution and response time."""
    from chainshaper.analysis import callback_statistics, data_flow
    from chainshaper.cli.output import late_progress, notes, print_json, show, show_line
    from chainshaper.flow.exploration import lost_events
    from chainshaper.reporting.recordings import callback_rows, callback_table
    from chainshaper.sources import open_source

    with late_progress("callbacks") as report:
        opened = open_source(*trace, progress=report)
        flow = data_flow(opened.events, opened.info.clock_offset_ns)
        statistics = callback_statistics(flow)
    if json:
        print_json(callback_rows(statistics))
        if any(opened.info.lost.values()):  # the array has no place for it
            notes([lost_events(opened.info)])
        return
    show(callback_table(statistics))
    show_line(lost_events(opened.info))
    notes((*opened.info.notes, *flow.notes))
