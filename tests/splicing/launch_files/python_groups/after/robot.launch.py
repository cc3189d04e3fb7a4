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
    nodes += [Node(remappings=[('/pose', '/pose_tmp')], package='localizer', executable='ndt', name='ndt', namespace='rear')]
    return LaunchDescription([
        ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose.py', '--ros-args', '-r', '__node:=chainshaper_pose', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose.yaml'], output='screen', respawn=True, respawn_delay=0.1),
        ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose_standby.py', '--ros-args', '-r', '__node:=chainshaper_pose_standby', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose_standby.yaml'], output='screen', respawn=True, respawn_delay=0.1),
        ExecuteProcess(cmd=['ros2', 'bag', 'play', 'drive']),
        mapping,
        GroupAction(actions=nodes),
        Node(package='localizer', executable='ndt', name='ndt', namespace='/front'),
    ])
