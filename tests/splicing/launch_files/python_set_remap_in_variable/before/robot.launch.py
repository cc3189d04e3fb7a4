from launch import LaunchDescription
from launch_ros.actions import Node, SetRemap


def generate_launch_description():
    remap = SetRemap('out', '/pose')
    ndt = Node(package='localizer', executable='ndt', name='ndt', namespace='a')
    return LaunchDescription([remap, ndt])
