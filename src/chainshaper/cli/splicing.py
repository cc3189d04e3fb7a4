"""`chainshaper splice`: start shaping nodes, or throttlers, together with launch files."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chainshaper.cli.options import JSON, NODE, NodeKind, argument, option, wish
from chainshaper.cli.output import notes, print_json, show_line
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Fallback

if TYPE_CHECKING:
    from chainshaper.flow.launch_splicing import Splicing, ThrottledInput
    from chainshaper.planning import Plan
    from chainshaper.values.recording import Recording


def splice(
    plan: Path | None = argument(None, "plan.yaml", "The plan; none with --throttle."),
    launch: list[str] | None = argument(
        None,
        "LAUNCH... [NAME:=VALUE...]",
        "The launch files (.py, .xml, .yaml) and, for --dry-run, launch arguments; or, behind --, "
        "a `ros2 run …`.",
    ),
    *,
    output: Path = option(..., "--output -o DIR", "Folder for the launch file."),
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
    dry_run: bool = option(
        False,
        "--dry-run",
        "Write nothing, and show what would be redirected: the launch files are carried out in "
        "this ROS 2 environment, but no process is started.",
    ),
    undo: bool = option(False, "--undo", "Remove DIR again, unless it was changed since."),
    json: bool = JSON,
) -> None:
    """Write a launch file that includes yours, starts a shaping node, and redirects the output.

    With --throttle an input is redirected, and a throttler republishes it once a period; do this
    first, then record and plan, and splice the plan into its launch file. Launch the file that it
    names, with your launch arguments; your launch files stay as they are.
    """
    from chainshaper.flow.launch_splicing import undo_splice
    from chainshaper.splicing.shaping_process import build_package, check_build_tools
    from chainshaper.splicing.spliced_launch import NODES

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
    words = [*([str(plan)] if throttle and plan is not None else []), *(launch or [])]
    ran = words[:2] == ["ros2", "run"]
    arguments = {} if ran else dict(word.split(":=", 1) for word in words if ":=" in word)
    files = words if ran else [word for word in words if ":=" not in word]
    common: dict[str, Any] = {"launch_files": files, "output": output, "node": node}
    common |= {"arguments": arguments, "dry_run": dry_run}
    if throttle:
        if fallback is not None:
            raise InputError("a throttler has no fallback: --fallback goes with a plan")
        if message_type is not None or node == "typed":
            raise InputError(
                "a throttler is for all types: choose --node python or cpp, and no --type"
            )
        splicing = _throttled(throttle, recording, common)
    elif plan is None or not files:
        raise InputError("give a plan and the launch files: `splice plan.yaml LAUNCH... -o DIR`")
    else:
        common |= {"message_type": message_type, "fallback": fallback}
        splicing = _shaped(plan, recording, common)
    setup = build_package(splicing.folder / NODES) if build and not dry_run else None
    if json:
        print_json(_values(splicing, setup))
        return
    _show(splicing, arguments, setup)


def _shaped(plan: Path, recording: Path | None, common: dict[str, Any]) -> "Splicing":
    from chainshaper.flow.launch_splicing import splice_launch_files
    from chainshaper.planning import load_plan, plan_warnings

    planned = load_plan(plan)
    notes(plan_warnings(planned))
    known = _opened(recording or _own_recording(planned))
    return splice_launch_files(planned, recording=known, **common)


def _throttled(inputs: list[str], recording: Path | None, common: dict[str, Any]) -> "Splicing":
    from chainshaper.flow.launch_splicing import splice_throttlers

    if not common["launch_files"]:
        raise InputError("give the launch files: `splice --throttle TOPIC=PERIOD LAUNCH... -o DIR`")
    parsed = [_input(text) for text in inputs]
    return splice_throttlers(parsed, recording=_opened(recording), **common)


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


def _own_recording(plan: "Plan") -> Path | None:
    own = Path(plan.evidence.recording or "")
    return own if plan.evidence.recording and own.is_dir() else None


def _opened(recording: Path | None) -> "Recording | None":
    if recording is None:
        return None
    from chainshaper.sources import open_source

    return open_source(recording)


def _show(splicing: "Splicing", arguments: dict[str, str], setup: Path | None) -> None:
    for one in splicing.redirects:
        verb = "publishes" if one.kind == "publisher" else "subscribes to"
        for node in one.nodes:
            show_line(f"{node} {verb} {one.target} in place of {one.topic}, for {one.added[0]}")
    for found in splicing.redirected:
        for started in found["redirected"]:
            show_line(f"would add to {started['as']}: {' '.join(started['rules']) or 'nothing'}")
    notes(splicing.notes)
    if splicing.redirected:
        return
    if setup is not None:
        show_line(f"source {setup}")
    words = [f"{name}:={value}" for name, value in arguments.items()]
    for file in dict.fromkeys(splicing.launch.values()):
        show_line(shlex.join(["ros2", "launch", str(file), *words]))


def _values(splicing: "Splicing", setup: Path | None) -> dict[str, Any]:
    return {
        "folder": str(splicing.folder),
        "launch": {str(file): str(copy) for file, copy in splicing.launch.items()},
        "originals": {str(copy): str(file) for copy, file in splicing.originals.items()},
        "nodes": [process.name for process in splicing.processes],
        "standbys": [one.standby.name for one in splicing.processes if one.standby is not None],
        "logs": [str(log) for log in splicing.logs],
        "setup": None if setup is None else str(setup),
        "redirected": [dict(one) for one in splicing.redirected],
        "diff": splicing.diff,
        "notes": list(splicing.notes),
    }
