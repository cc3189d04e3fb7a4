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
        actions=[Node(package='localizer', executable='ndt', name='ndt')],
    )
    load_composable_nodes = LoadComposableNodes(
        condition=IfCondition(composed),
        target_container='container',
        composable_node_descriptions=[
            ComposableNode(package='localizer', plugin='localizer::Ndt', name='ndt'),
        ],
    )
    ld = LaunchDescription([DeclareLaunchArgument('composed', default_value='true')])
    ld.add_action(load_nodes)
    ld.add_action(load_composable_nodes)
    return ld
