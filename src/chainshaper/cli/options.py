"""Options that several verbs share."""

from pathlib import Path
from typing import Annotated, Any

import typer

from chainshaper.values.errors import InputError

__all__ = [
    "ApplicationArgument",
    "ChainOption",
    "CyclesOption",
    "JsonOption",
    "PlanInForceOption",
    "RealtimeOption",
    "RecordingOutput",
    "TraceArgument",
    "UsersOption",
    "duration_option",
]

JsonOption = Annotated[bool, typer.Option("--json", help="Print the figures as JSON (integer ns).")]
ChainOption = Annotated[
    str | None,
    typer.Option(
        "--chain",
        metavar="FIRST..LAST",
        help="The chain, by topics or nodes: /t1../t5. Default: the one the recording names.",
    ),
]
PlanInForceOption = Annotated[
    Path | None,
    typer.Option(
        "--plan",
        metavar="plan.yaml",
        help="The plan that the last recording was made with, where it does not say so.",
    ),
]
TraceArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="TRACE...",
        help="An LTTng trace's folder (several of one trace: kernel and user space), or a "
        "recording's.",
    ),
]
ApplicationArgument = Annotated[
    Path, typer.Argument(metavar="APP.yaml", help="The application's description.")
]
RecordingOutput = Annotated[
    Path, typer.Option("--output", "-o", metavar="REC", help="Folder to write; must not exist.")
]
CyclesOption = Annotated[int, typer.Option("--cycles", min=1, help="Cycles to record.")]
RealtimeOption = Annotated[
    bool | None,
    typer.Option(
        "--realtime/--no-realtime", help="Use SCHED_FIFO. Default: where it is permitted."
    ),
]
UsersOption = Annotated[
    list[str] | None,
    typer.Option(
        "--user",
        metavar="NAME",
        help="Whose processes are taken for nodes (may be repeated). Default: yours, also behind "
        "sudo, and root's.",
    ),
]


def _parse(text: str) -> int:
    from chainshaper.values.durations import parse_duration

    try:
        value = parse_duration(text)
    except InputError as error:
        raise typer.BadParameter(str(error)) from error
    if value < 0:
        raise typer.BadParameter(f"{text} is negative")
    return value


def duration_option(name: str, help_text: str, panel: str | None = None) -> Any:
    """An option that takes a duration with a unit and gives nanoseconds."""
    return typer.Option(
        name, help=help_text, metavar="DURATION", parser=_parse, rich_help_panel=panel
    )
