from launch import LaunchDescription
from launch_ros.actions import Node


def localizer(name, namespace='localization'):
    return Node(package='localizer', executable='ndt', name=name, namespace=namespace)


def generate_launch_description():
    return LaunchDescription([localizer('ndt')])
