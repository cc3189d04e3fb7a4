from launch.actions import ExecuteProcess
import launch
import launch_ros.actions as ros


def generate_launch_description():
    ld = launch.LaunchDescription([ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose.py', '--ros-args', '-r', '__node:=chainshaper_pose', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose.yaml'], output='screen')])
    ndt = ros.Node(
        remappings=[('/pose', '/pose_tmp')],
        package='localizer', executable='ndt', name='ndt'
    )
    ld.add_action(ndt)
    ld.add_action(ros.Node(package='planner', executable='planner', name='planner'))
    return ld
