"""`chainshaper splice`: put shaping nodes, or throttlers, into copies of launch files."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from chainshaper.cli.options import JSON, NODE, NodeKind, argument, option, wish
from chainshaper.cli.output import notes, print_json, show_line
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Fallback

if TYPE_CHECKING:
    from chainshaper.flow.launch_splicing import Splicing, ThrottledInput
    from chainshaper.values.recording import Recording


class _Launched(NamedTuple):
    """What is launched, and into what its copies are edited, whichever node is put in."""

    files: list[str]
    arguments: dict[str, str]
    folder: Path
    node: NodeKind
    message_type: str | None
    recording: Path | None
    fallback: Fallback | None


def splice(
    plan: Path | None = argument(None, "plan.yaml", "The plan; none with --throttle."),
    launch: list[str] | None = argument(
        None,
        "LAUNCH... [NAME:=VALUE...]",
        "The launch files (.py, .xml, .yaml), and launch arguments that are not at their "
        "defaults, as for `ros2 launch`.",
    ),
    *,
    output: Path = option(..., "--output -o DIR", "Folder for the copies."),
    throttle: list[str] | None = option(
        None,
        "--throttle [NODE:]TOPIC=PERIOD",
        "Instead of a plan: a throttler before an input that is not quite periodic, for "
        "NODE or whoever subscribes in the recording (may be repeated).",
    ),
    node: NodeKind = NODE,
    message_type: str | None = option(
        None,
        "--type PKG/msg/TYPE",
        "Of the output, for --node typed. Default: what the recording says.",
    ),
    recording: Path | None = option(
        None,
        "--recording REC",
        "A recording of the application: it tells publishers, subscribers and types. "
        "Default: the plan's own, where it exists.",
    ),
    fallback: Fallback | None = wish("fallback", default=None),
    build: bool = option(False, "--build", "Build the shaping node's package with colcon."),
    undo: bool = option(False, "--undo", "Remove DIR again, unless it was changed since."),
    json: bool = JSON,
) -> None:
    """Edit copies of launch files: the output is remapped, and a shaping node republishes it.

    With --throttle an input is, and a throttler republishes it once a period; do this first, then
    record and plan, and splice the plan into the copy. Shows a diff. Launch the copy that it names;
    the originals stay as they are.
    """
    from chainshaper.flow.launch_splicing import undo_splice
    from chainshaper.splicing.generated_package import build_package, check_build_tools
    from chainshaper.splicing.launch.folder import NODES

    if undo:
        undo_splice(output)
        if json:
            print_json({"removed": str(output)})
        else:
            show_line(f"{output} is removed")
        return
    if build and node == "python":
        raise InputError("--node python needs no building: leave out --build, or choose another")
    if build:
        check_build_tools()  # before anything is written
    words = launch or []
    if throttle:
        words = [*([] if plan is None else [str(plan)]), *words]
    arguments = dict(word.split(":=", 1) for word in words if ":=" in word)
    files = [word for word in words if ":=" not in word]
    launched = _Launched(files, arguments, output, node, message_type, recording, fallback)
    if throttle:
        splicing = _throttled(throttle, launched)
    elif plan is None or not files:
        raise InputError("give a plan and the launch files: `splice plan.yaml LAUNCH... -o DIR`")
    else:
        splicing = _shaped(plan, launched)
    setup = build_package(splicing.folder / NODES) if build else None
    _print(splicing, setup, json)


def _shaped(plan: Path, launched: _Launched) -> "Splicing":
    from chainshaper.flow.launch_splicing import splice_launch_files
    from chainshaper.planning import load_plan, plan_warnings

    planned = load_plan(plan)
    notes(plan_warnings(planned))
    own = planned.evidence.recording
    known = Path(own) if own and Path(own).is_dir() else None
    return splice_launch_files(
        *(planned, launched.files, launched.folder),
        node=launched.node,
        arguments=launched.arguments,
        message_type=launched.message_type,
        recording=_opened(launched.recording or known),
        fallback=launched.fallback,
    )


def _throttled(inputs: list[str], launched: _Launched) -> "Splicing":
    from chainshaper.flow.launch_splicing import splice_throttlers

    if launched.fallback is not None:
        raise InputError("a throttler has no fallback: --fallback goes with a plan")
    if launched.node == "typed" or launched.message_type is not None:
        raise InputError("a throttler is for all types: choose --node python or cpp, and no --type")
    if not launched.files:
        raise InputError("give the launch files: `splice --throttle TOPIC=PERIOD LAUNCH... -o DIR`")
    return splice_throttlers(
        *([_input(text) for text in inputs], launched.files, launched.folder),
        node=launched.node,
        arguments=launched.arguments,
        recording=_opened(launched.recording),
    )


def _input(text: str) -> "ThrottledInput":
    """One input to be throttled, as it is written: ``/fusion:/points_raw=100ms``."""
    from chainshaper.flow.launch_splicing import ThrottledInput
    from chainshaper.values.durations import parse_duration
    from chainshaper.values.yaml_file import wrong_values_refused

    where, equals, period = text.rpartition("=")
    if not equals:
        raise InputError(f"--throttle {text}: write a topic and a period: /points_raw=100ms")
    node, _, topic = where.rpartition(":")
    with wrong_values_refused(ThrottledInput):
        return ThrottledInput(
            topic=topic, period_ns=parse_duration(period), subscriber=node or None
        )


def _opened(recording: Path | None) -> "Recording | None":
    if recording is None:
        return None
    from chainshaper.sources import open_source

    return open_source(recording)


def _print(splicing: "Splicing", setup: Path | None, json: bool) -> None:
    if json:
        print_json(
            {
                "folder": str(splicing.folder),
                "launch": {str(file): str(copy) for file, copy in splicing.launch.items()},
                "originals": {str(copy): str(file) for copy, file in splicing.originals.items()},
                "nodes": [one.name for one in splicing.processes],
                "standbys": [one.standby.name for one in splicing.processes if one.standby],
                "logs": [str(log) for log in splicing.logs],
                "setup": None if setup is None else str(setup),
                "diff": splicing.diff,
                "notes": list(splicing.notes),
            }
        )
        return
    show_line(splicing.diff.rstrip("\n").expandtabs())
    notes(splicing.notes)
    if setup is not None:
        show_line(f"source {setup}")
    for copy in splicing.launch.values():
        show_line(f"ros2 launch {copy}")
