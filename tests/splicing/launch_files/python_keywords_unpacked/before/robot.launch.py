from launch import LaunchDescription
from launch_ros.actions import Node

COMMON = {'package': 'localizer', 'output': 'screen'}


def generate_launch_description():
    return LaunchDescription([Node(executable='ndt', name='ndt', **COMMON)])
