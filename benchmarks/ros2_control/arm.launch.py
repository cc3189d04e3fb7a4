"""The chain of `measure.py` in front of ros2_control: its environment says what is started."""

import json
import os
from pathlib import Path

from launch import LaunchDescription
from launch.actions import ExecuteProcess
from launch_ros.actions import Node

HERE = Path(__file__).resolve().parent


def generate_launch_description() -> LaunchDescription:
    settings = json.loads(os.environ["ARM"])
    parameters = settings["parameters"]
    manager = ["--controller-manager-timeout", "60", "--param-file", parameters]
    chain = [
        Node(executable=settings["program"], name=name, arguments=words)
        for name, words in settings["chain"].items()
    ]
    return LaunchDescription(
        [
            ExecuteProcess(
                cmd=["python3", f"{HERE}/robot_description.py", settings["description"]]
            ),
            Node(
                package="controller_manager",
                executable="ros2_control_node",
                parameters=[parameters],
            ),
            Node(
                package="controller_manager", executable="spawner", arguments=["forward", *manager]
            ),
            *chain,
        ]
    )
