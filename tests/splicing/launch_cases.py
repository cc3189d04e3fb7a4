"""The launch files in `launch_files/`: each folder a case, before and after, as a person reads it.

`before/` holds launch files, `after/` the copies that splicing makes of them, with `{BEFORE}` and
`{AFTER}` for the two folders. `case.yaml` may say more: the publisher (`/ndt`), the topic
(`/pose`), which files are launched with which arguments (and `variants`, with which others they
have to do as well), and what notes begin with.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from chainshaper.flow.launch_splicing import Splicing, splice_launch_files
from chainshaper.planning import Plan, plan_shaping

__all__ = ["CASES", "PACKAGES", "ROBOTS", "Case", "plan_for", "splice_case", "texts_of"]

LAUNCH_FILES = Path(__file__).parent / "launch_files"
PACKAGES = LAUNCH_FILES / "_packages"
ROBOTS = {
    "robot.launch.xml": '<launch>\n  <node pkg="l" exec="n" name="player"/>\n'
    '  <node pkg="l" exec="n" name="fusion"/>\n</launch>\n',
    "robot.launch.yaml": "launch:\n- node: {pkg: l, exec: n, name: player}\n"
    "- node: {pkg: l, exec: n, name: fusion}\n",
    "robot.launch.py": "from launch import LaunchDescription\n"
    "from launch_ros.actions import Node\n"
    "def generate_launch_description():\n"
    "    return LaunchDescription([\n"
    "        Node(package='l', executable='n', name='player'),\n"
    "        Node(package='l', executable='n', name='fusion'),\n"
    "    ])\n",
}
"""One robot in three languages: a player of data, and a node that takes them."""


@dataclass(frozen=True)
class Case:
    """One folder of `launch_files/`."""

    folder: Path
    publisher: str
    output: str
    launch: tuple[str, ...]
    arguments: dict[str, str]
    variants: tuple[dict[str, str], ...]
    notes: tuple[str, ...]

    @property
    def name(self) -> str:
        return self.folder.name


def _case(folder: Path) -> Case:
    more: dict[str, Any] = {}
    if (folder / "case.yaml").is_file():
        more = yaml.safe_load((folder / "case.yaml").read_text())
    before = sorted(path.name for path in (folder / "before").iterdir() if path.is_file())
    roots = [name for name in before if name.startswith(("robot.", "chain."))] or before
    return Case(
        folder,
        more.get("publisher", "/ndt"),
        more.get("output", "/pose"),
        tuple(more.get("launch", roots)),
        more.get("arguments", {}),
        tuple(more.get("variants", ())),
        tuple(more.get("notes", ())),
    )


CASES = [
    _case(folder) for folder in sorted(LAUNCH_FILES.iterdir()) if not folder.name.startswith("_")
]


def plan_for(publisher: str, output: str) -> Plan:
    """A plan that shapes a topic of this publisher."""
    return plan_shaping(
        np.array([5_000_000, 20_000_000]),
        100_000_000,
        spec=f"/first..{output}",
        output=output,
        publisher=publisher,
        nodes=(publisher,),
        core=0,
    )


def splice_case(case: Case, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Splicing:
    """Splice a case's files, as copies below ``folder``; the result is in ``folder / "after"``."""
    shutil.copytree(case.folder / "before", folder / "before")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(PACKAGES))
    monkeypatch.delenv("SIMULATED", raising=False)
    return splice_launch_files(
        plan_for(case.publisher, case.output),
        [folder / "before" / name for name in case.launch],
        folder / "after",
        arguments=case.arguments,
    )


def texts_of(folder: Path) -> dict[str, str]:
    """The launch files that splicing wrote, without what it was told, by name."""
    names = {"after": "{AFTER}", "before": "{BEFORE}"}
    return {
        path.name: _replaced(
            path.read_bytes().decode(), {str(folder / name): text for name, text in names.items()}
        )
        for path in sorted((folder / "after").iterdir())
        if path.is_file() and path.name != "splice.json"
    }


def _replaced(text: str, names: dict[str, str]) -> str:
    for old, new in names.items():
        text = text.replace(old, new)
    return text
