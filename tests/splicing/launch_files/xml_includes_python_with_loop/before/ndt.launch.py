from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    names = ['voxel', 'ndt', 'filter']
    return LaunchDescription([Node(package='localizer', executable=name, name=name) for name in names])
