"""An owner of servers, to be killed: gates threads and waits for its end.

    python freezer_owner.py RUN_DIRECTORY CORE CYCLE_MS SLOT_MS TID…

Its threads run in [0, SLOT_MS) of each cycle; the first one begins as soon as may be. It prints a
line when the servers are in force, raises when it reads `raise`, tells `failure()` or `real_time()`
when it reads `failure` or `real time`, and releases when its input ends.
"""

import sys
import time
from pathlib import Path

from chainshaper.enforcement.freezer.back_end import create
from chainshaper.enforcement.servers import ReservationServer, ServerTable

MS = 1_000_000


def main() -> None:
    run_directory, core, cycle, slot = Path(sys.argv[1]), *map(int, sys.argv[2:5])
    server = ReservationServer("gated", core, 1, ((0, slot * MS),))
    servers = create(ServerTable(cycle * MS, (server,)), run_directory)
    for tid in sys.argv[5:]:
        servers.assign(int(tid), "gated")
    servers.arm(time.monotonic_ns() + 320 * MS)
    begin = servers.in_force_from()
    assert begin is not None
    time.sleep(max(0, begin - time.monotonic_ns()) / 1e9)
    answer(f"in force, supervised by {servers.supervisor}")
    for line in sys.stdin:
        if line == "raise\n":
            raise ValueError("something that nobody foresaw")
        answer(str(servers.real_time() if line == "real time\n" else servers.failure()))
    servers.release()
    answer("released")


def answer(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
