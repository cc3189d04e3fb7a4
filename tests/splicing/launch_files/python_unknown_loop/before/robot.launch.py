import os

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    nodes = [Node(package='planner', executable='planner', name='planner')]
    for name in sorted(os.listdir(os.path.join(os.path.dirname(__file__), 'names'))):
        nodes.append(Node(package='localizer', executable=name, name=name))
    return LaunchDescription(nodes)
