"""`chainshaper record`: trace an application that runs, or that a command starts."""

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import typer

from chainshaper.cli.options import JsonOption, RecordingOutput, UsersOption, duration_option
from chainshaper.cli.signals import stop_on_signals
from chainshaper.values.errors import InputError, OperationError

if TYPE_CHECKING:
    from chainshaper.flow.record import Scheduling

__all__ = [
    "BufferOption",
    "CommandArgument",
    "DurationOption",
    "Source",
    "SourceOption",
    "record",
    "record_and_show",
]

MIB = 1 << 20
STDERR = 2


Source: TypeAlias = Literal["lttng", "ebpf"]

CommandArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[-- COMMAND…]",
        help="Starts the application, such as `ros2 launch …`; ended with the recording.",
    ),
]
SourceOption = Annotated[Source, typer.Option("--source", help="Who records the events.")]
DurationOption = Annotated[
    int | None,
    duration_option(
        "--duration", "How long to record. Default: until the application ends, or Ctrl-C."
    ),
]
BufferOption = Annotated[
    int | None,
    typer.Option(
        "--buffer",
        metavar="MIB",
        min=1,
        help="LTTng's buffer of each core, in MiB, for when events were lost. Default: 4.",
    ),
]


def record(
    output: RecordingOutput,
    command: CommandArgument = None,
    source: SourceOption = "lttng",
    duration: DurationOption = None,
    pid: Annotated[
        list[int] | None,
        typer.Option(
            help="Attach to this process and what it has started (ebpf; may be repeated). "
            "Default, without a COMMAND: everything of the users that looks like ROS 2."
        ),
    ] = None,
    user: UsersOption = None,
    buffer: BufferOption = None,
    watch_stalls: Annotated[
        bool,
        typer.Option(
            "--watch-stalls",
            help="Have a sleeper on every core notice when the machine itself stands still.",
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Record a ROS 2 application: its events, nodes, threads and QoS.

    Starts tracing, then the COMMAND, and ends both with Ctrl-C, after --duration, or when the
    application ends by itself. The application is neither changed nor recompiled.
    """
    if command and pid:
        raise InputError("a COMMAND is started, --pid attaches to what runs: give one of them")
    if not command and source == "lttng":
        raise InputError(
            "no command given: `chainshaper record -o REC -- ros2 launch …`; to attach to what "
            "runs already, add `--source ebpf`"
        )
    record_and_show(
        *(output, command or [], source, duration, buffer),
        json=json,
        pids=pid or [],
        users=user or [],
        watch_stalls=watch_stalls,
    )


def record_and_show(
    output: Path,
    command: list[str],
    source: Source,
    duration_ns: int | None,
    buffer_mib: int | None,
    *,
    json: bool,
    pids: list[int] | None = None,
    users: Sequence[str] = (),
    chain: str | None = None,
    scheduling: "Scheduling | None" = None,
    watch_stalls: bool = False,
) -> None:
    """Record and say what came of it.

    Raises:
        OperationError: the application failed; what was recorded until then is there.
    """
    from chainshaper.cli.output import notes, print_json, show_line, stage_lines
    from chainshaper.flow.exploration import lost_events
    from chainshaper.flow.record import record_command
    from chainshaper.linux.own_processes import end_in_words
    from chainshaper.values.recording import event_counts

    stop = threading.Event()
    with stop_on_signals(stop):
        recorded = record_command(
            output,
            command,
            source=source,
            duration_ns=duration_ns,
            pids=pids or (),
            users=users,
            buffer=buffer_mib and buffer_mib * MIB,
            chain=chain,
            scheduling=scheduling,
            watch_stalls=watch_stalls,
            command_stdout=STDERR if json else None,  # standard output is ours
            stop=stop,
            progress=stage_lines("record"),
        )
    recording = recorded.recording
    count = int(event_counts(recording)["count"].sum())
    if json:
        print_json(
            {
                "recording": str(recording.path),
                "events": count,
                "lost": recording.info.lost,
                "exit_code": recorded.exit_code,
                "notes": list(recording.info.notes),
            }
        )
    else:
        show_line(str(recording.path))
    notes((*recording.info.notes, f"{count} events; {lost_events(recording.info)}"))
    if recorded.exit_code:
        raise OperationError(
            f"the command {end_in_words(recorded.exit_code)}; what was recorded until then is in "
            f"{recording.path}"
        )
