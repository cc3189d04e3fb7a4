from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import ComposableNodeContainer
from launch_ros.descriptions import ComposableNode


def generate_launch_description() -> LaunchDescription:
    nodes = [
        ComposableNode(
            package="clouds",
            plugin=f"clouds::{name.title()}",
            name=name,
            extra_arguments=[{"use_intra_process_comms": True}],
        )
        for name in ("source", "filter", "sink")
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument("container", default_value="component_container"),
            ComposableNodeContainer(
                name="clouds",
                namespace="",
                package="rclcpp_components",
                executable=LaunchConfiguration("container"),
                composable_node_descriptions=nodes,
                output="screen",
            ),
        ]
    )
