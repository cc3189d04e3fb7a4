"""A launch file as `ros2 launch` carries it out, ended after a while if it does not end itself.

Run by the Python of a ROS 2 environment. Arguments: the file, and its launch arguments.
"""

import sys

from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription, Shutdown, TimerAction
from launch.launch_description_sources import AnyLaunchDescriptionSource

SECONDS = 13.0


def main() -> int:
    arguments = [word.split(":=", 1) for word in sys.argv[2:]]
    service = LaunchService(argv=sys.argv[2:])
    service.include_launch_description(
        LaunchDescription(
            [
                IncludeLaunchDescription(
                    AnyLaunchDescriptionSource(sys.argv[1]), launch_arguments=arguments
                ),
                TimerAction(period=SECONDS, actions=[Shutdown(reason="that is enough")]),
            ]
        )
    )
    return int(service.run())


if __name__ == "__main__":
    sys.exit(main())
