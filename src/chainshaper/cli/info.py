"""`chainshaper info`: what is in a recording or a trace."""

from chainshaper.cli.options import JsonOption, TraceArgument

__all__ = ["info"]


def info(trace: TraceArgument, json: JsonOption = False) -> None:
    """Show what is in a trace: events, losses, clock, distribution, RMW, hosts, processes."""
    from chainshaper.cli.output import late_progress, notes, print_json, show, show_line
    from chainshaper.flow.exploration import lost_events
    from chainshaper.reporting.recordings import contents_json, contents_table
    from chainshaper.sources import open_source

    with late_progress("info") as report:
        opened = open_source(*trace, progress=report, overview=True)
        result = contents_json(opened)
    if json:
        print_json(result)
        return
    show(*contents_table(opened))
    show_line(lost_events(opened.info))
    notes(result["notes"])
