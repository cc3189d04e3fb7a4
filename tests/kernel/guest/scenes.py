"""Spinning threads and a process that holds the back end, gone again when a check is over."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from run_windows import Intervals, read_windows

from chainshaper.enforcement.servers import ReservationServer, ServerTable

HERE = Path(__file__).parent
MS = 1_000_000


def server(
    name: str, start_ms: int, end_ms: int, priority: int = 1, core: int = 0
) -> ReservationServer:
    return ReservationServer(name, core, priority, ((start_ms * MS, end_ms * MS),))


def table(*servers: ReservationServer, cycle_ms: int = 50) -> ServerTable:
    return ServerTable(cycle_ms * MS, servers)


A = server("A", 10, 20)
CYCLE = 50 * MS


def scheduler_state() -> str:
    """What the kernel says of sched_ext: enabled, disabled or on the way."""
    return Path("/sys/kernel/sched_ext/state").read_text().strip()


def wait(milliseconds: float) -> None:
    time.sleep(milliseconds / 1e3)


def wait_for_state(wanted: str, limit_ms: int = 2000) -> None:
    """Until sched_ext is in this state; its absence is what a check fails with."""
    until = time.monotonic_ns() + limit_ms * MS
    while scheduler_state() != wanted:
        assert time.monotonic_ns() < until, f"sched_ext is {scheduler_state()}, not {wanted}"
        wait(1)


def wait_for_phase(phase_ms: int) -> int:
    """Sleep until this phase of the next cycle; the instant."""
    now = time.monotonic_ns()
    instant = now - now % CYCLE + CYCLE + phase_ms * MS
    wait((instant - now) / MS)
    return instant


class Spinner:
    """A process with one thread that wants the core; `job` is (anchor, period, offset, work), and
    behind these what else is to stand on its command line.

    As a ``gate`` it is `gate_process.py`, whose job and log are its own.
    """

    def __init__(
        self,
        name: str,
        core: int = 0,
        job: tuple[int | str, ...] | None = None,
        gate: bool = False,
    ):
        self.log = Path(f"/tmp/{name}.log")
        program = [sys.executable, HERE / "gate_process.py"] if gate else [HERE / "spin"]
        arguments = [str(one) for one in (*program, self.log, core, *(job or ()))]
        self.process = subprocess.Popen(arguments, stdout=subprocess.PIPE)
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == b"ready\n"
        self.tid = self.process.pid

    def windows(self) -> Intervals:
        """Stop it; when it ran."""
        self.process.terminate()
        assert self.process.wait() == 0, "spin has failed, or written down too many windows"
        return read_windows(self.log)


class Loader:
    """The process that holds the back end; calls go through :meth:`ask`."""

    def __init__(self, servers: ServerTable, user: int | None = None) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(HERE / "scx_loader.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            user=user,
        )
        self.ask("create", asdict(servers))

    def answer(self, method: str, *arguments: Any) -> dict[str, Any]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps([method, *arguments]).encode() + b"\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        return answer

    def ask(self, method: str, *arguments: Any) -> Any:
        """A call's result; an error is a failure of the check."""
        answer = self.answer(method, *arguments)
        assert "ok" in answer, f"{method}: {answer}"
        return answer["ok"]

    def arm(self, anchor: int = 0) -> int:
        """Arm, make sure of it, and tell since when."""
        self.ask("arm", anchor)
        assert scheduler_state() == "enabled", f"sched_ext is {scheduler_state()}"
        return int(self.ask("since"))


class Scene:
    def __init__(self) -> None:
        self._processes: list[subprocess.Popen[bytes]] = []

    def spinner(self, name: str, core: int = 0, job: Any = None, gate: bool = False) -> Spinner:
        made = Spinner(name, core, job, gate)
        self._processes.append(made.process)
        return made

    def loader(
        self, servers: ServerTable, members: dict[str, list[Spinner]] | None = None
    ) -> Loader:
        """The back end, with threads assigned."""
        made = Loader(servers)
        self._processes.append(made.process)
        for name, threads in (members or {}).items():
            for thread in threads:
                made.ask("assign", thread.tid, name)
        return made

    def applied(self, *arguments: int | str) -> subprocess.Popen[bytes]:
        """`apply_process.py`, in force."""
        command = [sys.executable, str(HERE / "apply_process.py"), *map(str, arguments)]
        said = Path("/tmp/apply_process.err")
        with said.open("wb") as errors:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors)
        self._processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == b"in force\n", said.read_text()
        return process

    def close(self) -> None:
        """End everything, and see the machine as it was."""
        for process in self._processes:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGCONT)
            process.kill()
            process.wait()
        wait_for_state("disabled")


@contextlib.contextmanager
def scene() -> Iterator[Scene]:
    made = Scene()
    try:
        yield made
    finally:
        made.close()
