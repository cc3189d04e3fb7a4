from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    remaps = [('out', '/pose')]
    return LaunchDescription([
        Node(package='localizer', executable='ndt', name='ndt', remappings=remaps),
        Node(package='planner', executable='planner', name='planner', remappings=remaps),
    ])
