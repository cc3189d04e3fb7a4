"""Starts chain.launch.py with nodes added; written by `chainshaper splice`."""

from launch import LaunchDescription
from launch.actions import ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import SetRemap


def generate_launch_description():
    return LaunchDescription(
        [
            ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_t5.py', '--ros-args', '-r', '__node:=chainshaper_t5', '-r', '__ns:=/', '-r', 'input:=/t5_tmp', '-r', 'output:=/t5', '--params-file', '{AFTER}/shaping_nodes/chainshaper_t5.yaml'], output='screen', respawn=True, respawn_delay=0.1),
            ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_t5_standby.py', '--ros-args', '-r', '__node:=chainshaper_t5_standby', '-r', '__ns:=/', '-r', 'input:=/t5_tmp', '-r', 'output:=/t5', '--params-file', '{AFTER}/shaping_nodes/chainshaper_t5_standby.yaml'], output='screen', respawn=True, respawn_delay=0.1),
            SetRemap('node5:/out', '/t5_tmp'),
            IncludeLaunchDescription(PythonLaunchDescriptionSource('{BEFORE}/chain.launch.py')),
        ]
    )
