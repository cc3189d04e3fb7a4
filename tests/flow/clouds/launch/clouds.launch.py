from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import ComposableNodeContainer
from launch_ros.descriptions import ComposableNode


def containers(context: LaunchContext) -> list[ComposableNodeContainer]:
    """One for all, or a second one for the node that is apart."""
    executable, apart = (
        LaunchConfiguration(name).perform(context) for name in ("container", "apart")
    )
    nodes = {
        name: ComposableNode(
            package="clouds",
            plugin=f"clouds::{name.title()}",
            name=name,
            extra_arguments=[{"use_intra_process_comms": True}],
        )
        for name in ("source", "filter", "sink")
    }
    shared = [node for name, node in nodes.items() if name != apart]
    hosted = {"clouds": shared} | ({"apart": [nodes[apart]]} if apart else {})
    return [
        ComposableNodeContainer(
            name=name,
            namespace="",
            package="rclcpp_components",
            executable=executable,
            composable_node_descriptions=own,
            output="screen",
        )
        for name, own in hosted.items()
    ]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument("container", default_value="component_container"),
            DeclareLaunchArgument("apart", default_value="", description="a node's name"),
            OpaqueFunction(function=containers),
        ]
    )
