"""A launch file on disk, read in the language that its name says.

The three languages share one set of functions: ``read`` a text, ``add_remaps`` to a node,
``add_set_remaps`` before one that is there, ``add_at_start`` of the whole, ``keep_folder`` for a
copy that stands elsewhere, and ``replaced`` for a value in place of another.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from chainshaper.splicing.launch import xml as launch_xml
from chainshaper.splicing.launch import yaml as launch_yaml
from chainshaper.splicing.launch.actions import Edit, Language, LaunchFile, Rules, Span
from chainshaper.splicing.launch.python import editing as launch_python
from chainshaper.splicing.shaping_process import ShapingProcess
from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import read_text as file_text

__all__ = ["LANGUAGES", "is_launch_file", "read_launch_file", "read_text"]


class _LanguageModule(Protocol):
    """What each language offers; None is: not without doubt."""

    def read(self, path: Path, text: str) -> LaunchFile: ...
    def replaced(self, file: LaunchFile, span: Span, value: str) -> Edit: ...
    def add_remaps(self, file: LaunchFile, place: object, rules: Rules) -> list[Edit] | None: ...
    def add_set_remaps(
        self, file: LaunchFile, place: object, rules: Rules
    ) -> list[Edit] | None: ...
    def add_at_start(
        self, file: LaunchFile, rules: Rules, processes: Sequence[ShapingProcess]
    ) -> list[Edit] | None: ...
    def keep_folder(self, file: LaunchFile) -> list[Edit] | None: ...


LANGUAGES: dict[Language, _LanguageModule] = {
    "python": launch_python,
    "xml": launch_xml,
    "yaml": launch_yaml,
}

_LANGUAGE_OF: dict[str, Language] = {
    ".py": "python",
    ".xml": "xml",
    ".yaml": "yaml",
    ".yml": "yaml",
}


def is_launch_file(path: Path) -> bool:
    """Whether a file's name is one of a launch file's."""
    return path.suffix in (*_LANGUAGE_OF, ".launch")


def read_launch_file(path: str | Path) -> LaunchFile:
    """What a launch file says.

    Raises:
        InputError: there is no such file, it is no launch file, or has a mistake, which is named
            with its line.
    """
    path = Path(path).absolute()
    if not is_launch_file(path):
        raise InputError(
            f"{path}: a launch file's name ends in .py, .xml, .yaml, .yml or .launch: give one"
        )
    return read_text(path, file_text(path, "what `ros2 launch` starts"))


def read_text(path: Path, text: str) -> LaunchFile:
    """What a text says as the launch file of this name."""
    language = _LANGUAGE_OF.get(path.suffix)
    if language is None:  # .launch is either of two
        language = "xml" if text.lstrip("\ufeff \t\r\n").startswith("<") else "yaml"
    return LANGUAGES[language].read(path, text)
