from launch import LaunchDescription
from launch_ros.actions import LifecycleNode


def generate_launch_description():
    return LaunchDescription([
        LifecycleNode(package='localizer', executable='ndt', name='ndt', namespace='',
                      remappings=[('~/out', 'pose')]),
    ])
