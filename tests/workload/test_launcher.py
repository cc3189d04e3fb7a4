"""The launcher: what dies says how, and nothing is left behind."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest
from known import known
from processes import children_of, is_alive, wait_for

from chainshaper.values.errors import OperationError
from chainshaper.workload.launcher import Child, end_all, first_casualty, start_child

BODIES = {
    "polite": "input()\ninput()",
    "fails": "import sys\nsys.exit('earlier line\\ndisk on fire')",
    "exits": "import sys\nsys.exit(3)",
    "raises": "raise RuntimeError('no sensor')",
    "crashes": "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)",
    "real_time_signal": "import os\nos.kill(os.getpid(), 40)",
    "babbles": "print('hello', flush=True)\ninput()\ninput()",
    "counts": "print(3, flush=True)\ninput()\ninput()",
    "cut_off": "import json\nprint(json.dumps({'bytes': 100}), flush=True)\nprint('short')",
    "hesitates": "print('{', end='', flush=True)\ninput()\ninput()",
    "says_its_pid": "import json, os\nprint(json.dumps({'pid': os.getpid()}), flush=True)\ninput()",
    "stubborn": (
        "import signal, time\n"
        "for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):\n"
        "    signal.signal(number, signal.SIG_IGN)\n"
        "print('{}', flush=True)\n"
        "while True:\n"
        "    time.sleep(600)"
    ),
    "bound": (
        "import json, time\n"
        "import signal\nfrom chainshaper.linux.scheduling import signalled_with_parent\n"
        "signalled_with_parent(json.loads(input())['parent'], signal.SIGKILL)\n"
        "print('{}', flush=True)\n"
        "while True:\n"
        "    time.sleep(600)"  # it would never notice that the pipe is closed
    ),
}


class Nursery:
    """Starts children with given bodies; whatever a test does, they are gone after it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.children: list[Child] = []

    def start(self, body: str) -> Child:
        (self.folder / f"{body}.py").write_text(BODIES[body])
        with mock.patch.object(sys, "path", [*sys.path, str(self.folder)]):
            child = start_child(f"node {body}", body, {}, libraries=[body])
        self.children.append(child)
        return child


@pytest.fixture
def nursery(tmp_path: Path) -> Iterator[Nursery]:
    nursery = Nursery(tmp_path)
    yield nursery
    for child in nursery.children:
        with contextlib.suppress(ProcessLookupError):
            child.process.kill()
        child.process.wait()


@pytest.mark.parametrize(
    ("body", "how"),
    [
        ("fails", "ended with code 1 before the run was over: disk on fire"),
        ("exits", "ended with code 3 before the run was over"),
        ("raises", "ended with code 1 before the run was over: RuntimeError: no sensor"),
        ("crashes", "was killed by SIGSEGV before the run was over"),
        ("real_time_signal", "was killed by signal 40 before the run was over"),
    ],
)
def test_the_obituary_says_how_it_died_and_what_it_said_last(
    nursery: Nursery, body: str, how: str
) -> None:
    child = nursery.start(body)
    with pytest.raises(OperationError) as died:
        child.hear()
    assert str(died.value) == f"node {body} (pid {child.pid}) {how}"
    assert first_casualty([child]) is child


def test_a_child_killed_from_outside_is_a_casualty(nursery: Nursery) -> None:
    healthy, victim = nursery.start("polite"), nursery.start("polite")
    assert first_casualty([healthy, victim]) is None
    os.kill(victim.pid, signal.SIGKILL)
    wait_for(lambda: first_casualty([healthy, victim]) is victim, "the casualty to be noticed")
    assert "was killed by SIGKILL" in victim.obituary()


@pytest.mark.parametrize("body", ["polite", "hesitates"])  # in the midst of a line
def test_a_child_that_is_silent_is_not_waited_for_for_ever(nursery: Nursery, body: str) -> None:
    said = rf"node {body} \(pid \d+\) has not answered for 0.5 s: it hangs, or was stopped"
    with pytest.raises(OperationError, match=said):
        nursery.start(body).hear(within_s=0.5)


def test_a_child_that_babbles_or_is_cut_off_is_not_believed(
    nursery: Nursery, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("chainshaper.workload.launcher.DYING_S", 0.1)  # these two run on
    for body in ("babbles", "counts"):
        child = nursery.start(body)
        said = "sends something that is not part of the protocol"
        with pytest.raises(OperationError, match=said):
            child.hear()
        assert first_casualty([child]) is None
    monkeypatch.undo()
    child = nursery.start("cut_off")
    with pytest.raises(OperationError, match="ended with code 0 before the run was over"):
        child.hear_bytes(child.hear()["bytes"])
    for _ in range(3):  # and talking to a dead one is no error of its own
        child.tell(anything="x" * 100_000)


def test_a_program_that_does_not_exist_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/no/python")
    with pytest.raises(OperationError, match=r"node x cannot be started: .*/no/python"):
        start_child("node x", "anything", {})


def test_the_end_leaves_none_whatever_they_do(nursery: Nursery) -> None:
    polite, stubborn = nursery.start("polite"), nursery.start("stubborn")
    stopped, dead = nursery.start("says_its_pid"), nursery.start("exits")
    stubborn.hear()
    assert stopped.hear() == {"pid": stopped.pid}
    os.kill(stopped.pid, signal.SIGSTOP)
    dead.process.wait()

    end_all([polite, stubborn, stopped, dead], patience_s=0.3)

    for child in nursery.children:
        assert child.process.returncode is not None
        assert not Path(f"/proc/{child.pid}").exists(), f"{child.name} is still there"
    assert polite.pid not in children_of(os.getpid())


def test_a_polite_child_is_out_of_reach_of_ctrl_c_and_asked_before_it_is_killed(
    nursery: Nursery,
) -> None:
    polite = nursery.start("says_its_pid")
    polite.hear()
    assert os.getsid(polite.pid) == polite.pid != os.getsid(0)
    end_all([polite], patience_s=20)
    assert polite.process.returncode == 0


def test_children_die_when_their_launcher_is_killed(tmp_path: Path) -> None:
    """SIGKILL leaves the launcher no time for anything: the kernel has to do it."""
    (tmp_path / "bound.py").write_text(BODIES["bound"])
    program = (
        "import os, sys, time\n"
        "from chainshaper.workload.launcher import start_child\n"
        f"sys.path.append({str(tmp_path)!r})\n"
        "children = [start_child(f'node {i}', 'bound', {}, (), ['bound']) for i in range(2)]\n"
        "for child in children:\n"
        "    child.tell(parent=os.getpid())\n"
        "    child.hear()\n"
        "print(*[child.pid for child in children], flush=True)\n"
        "time.sleep(600)\n"
    )
    launcher = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    try:
        pids = [int(pid) for pid in known(launcher.stdout).readline().split()]
        assert len(pids) == 2
        assert all(Path(f"/proc/{pid}").exists() for pid in pids)
    finally:
        launcher.kill()
        launcher.communicate()
    wait_for(lambda: not any(is_alive(pid) for pid in pids), "the kernel to end the children")


def test_waiting_ends_with_a_signal_whoever_else_handles_it(nursery: Nursery) -> None:
    """Libraries install handlers after which the kernel goes on with an interrupted `read`."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupted)
    try:
        signal.siginterrupt(signal.SIGALRM, False)
        child = nursery.start("hesitates")
        signal.setitimer(signal.ITIMER_REAL, 0.5)
        with pytest.raises(KeyboardInterrupt):
            child.hear(within_s=30.0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
