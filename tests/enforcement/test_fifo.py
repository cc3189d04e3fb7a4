"""The back end `fifo` with real threads."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from actors import Actor, acting

from chainshaper.enforcement.back_ends import Fifo
from chainshaper.enforcement.scheduling_memory import change_all
from chainshaper.enforcement.servers import BackEnd, ReservationServer, ServerTable
from chainshaper.linux.runs import Journal, open_journal
from chainshaper.linux.scheduling import Scheduling, available_cores, may_use_fifo, state_of
from chainshaper.values.errors import InputError

pytestmark = pytest.mark.skipif(
    not may_use_fifo(), reason="SCHED_FIFO is not permitted here: run as root to have this tested"
)

MS = 1_000_000
CORE = available_cores()[-1]
OUTPUT = ReservationServer("output", CORE, 1, ((86 * MS, 87 * MS),))
CHAIN = ReservationServer("chain", CORE, 2, ((0, 86 * MS),))
TABLE = ServerTable(100 * MS, (CHAIN, OUTPUT))


@pytest.fixture
def actor(tmp_path: Path) -> Iterator[Actor]:
    with acting(tmp_path, "a", "b", "c", "dds.asyn.0.1") as started:
        yield started


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    return open_journal(tmp_path / "journals", "run")


def _class(tid: int) -> tuple[int, int]:
    held = state_of(tid).scheduling_class
    return held.policy, held.priority


def test_servers_become_priorities_in_their_order_and_go_again(
    journal: Journal, actor: Actor
) -> None:
    before = {tid: state_of(tid) for tid in actor.tids.values()}
    servers: BackEnd = Fifo(TABLE, journal)
    servers.assign(actor.tids["a"], "chain")
    servers.assign(actor.tids["c"], "output")
    assert {tid: state_of(tid) for tid in actor.tids.values()} == before, "not armed yet"
    servers.arm(anchor_ns=0)
    assert _class(actor.tids["c"]) == (os.SCHED_FIFO, 87)
    assert _class(actor.tids["a"]) == (os.SCHED_FIFO, 85)
    assert state_of(actor.tids["a"]).cores == (CORE,)
    servers.assign(actor.tids["b"], "chain")  # now two of them take turns
    assert _class(actor.tids["a"]) == _class(actor.tids["b"]) == (os.SCHED_RR, 85)
    assert servers.failure() is None
    assert servers.counters()["chain"].slots is None
    for _ in range(2):
        servers.release()
    assert {tid: state_of(tid) for tid in actor.tids.values()} == before


def test_an_asynchronous_publisher_stays_below_its_executor(journal: Journal, actor: Actor) -> None:
    """Its server has the better priority, but it spins on locks that the executor holds."""
    servers = Fifo(TABLE, journal)
    servers.assign(actor.tids["dds.asyn.0.1"], "output")
    servers.assign(actor.tids["a"], "chain")
    servers.arm(anchor_ns=0)
    assert _class(actor.tids["a"]) == (os.SCHED_FIFO, 85)
    assert _class(actor.tids["dds.asyn.0.1"]) == (os.SCHED_FIFO, 84)
    servers.release()


def test_threads_that_end_are_passed_over(journal: Journal, actor: Actor) -> None:
    servers = Fifo(TABLE, journal)
    servers.assign(actor.tids["a"], "chain")
    actor.end("a")
    servers.assign(actor.tids["a"], "chain")
    servers.arm(anchor_ns=0)
    servers.release()


def test_threads_that_a_plan_has_scheduled_already_stay_as_they_are(
    journal: Journal, actor: Actor
) -> None:
    change_all(journal, [(actor.thread("a"), Scheduling(41, None))])
    servers = Fifo(TABLE, journal)
    servers.assign(actor.tids["a"], "chain")
    servers.assign(actor.tids["b"], "output")
    servers.arm(anchor_ns=0)
    assert _class(actor.tids["a"]) == (os.SCHED_FIFO, 41)
    assert _class(actor.tids["b"]) == (os.SCHED_FIFO, 87)
    servers.release()
    assert _class(actor.tids["a"]) == (os.SCHED_OTHER, 0)


def test_a_server_that_does_not_exist_is_refused(journal: Journal) -> None:
    with pytest.raises(InputError, match="no server is named chains: chain, output are"):
        Fifo(TABLE, journal).assign(1, "chains")


def test_more_priorities_than_there_are_are_refused(journal: Journal) -> None:
    many = tuple(ReservationServer(f"s{n}", CORE, n, ((0, MS),)) for n in range(1, 45))
    with pytest.raises(InputError, match="44 different server priorities do not fit"):
        Fifo(ServerTable(100 * MS, many), journal)
    Fifo(ServerTable(100 * MS, many[:43]), journal)
