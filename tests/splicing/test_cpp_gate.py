"""The gate in C++ decides what the gate in Python decides, and its log is read."""

import random
import shutil
import struct
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest
from cpp_program import compiled
from gate_table import PUBLISHING_NS, Case, Change, ChangeKind, Outcome, cases, walk

from chainshaper.robot.decision import DROPPED
from chainshaper.robot.gate import (
    ANCHORS,
    INTO_OPEN_SLOT,
    LATE,
    MESSAGES,
    OVERRUNS,
    Gate,
    GateModes,
)
from chainshaper.robot.serialized import origin_of
from chainshaper.sources.gate_log import read_gate_log

CASES = 5000
CHANGED = ("mode", "moved", "phase")


SOURCE = Path(__file__).parent / "cpp_gate.cpp"


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(SOURCE, tmp_path_factory.mktemp("cpp"))


def as_text(case: Case) -> str:
    """A case as the driver reads it; modes are named by their numbers."""
    gate, modes = case.gate, case.gate.modes
    names = [] if modes is None else list(modes.slots)
    words: list[int | str] = [
        *(ANCHORS.index(gate.anchor), gate.phase_ns, LATE.index(gate.overrun), gate.due_cycles),
        *(MESSAGES.index(gate.messages), gate.depth, gate.cycle_ns),
        *(INTO_OPEN_SLOT.index(gate.into_open_slot), len(gate.slots)),
        *(bound for slot in gate.slots for bound in slot),
        len(names),
    ]
    if modes is not None:
        words += [*modes.slots.values(), names.index(modes.default), LATE.index(modes.late)]
    words += [len(case.changes)]
    for change in case.changes:
        value = names.index(change.value) if isinstance(change.value, str) else change.value
        words += [change.from_ns, CHANGED.index(change.kind), value]
    words += [len(case.steps), *case.steps, PUBLISHING_NS, case.late_ns, len(case.arrivals)]
    words += [word for arrival, stamp in case.arrivals for word in (arrival, _or_dash(stamp))]
    return " ".join(map(str, words))


def as_answer(case: Case, outcome: Outcome) -> str:
    """ChangeKind becomes of a message, as the driver prints it."""
    release, dash = outcome.release, _or_dash
    names = [] if case.gate.modes is None else list(case.gate.modes.slots)
    words = [
        *(dash(outcome.left_ns), dash(release.at_ns), release.origin_ns, dash(release.slot)),
        *(release.cycles_waited, ANCHORS.index(release.anchor), _place(LATE, release.overrun)),
        *(_place(names, release.mode), _place(DROPPED, release.dropped), release.moved_ns),
    ]
    return " ".join(map(str, words))


def _place(words: Sequence[str], word: str | None) -> int | str:
    return "-" if word is None else words.index(word)


def _or_dash(value: int | None) -> int | str:
    return "-" if value is None else value


def _any_case(draw: random.Random) -> Case:
    """Small numbers, so that every border is met again and again; sometimes real ones."""
    scale = draw.choice([1, 1, 1_000_000])
    cycle = draw.randint(2, 40)
    cuts = sorted(draw.sample(range(cycle + 1), min(cycle + 1, draw.choice([2, 4, 6]))))
    slots = tuple((a * scale, b * scale) for a, b in zip(cuts[::2], cuts[1::2], strict=False))
    modes, changes = None, list[Change]()
    if draw.random() < 0.5:
        bands = {f"mode{n}": draw.randrange(len(slots)) for n in range(draw.randint(1, 3))}
        modes = GateModes(bands, draw.choice(list(bands)), draw.choice(LATE))
        times = [draw.randint(0, 300) * scale for _ in range(draw.randint(0, 4))]
        changes += [Change(time, "mode", draw.choice(list(bands))) for time in times]
    gate = Gate(
        slots=slots,
        cycle_ns=cycle * scale,
        anchor=draw.choice(ANCHORS),
        phase_ns=draw.randint(-100, 100) * scale,
        overrun=draw.choice(OVERRUNS),
        due_cycles=draw.randint(0, 2),
        modes=modes,
        messages=draw.choice(MESSAGES),
        depth=draw.randint(1, 4),
        into_open_slot=draw.choice(INTO_OPEN_SLOT),
    )
    times = sorted(draw.randint(0, 300) * scale for _ in range(draw.choice([1, 1, 2, 5])))
    stamps = [draw.choice([None, draw.randint(0, 300) * scale]) for _ in times]
    late_ns = draw.choice([0, 0, draw.randint(1, 40) * scale])
    arrivals = tuple(zip(times, stamps, strict=True))
    earliest, latest = -slots[0][0], gate.cycle_ns - slots[-1][1]
    limits: dict[ChangeKind, tuple[int, int]] = {
        "moved": (earliest, latest),
        "phase": (-100 * scale, 100 * scale),
    }
    for what, (low, high) in limits.items():
        changes += [
            Change(draw.randint(0, 300) * scale, what, draw.randint(low, high))
            for _ in range(draw.choice([0, 1, 3]))
        ]
    draw.shuffle(changes)  # as they are announced
    steps = tuple(sorted(draw.randint(0, 300) * scale for _ in range(draw.choice([0, 0, 0, 1, 2]))))
    return Case(gate, arrivals, tuple(changes), steps, late_ns=late_ns)


def test_both_gates_decide_alike(driver: Path) -> None:
    _decide_alike(CASES, driver)


def test_both_gates_decide_alike_on_arm64(tmp_path: Path) -> None:
    """Where `char` has no sign, and memory another order. Emulated, so with fewer cases."""
    program = compiled(SOURCE, tmp_path, "aarch64-linux-gnu-g++")
    if shutil.which("qemu-aarch64") is None:
        pytest.skip("qemu-aarch64 is not installed (package qemu-user)")
    _decide_alike(CASES // 10, "qemu-aarch64", program)


def _decide_alike(count: int, *command: str | Path) -> None:
    draw = random.Random(20240612)
    table = cases()
    every = [*table, *(_any_case(draw) for _ in range(count))]
    questions = "\n".join([str(len(every)), *map(as_text, every)])
    run = subprocess.run(
        command, input=questions, capture_output=True, text=True, check=True, timeout=60
    )
    answers = iter(line.strip() for line in run.stdout.splitlines())
    seen: set[tuple[str | None, str | None]] = set()
    for case in every:
        outcomes = walk(case)
        if case.leave:
            assert tuple(outcome.leave for outcome in outcomes) == case.leave, case.name
        for outcome in outcomes:
            assert next(answers) == as_answer(case, outcome), case
            seen.add((outcome.release.overrun, outcome.release.dropped))
    assert next(answers, None) is None
    assert {overrun for overrun, _ in seen} == {None, *LATE}, "some treatment never occurred"
    assert {dropped for _, dropped in seen} == {None, *DROPPED}


def test_both_read_the_same_origin_from_a_payload(driver: Path) -> None:
    draw = random.Random(5)
    payloads = [draw.randbytes(draw.randint(0, 14)) for _ in range(500)]
    # Most random nanoseconds are none, so half of the payloads get a stamp that could be one.
    for payload in draw.sample(payloads, 250):
        stamp = struct.pack("<iI", draw.randint(-(2**31), 2**31 - 1), draw.randint(0, 10**9))
        payloads.append(b"\0\1\0\0" + stamp + payload)
        payloads.append(b"\0\0\0\0" + stamp[3::-1] + stamp[:3:-1] + payload)
    payloads += [b"\0\1\0\0" + bytes(8), b"\0\1\0\0" + bytes(7) + b"\1"]
    lines = "\n".join(payload.hex() for payload in payloads) + "\n"
    run = subprocess.run(
        [driver, "--origins"], input=lines, capture_output=True, text=True, check=True, timeout=60
    )
    origins = [origin_of(payload) for payload in payloads]
    assert [line.strip() for line in run.stdout.splitlines()] == [
        str(_or_dash(origin)) for origin in origins
    ]
    assert origins.count(None) > 100 < len(origins) - origins.count(None)


def test_the_log_of_the_cpp_node_is_read(driver: Path, tmp_path: Path) -> None:
    log = tmp_path / "gate.csv"
    for _ in range(2):  # a node that is started again adds to its log
        subprocess.run([driver, str(log), "1000000", "1"], check=True, timeout=60)
    table = read_gate_log(log)
    assert table.height == 6
    assert table["row"].to_list() == [1, 2, 3] * 2
    first, second, late = table.rows(named=True)[:3]
    assert (first["mode"], first["slot"], first["overrun"]) == ("highway", 0, None)
    assert first["release"] - first["origin"] == 300_000_000
    assert first["arrival"] < first["release"] <= first["time"] <= first["published"]
    assert (first["source_timestamp"], second["source_timestamp"]) == (5, None)
    assert (first["lost"], second["lost"]) == (2, 0)
    assert second["mode"] == "city"
    assert 0 <= first["stalled"] <= first["time"] - first["release"]
    assert (late["release"], late["slot"], late["published"], late["stalled"]) == (None,) * 4
    assert (late["overrun"], late["dropped"]) == ("discard", "discarded")
    assert late["source_timestamp"] == 2**63 - 1


def test_the_log_of_the_cpp_node_is_bounded(driver: Path, tmp_path: Path) -> None:
    log = tmp_path / "gate.csv"
    run = subprocess.run(
        [driver, str(log), "100000", "5000"], check=True, timeout=60, capture_output=True, text=True
    )
    assert run.stdout == "5000 discarded, 10002 lost by DDS\n"
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == ["gate.csv", "gate.csv.1"]
    assert sum(file.stat().st_size for file in files) <= 100_000
    rows = read_gate_log(log)["row"]
    assert rows[-1] == 5002
    assert rows.to_list() == list(range(rows[0], 5003)), "both files, in order"
