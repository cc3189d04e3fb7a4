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
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource([FindPackageShare('nowhere'), '/launch/a.launch.py']),
            condition=IfCondition('false'),
        ),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource([ThisLaunchFileDir(), '/sensing.launch.py']),
        ),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(os.path.join(HERE, 'localization.launch.py')),
            launch_arguments={'ns': 'localization'}.items(),
        ),
        IncludeLaunchDescription(
            PathJoinSubstitution([FindPackageShare('localizer'), 'launch', 'other.launch.xml']),
        ),
        IncludeLaunchDescription(str(launch_files / 'other.launch.xml')),
    ])
