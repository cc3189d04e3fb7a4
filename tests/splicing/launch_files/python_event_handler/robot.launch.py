from launch import LaunchDescription
from launch.actions import RegisterEventHandler, TimerAction
from launch.event_handlers import OnProcessStart
from launch_ros.actions import Node


def generate_launch_description():
    lidar = Node(package='lidar', executable='driver', name='lidar')
    ndt = Node(package='localizer', executable='ndt', name='ndt')
    return LaunchDescription([
        lidar,
        RegisterEventHandler(OnProcessStart(target_action=lidar, on_start=[
            TimerAction(period=2.0, actions=[ndt]),
        ])),
    ])
