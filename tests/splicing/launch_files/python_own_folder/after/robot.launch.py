#!/usr/bin/env python3
from __future__ import annotations

__file__ = '{BEFORE}/robot.launch.py'
from launch.actions import ExecuteProcess
import os

from launch import LaunchDescription
from launch.substitutions import ThisLaunchFileDir
from launch_ros.actions import Node


def generate_launch_description():
    params = os.path.join(os.path.dirname(__file__), 'ndt.yaml')
    return LaunchDescription([
        ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose.py', '--ros-args', '-r', '__node:=chainshaper_pose', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose.yaml'], output='screen', respawn=True, respawn_delay=0.1),
        ExecuteProcess(cmd=['python3', '{AFTER}/shaping_nodes/chainshaper_pose_standby.py', '--ros-args', '-r', '__node:=chainshaper_pose_standby', '-r', '__ns:=/', '-r', 'input:=/pose_tmp', '-r', 'output:=/pose', '--params-file', '{AFTER}/shaping_nodes/chainshaper_pose_standby.yaml'], output='screen', respawn=True, respawn_delay=0.1),
        Node(remappings=[('/pose', '/pose_tmp')], package='localizer', executable='ndt', name='ndt',
             parameters=[params, ['{BEFORE}', '/more.yaml']]),
    ])
