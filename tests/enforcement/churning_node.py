"""A stand-in for a node whose threads come and go: one of DDS, and 20 that live for 10 ms each.

    python churning_node.py CHILDREN --ros-args -r __node:=NAME

With CHILDREN (1), it also forks a child every 20 ms, which ends at once.
"""

import ctypes
import os
import sys
import threading
import time


def dds_thread() -> None:
    ctypes.CDLL(None).prctl(15, b"recvUC", 0, 0, 0)
    time.sleep(600)


def main() -> None:
    threading.Thread(target=dds_thread, daemon=True).start()
    forks = sys.argv[1] == "1"
    while True:
        for number in range(20):
            threading.Thread(target=time.sleep, args=(0.01,), daemon=True).start()
            time.sleep(0.0005)
            if forks and number % 20 == 0:
                child = os.fork()
                if child == 0:
                    os._exit(0)
                os.waitpid(child, 0)


if __name__ == "__main__":
    main()
