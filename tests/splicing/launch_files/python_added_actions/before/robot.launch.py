import launch
import launch_ros.actions as ros


def generate_launch_description():
    ld = launch.LaunchDescription()
    ndt = ros.Node(
        package='localizer', executable='ndt', name='ndt'
    )
    ld.add_action(ndt)
    ld.add_action(ros.Node(package='planner', executable='planner', name='planner'))
    return ld
