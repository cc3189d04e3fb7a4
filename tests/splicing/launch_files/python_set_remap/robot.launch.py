from launch import LaunchDescription
from launch.actions import GroupAction
from launch_ros.actions import Node, SetRemap


def generate_launch_description():
    return LaunchDescription([
        GroupAction([
            SetRemap(src='points', dst='/p'),
            SetRemap(src='out', dst='/pose'),
            Node(package='localizer', executable='ndt', name='ndt'),
            Node(package='monitor', executable='monitor', name='monitor'),
        ]),
    ])
