from launch import LaunchDescription
from launch_ros.actions import Node

ROBOTS = {'one': 'ndt', 'two': 'icp'}


def generate_launch_description():
    return LaunchDescription(
        [
            Node(package='localizer', executable=kind, name=kind, namespace=robot)
            for robot, kind in ROBOTS.items()
        ]
        + [Node(package='planner', executable='planner', name='planner')]
    )
