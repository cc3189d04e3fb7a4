"""The paper's synthetic chain: every node reads what the one before it writes."""

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    nodes = []
    for number in range(1, 6):
        nodes.append(
            Node(
                package='chain_nodes',
                executable='chain_node',
                name=f'node{number}',
                remappings=[('in', f'/t{number - 1}'), ('out', f'/t{number}')],
            )
        )
    sink = Node(package='chain_nodes', executable='sink', name='sink', remappings=[('in', '/t5')])
    return LaunchDescription([*nodes, sink])
