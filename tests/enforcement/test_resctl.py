"""Commands for LITMUS^RT in its own grammar: known texts, and what the tools' rules make of them.

The rules of `resctl` are applied by a stand-in, see `litmus_stand_in`.
"""

import subprocess
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from litmus_stand_in import StandIn, install

from chainshaper.enforcement.litmus import (
    create_command,
    interval_text,
    litmus_commands,
    milliseconds_text,
    turned,
)
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.values.errors import InputError

MS = 1_000_000
CHAIN = ReservationServer("chain", core=1, priority=2, slots=((0, 86 * MS),))
OUTPUT = ReservationServer("output", core=1, priority=1, slots=((86 * MS, 87 * MS),))
TABLE = ServerTable(100 * MS, (OUTPUT, CHAIN))


def test_the_commands_of_a_plan_are_these() -> None:
    """The paper's single band (section 3.2): R_m° [86, 87), R_m [0, 86)."""
    commands = litmus_commands(TABLE, {"chain": [101, 102], "output": [103]}, anchor_ns=0)
    assert [" ".join(command) for command in commands] == [
        "setsched P-RES",
        "resctl -n 1001 -t table-driven -c 1 -m 100 -q 1 [86,87)",
        "resctl -n 1002 -t table-driven -c 1 -m 100 -q 2 [0,86)",
        "resctl -a 103 -r 1001 -c 1",
        "resctl -a 101 -r 1002 -c 1",
        "resctl -a 102 -r 1002 -c 1",
    ]


@pytest.mark.parametrize(
    ("duration_ns", "text"),
    [(0, "0"), (1, "0.000001"), (86_500_000, "86.5"), (100 * MS, "100"), (1_234, "0.001234")],
)
def test_times_are_decimal_milliseconds(duration_ns: int, text: str) -> None:
    assert milliseconds_text(duration_ns) == text


@settings(max_examples=2000)
@given(st.integers(0, 10**13))
def test_a_time_survives_being_a_double_to_the_nanosecond(duration_ns: int) -> None:
    """C's conversion: to a double, times a million, cut off; `resctl` does no rounding."""
    assert int(float(milliseconds_text(duration_ns)) * 1_000_000) == duration_ns


def test_where_a_plain_text_would_lose_a_nanosecond_it_gets_half_of_one_more() -> None:
    assert int(float("1.001") * 1_000_000) == 1_000_999
    assert milliseconds_text(1_001_000) == "1.0010005"


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


def test_more_slots_than_the_kernel_takes_are_refused() -> None:
    many = tuple((10 * n, 10 * n + 5) for n in range(1025))
    server = ReservationServer("many", 0, 1, many)
    with pytest.raises(InputError, match=r"server many has 1025 slots.*1024"):
        create_command(1, server, 100 * MS, 0)


def test_a_slot_that_is_too_short_for_the_kernel_is_refused() -> None:
    server = ReservationServer("short", 0, 1, ((10, 11),))
    with pytest.raises(InputError, match="server short: the slot at 10ns is shorter than 2 ns"):
        create_command(1, server, 100 * MS, 0)


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory: pytest.TempPathFactory) -> StandIn:
    return install(tmp_path_factory.mktemp("litmus"), plugin="P-RES")


def _resctl(stand_in: StandIn, *arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [str(stand_in.programs / "resctl"), *arguments], capture_output=True, text=True, check=False
    )


REFUSED = {
    "exceeds major cycle length": ["[86,100]"],
    "overlaps with previous interval": ["[2,86]", "[86,87]"],
    "end before start": ["[5,5)"],
    "must not start before zero": ["[-1,5)"],
    "could not parse": ["[1 ,2)"],
    "at least one interval": [],
}


@pytest.mark.parametrize(("reason", "intervals"), REFUSED.items(), ids=list(REFUSED))
def test_the_stand_in_refuses_what_resctl_refuses(
    stand_in: StandIn, reason: str, intervals: list[str]
) -> None:
    done = _resctl(stand_in, "-n", "9", "-t", "table-driven", "-m", "100", *intervals)
    assert done.returncode in (1, 5)
    assert reason in done.stderr
    assert not [r for r in stand_in.state["reservations"] if r["number"] == 9]


def test_the_stand_in_takes_what_resctl_takes(stand_in: StandIn) -> None:
    for number, intervals in enumerate(
        (["[2,86)", "[86,87)"], ["[ 50, 60)", "[100,125]x"], ["[0.5,1e2)"], ["[0x1p3,9)"]), 20
    ):
        done = _resctl(stand_in, "-n", str(number), "-t", "table-driven", "-m", "250", *intervals)
        assert (done.returncode, done.stderr) == (0, "")


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
    stand_in: StandIn, table: tuple[ReservationServer, int, int]
) -> None:
    server, cycle, anchor = table
    number = 1_000 + len(stand_in.state["reservations"])
    command = create_command(number, server, cycle, anchor)
    done = _resctl(stand_in, *command[1:])
    assert (done.returncode, done.stderr) == (0, ""), command
    (made,) = [r for r in stand_in.state["reservations"] if r["number"] == number]
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


def test_intervals_are_half_open() -> None:
    assert interval_text(2 * MS, 86_250_000) == "[2,86.25)"


def test_the_stand_in_is_installed_where_it_is_asked_to(tmp_path: Path) -> None:
    assert install(tmp_path).plugin == "Linux"
