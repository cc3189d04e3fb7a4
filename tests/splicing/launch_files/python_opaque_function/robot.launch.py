from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def launch_setup(context, *args, **kwargs):
    namespace = LaunchConfiguration('namespace').perform(context)
    node = Node(
        package='localizer',
        executable='ndt',
        name='ndt',
        namespace=namespace,
        remappings=[('out', f'/{namespace}/pose')],
    )
    return [node]


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument('namespace'),
        OpaqueFunction(function=launch_setup),
    ])
