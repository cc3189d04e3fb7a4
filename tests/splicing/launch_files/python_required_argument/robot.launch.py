from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    nodes = [
        Node(package='localizer', executable=name, name=name, namespace=LaunchConfiguration('ns'))
        for name in ('voxel', 'ndt')
    ]
    return LaunchDescription([DeclareLaunchArgument('ns'), *nodes])
