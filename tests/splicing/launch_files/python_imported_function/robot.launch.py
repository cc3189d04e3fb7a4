import os
import sys

from launch import LaunchDescription
from launch.actions import OpaqueFunction

sys.path.insert(0, os.path.dirname(__file__))
from robot_nodes import nodes_of, setup  # noqa: E402


def generate_launch_description():
    return LaunchDescription([*nodes_of('robot'), OpaqueFunction(function=setup)])
