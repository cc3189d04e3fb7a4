"""The back end `litmus`, up to the border of a kernel that is not here: see `litmus_stand_in`."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from actors import Actor, acting
from litmus_stand_in import StandIn, install

from chainshaper.enforcement import litmus
from chainshaper.enforcement.litmus import create, restore_plugin
from chainshaper.enforcement.scheduling_memory import restore_scheduling
from chainshaper.enforcement.servers import BackEnd, ReservationServer, ServerTable
from chainshaper.linux.runs import Journal, find_journals, open_journal
from chainshaper.linux.scheduling import available_cores, state_of
from chainshaper.values.errors import InputError, OperationError, PlatformError

MS = 1_000_000
CORE = available_cores()[-1]
CHAIN = ReservationServer("chain", CORE, 2, ((0, 86 * MS),))
OUTPUT = ReservationServer("output", CORE, 1, ((86 * MS, 87 * MS),))
TABLE = ServerTable(100 * MS, (OUTPUT, CHAIN))


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StandIn:
    installed = install(tmp_path)
    monkeypatch.setenv("PATH", str(installed.programs), prepend=os.pathsep)
    monkeypatch.setattr(litmus, "SCHED_LITMUS", os.SCHED_BATCH)
    return installed


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    return open_journal(tmp_path / "journals", "run")


@pytest.fixture
def actor(tmp_path: Path) -> Iterator[Actor]:
    with acting(tmp_path, "a", "b") as started:
        yield started


def _home(stand_in: StandIn, tid: int) -> dict[str, object]:
    """The reservation that a thread is in."""
    core, number = stand_in.state["home"][str(tid)]
    (found,) = [
        r for r in stand_in.state["reservations"] if (r["core"], r["number"]) == (core, number)
    ]
    return found  # type: ignore[no-any-return]


def test_servers_are_made_threads_attached_and_everything_put_back(
    stand_in: StandIn, journal: Journal, actor: Actor
) -> None:
    before = {tid: state_of(tid) for tid in actor.tids.values()}
    servers: BackEnd = create(TABLE, journal, stand_in.proc)
    servers.assign(actor.tids["a"], "chain")
    assert stand_in.calls == [], "nothing before it is armed"
    servers.arm(anchor_ns=0)
    servers.assign(actor.tids["b"], "output")
    assert stand_in.plugin == "P-RES"
    assert _home(stand_in, actor.tids["a"])["slots"] == [[0, 86 * MS - 1]]
    assert _home(stand_in, actor.tids["b"])["slots"] == [[86 * MS, 87 * MS - 1]]
    assert _home(stand_in, actor.tids["b"])["priority"] == 1
    assert state_of(actor.tids["a"]).cores == (CORE,)
    assert servers.failure() is None
    assert servers.counters()["chain"].slots is None
    for _ in range(2):
        servers.release()
    assert stand_in.plugin == "Linux"
    assert stand_in.state["reservations"] == []
    assert {tid: state_of(tid) for tid in actor.tids.values()} == before


def test_another_anchor_turns_the_slots_and_moves_the_threads(
    stand_in: StandIn, journal: Journal, actor: Actor
) -> None:
    servers = create(TABLE, journal, stand_in.proc)
    servers.assign(actor.tids["a"], "chain")
    servers.arm(anchor_ns=0)
    servers.arm(anchor_ns=1_030 * MS)
    home = _home(stand_in, actor.tids["a"])
    assert home["slots"] == [[0, 16 * MS - 1], [30 * MS, 100 * MS - 1]]
    servers.release()
    assert stand_in.plugin == "Linux"


def test_the_plugin_that_was_active_comes_back(
    tmp_path: Path, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "other").mkdir()
    stand_in = install(tmp_path / "other", plugin="GSN-EDF")
    monkeypatch.setenv("PATH", str(stand_in.programs), prepend=os.pathsep)
    servers = create(TABLE, journal, stand_in.proc)
    servers.arm(anchor_ns=0)
    assert stand_in.plugin == "P-RES"
    servers.release()
    assert stand_in.plugin == "GSN-EDF"


def test_reservations_of_others_are_not_put_at_risk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, journal: Journal
) -> None:
    stand_in = install(tmp_path, plugin="P-RES")
    monkeypatch.setenv("PATH", str(stand_in.programs), prepend=os.pathsep)
    with pytest.raises(OperationError, match=r"P-RES is active already.*`setsched Linux`"):
        create(TABLE, journal, stand_in.proc)
    assert stand_in.calls == []


def test_a_kernel_that_is_not_litmus_is_named_with_the_remedy(
    tmp_path: Path, journal: Journal
) -> None:
    with pytest.raises(PlatformError, match=r"not LITMUS.RT.*--backend auto.*--dry-run"):
        create(TABLE, journal, tmp_path / "nothing")


def test_tools_that_are_not_installed_are_named(
    stand_in: StandIn, monkeypatch: pytest.MonkeyPatch, journal: Journal
) -> None:
    (stand_in.programs / "resctl").unlink()
    monkeypatch.setenv("PATH", str(stand_in.programs))
    with pytest.raises(PlatformError, match=r"resctl is not on \$PATH.*liblitmus"):
        create(TABLE, journal, stand_in.proc)


def test_a_server_that_does_not_exist_is_refused(stand_in: StandIn, journal: Journal) -> None:
    with pytest.raises(InputError, match="no server 'chains': choose of output, chain"):
        create(TABLE, journal, stand_in.proc).assign(1, "chains")


def test_what_litmus_refuses_is_said_in_its_words_and_undone(
    stand_in: StandIn, journal: Journal
) -> None:
    beyond = ReservationServer("far", 4095, 1, ((0, MS),))
    servers = create(ServerTable(100 * MS, (beyond,)), journal, stand_in.proc)
    with pytest.raises(OperationError, match="failed to create reservation 4095001"):
        servers.arm(anchor_ns=0)
    servers.release()
    assert stand_in.plugin == "Linux"


def test_threads_that_have_ended_are_passed_over(
    stand_in: StandIn, journal: Journal, actor: Actor
) -> None:
    servers = create(TABLE, journal, stand_in.proc)
    servers.assign(actor.tids["a"], "chain")
    servers.assign(actor.tids["b"], "chain")
    actor.end("a")
    servers.arm(anchor_ns=0)
    assert stand_in.state["attached"] == [actor.tids["b"]]
    actor.end("b")
    servers.release()
    assert stand_in.plugin == "Linux"


def test_a_plugin_that_somebody_changed_is_a_failure(stand_in: StandIn, journal: Journal) -> None:
    servers = create(TABLE, journal, stand_in.proc)
    servers.arm(anchor_ns=0)
    subprocess.run([str(stand_in.programs / "setsched"), "GSN-EDF"], check=True)
    assert servers.failure() == "somebody has changed the scheduler plugin from P-RES to GSN-EDF"
    servers.release()
    assert stand_in.plugin == "GSN-EDF", "it is theirs"


_ARMED_AND_KILLED = """
import os, signal, sys
from pathlib import Path
from chainshaper.enforcement import litmus
from chainshaper.linux.runs import open_journal
from chainshaper.enforcement.servers import ReservationServer, ServerTable

litmus.SCHED_LITMUS = os.SCHED_BATCH
server = ReservationServer("chain", int(sys.argv[3]), 1, ((0, 1_000_000),))
servers = litmus.create(
    ServerTable(100_000_000, (server,)), open_journal(sys.argv[2]), Path(sys.argv[1])
)
servers.assign(int(sys.argv[4]), "chain")
servers.arm(0)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_after_a_crash_another_process_puts_all_back(
    stand_in: StandIn, tmp_path: Path, actor: Actor
) -> None:
    before = state_of(actor.tids["a"])
    arguments = (stand_in.proc, tmp_path / "killed", CORE, actor.tids["a"])
    subprocess.run([sys.executable, "-c", _ARMED_AND_KILLED, *map(str, arguments)], check=False)
    assert stand_in.plugin == "P-RES"
    assert state_of(actor.tids["a"]) != before
    (left,) = find_journals(tmp_path / "killed")
    with pytest.raises(OperationError, match="Setting new plugin failed"):
        restore_plugin(left)  # threads first
    for _ in range(2):
        restore_scheduling(left)
        restore_plugin(left)
    assert state_of(actor.tids["a"]) == before
    assert stand_in.plugin == "Linux"
