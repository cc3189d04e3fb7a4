#!/usr/bin/env python3
from __future__ import annotations

import os

from launch import LaunchDescription
from launch.substitutions import ThisLaunchFileDir
from launch_ros.actions import Node


def generate_launch_description():
    params = os.path.join(os.path.dirname(__file__), 'ndt.yaml')
    return LaunchDescription([
        Node(package='localizer', executable='ndt', name='ndt',
             parameters=[params, [ThisLaunchFileDir(), '/more.yaml']]),
    ])
