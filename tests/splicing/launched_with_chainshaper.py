"""`ros2 launch …` by the Python of a ROS 2 that finds chainshaper's launch extension, for a while.

Arguments: the Python that has chainshaper's dependencies, the seconds until Ctrl-C, and the words
behind `ros2`. Entry points are those of the folder `chainshaper-….dist-info` on PYTHONPATH.
"""

import os
import signal
import sys
import threading

from ros2cli.cli import main

from chainshaper import launch_actions

python, seconds, *words = sys.argv[1:]
launch_actions.PROGRAM = (python, *launch_actions.PROGRAM[1:])
ending = threading.Timer(float(seconds), os.kill, (os.getpid(), signal.SIGINT))
ending.daemon = True
ending.start()
sys.argv = ["ros2", *words]
sys.exit(main(argv=words))
