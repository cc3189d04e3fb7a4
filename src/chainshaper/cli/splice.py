"""`chainshaper splice`: put a plan's shaping nodes into copies of launch files."""

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from chainshaper.cli.options import JsonOption
from chainshaper.errors import InputError

if TYPE_CHECKING:
    from chainshaper.launch_splicing import Splicing
    from chainshaper.planning import Plan
    from chainshaper.recording import Recording

__all__ = ["splice"]


class NodeKind(str, Enum):
    """How the shaping node is made."""

    PYTHON = "python"
    CPP = "cpp"
    TYPED = "typed"


def splice(
    plan: Annotated[
        Path | None,
        typer.Argument(metavar="plan.yaml", help="The plan.", show_default=False),
    ] = None,
    launch: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="LAUNCH... [NAME:=VALUE...]",
            help="The launch files (.py, .xml, .yaml), and launch arguments that are not at their "
            "defaults, as for `ros2 launch`.",
            show_default=False,
        ),
    ] = None,
    *,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="DIR", help="Folder for the copies.", show_default=False
        ),
    ],
    node: Annotated[
        NodeKind,
        typer.Option(help="A script; a package for all types; or one generated for the type."),
    ] = NodeKind.PYTHON,
    message_type: Annotated[
        str | None,
        typer.Option(
            "--type",
            metavar="PKG/msg/TYPE",
            help="Of the output, for --node typed. Default: what the recording says.",
            show_default=False,
        ),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            "--recording",
            metavar="REC",
            help="A recording of the application: it tells publishers and types. Default: the "
            "plan's own, where it exists.",
            show_default=False,
        ),
    ] = None,
    build: Annotated[
        bool, typer.Option("--build", help="Build the shaping node's package with colcon.")
    ] = False,
    undo: Annotated[
        bool, typer.Option("--undo", help="Remove DIR again, unless it was changed since.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Edit copies of launch files: the output is remapped, and a shaping node republishes it.

    Shows a diff. Launch the copy that it names; the originals stay as they are.
    """
    from chainshaper.cli.output import print_json, show_line
    from chainshaper.launch_splicing import splice_launch_files, undo_splice
    from chainshaper.planning import load_plan

    if undo:
        undo_splice(output)
        if json:
            print_json({"removed": str(output)})
        else:
            show_line(f"{output} is removed")
        return
    arguments = dict(word.split(":=", 1) for word in launch or [] if ":=" in word)
    files = [word for word in launch or [] if ":=" not in word]
    if plan is None or not files:
        raise InputError("give a plan and the launch files: `splice plan.yaml LAUNCH... -o DIR`")
    if build and node is NodeKind.PYTHON:
        raise InputError("--node python needs no building: leave out --build, or choose another")
    planned = load_plan(plan)
    splicing = splice_launch_files(
        planned,
        files,
        output,
        node=node.value,
        arguments=arguments,
        message_type=message_type,
        recording=_opened(planned, recording),
    )
    setup = _built(splicing) if build else None
    _print(splicing, setup, json)


def _opened(plan: "Plan", recording: Path | None) -> "Recording | None":
    if recording is None:
        own = Path(plan.evidence.recording or "")
        if not plan.evidence.recording or not own.is_dir():
            return None
        recording = own
    from chainshaper.sources import open_source

    return open_source(recording)


def _built(splicing: "Splicing") -> Path:
    from chainshaper.splicing.generated_package import build_package
    from chainshaper.splicing.launch_folder import NODES

    return build_package(splicing.folder / NODES)


def _print(splicing: "Splicing", setup: Path | None, json: bool) -> None:
    from chainshaper.cli.output import notes, print_json, show_line

    if json:
        print_json(_values(splicing, setup))
        return
    show_line(splicing.diff.rstrip("\n"))
    notes(splicing.notes)
    if setup is not None:
        show_line(f"source {setup}")
    for copy in splicing.launch.values():
        show_line(f"ros2 launch {copy}")


def _values(splicing: "Splicing", setup: Path | None) -> dict[str, Any]:
    return {
        "folder": str(splicing.folder),
        "launch": {str(file): str(copy) for file, copy in splicing.launch.items()},
        "originals": {str(copy): str(file) for copy, file in splicing.originals.items()},
        "shaping_nodes": [process.name for process in splicing.processes],
        "logs": [str(log) for log in splicing.logs],
        "setup": None if setup is None else str(setup),
        "diff": splicing.diff,
        "notes": list(splicing.notes),
    }
