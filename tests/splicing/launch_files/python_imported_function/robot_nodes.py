from launch_ros.actions import Node


def nodes_of(robot):
    return [Node(package=robot, executable='planner', name='planner')]


def setup(context):
    return [Node(package='localizer', executable='ndt', name='ndt')]
