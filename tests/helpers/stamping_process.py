"""A process to be gated: one thread notes when it runs, another may compute on without a lock.

    python stamping_process.py SECONDS OUTPUT CORE [OTHER_CORE]

The main thread reads the clock without pause and keeps the windows in which it did: a gap of more
than 0.2 ms ends one. The other thread is inside one long call that needs no interpreter lock, so
freezing the first cannot hold it up. It ends after SECONDS, or when it gets a SIGTERM.
"""

import hashlib
import json
import os
import signal
import sys
import threading
import time

GAP_NS = 200_000


def compute_on(core: int, seconds: float) -> None:
    # Python would not tell the main thread of a signal that came here.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    os.sched_setaffinity(threading.get_native_id(), {core})
    hashlib.pbkdf2_hmac("sha256", b"password", b"salt", int(20_000_000 * seconds))


def cpu_ns(tid: int | None) -> int:
    with open(f"/proc/self/task/{tid}/schedstat") as file:  # noqa: PTH123
        return int(file.read().split()[0])


def main() -> None:
    seconds, output, core = float(sys.argv[1]), *sys.argv[2:4]
    for other_core in sys.argv[4:]:
        beside = threading.Thread(target=compute_on, args=(int(other_core), seconds), daemon=True)
        beside.start()
        while cpu_ns(beside.native_id) < 10_000_000:  # it has the lock, and is inside its call
            time.sleep(0.005)
    os.sched_setaffinity(0, {int(core)})
    signals = []
    signal.signal(signal.SIGTERM, lambda *_: signals.append(True))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    end = time.monotonic_ns() + int(seconds * 1e9)
    windows = []
    first = last = time.monotonic_ns()
    while last < end and not signals:
        now = time.monotonic_ns()
        if now - last > GAP_NS:
            windows.append((first, last))
            first = now
        last = now
    with open(output, "w") as file:  # noqa: PTH123 - as little as possible is imported
        json.dump([*windows, (first, last)], file)
    os._exit(0)  # the other thread is not waited for


if __name__ == "__main__":
    main()
