"""An outer launch file: it includes one that is better not edited, and adds what that one lacks.

Its remap rules begin with the name of the node that they are for. A rule without it would apply to
every node that is included, to subscribers of the topic just as well as to its publisher; with it,
ROS 2 applies the rule to nodes of this name only, so it needs no scope of its own either. Whatever
the included file sets for those who include it still gets out.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from chainshaper.splicing.launch.actions import Rules
from chainshaper.splicing.launch.python.editing import process_class, process_text
from chainshaper.splicing.shaping_process import ShapingProcess

__all__ = ["wrapper_text"]


def wrapper_text(
    included: Path, rules: Rules, processes: Sequence[ShapingProcess], required: Sequence[str]
) -> str:
    """The text of a Python launch file.

    ``required`` are arguments that the included file declares without a default: launch wants
    to see them handed on.
    """
    classes = {"IncludeLaunchDescription"} | {
        process_class(process) for process in processes if process.command is not None
    }
    ros_classes = {"SetRemap"} if rules else set()
    ros_classes |= {process_class(process) for process in processes if process.command is None}
    imports = [
        "from launch import LaunchDescription",
        f"from launch.actions import {', '.join(sorted(classes))}",
        "from launch.launch_description_sources import PythonLaunchDescriptionSource",
        *(["from launch.substitutions import LaunchConfiguration"] if required else []),
        *(
            [f"from launch_ros.actions import {', '.join(sorted(ros_classes))}"]
            if ros_classes
            else []
        ),
    ]
    handed_on = [f"({name!r}, LaunchConfiguration({name!r}))" for name in required]
    arguments = f", launch_arguments=[{', '.join(handed_on)}]" if handed_on else ""
    actions = [
        *(process_text(process, process_class(process)) for process in processes),
        *(f"SetRemap({match!r}, {target!r})" for match, target in rules),
        f"IncludeLaunchDescription(PythonLaunchDescriptionSource({str(included)!r}){arguments})",
    ]
    inside = "".join(f"            {action},\n" for action in actions)
    name = re.sub(r"[^\w. -]", "_", included.name)  # a file's name cannot end the text it stands in
    return (
        f'"""Starts {name} with nodes added; written by `chainshaper splice`."""\n\n'
        + "\n".join(imports)
        + "\n\n\ndef generate_launch_description():\n"
        + f"    return LaunchDescription(\n        [\n{inside}        ]\n    )\n"
    )
