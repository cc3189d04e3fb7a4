from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription([
        Node(package='localizer', executable='ndt', name='ndt',
             remappings=[('points', '/p'), ("out", "/pose")]),
        Node(package='planner', executable='planner', name='planner',
             remappings=[('in', '/pose')]),
    ])
