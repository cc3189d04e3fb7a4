"""The launch files in `launch_files/`: each folder a case, as somebody's robot may be launched.

`case.yaml` may say more: the publisher (`/ndt`), the topic (`/pose`), which files are launched with
which arguments, and with which others (`variants`) they have to do as well.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from chainshaper.planning import ChainPlan, plan_shaping

LAUNCH_FILES = Path(__file__).parent / "launch_files"
PACKAGES = LAUNCH_FILES / "_packages"
NDT = '<launch>\n  <node pkg="l" exec="n" name="ndt"/>\n</launch>\n'
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
    folder: Path
    publisher: str
    output: str
    launch: tuple[Path, ...]
    arguments: dict[str, str]
    variants: tuple[dict[str, str], ...]

    @property
    def name(self) -> str:
        return self.folder.name


def _case(folder: Path) -> Case:
    more: dict[str, Any] = {}
    if (folder / "case.yaml").is_file():
        more = yaml.safe_load((folder / "case.yaml").read_text())
    files = sorted(path.name for path in folder.iterdir() if ".launch" in path.name)
    roots = [name for name in files if name.startswith(("robot.", "chain."))] or files
    return Case(
        folder,
        more.get("publisher", "/ndt"),
        more.get("output", "/pose"),
        tuple(folder / name for name in more.get("launch", roots)),
        more.get("arguments", {}),
        tuple(more.get("variants", ())),
    )


CASES = [
    _case(folder) for folder in sorted(LAUNCH_FILES.iterdir()) if not folder.name.startswith("_")
]


def plan_for(publisher: str, output: str) -> ChainPlan:
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


def robot_file(tmp_path: Path) -> Path:
    path = tmp_path / "robot.launch.xml"
    path.write_text(NDT)
    return path
