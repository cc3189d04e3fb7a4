import os

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    ld = LaunchDescription()
    if os.environ.get('SIMULATED') == '1':
        ld.add_action(Node(package='sim', executable='truth', name='ndt'))
    else:
        ld.add_action(Node(package='localizer', executable='ndt', name='ndt'))
    return ld
