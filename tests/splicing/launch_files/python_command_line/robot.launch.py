from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription([
        Node(package='localizer', executable='ndt', name='ndt',
             arguments=['--ros-args', '-r', 'out:=/pose', '--log-level', 'debug']),
    ])
