__file__ = '{BEFORE}/robot.launch.py'
from launch.actions import ExecuteProcess
import os

from ament_index_python.packages import get_package_share_path
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution, ThisLaunchFileDir
from launch_ros.substitutions import FindPackageShare

HERE = os.path.dirname(os.path.realpath(__file__))


def generate_launch_description():
    launch_files = get_package_share_path('localizer') / 'launch'
    return LaunchDescription([
        ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose.py', '--ros-args', '-r', '__node:=chainshaper_pose', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose.yaml'], output='screen', respawn=True, respawn_delay=0.1),
        ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose_standby.py', '--ros-args', '-r', '__node:=chainshaper_pose_standby', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose_standby.yaml'], output='screen', respawn=True, respawn_delay=0.1),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource([FindPackageShare('nowhere'), '/launch/a.launch.py']),
            condition=IfCondition('false'),
        ),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(['{BEFORE}', '/sensing.launch.py']),
        ),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource('{AFTER}/localization.launch.py'),
            launch_arguments={'ns': 'localization'}.items(),
        ),
        IncludeLaunchDescription(
            PathJoinSubstitution([FindPackageShare('localizer'), 'launch', 'other.launch.xml']),
        ),
        IncludeLaunchDescription(str(launch_files / 'other.launch.xml')),
    ])
