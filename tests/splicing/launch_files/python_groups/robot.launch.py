from launch import LaunchDescription
from launch.actions import GroupAction, ExecuteProcess
from launch_ros.actions import Node, PushRosNamespace


def generate_launch_description():
    mapping = GroupAction([
        PushRosNamespace('mapping'),
        Node(package='localizer', executable='ndt', name='ndt'),
    ])
    nodes = [PushRosNamespace('localization')]
    nodes.append(Node(package='localizer', executable='ndt', name='ndt'))
    nodes += [Node(package='localizer', executable='ndt', name='ndt', namespace='rear')]
    return LaunchDescription([
        ExecuteProcess(cmd=['ros2', 'bag', 'play', 'drive']),
        mapping,
        GroupAction(actions=nodes),
        Node(package='localizer', executable='ndt', name='ndt', namespace='/front'),
    ])
