from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    ExecuteProcess = Node
    ndt = ExecuteProcess(package='localizer', executable='ndt', name='ndt')
    ld = LaunchDescription()
    ld.add_action(ndt)
    return ld
