from launch.actions import ExecuteProcess
from launch import LaunchDescription
from launch.actions import RegisterEventHandler, TimerAction
from launch.event_handlers import OnProcessStart
from launch_ros.actions import Node


def generate_launch_description():
    lidar = Node(package='lidar', executable='driver', name='lidar')
    ndt = Node(remappings=[('/pose', '/pose_tmp')], package='localizer', executable='ndt', name='ndt')
    return LaunchDescription([
        ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose.py', '--ros-args', '-r', '__node:=chainshaper_pose', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose.yaml'], output='screen'),
        lidar,
        RegisterEventHandler(OnProcessStart(target_action=lidar, on_start=[
            TimerAction(period=2.0, actions=[ndt]),
        ])),
    ])
