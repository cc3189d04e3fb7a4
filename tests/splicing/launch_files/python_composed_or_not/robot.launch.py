"""As the bringup of a navigation stack has it: one process each, or one for all."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import LoadComposableNodes, Node, PushROSNamespace
from launch_ros.descriptions import ComposableNode


def generate_launch_description():
    namespace = LaunchConfiguration('namespace')
    composed = LaunchConfiguration('composed')
    remappings = [('/tf', 'tf'), ('/tf_static', 'tf_static')]

    ld = LaunchDescription()
    ld.add_action(DeclareLaunchArgument('namespace', default_value=''))
    ld.add_action(DeclareLaunchArgument('composed', default_value='False'))
    ld.add_action(GroupAction(
        condition=IfCondition(PythonExpression(['not ', composed])),
        actions=[
            PushROSNamespace(namespace),
            Node(
                package='controller',
                executable='controller',
                remappings=remappings + [('out', 'command')],
            ),
            Node(package='planner', executable='planner', name='planner', remappings=remappings),
        ],
    ))
    ld.add_action(GroupAction(
        condition=IfCondition(composed),
        actions=[
            PushROSNamespace(namespace),
            LoadComposableNodes(
                target_container=(namespace, '/', 'container'),
                composable_node_descriptions=[
                    ComposableNode(
                        package='controller',
                        plugin='controller::Controller',
                        name='controller',
                        remappings=remappings + [('out', 'command')],
                    ),
                    ComposableNode(package='planner', plugin='planner::Planner', name='planner'),
                ],
            ),
        ],
    ))
    return ld
