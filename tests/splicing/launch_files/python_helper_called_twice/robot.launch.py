from launch import LaunchDescription
from launch_ros.actions import Node


def localizer(name, *, namespace):
    return Node(package='localizer', executable='ndt', name=name, namespace=namespace)


def generate_launch_description():
    return LaunchDescription([localizer('ndt', namespace='a'), localizer('ndt', namespace='b')])
