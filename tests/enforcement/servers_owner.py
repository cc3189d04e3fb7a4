"""An owner of servers, to be killed: governs threads and waits for its end.

    python servers_owner.py BACK_END RUNS CORE CYCLE_MS SLOT_MS TID…

Its threads run in [0, SLOT_MS) of each cycle; the first one begins as soon as may be. The journal
is in a folder of RUNS. It prints a line with its guardians and dispatchers when the servers are in
force, raises when it reads `raise`, answers `failure()` to any other line, and releases when its
input ends.
"""

import sys
import time
from contextlib import suppress
from pathlib import Path

from chainshaper.enforcement.back_ends import make_back_end
from chainshaper.enforcement.freezer import Freezer
from chainshaper.enforcement.guardian import Guardians
from chainshaper.enforcement.journal import open_journal
from chainshaper.enforcement.scheduling_memory import change_all
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.enforcement.undoing import undo_run
from chainshaper.linux.scheduling import SchedulingRequest
from chainshaper.linux.threads import find_thread
from chainshaper.values.errors import PlatformError

MS = 1_000_000


def main() -> None:
    runs, core, cycle, slot = Path(sys.argv[2]), *map(int, sys.argv[3:6])
    server = ReservationServer("gated", core, 1, ((0, slot * MS),))
    journal = open_journal(runs)
    guardians = Guardians(journal)
    guardians.await_ready()
    table = ServerTable(cycle * MS, (server,))
    servers = make_back_end(sys.argv[1], table, journal)
    for tid in map(int, sys.argv[6:]):
        thread = find_thread(tid)
        assert thread is not None
        with suppress(PlatformError):
            change_all(journal, [(thread, SchedulingRequest(5, None))])
        servers.assign(tid, "gated")
    servers.arm(time.monotonic_ns() + 320 * MS)
    own = [one.pid for one in guardians.processes]
    if isinstance(servers, Freezer):
        begin = servers.in_force_from()
        assert begin is not None
        time.sleep(max(0, begin - time.monotonic_ns()) / 1e9)
        own += servers.dispatchers.values()
    answer(f"in force with {' '.join(map(str, own))}")
    for line in sys.stdin:
        if line == "raise\n":
            raise ValueError("something that nobody foresaw")
        answer(str(servers.failure()))
    servers.release()
    assert undo_run(journal, by_owner=True) == ()
    guardians.end()
    answer("released")


def answer(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
