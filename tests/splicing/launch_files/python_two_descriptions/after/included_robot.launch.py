from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    ndt = Node(remappings=[('/pose', '/pose_tmp')], package='localizer', executable='ndt', name='ndt')
    try:
        import planner  # noqa: F401
    except ImportError:
        return LaunchDescription([ndt])
    return LaunchDescription([ndt, Node(package='planner', executable='planner', name='planner')])
