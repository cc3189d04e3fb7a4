"""`chainshaper status`: the plans in force on this machine."""

from chainshaper.cli.options import JsonOption

__all__ = ["status"]


def status(json: JsonOption = False) -> None:
    """Show the plans in force: back end, servers, counters, and runs that crashed."""
    from chainshaper.cli.output import print_json, show, show_line
    from chainshaper.enforcement.runs.state import find_runs, runs_as_json
    from chainshaper.reporting.servers import runs_table, servers_table

    if json:
        print_json(runs_as_json())
        return
    runs = list(find_runs())
    if not runs:
        show_line("no plan is in force")
        return
    show(runs_table(runs), *(servers_table(state) for _, state in runs if state is not None))
