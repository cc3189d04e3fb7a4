from launch.actions import ExecuteProcess
import launch
import launch_ros.actions as ros


def generate_launch_description():
    ld = launch.LaunchDescription([ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose.py', '--ros-args', '-r', '__node:=chainshaper_pose', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose.yaml'], output='screen', respawn=True, respawn_delay=0.1), ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose_standby.py', '--ros-args', '-r', '__node:=chainshaper_pose_standby', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose_standby.yaml'], output='screen', respawn=True, respawn_delay=0.1)])
    ndt = ros.Node(
        remappings=[('/pose', '/pose_tmp')],
        package='localizer', executable='ndt', name='ndt'
    )
    ld.add_action(ndt)
    ld.add_action(ros.Node(package='planner', executable='planner', name='planner'))
    return ld
