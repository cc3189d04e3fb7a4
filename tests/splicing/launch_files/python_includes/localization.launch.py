from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument('ns'),
        Node(
            package='localizer',
            executable='ndt',
            name='ndt',
            namespace=LaunchConfiguration('ns'),
            parameters=[str(Path(__file__).parent / 'ndt.yaml')],
        ),
    ])
