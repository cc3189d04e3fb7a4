"""The robot."""

from launch.actions import ExecuteProcess
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    """Two nodes."""
    return LaunchDescription([
        ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose.py', '--ros-args', '-r', '__node:=chainshaper_pose', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose.yaml'], output='screen', respawn=True, respawn_delay=0.1),
        ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose_standby.py', '--ros-args', '-r', '__node:=chainshaper_pose_standby', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose_standby.yaml'], output='screen', respawn=True, respawn_delay=0.1),
        Node(package='lidar', executable='driver', name='lidar'),
        # finds out where we are
        Node(
            remappings=[('/pose', '/pose_tmp')],
            package='localizer',
            executable='ndt',
            name='ndt',  # as the planner expects
            parameters=[{'resolution': 0.5}],
        ),
    ])
