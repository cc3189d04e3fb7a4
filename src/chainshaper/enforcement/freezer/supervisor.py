"""The supervisor: a process that outlives the owner for as long as it takes to restore things.

A dispatcher that is killed leaves its threads frozen, and an owner that is killed leaves an
application in somebody's slots for ever. So a third process watches both: it learns of a death
from a pidfd, at once, and of a dispatcher that hangs from the sign of life that stands still.
Whoever it is, it ends all dispatchers, thaws the threads, puts them back and removes the groups,
says why in the run's log, and ends. It has a session of its own, so what is sent to the owner's
terminal does not reach it, and it out-ranks the dispatchers.

A dispatcher that gives no sign of life for a tenth of a second may hang, or its core may have been
taken from the machine for a moment. So its threads are let go first, and questions asked later: one
that comes back closes what has to be closed, at the price of a cycle or less in which a server's
threads ran freely; one that stays away for half a second has failed.

The sign of life must stand still over several looks of the supervisor, rather than for some time:
a machine that stalls as a whole is nobody's fault.

    python -m chainshaper.enforcement.freezer.supervisor RUN_DIRECTORY OWNER_PID CORE=FD …
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import FrameType

from chainshaper.enforcement.freezer.counters import CounterPage, open_page
from chainshaper.enforcement.freezer.state import (
    COUNTERS,
    load_state,
    remove_state,
    restore,
    thaw,
)
from chainshaper.enforcement.own_processes import end_in_words, module_command
from chainshaper.enforcement.realtime import set_thread_name
from chainshaper.errors import ChainshaperError, OperationError, PlatformError

__all__ = ["main"]

PRIORITY = 98
LOOK_S = 0.02
LOOKS_UNTIL_THAWED = 4
LOOKS_UNTIL_HUNG = 24
_START_S = 10.0


class _EndAsked(BaseException):
    """The owner asks for the end (SIGTERM)."""


def _start(run_directory: Path, core: int, commands: int) -> subprocess.Popen[bytes]:
    command = module_command("chainshaper.enforcement.freezer.slot_dispatcher")
    return subprocess.Popen(
        [*command, str(run_directory), str(core), str(commands)],
        pass_fds=(commands,),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )


def _wait_until_running(page: CounterPage, dispatchers: dict[int, subprocess.Popen[bytes]]) -> None:
    """Until each has given its first sign of life.

    Raises:
        PlatformError, OperationError: one has not; what it said stands in the log already.
    """
    deadline = time.monotonic() + _START_S
    for core, process in dispatchers.items():
        while page.cores[core].beats == 0:
            code = process.poll()
            if code is not None:
                kind = PlatformError if code == PlatformError.exit_code else OperationError
                raise kind(f"the dispatcher of core {core} {end_in_words(code)} at its start")
            if time.monotonic() > deadline:
                raise OperationError(
                    f"the dispatcher of core {core} did not start within {_START_S:g} s: is a "
                    "real-time process keeping that core from everybody?"
                )
            time.sleep(0.002)


def _watch(
    owner: int,
    page: CounterPage,
    dispatchers: dict[int, subprocess.Popen[bytes]],
    run_directory: Path,
) -> str:
    """Returns when something has gone wrong: what. ``owner`` is a pidfd."""
    poll = select.poll()
    poll.register(owner, select.POLLIN)
    pidfds = {os.pidfd_open(process.pid): core for core, process in dispatchers.items()}
    for pidfd in pidfds:
        poll.register(pidfd, select.POLLIN)
    seen = dict.fromkeys(dispatchers, -1)
    still = dict.fromkeys(dispatchers, 0)
    while True:
        page.supervisor.value += 1
        for ended, _ in poll.poll(LOOK_S * 1000):
            if ended == owner:
                return "the owner has ended without releasing the servers"
            core = pidfds[ended]
            return f"the dispatcher of core {core} {end_in_words(dispatchers[core].wait())}"
        for core in dispatchers:
            beats = page.cores[core].beats
            still[core] = still[core] + 1 if beats == seen[core] else 0
            seen[core] = beats
            if still[core] == LOOKS_UNTIL_THAWED:
                _let_go(run_directory, core)
            if still[core] >= LOOKS_UNTIL_HUNG:
                return f"the dispatcher of core {core} hung, or somebody stopped it"


def _let_go(run_directory: Path, core: int) -> None:
    """Thaw the threads of all servers of a core; they stay in their groups."""
    state = load_state(run_directory)
    if state is not None:
        served = {server.name for server in state.table.servers if server.core == core}
        thaw(group for group in state.groups if group.server in served)


def _end(run_directory: Path, dispatchers: dict[int, subprocess.Popen[bytes]]) -> tuple[str, ...]:
    """End all dispatchers and restore everything; what could not be restored, in sentences.

    First restore, then end them: should we be killed in between, they are there to finish it.
    They are killed outright, because one that has been stopped hears nothing else.
    """
    state = load_state(run_directory)
    left = restore(state)
    for process in dispatchers.values():
        process.kill()
        process.wait()
    if not left:
        remove_state(run_directory)
    return left


def _asked(_number: int, _frame: FrameType | None) -> None:
    raise _EndAsked


def _become_first() -> None:
    """Out-rank the dispatchers where that is permitted: one of them may be what hangs."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


def main() -> None:
    """The process, as the owner starts it."""
    run_directory, owner_pid = Path(sys.argv[1]), int(sys.argv[2])
    signal.signal(signal.SIGTERM, _asked)
    for ignored in (signal.SIGINT, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    set_thread_name("servers/watch")
    owner = os.pidfd_open(owner_pid)
    state = load_state(run_directory)
    if state is None or os.getppid() != owner_pid:
        sys.exit("the owner has ended before the servers were in force")
    try:
        page = open_page(run_directory / COUNTERS, state.table)
    except OSError as error:
        sys.exit(f"the owner has ended before the servers were in force ({error})")
    dispatchers: dict[int, subprocess.Popen[bytes]] = {}
    code, reason = 0, ""
    try:
        for argument in sys.argv[3:]:
            core, _, commands = argument.partition("=")
            dispatchers[int(core)] = _start(run_directory, int(core), int(commands))
            os.close(int(commands))
        _wait_until_running(page, dispatchers)
        _become_first()
        reason, code = _watch(owner, page, dispatchers, run_directory), OperationError.exit_code
    except _EndAsked:
        pass
    except ChainshaperError as error:
        reason, code = str(error), error.exit_code
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        left = _end(run_directory, dispatchers)
    sys.stderr.write("\n".join(filter(None, [reason, *left])))
    sys.exit(code)


if __name__ == "__main__":
    main()
