"""`ros2 launch …` by the Python of a ROS 2 that finds chainshaper's launch extension.

Arguments: the Python that has chainshaper's dependencies, and the words behind `ros2`. Entry points
are those of the folder `chainshaper-….dist-info` on PYTHONPATH.
"""

import sys

from ros2cli.cli import main

from chainshaper import launch_actions

python, *words = sys.argv[1:]
launch_actions.PROGRAM = (python, *launch_actions.PROGRAM[1:])
sys.argv = ["ros2", *words]
sys.exit(main(argv=words))
