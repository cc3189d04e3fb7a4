"""A stand-in for a ROS 2 node: a timer of its own, a command line like a node's, no DDS.

    python ticking_node.py PERIOD_NS BUSY_NS OUTPUT --ros-args -r __node:=NAME

It computes for BUSY_NS in every period and writes when each time began and ended, a line each.
On SIGINT it ends with code 0, as nodes do. On SIGUSR1 it begins a third of a period later from
then on.
"""

import signal
import sys
import time


def main() -> None:
    period, busy, output = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
    late: list[int] = []
    signal.signal(signal.SIGUSR1, lambda *_: late.append(period // 3))
    due = time.monotonic_ns()
    with open(output, "w", buffering=1) as file:  # noqa: PTH123 - as little as possible is imported
        while True:
            due += period + (late.pop() if late else 0)
            time.sleep(max(0, due - time.monotonic_ns()) / 1e9)
            began = time.monotonic_ns()
            used = time.thread_time_ns()
            while time.thread_time_ns() - used < busy:
                pass
            file.write(f"{began} {time.monotonic_ns()}\n")


if __name__ == "__main__":
    main()
