from launch import LaunchDescription
from launch_ros.actions import Node

REMAPS = [('points', '/p')]


def generate_launch_description():
    return LaunchDescription([
        Node(package='localizer', executable='ndt', name='ndt', remappings=REMAPS),
        Node(package='planner', executable='planner', name='planner', remappings=[]),
    ])
