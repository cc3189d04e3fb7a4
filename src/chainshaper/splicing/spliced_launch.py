"""The folder with the launch file that splicing writes.

It is written whole or not at all. Beside the launch file are the module that redirects topics
(:mod:`.redirection`) and the nodes that are added. A manifest, `splice.json`, names every file with
its hash, so that `splice` can replace or remove the folder while nothing in it was changed; files
that running and building leave there do not count.
"""

import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from pprint import pformat
from typing import Any

from chainshaper.splicing import redirection
from chainshaper.splicing.redirection import Redirect
from chainshaper.splicing.shaping_process import ShapingProcess
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.files import folder_beside, open_to_all, rename_output, write_whole
from chainshaper.values.leftovers import claimed
from chainshaper.values.yaml_file import read_text

MANIFEST = "splice.json"
NODES = "shaping_nodes"
LOGS = "logs"
_FORMAT = 1
_DERIVED = {LOGS, *(f"{NODES}/{name}" for name in ("build", "install", "log"))}
_WITH_VALUE = ("--launch-prefix", "--launch-prefix-filter", "--prefix")
_SIGNS = {  # what a launch file has in it, by the end of its name; only launch reads it in full
    ".py": "generate_launch_description",
    ".xml": "<launch",
    **dict.fromkeys((".yaml", ".yml"), r"(?m)^[\s'\"{]*launch\b"),
    ".launch": "launch",
}
ALONE = "shaping.launch.py"  # of a launch file that includes none
_TEXT = '''"""Starts {launched} with nodes added; written by `chainshaper splice`."""

import importlib.util
from pathlib import Path

LAUNCH_FILES = {files}

PROCESSES = {processes}

REDIRECTS = {redirects}

ENVIRONMENT = {environment}


def generate_launch_description():
    path = Path(__file__).resolve().with_name("redirection.py")
    spec = importlib.util.spec_from_file_location("redirection", path)
    redirection = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(redirection)
    redirects = [redirection.Redirect(**values) for values in REDIRECTS]
    return redirection.launch_description(LAUNCH_FILES, PROCESSES, redirects, ENVIRONMENT)
'''


@dataclass(frozen=True)
class LaunchCommand:
    """`ros2 launch …` as it was typed."""

    before: tuple[str, ...]  # the words before the launch file, or its package and name
    file: Path
    after: tuple[str, ...]

    def with_file(self, file: Path) -> list[str]:
        """Return the command that launches another file in the same way."""
        return [*self.before, str(file), *self.after]


def parse_launch_command(command: Sequence[str]) -> LaunchCommand:
    """Find the launch file of a command: named by its path, or by a package and its name there.

    Upstream: ros2launch, `command/launch.py` and `api/api.py`. Raises InputError: it is not `ros2
    launch`, or there is no such package or launch file.
    """
    words = list(command)
    if len(words) < 3 or Path(words[0]).name != "ros2" or words[1] != "launch":
        raise InputError(
            f"`{' '.join(command)}` is not `ros2 launch …`: a shaping node can be added to launch "
            "files only; for other ways of starting see `chainshaper run` and `chainshaper splice`"
        )
    at = _behind_options(words)
    first, second = [*words[at : at + 2], "", ""][:2]
    if not first:
        raise InputError("no launch file given: `ros2 launch PACKAGE FILE`, or `ros2 launch FILE`")
    file, end = Path(first), at + 1
    if not file.is_file():
        file, end = _file_of_package(first, second), at + 2
    return LaunchCommand(tuple(words[:at]), file.absolute(), tuple(words[end:]))


def _behind_options(words: Sequence[str]) -> int:
    """Return the place of the first word behind `ros2 launch`, or `ros2 run`, and its options."""
    at = 2
    while at < len(words) and words[at].startswith("-"):
        at += 2 if words[at] in _WITH_VALUE else 1
    return at


def _file_of_package(package: str, name: str) -> Path:
    """Return a launch file anywhere in a package's share folder (found as by `ament_index`)."""
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    shares = [Path(prefix) / "share" for prefix in prefixes]
    index = Path("ament_index/resource_index/packages", package)
    share = next((folder / package for folder in shares if (folder / index).is_file()), None)
    if share is None and not shares and shutil.which("ros2") is None:
        raise InputError(
            f"{package}: ROS 2 is not sourced (no `ros2` on the path): source its setup.bash,"
            " such as /opt/ros/jazzy/setup.bash, then your workspace's"
        )
    if share is None:
        raise InputError(
            f"{package}: neither a launch file nor a package of this environment; is it sourced "
            "(`source install/setup.bash`)?"
        )
    if not name:
        raise InputError(f"no launch file given: `ros2 launch {package} FILE`")
    paths = [Path(folder) / name for folder, _, files in os.walk(share) if name in files]
    if not paths:
        raise InputError(f"package {package} has no launch file {name} in {share}")
    if len(paths) > 1:
        raise InputError(
            f"package {package} has {len(paths)} files {name}: give the path of the one that is "
            f"meant, {' or '.join(map(str, sorted(paths)))}"
        )
    return paths[0]


def launch_file_name(words: Sequence[str]) -> str:
    """Return the name of the launch file that stands for others, or for `ros2 run …`."""
    if not words:
        return ALONE
    name = executable_of(words) or Path(words[0]).name
    return re.sub(r"([.]launch)?([.](py|xml|ya?ml|launch))?$", "", name, count=1) + ".launch.py"


def launch_text(
    words: Sequence[str],
    processes: Sequence[ShapingProcess],
    redirects: Sequence[Redirect],
    environment: Mapping[str, str],
) -> str:
    """Return the text of the launch file that starts processes and includes launch files.

    ``words`` are the files, or `ros2 run …`; everything launched gets the ``environment`` as well.
    Without words it is for what the same `ros2 launch` starts after it.
    """
    files, actions = list(words), list[dict[str, Any]]()
    for process in processes:
        if process.plugin is None:
            actions.append(process.action)
        if process.standby is not None:
            actions.append(process.standby.action)
    if is_run(words):
        files = []
        actions.append({"cmd": [*words], "output": "screen"})
    launched = executable_of(words) or ", ".join(Path(word).name for word in words)
    launched = launched or "what is launched after it"
    return _TEXT.format(
        launched=re.sub(r"[^\w., -]", "_", launched),  # so a file's name cannot end the docstring
        files=pformat(files, width=96),
        processes=pformat(actions, width=96, sort_dicts=False),
        redirects=pformat(
            [redirect.values() for redirect in redirects], width=96, sort_dicts=False
        ),
        environment=pformat(dict(environment), width=96, sort_dicts=False),
    )


def is_run(words: Sequence[str]) -> bool:
    """Return whether words are `ros2 run PACKAGE EXECUTABLE …` in place of launch files."""
    return executable_of(words) is not None


def executable_of(words: Sequence[str]) -> str | None:
    """Return the executable of `ros2 run [--prefix PREFIX] PACKAGE EXECUTABLE …`; None: it is none.

    Upstream: ros2run, `command/run.py`.
    """
    if words[1:2] != ["run"] or Path(words[0]).name != "ros2":
        return None
    behind = words[_behind_options(words) :]
    return Path(behind[1]).name if len(behind) > 1 else None


def original_words(words: Sequence[str], *, throttled: bool = False) -> list[str]:
    """Return the launch files before splicing, each once, or `ros2 run …` as it is.

    With ``throttled`` a launch file that has a throttler is an original too. Raises InputError: a
    file is not there, or is no launch file, or stands for `ros2 run …` beside other files.
    """
    if is_run(words):
        return list(words)
    originals: list[str] = []
    for word in words:
        file = Path(word).absolute()
        manifest = _manifest(file.parent)
        ours = manifest is not None and file.name in manifest["copies"]
        if manifest is None or not ours or (throttled and manifest["throttled"]):
            if file.suffix not in _SIGNS:
                raise InputError(
                    f"{file}: a launch file's name ends in .py, .xml, .yaml, .yml or .launch: give"
                    " one"
                )
            if not re.search(_SIGNS[file.suffix], read_text(file, "what `ros2 launch` starts")):
                raise InputError(
                    f"{file}: no launch file: it has no `launch`, or no"
                    " `generate_launch_description`"
                )
            originals.append(str(file))
            continue
        copied = original_words(manifest["copies"][file.name], throttled=throttled)
        if not copied:
            raise InputError(f"{file} includes no launch file: splice yours, which includes it")
        if is_run(copied) and len(words) > 1:
            raise InputError(
                f"{file} stands for `{' '.join(copied)}`, which is spliced alone: splice it into"
                " another folder, or write a launch file that starts it"
            )
        originals += copied
    return originals if is_run(originals) else list(dict.fromkeys(originals))


def usable(folder: Path) -> Path:
    """Return the absolute path of the folder to write, after a check that nothing would be lost.

    Raises InputError: something in it was not written by `splice`, or was changed.
    """
    folder = folder.absolute()
    if not folder.parent.is_dir():
        raise InputError(f"{folder.parent}: no such folder to write {folder.name} into")
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        _refuse_changed(folder, "not overwritten: name another, or remove it")
    return folder


def _refuse_changed(folder: Path, consequence: str) -> None:
    manifest = _manifest(folder)
    if manifest is None:
        raise InputError(
            f"{folder} was not written by `chainshaper splice`, so it is {consequence}"
        )
    written = manifest["files"]
    changed = sorted(
        name for name, digest in _hashes(folder).items() if written.get(name) != digest
    )
    if changed:
        raise InputError(
            f"{folder}: {', '.join(changed)} was changed or added since it was written, so it is"
            f" {consequence}"
        )


def _manifest(folder: Path) -> dict[str, Any] | None:
    """Return the manifest of a folder; None: it has none.

    * ``copies``: the launch files that were written, with the words that they stand for.
    * ``files``: the SHA-256 of each file by its name.
    * ``throttled``: whether it has a throttler.
    """
    try:
        values = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        if values["format"] != _FORMAT:
            return None
        copies = {name: list(words) for name, words in values["copies"].items()}
        throttled = bool(values.get("throttled"))
        return {"copies": copies, "files": dict(values["files"]), "throttled": throttled}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _hashes(folder: Path) -> dict[str, str]:
    """Return the hash of every file that counts, by its path below the folder."""
    hashes: dict[str, str] = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        derived = "__pycache__" in name.parts or not _DERIVED.isdisjoint(map(str, name.parents))
        if path.is_file() and not derived and str(name) != MANIFEST:
            hashes[str(name)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return hashes


@contextmanager
def new_folder(
    folder: Path, copies: Mapping[str, Sequence[str]], *, throttled: bool = False
) -> Iterator[Path]:
    """Give a folder to fill, which takes the place of ``folder`` if nothing failed.

    ``copies`` are the launch files in it, with the words that they stand for. Raises
    OperationError: it cannot be written; nothing is left behind, and an older folder stays.
    """
    try:
        with folder_beside(folder) as partial_name:
            partial = Path(partial_name)
            write_whole(partial / "redirection.py", [Path(redirection.__file__).read_bytes()])
            yield partial
            (partial / LOGS).mkdir()
            manifest = {"throttled": throttled, "copies": dict(copies), "files": _hashes(partial)}
            text = json.dumps({"format": _FORMAT, **manifest}, indent=2) + "\n"
            write_whole(partial / MANIFEST, [text.encode()])
            open_to_all(partial)
            if _manifest(folder) != manifest or _hashes(folder) != manifest["files"]:
                _replace(folder, partial)
    except OSError as error:
        raise OperationError(f"{folder}: cannot be written: {error}") from error


def _replace(folder: Path, new: Path) -> None:
    """Put a new folder in the place of an older one, which comes back if that fails."""
    if not folder.exists():
        rename_output(new, folder)
        return
    with claimed(folder):  # `chainshaper release` removes what a killed run leaves
        aside = _moved_aside(folder)
        try:
            rename_output(new, folder)
        except OSError:
            rename_output(aside, folder)
            raise
        shutil.rmtree(aside, ignore_errors=True)


def _moved_aside(folder: Path) -> Path:
    aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.older-", dir=folder.parent))
    return rename_output(folder, aside)


def undo_splice(folder: str | Path) -> None:
    """Remove the folder that splicing wrote, whole or not at all.

    Raises InputError: `splice` did not write it, or something in it was changed or added since.
    OperationError: it cannot be removed.
    """
    folder = Path(folder).absolute()
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, so there is nothing to undo")
    _refuse_changed(folder, "not removed: move away what you need, and remove the rest")
    try:
        with claimed(folder):
            shutil.rmtree(_moved_aside(folder))
    except OSError as error:
        raise OperationError(f"{folder}: cannot be removed: {error}") from error
