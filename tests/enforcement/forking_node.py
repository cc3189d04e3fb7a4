"""A stand-in for a ROS 2 node that starts processes once it is told to.

    python forking_node.py TRIGGER OUTPUT [dds] --ros-args -r __node:=NAME

When the file TRIGGER appears, it forks a child, and another that forks a daemon (whose parent ends,
and which has a session of its own), and writes the ids of the child and of the daemon to OUTPUT.
With `dds` it has a thread as DDS has, which tells it from what it forks.
"""

import ctypes
import os
import sys
import threading
import time


def wait_a_minute() -> None:
    time.sleep(60)
    os._exit(0)


def dds_thread() -> None:
    ctypes.CDLL(None).prctl(15, b"recvUC", 0, 0, 0)
    time.sleep(600)


def main() -> None:
    trigger, output = sys.argv[1:3]
    if sys.argv[3] == "dds":
        threading.Thread(target=dds_thread, daemon=True).start()
    while not os.path.exists(trigger):  # noqa: PTH110 - as little as possible is imported
        time.sleep(0.01)
    child = os.fork()
    if child == 0:
        wait_a_minute()
    reading, writing = os.pipe()
    between = os.fork()
    if between == 0:
        os.setsid()
        daemon = os.fork()
        if daemon == 0:
            wait_a_minute()
        os.write(writing, str(daemon).encode())
        os._exit(0)
    os.waitpid(between, 0)
    with open(f"{output}.partial", "w") as file:  # noqa: PTH123
        file.write(f"{child} {os.read(reading, 20).decode()}")
    os.rename(f"{output}.partial", output)  # noqa: PTH104
    while True:
        time.sleep(0.01)


if __name__ == "__main__":
    main()
