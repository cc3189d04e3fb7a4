"""The back end `litmus`: its commands, and their effect up to the border of the kernel.

The rules of LITMUS^RT's tools are applied by a stand-in, see `litmus_stand_in`.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from actors import Actor, acting
from applied_plans import one_server_plan
from bare_plans import bare_plan
from command_line import called
from hypothesis import example, given, settings
from hypothesis import strategies as st
from litmus_stand_in import StandIn, install
from small_chain import small_chain_plan

from chainshaper.enforcement import litmus
from chainshaper.enforcement.journal import Journal, find_journals, open_journal
from chainshaper.enforcement.litmus import (
    Litmus,
    create_command,
    litmus_commands,
    milliseconds_text,
    restore_plugin,
    turned,
)
from chainshaper.enforcement.node_threads import Allocation
from chainshaper.enforcement.scheduling_memory import release_threads
from chainshaper.enforcement.servers import BackEnd, ReservationServer, ServerTable
from chainshaper.flow import anchoring
from chainshaper.flow import planned_changes as changes
from chainshaper.flow.phase import Phase
from chainshaper.flow.planned_changes import planned_changes
from chainshaper.linux.scheduling import available_cores, state_of
from chainshaper.planning import Plan, save_plan
from chainshaper.planning.chain_plan import Server, Thread, revised
from chainshaper.values.errors import InputError, OperationError, PlatformError

pytestmark = pytest.mark.timed

MS = 1_000_000
PAPER_CHAIN = ReservationServer("chain", core=1, priority=2, slots=((0, 86 * MS),))
PAPER_OUTPUT = ReservationServer("output", core=1, priority=1, slots=((86 * MS, 87 * MS),))
PAPER_TABLE = ServerTable(100 * MS, (PAPER_OUTPUT, PAPER_CHAIN))


def test_the_commands_of_a_plan_are_these() -> None:
    """The paper's single band (section 3.2): R_m° [86, 87), R_m [0, 86)."""
    commands = litmus_commands(PAPER_TABLE, {"chain": [101, 102], "output": [103]}, anchor_ns=0)
    assert [" ".join(command) for command in commands] == [
        "setsched P-RES",
        "resctl -n 1001 -t table-driven -c 1 -m 100 -q 1 [86,87)",
        "resctl -n 1002 -t table-driven -c 1 -m 100 -q 2 [0,86)",
        "resctl -a 103 -r 1001 -c 1",
        "resctl -a 101 -r 1002 -c 1",
        "resctl -a 102 -r 1002 -c 1",
    ]


def test_litmus_commands_are_printed_on_any_kernel(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    save_plan(Plan.of(one_server_plan()), path)
    said = called("apply", path, "--backend", "litmus", "--dry-run")
    core = available_cores()[-1]
    number = core * 1000 + 1
    assert said.out.splitlines() == [
        "setsched P-RES",
        f"resctl -n {number} -t table-driven -c {core} -m 100 -q 1 '[0,30)'",
        f"resctl -a TID:/origin -r {number} -c {core}",
    ]


def test_printed_commands_have_the_slots_that_apply_would_enforce() -> None:
    """A timer at 17 ms, cycles of 100 that start 20 ms behind the anchor: the slot opens at 19."""
    plan = revised(one_server_plan(), offset_ns=20 * MS)
    changes = planned_changes(Plan.of(plan), "litmus", phase_ns=17 * MS)
    assert [command[-1] for command in changes.commands if "-n" in command] == ["[19,49)"]


def test_printed_commands_open_servers_for_overruns_as_apply_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A timer at 17 ms of 50: the slot opens at 19, and is open until 1 ms before the next timer.
    Cycles start 10 ms behind the anchor, at 9: the server is open for the first 7 ms from there.
    """
    plan = revised(small_chain_plan(10 * MS, 20 * MS), offset_ns=10 * MS)
    monkeypatch.setattr(anchoring, "chain_phases", lambda *_: [Phase(17 * MS, 0)])
    monkeypatch.setattr(changes, "find_threads", lambda *_, **__: Allocation((), ()))
    _, created, *_ = planned_changes(Plan.of(plan), "litmus").commands
    assert created[-3:] == ("[0,9)", "[9,16)", "[19,50)")


def test_printed_commands_close_the_papers_servers_where_the_plan_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Table 1: five callbacks in slots of 16 ms, whose timer expires 2 ms before the first. Left
    open until callbacks are done, all but the first end 1 ms before the timer expires again.
    """
    monkeypatch.setattr(anchoring, "chain_phases", lambda *_: [Phase(98 * MS, 0)])
    monkeypatch.setattr(changes, "find_threads", lambda *_, **__: Allocation((), ()))
    servers = [
        Server(
            name=f"node{number}",
            core=1,
            priority=1,
            slots=(((number - 1) * 16 * MS, number * 16 * MS),),
            threads=(Thread(node=f"/node{number}"),),
        )
        for number in range(1, 6)
    ]
    plan = bare_plan("/t1../t5", 100 * MS, *servers, policy="server-per-callback")
    closed = planned_changes(Plan.of(revised(plan, slot_ends="closed")), "litmus").commands
    assert [" ".join(command) for command in closed] == [
        "setsched P-RES",
        "resctl -n 1001 -t table-driven -c 1 -m 100 -q 1 [0,16)",
        "resctl -n 1002 -t table-driven -c 1 -m 100 -q 1 [16,32)",
        "resctl -n 1003 -t table-driven -c 1 -m 100 -q 1 [32,48)",
        "resctl -n 1004 -t table-driven -c 1 -m 100 -q 1 [48,64)",
        "resctl -n 1005 -t table-driven -c 1 -m 100 -q 1 [64,80)",
        *(f"resctl -a TID:/node{number} -r 100{number} -c 1" for number in range(1, 6)),
    ]
    left_open = planned_changes(Plan.of(plan), "litmus").commands
    assert [one[-1] for one in left_open if "-n" in one] == [
        "[0,16)",
        *(f"[{start},97)" for start in (16, 32, 48, 64)),
    ]


@settings(max_examples=2000)
@given(st.integers(0, 10**13))
@example(86_500_000)
def test_times_are_decimal_milliseconds_that_survive_being_a_double(duration_ns: int) -> None:
    """C's conversion: to a double, times a million, cut off; `resctl` does no rounding."""
    assert int(float(milliseconds_text(duration_ns)) * 1_000_000) == duration_ns
    known = {0: "0", 1: "0.000001", 86_500_000: "86.5", 1_001_000: "1.0010005"}
    assert {one: milliseconds_text(one) for one in known} == known


@pytest.mark.parametrize(
    ("slots", "anchor_ns", "expected"),
    [
        ([(0, 30)], 0, ((0, 30),)),
        ([(0, 30)], 1_000, ((0, 30),)),
        ([(0, 30)], 1_020, ((20, 50),)),
        ([(0, 30)], 1_070, ((70, 100),)),
        ([(0, 30)], 1_080, ((0, 10), (80, 100))),
        ([(10, 20), (90, 100)], 5, ((0, 5), (15, 25), (95, 100))),
        ([(0, 100)], 40, ((0, 40), (40, 100))),
        ([(0, 30)], 1_071, ((71, 100),)),  # one nanosecond is nothing to the kernel
    ],
)
def test_slots_turn_with_the_anchor(
    slots: list[tuple[int, int]], anchor_ns: int, expected: tuple[tuple[int, int], ...]
) -> None:
    assert turned(slots, 100, anchor_ns) == expected


@pytest.mark.parametrize(
    ("slots", "reason"),
    [
        (tuple((10 * n, 10 * n + 5) for n in range(1025)), r"server any has 1025 slots.*1024"),
        (((10, 11),), "server any: the slot at 10 ns is shorter than 2 ns"),
    ],
)
def test_slots_that_the_kernel_does_not_take_are_refused(
    slots: tuple[tuple[int, int], ...], reason: str
) -> None:
    with pytest.raises(InputError, match=reason):
        create_command(1, ReservationServer("any", 0, 1, slots), 100 * MS, 0)


@pytest.fixture(scope="module")
def tools(tmp_path_factory: pytest.TempPathFactory) -> StandIn:
    return install(tmp_path_factory.mktemp("litmus"), plugin="P-RES")


def _resctl(tools: StandIn, *arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [str(tools.programs / "resctl"), *arguments], capture_output=True, text=True, check=False
    )


def test_the_stand_in_refuses_what_resctl_refuses(tools: StandIn) -> None:
    for reason, intervals in {
        "exceeds major cycle length": ["[86,100]"],
        "overlaps with previous interval": ["[2,86]", "[86,87]"],
        "end before start": ["[5,5)"],
        "must not start before zero": ["[-1,5)"],
        "could not parse": ["[1 ,2)"],
        "at least one interval": [],
    }.items():
        done = _resctl(tools, "-n", "9", "-t", "table-driven", "-m", "100", *intervals)
        assert done.returncode in (1, 5)
        assert reason in done.stderr
        assert not [r for r in tools.state["reservations"] if r["number"] == 9]


@st.composite
def tables(draw: st.DrawFn) -> tuple[ReservationServer, int, int]:
    cycle = draw(st.integers(1_000, 2 * 10**9))
    edges = draw(st.lists(st.integers(0, cycle), min_size=2, max_size=8, unique=True))
    edges.sort()
    slots = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=False) if b - a >= 2]
    anchor = draw(st.integers(0, 10**15))
    return ReservationServer("any", 0, 1, tuple(slots or [(0, cycle)])), cycle, anchor


@settings(max_examples=25, deadline=None)  # each example is a process
@given(tables())
def test_every_table_is_taken_and_opens_where_it_should(
    tools: StandIn, table: tuple[ReservationServer, int, int]
) -> None:
    server, cycle, anchor = table
    number = 1_000 + len(tools.state["reservations"])
    command = create_command(number, server, cycle, anchor)
    done = _resctl(tools, *command[1:])
    assert (done.returncode, done.stderr) == (0, ""), command
    (made,) = [r for r in tools.state["reservations"] if r["number"] == number]
    assert made["cycle"] == cycle
    # Closed intervals, since time zero of the clock: from each slot's start to before its end.
    for start, end in server.slots:
        middle = (start + end) // 2
        for instant in (start + 1, middle, end - 2):
            if start < instant < end - 1:
                phase = (instant + anchor) % cycle
                assert any(a <= phase <= b for a, b in made["slots"])
    lost = sum(b - a for a, b in server.slots) - sum(b - a + 1 for a, b in made["slots"])
    assert 0 <= lost <= 2 * len(server.slots), "a nanosecond for each cut at most"


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
    made = {(r["core"], r["number"]): r for r in stand_in.state["reservations"]}
    return made[core, number]  # type: ignore[no-any-return]


def test_servers_are_made_threads_attached_and_everything_put_back(
    stand_in: StandIn, journal: Journal, actor: Actor
) -> None:
    before = {tid: state_of(tid) for tid in actor.tids.values()}
    servers: BackEnd = Litmus(TABLE, journal, stand_in.proc)
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


def test_another_anchor_moves_threads_and_those_that_have_ended_are_passed_over(
    stand_in: StandIn, journal: Journal, actor: Actor
) -> None:
    servers = Litmus(TABLE, journal, stand_in.proc)
    for tid in actor.tids.values():
        servers.assign(tid, "chain")
    actor.end("b")
    servers.arm(anchor_ns=0)
    assert stand_in.state["attached"] == [actor.tids["a"]]
    servers.arm(anchor_ns=1_030 * MS)
    home = _home(stand_in, actor.tids["a"])
    assert home["slots"] == [[0, 16 * MS - 1], [30 * MS, 100 * MS - 1]]
    actor.end("a")
    servers.release()
    assert stand_in.plugin == "Linux"


def test_a_plugin_that_others_chose_comes_back_stays_theirs_or_is_not_put_at_risk(
    tmp_path: Path, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in = install(tmp_path, plugin="GSN-EDF")
    monkeypatch.setenv("PATH", str(stand_in.programs), prepend=os.pathsep)
    setsched = str(stand_in.programs / "setsched")
    servers = Litmus(TABLE, journal, stand_in.proc)
    servers.arm(anchor_ns=0)
    assert stand_in.plugin == "P-RES"
    servers.release()
    assert stand_in.plugin == "GSN-EDF"
    servers = Litmus(TABLE, journal, stand_in.proc)
    servers.arm(anchor_ns=0)
    subprocess.run([setsched, "Linux"], check=True)
    assert servers.failure() == "the scheduler plugin was changed from P-RES to Linux"
    servers.release()
    assert stand_in.plugin == "Linux", "it is theirs"
    subprocess.run([setsched, "P-RES"], check=True)
    calls = stand_in.calls
    with pytest.raises(OperationError, match=r"P-RES is active already.*`setsched Linux`"):
        Litmus(TABLE, journal, stand_in.proc)
    assert stand_in.calls == calls


def test_what_is_missing_or_refused_is_named_with_the_remedy(
    stand_in: StandIn, monkeypatch: pytest.MonkeyPatch, journal: Journal, tmp_path: Path
) -> None:
    beyond = ReservationServer("far", 4095, 1, ((0, MS),))
    servers = Litmus(ServerTable(100 * MS, (beyond,)), journal, stand_in.proc)
    with pytest.raises(OperationError, match="failed to create reservation 4095001"):
        servers.arm(anchor_ns=0)
    servers.release()
    assert stand_in.plugin == "Linux"
    with pytest.raises(PlatformError, match=r"not LITMUS.RT.*--backend auto.*--dry-run"):
        Litmus(TABLE, journal, tmp_path / "nothing")
    (stand_in.programs / "resctl").unlink()
    monkeypatch.setenv("PATH", str(stand_in.programs))
    with pytest.raises(PlatformError, match=r"resctl is not on \$PATH.*liblitmus"):
        Litmus(TABLE, journal, stand_in.proc)


_ARMED_AND_KILLED = """
import os, signal, sys
from pathlib import Path
from chainshaper.enforcement import litmus
from chainshaper.enforcement.journal import open_journal
from chainshaper.enforcement.servers import ReservationServer, ServerTable

litmus.SCHED_LITMUS = os.SCHED_BATCH
server = ReservationServer("chain", int(sys.argv[3]), 1, ((0, 1_000_000),))
servers = litmus.Litmus(
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
        release_threads(left)
        restore_plugin(left)
    assert state_of(actor.tids["a"]) == before
    assert stand_in.plugin == "Linux"
