from launch import LaunchDescription
from launch_ros.actions import ComposableNodeContainer
from launch_ros.descriptions import ComposableNode


def generate_launch_description():
    container = ComposableNodeContainer(
        name='container',
        namespace='',
        package='rclcpp_components',
        executable='component_container',
        composable_node_descriptions=[
            ComposableNode(package='filter', plugin='filter::Voxel', name='voxel'),
            ComposableNode(
                package='localizer',
                plugin='localizer::Ndt',
                name='ndt',
                namespace='localization',
                remappings=[
                    ('points', '/p'),
                ],
                extra_arguments=[{'use_intra_process_comms': True}],
            ),
        ],
        output='screen',
    )
    return LaunchDescription([container])
