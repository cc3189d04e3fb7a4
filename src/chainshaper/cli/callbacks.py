"""`chainshaper callbacks`: execution and response times of every callback."""

from chainshaper.cli.options import JsonOption, RecordingArgument

__all__ = ["callbacks"]


def callbacks(recording: RecordingArgument, json: JsonOption = False) -> None:
    """Show every callback of a recording: kind, count, execution time, response time."""
    from chainshaper.analysis import callback_statistics, data_flow
    from chainshaper.cli.output import notes, print_json, show
    from chainshaper.reporting.tables import callback_rows, callback_table
    from chainshaper.sources import open_source

    opened = open_source(recording)
    flow = data_flow(opened.events, opened.info.clock_offset_ns)
    statistics = callback_statistics(flow)
    if json:
        print_json(callback_rows(statistics))
        return
    show(callback_table(statistics))
    notes((*opened.info.notes, *flow.notes))
