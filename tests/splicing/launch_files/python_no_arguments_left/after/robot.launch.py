from launch.actions import ExecuteProcess as ShapingExecuteProcess
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    ExecuteProcess = Node
    ndt = ExecuteProcess(remappings=[('/pose', '/pose_tmp')], package='localizer', executable='ndt', name='ndt')
    ld = LaunchDescription([ShapingExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose.py', '--ros-args', '-r', '__node:=chainshaper_pose', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose.yaml'], output='screen')])
    ld.add_action(ndt)
    return ld
