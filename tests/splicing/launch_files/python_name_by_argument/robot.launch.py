from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, TextSubstitution
from launch_ros.actions import Node


def generate_launch_description():
    robot = LaunchConfiguration('robot', default='one')
    return LaunchDescription([
        DeclareLaunchArgument('kind', default_value='ndt', description='which localizer'),
        Node(
            package='localizer',
            executable='ndt',
            name=LaunchConfiguration('kind'),
            namespace=[TextSubstitution(text='robot_'), robot],
        ),
    ])
