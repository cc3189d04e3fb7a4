from launch.actions import ExecuteProcess as ShapingExecuteProcess
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    ExecuteProcess = Node
    ndt = ExecuteProcess(remappings=[('/pose', '/pose_tmp')], package='localizer', executable='ndt', name='ndt')
    ld = LaunchDescription([ShapingExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose.py', '--ros-args', '-r', '__node:=chainshaper_pose', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose.yaml'], output='screen', respawn=True, respawn_delay=0.1), ShapingExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose_standby.py', '--ros-args', '-r', '__node:=chainshaper_pose_standby', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose_standby.yaml'], output='screen', respawn=True, respawn_delay=0.1)])
    ld.add_action(ndt)
    return ld
