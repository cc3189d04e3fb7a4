from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    ld = LaunchDescription()
    for name in ('voxel', 'ndt'):
        ld.add_action(Node(package='localizer', executable=name, name=name, remappings=[('out', '/pose')]))
    return ld
