from launch import LaunchDescription
from launch_ros.actions import Node

POSE = '/pose'


def generate_launch_description():
    pose = POSE
    return LaunchDescription([
        Node(package='localizer', executable='ndt', name='ndt', remappings=[('out', pose)]),
        Node(package='planner', executable='planner', name='planner', remappings=[('in', pose)]),
    ])
