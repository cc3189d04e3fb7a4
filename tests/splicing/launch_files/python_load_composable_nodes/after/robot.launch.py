from launch.actions import ExecuteProcess
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LoadComposableNodes, Node, PushRosNamespace
from launch_ros.descriptions import ComposableNode


def generate_launch_description():
    composed = LaunchConfiguration('composed')
    load_nodes = GroupAction(
        condition=UnlessCondition(composed),
        actions=[Node(remappings=[('/pose', '/pose_tmp')], package='localizer', executable='ndt', name='ndt')],
    )
    load_composable_nodes = LoadComposableNodes(
        condition=IfCondition(composed),
        target_container='container',
        composable_node_descriptions=[
            ComposableNode(remappings=[('/pose', '/pose_tmp')], package='localizer', plugin='localizer::Ndt', name='ndt'),
        ],
    )
    ld = LaunchDescription([ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose.py', '--ros-args', '-r', '__node:=chainshaper_pose', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose.yaml'], output='screen', respawn=True, respawn_delay=0.1), ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose_standby.py', '--ros-args', '-r', '__node:=chainshaper_pose_standby', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose_standby.yaml'], output='screen', respawn=True, respawn_delay=0.1), DeclareLaunchArgument('composed', default_value='true')])
    ld.add_action(load_nodes)
    ld.add_action(load_composable_nodes)
    return ld
