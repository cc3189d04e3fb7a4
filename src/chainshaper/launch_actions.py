"""The launch action `Shape`: nodes that a launch file starts behind it are shaped by a plan.

In Python `Shape(plan="plan.yaml")`, in XML `<shape plan="plan.yaml"/>`, in YAML
`- shape: {plan: plan.yaml}`. `ros2 launch … --shape plan.yaml` puts it before all else. It includes
what `chainshaper splice plan.yaml` writes, without launch files, into the folder of the launch's
logs.

`ros2 launch` loads this file where launch files have tags in XML and YAML. It calls chainshaper as
a program, so that the robot's process imports nothing of what that depends on. Upstream: launch,
`launch/frontend/expose.py`.
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import launch.logging
from launch import Action
from launch.actions import ExecuteProcess, IncludeLaunchDescription, LogInfo
from launch.frontend import expose_action
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

__all__ = ["Shape"]

PROGRAM = (sys.executable, "-m", "chainshaper")
WAIT = "60s"  # how long the plan's nodes have to appear before the plan is put in force
RELEASE_S = "15"  # how long putting back what the plan changed may take, after Ctrl-C


@expose_action("shape")
class Shape(Action):  # type: ignore[misc]  # launch has no types here
    """Shapes the nodes that are started behind it by a plan.

    * ``plan``: the plan's file.
    * ``recording``: a recording that tells who publishes the outputs, where the plan does not.
    * ``apply``: the back end that puts the plan in force too, such as ``auto``. Default: none, and
      only the outputs are held until their slots.
    """

    def __init__(self, *, plan: Any, recording: Any = None, apply: Any = None, **more: Any) -> None:
        super().__init__(**more)
        values = {"plan": plan, "recording": recording, "apply": apply}
        self._values = {
            name: normalize_to_list_of_substitutions(value)
            for name, value in values.items()
            if value is not None
        }

    @classmethod
    def parse(cls, entity: Any, parser: Any) -> tuple[type["Shape"], dict[str, Any]]:
        """Return the action and its arguments, as a launch file in XML or YAML has them."""
        _, arguments = super().parse(entity, parser)
        for name in ("plan", "recording", "apply"):
            text = entity.get_attr(name, optional=name != "plan")
            if text is not None:
                arguments[name] = parser.parse_substitution(text)
        return cls, arguments

    def execute(self, context: Any) -> list[Any]:
        """Write what shapes the nodes; return what launch has to do next."""
        values = {
            name: perform_substitutions(context, value) for name, value in self._values.items()
        }
        folder = _unused(Path(launch.logging.launch_config.log_dir, "chainshaper"))
        words = [values["plan"], "--output", str(folder)]
        if values.get("recording"):
            words += ["--recording", values["recording"]]
        spliced = _spliced(words)
        actions: list[Any] = [LogInfo(msg=note) for note in spliced["notes"]]
        actions += [LogInfo(msg=f"shaping node's log: {log}") for log in spliced["logs"]]
        if values.get("apply"):
            actions.append(
                ExecuteProcess(
                    cmd=[*PROGRAM, *_apply_words(values["plan"], values["apply"])],
                    name="chainshaper_apply",
                    output="screen",
                    sigterm_timeout=RELEASE_S,
                )
            )
        for file in spliced["launch"]:
            source = PythonLaunchDescriptionSource(file)
            actions.append(IncludeLaunchDescription(source))
        return actions


def _apply_words(plan: str, back_end: str) -> list[str]:
    return ["apply", plan, "--backend", back_end, "--wait", WAIT]


def _unused(folder: Path) -> Path:
    """Return the path of a folder that is not there yet; a launch may have several of them."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    number, unused = 1, folder
    while unused.exists():
        number += 1
        unused = folder.with_name(f"{folder.name}_{number}")
    return unused


def _spliced(words: Sequence[str]) -> dict[str, Any]:
    """Return what `chainshaper splice` has written.

    Raises RuntimeError, which ends the launch: it has written nothing.
    """
    command = [*PROGRAM, "splice", *words, "--json"]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode:
        last = (finished.stderr.splitlines() or [""])[-1]
        try:
            last = json.loads(last)["error"]
        except (ValueError, KeyError, TypeError):
            last = last or f"`{' '.join(command)}` ended with exit code {finished.returncode}"
        raise RuntimeError(f"nothing is shaped: {last}")
    spliced: dict[str, Any] = json.loads(finished.stdout)
    return spliced
