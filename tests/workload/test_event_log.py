"""The event log: what a process records is what the tables have, and arrives whole."""

import json
import threading
from array import array
from typing import Any

import polars as pl
import pytest

from chainshaper.values import events
from chainshaper.workload.event_log import (
    ABSENT,
    BLOCK,
    EVENTS,
    LAYOUT,
    WIDTH,
    WORDS,
    EventLog,
    number_of,
    number_of_real,
)
from chainshaper.workload.launcher import send_events
from chainshaper.workload.live import ProcessLog, event_tables
from chainshaper.workload.stall_meter import NO_PACE, meter_tables


def _process(log: EventLog, pid: int = 100, core: int | None = 1) -> ProcessLog:
    return ProcessLog(pid, core, log.rows, tuple(log.objects), modes=("city", "highway"))


def _types(name: str, fields: tuple[str, ...]) -> dict[str, pl.DataType]:
    known = {**events.FIELDS[name], **events.OPTIONAL_FIELDS.get(name, {})}
    return {**events.COMMON_COLUMNS, **{field: known[field] for field in known if field in fields}}


@pytest.mark.parametrize(("entry", "fields"), LAYOUT.items())
def test_every_event_is_read_back_as_it_was_recorded(entry: str, fields: tuple[str, ...]) -> None:
    log = EventLog()
    values = dict(zip(fields, range(1, len(fields) + 1), strict=True))
    values |= {field: len(words) - 1 for field, words in WORDS.items() if field in fields}
    values |= {field: number for field, number in (("mode", 0), ("taken", 1)) if field in fields}
    if entry == "plant_step":
        reals = {"cost": 0.5, "output": -1e-9, "input": 3.0}
        values |= {field: number_of_real(value) for field, value in reals.items()}
    log.point(entry)(5000, *values.values())
    tables = event_tables([_process(log)], from_ns=0)

    assert set(tables) == set(EVENTS[entry])
    expected: dict[str, Any] = {"time": 5000, "pid": 100, "cpu": 1, **values}
    expected["tid"] = threading.get_native_id()
    if entry == "gate_release":
        expected |= {"anchor": "cycle", "overrun": "next-slot", "mode": "city"}
        expected["dropped"] = "discarded"
    if entry == "asynchronous_send":
        expected["outcome"] = "overwritten"
    if entry == "plant_step":
        expected |= {"step": "driven", "cost": 0.5, "output": -1e-9, "input": 3.0}
    for name, table in tables.items():
        types = _types(name, fields)
        assert dict(table.schema) == types
        assert table.to_dicts() == [{field: expected[field] for field in types}]


def test_of_a_message_that_was_not_there_only_the_attempt_to_take_it_is_an_event() -> None:
    log = EventLog()
    log.point("take")(5000, 1, 2, 0, 0)
    assert list(event_tables([_process(log)], from_ns=0)) == ["rmw_take"]


def test_no_array_of_a_long_log_gets_long() -> None:
    """One of tens of megabytes grew by so many pages at a time that its thread paused for 10 ms."""
    log = EventLog()
    record = log.point("callback_start")
    for time in range(3_500):
        record(time, 7, 2 * time, 0)
    assert [len(one) for one in log._blocks] == [BLOCK, BLOCK, BLOCK, 500 * WIDTH]
    started = event_tables([_process(log)], from_ns=100)["callback_start"]
    assert started.select("time", "thread_time").rows() == [(n, 2 * n) for n in range(100, 3_500)]


def test_the_layout_says_what_the_event_tables_say() -> None:
    for entry, fields in LAYOUT.items():
        known = set(events.COMMON_COLUMNS)
        for name in EVENTS[entry]:
            assert set(events.FIELDS[name]) <= set(fields), name
            known |= {*events.FIELDS[name], *events.OPTIONAL_FIELDS.get(name, {})}
        assert set(fields) <= known, entry
        assert 3 + len(fields) <= WIDTH, entry


def test_a_discarded_message_has_no_release_and_no_slot() -> None:
    log = EventLog()
    overrun = number_of("overrun", "discard")
    log.point("gate_release")(9, 1, 2, 3, 4, ABSENT, ABSENT, 0, 0, overrun, ABSENT, 3, 0)
    in_time = number_of("overrun", None)
    log.point("gate_release")(19, 1, 2, 3, 4, 18, 0, 0, 1, in_time, 1, ABSENT, 0)
    table = event_tables([_process(log)], from_ns=0)["gate_release"]
    assert table.select("release", "slot", "anchor", "overrun", "mode").rows() == [
        (None, None, "stamp", "discard", None),
        (18, 0, "cycle", None, "highway"),
    ]


def test_processes_are_merged_by_time_and_the_warm_up_is_cut_but_objects_are_kept() -> None:
    logs = [EventLog(), EventLog(clock=lambda: 5), EventLog()]  # the last one records nothing
    logs[1].init("rcl_timer_init", timer_handle=7, period=100)
    for log, times in zip(logs, ((10, 40), (19, 20, 30), ()), strict=True):
        for time in times:
            log.point("callback_end")(time, 5, 0)
    processes = [_process(log, pid=number, core=number) for number, log in enumerate(logs)]
    tables = event_tables(processes, from_ns=20)
    assert tables["callback_end"].select("time", "pid", "cpu").rows() == [
        (20, 1, 1), (30, 1, 1), (40, 0, 0)
    ]  # fmt: skip
    own = tables["rcl_timer_init"].select("time", "pid", "timer_handle", "period")
    assert own.rows() == [(5, 1, 7, 100)]
    assert event_tables([], from_ns=0) == {}


def test_stalls_come_from_meters_and_gates() -> None:
    log = EventLog()
    log.point("machine_stall")(150, 9)
    seen = event_tables([_process(log)], from_ns=0)["machine_stall"]
    rows = array("q", (100, 7, NO_PACE, 50, 90, 12, 200, 8, NO_PACE))
    tables = meter_tables([(11, 0, rows.tobytes()), (12, 1, b"")], seen)
    stalls, paces = tables["machine_stall"], tables["machine_pace"]
    assert stalls.select("time", "cpu", "duration").rows() == [
        (100, 0, 7),
        (150, 1, 9),
        (200, 0, 8),
    ]
    assert paces.rows() == [(50, 11, 11, 0, 90, 12)]
    for name, table in meter_tables([]).items():
        assert table.schema == events.empty(name).schema


class _Interrupted:
    """Standard output without a buffer, whose writer is stopped again and again.

    Text goes through; of bytes, each write takes a part only.
    """

    def __init__(self) -> None:
        self.received, self.buffer = b"", self

    def write(self, data: str | memoryview) -> int:
        part = data.encode() if isinstance(data, str) else bytes(data)[:7]
        self.received += part
        return len(part)

    def flush(self) -> None:
        pass


def test_events_arrive_whole_when_the_writer_is_frozen_in_the_middle() -> None:
    output, events = _Interrupted(), bytes(range(256)) * 3
    send_events(output, events, objects=[])  # type: ignore[arg-type]
    line, _, rest = output.received.partition(b"\n")
    assert json.loads(line) == {"bytes": len(events), "objects": []}
    assert rest == events
