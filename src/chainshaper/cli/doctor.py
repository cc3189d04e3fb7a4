"""`chainshaper doctor`: what this machine can do, and how badly it stalls."""

from typing import Annotated

from chainshaper.cli.options import JsonOption, duration_option

__all__ = ["doctor"]


def doctor(
    watch: Annotated[
        int, duration_option("--watch", "How long to watch for stalls of the machine.")
    ] = "5s",  # type: ignore[assignment]
    json: JsonOption = False,
) -> None:
    """Examine this machine: scheduling, privileges, tracing, DDS, and its own stalls."""
    from chainshaper.cli.output import print_json, progress, show
    from chainshaper.flow.doctor import examine_machine
    from chainshaper.reporting.recordings import machine_json, machine_tables

    with progress("examining this machine") as report:
        report(0.0, "watching for stalls")
        found = examine_machine(watch)
    if json:
        print_json(machine_json(found))
        return
    show(*machine_tables(found))
