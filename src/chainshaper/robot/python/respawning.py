#!/usr/bin/env python3
"""Starts a program again whenever it ends, where no `ros2 launch` does.

    ros2 run chainshaper_shaping respawning shaping_node --ros-args ...
    python3 respawning.py chainshaper_t5.py --ros-args ...

The program is looked for beside this file, then as it is named. SIGINT and SIGTERM end both.
"""

import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path


def main() -> int:
    """Run the program of the command line until this process is asked to end.

    Return the last exit code of the program.
    """
    beside = Path(__file__).parent / sys.argv[1]
    program = str(beside) if beside.exists() else sys.argv[1]
    command = [program, *sys.argv[2:]]
    if program.endswith(".py"):
        command.insert(0, sys.executable)
    received: list[int] = []  # signals
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: received.append(number))
    while True:
        child, handed_on = subprocess.Popen(command), 0
        while child.poll() is None:
            for signal_number in received[handed_on:]:
                child.send_signal(signal_number)
                handed_on += 1
            with suppress(subprocess.TimeoutExpired):
                child.wait(0.05)
        if received:
            return child.returncode
        sys.stderr.write(f"{sys.argv[1]} ended with code {child.returncode}: it is started again\n")
        time.sleep(0.1)  # a program that ends at once each time leaves the core to others


if __name__ == "__main__":
    sys.exit(main())
