"""The robot."""

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    """Two nodes."""
    return LaunchDescription([
        Node(package='lidar', executable='driver', name='lidar'),
        # finds out where we are
        Node(
            package='localizer',
            executable='ndt',
            name='ndt',  # as the planner expects
            parameters=[{'resolution': 0.5}],
        ),
    ])
