from launch import LaunchContext, LaunchDescription
from launch.substitutions import ThisLaunchFileDir
from launch_ros.actions import Node


def folder_of(context):
    return ThisLaunchFileDir().perform(context)


def generate_launch_description():
    return LaunchDescription([Node(package='localizer', executable='ndt', name='ndt')])
