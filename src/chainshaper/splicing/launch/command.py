"""`ros2 launch …` as it was typed: which launch file it means, and the same for another file.

The file is named by its path, or by a package and the file's name anywhere in the package's share
folder. Upstream: ros2launch, `command/launch.py` and `api/api.py`.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from chainshaper.splicing.launch.substitutions import package_share
from chainshaper.values.errors import InputError

__all__ = ["LaunchCommand", "parse_launch_command"]

_WITH_VALUE = ("--launch-prefix", "--launch-prefix-filter")


@dataclass(frozen=True)
class LaunchCommand:
    """``before`` and ``after`` are the words around those that name the launch ``file``.

    ``arguments`` are launch arguments by name.
    """

    before: tuple[str, ...]
    file: Path
    after: tuple[str, ...]
    arguments: dict[str, str]

    def with_file(self, file: Path) -> list[str]:
        """The command that launches another file in the same way."""
        return [*self.before, str(file), *self.after]


def parse_launch_command(command: Sequence[str]) -> LaunchCommand:
    """Find the launch file of a command.

    Raises:
        InputError: it is not `ros2 launch`, or there is no such package or launch file.
    """
    words = list(command)
    if len(words) < 3 or Path(words[0]).name != "ros2" or words[1] != "launch":
        raise InputError(
            f"`{' '.join(command)}` is not `ros2 launch …`: a shaping node can be added to launch "
            "files only; for other ways of starting see `chainshaper run` and `chainshaper splice`"
        )
    at = _first_positional(words, 2)
    first = words[at]
    if Path(first).is_file():
        return _command(words, at, at + 1, Path(first))
    share = package_share(first)
    if share is None:
        raise InputError(
            f"{first}: neither a launch file nor a package of this environment; is it sourced "
            "(`source install/setup.bash`)?"
        )
    if at + 1 >= len(words):
        raise InputError(f"no launch file given: `ros2 launch {first} FILE`")
    return _command(words, at, at + 2, _file_of_package(share, first, words[at + 1]))


def _first_positional(words: list[str], at: int) -> int:
    while at < len(words) and words[at].startswith("-"):
        at += 2 if words[at] in _WITH_VALUE else 1
    if at >= len(words):
        raise InputError("no launch file given: `ros2 launch PACKAGE FILE`, or `ros2 launch FILE`")
    return at


def _command(words: list[str], start: int, end: int, file: Path) -> LaunchCommand:
    after = words[end:]
    arguments = dict(word.split(":=", 1) for word in after if ":=" in word)
    return LaunchCommand(tuple(words[:start]), file.absolute(), tuple(after), arguments)


def _file_of_package(share: str, package: str, name: str) -> Path:
    found = [Path(folder) / name for folder, _, files in os.walk(share) if name in files]
    if not found:
        raise InputError(f"package {package} has no launch file {name} in {share}")
    if len(found) > 1:
        raise InputError(
            f"package {package} has {len(found)} files {name}: give the path of the one that is "
            f"meant, {' or '.join(map(str, sorted(found)))}"
        )
    return found[0]
