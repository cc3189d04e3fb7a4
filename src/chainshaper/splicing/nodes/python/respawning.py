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
from pathlib import Path
from typing import Any

DELAY_S = 0.1


def main() -> int:
    """Run the program of the command line until this process is to end; the last exit code."""
    beside = Path(__file__).parent / sys.argv[1]
    program = str(beside) if beside.exists() else sys.argv[1]
    command = [*([sys.executable] if program.endswith(".py") else []), program, *sys.argv[2:]]
    asked: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: asked.append(number))
    while True:
        child = subprocess.Popen(command)
        code = _ended(child, asked)
        if asked:
            return code
        sys.stderr.write(f"{sys.argv[1]} ended with code {code}: it is started again\n")
        time.sleep(DELAY_S)


def _ended(child: "subprocess.Popen[Any]", asked: list[int]) -> int:
    """Wait for a program's end, and hand on what this process is asked."""
    handed_on = 0
    while True:
        for number in asked[handed_on:]:
            child.send_signal(number)
        handed_on = len(asked)
        try:
            return child.wait(0.05)
        except subprocess.TimeoutExpired:
            continue


if __name__ == "__main__":
    sys.exit(main())
