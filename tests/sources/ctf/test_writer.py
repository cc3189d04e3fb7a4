"""What the writer writes comes back, from us and from babeltrace2."""

import random
from pathlib import Path
from typing import Any

import pytest
from ctf_writing import (
    EventRecord,
    encode_packet,
    lttng_metadata,
    write_packet,
    write_trace,
)
from made import START, USER_CONTEXT, USER_EVENTS, make_trace, records
from reference import actual_rows, assert_equal_to_babeltrace, lean

from chainshaper.sources.ctf import count_events, open_trace, read_events
from chainshaper.sources.ctf.tsdl import parse_tsdl


@pytest.mark.parametrize("options", [
    {}, {"header": "compact"}, {"big": True}, {"big": True, "header": "compact"},
    {"aligned": True}, {"aligned": True, "header": "compact", "big": True},
], ids=str)  # fmt: skip
def test_round_trip(tmp_path: Path, options: dict[str, Any]) -> None:
    expected: dict[str, list[Any]] = {}
    for event in make_trace(tmp_path, **options):
        who = {"time": event.time, "pid": event.context["vpid"], "tid": event.context["vtid"]}
        row = {**who, **event.payload}
        row.pop("subs", None)  # of 64 bits each: no table has a column for them
        expected.setdefault(event.name, []).append(lean(row))
    frames = read_events(open_trace(tmp_path))
    rows = actual_rows({n: f.drop("cpu", "procname") for n, f in frames.items()})
    assert rows.keys() == expected.keys()
    for name, expected_rows in expected.items():
        assert sorted(map(repr, rows[name])) == sorted(map(repr, expected_rows))
    assert_equal_to_babeltrace(tmp_path)


@pytest.mark.parametrize("header", ["compact", "large"])
@pytest.mark.parametrize("aligned", [False, True])
def test_kernel_traces(tmp_path: Path, header: str, aligned: bool) -> None:
    make_trace(tmp_path / "kernel", kernel=True, header=header, aligned=aligned)
    trace, frames = assert_equal_to_babeltrace(tmp_path, kernel=True)
    assert trace.folders[0].env["domain"] == "kernel"
    assert {"prev_comm", "pid", "tid", "cpu"} <= set(frames["sched_switch"].columns)
    assert "payload.tid" in frames["sched_wakeup"].columns


def test_kernel_beside_user_space_and_per_process_folders(tmp_path: Path) -> None:
    """One frame per event over all folders, by time, with null where a trace has no column."""
    make_trace(tmp_path / "kernel", kernel=True, seed=1)
    make_trace(tmp_path / "ust/pid/first-1-20260101/64-bit", seed=2)
    make_trace(tmp_path / "ust/pid/second-2-20260101/64-bit", seed=3, header="compact")
    trace = open_trace(tmp_path)
    assert len(trace.folders) == 3
    assert len(trace.streams) == 9
    frames = read_events(trace)
    assert sum(count_events(trace)[0].values()) == 3 * 3 * 4 * 20
    assert all(frame["time"].is_sorted() for frame in frames.values())
    alone = read_events(open_trace(tmp_path / "ust/pid/first-1-20260101"))
    for name, frame in alone.items():
        assert set(frame["time"]) <= set(frames[name]["time"])
    metadata = lttng_metadata({"ros2:callback_end": {"other": "u32"}})
    write_packet(
        tmp_path / "other", metadata, [EventRecord("ros2:callback_end", START, {"other": 1})]
    )
    both = read_events(open_trace(tmp_path))["ros2:callback_end"]
    assert both["other"][0] == 1, "events of one name and other fields are in one frame"
    assert both["callback"][1:].to_list() == frames["ros2:callback_end"]["callback"].to_list()
    # Naming a folder twice does not read it twice.
    twice = open_trace(tmp_path, tmp_path / "kernel")
    packets = [sum(len(stream.packets) for stream in opened.streams) for opened in (twice, trace)]
    assert packets[0] == packets[1] + 1


@pytest.mark.parametrize("files", [4, 2], ids=["one file", "rotated files"])
def test_losses_are_counted(tmp_path: Path, files: Any) -> None:
    text = lttng_metadata(USER_EVENTS, USER_CONTEXT)
    declared = parse_tsdl(text)
    packets, start = [], START
    for number, (sequence, discarded) in enumerate([(3, 2), (4, 2), (9, 12), (10, 13)]):
        part = records(number, 10, start=start)
        start = part[-1].time + 1
        about = {"packet_seq_num": sequence, "events_discarded": discarded}
        packets.append(encode_packet(declared, part, about))
    write_trace(tmp_path, text, {"a_1": packets[:files], "a_0": packets[files:]})
    trace, _ = assert_equal_to_babeltrace(tmp_path)
    assert (trace.discarded_events, trace.lost_packets) == (11, 4)
    assert len(trace.warnings) == 2
    assert "11 events" in trace.warnings[0]
    # babeltrace2 does not count what was lost before a stream's first packet; counters wrap.
    lost = [(1 << 32) - 2, 3]
    first = [
        encode_packet(declared, records(1, 1), {"packet_seq_num": n, "events_discarded": discarded})
        for n, discarded in enumerate(lost)
    ]
    write_trace(tmp_path / "first", text, {"a": first})
    assert open_trace(tmp_path / "first").discarded_events == (1 << 32) + 3


def test_many_spans_and_threads_give_the_same_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from chainshaper.sources.ctf import read as decode

    make_trace(tmp_path, streams=4, packets=10, events=60)
    trace = open_trace(tmp_path)
    whole = read_events(trace)
    monkeypatch.setattr(decode, "_SMALLEST_CHUNK_BYTES", 0)
    monkeypatch.setattr(decode, "_CHUNK_BYTES", 4096)
    for threads in (1, 3):
        cut = read_events(trace, threads=threads)
        assert cut.keys() == whole.keys()
        assert all(cut[name].to_dicts() == whole[name].to_dicts() for name in whole)


def test_many_different_strings(tmp_path: Path) -> None:
    """The dictionary grows while columns are being filled."""
    payloads = [
        {"s": f"{i:x}" * (i % 4), "t": f"text {i}", "_n_length": i % 3, "n": [i & 255] * (i % 3)}
        for i in range(2200)
    ]
    text = lttng_metadata({"e": {"s": "string", "t": "char[24]", "n": "u8[]"}})
    write_packet(tmp_path, text, [EventRecord("e", START + i, p) for i, p in enumerate(payloads)])
    frame = read_events(open_trace(tmp_path))["e"]
    for name in ("s", "t", "n"):
        assert frame[name].to_list() == [payload[name] for payload in payloads]


BATCH = 128  # so many events of one class are written together (core/ctf/events.cpp)
EVENTS = {"ros2:number": {"place": "u64"}, "ros2:text": {"place": "u64", "text": "string"}}


@pytest.mark.parametrize("streams", [1, 2, 5, 13])
@pytest.mark.parametrize("threads", [1, 3])
def test_every_event_is_where_a_sort_by_time_and_file_puts_it(
    tmp_path: Path, streams: int, threads: int
) -> None:
    """Steps of 0 and 1 make many equal times; texts end what is read ahead, and so do packets."""
    chance = random.Random(streams)
    made: list[tuple[int, int, int, str]] = []
    encoded = {}
    declared = parse_tsdl(lttng_metadata(EVENTS, {}))
    for file in range(streams):
        time, events_of_file = 1 << 40, []
        for _ in range(chance.choice([0, 1, BATCH, BATCH + 1, 5 * BATCH])):
            time += chance.choice([0, 0, 1, 3])
            name = chance.choice(["ros2:number"] * 30 + ["ros2:text"])
            payload = {"place": len(made)} | ({"text": "x"} if name == "ros2:text" else {})
            made.append((time, file, len(made), name))
            events_of_file.append(EventRecord(name, time, payload, {}))
        sizes = [events_of_file[n : n + 100] for n in range(0, len(events_of_file), 100)]
        encoded[f"channel_{file:02}"] = [
            encode_packet(declared, part, {"cpu_id": file, "packet_seq_num": n}, instance=file)
            for n, part in enumerate(sizes)
        ]
    write_trace(tmp_path / "trace", lttng_metadata(EVENTS, {}), encoded)
    frames = read_events(open_trace(tmp_path / "trace"), threads=threads)
    for name in EVENTS:
        expected = [(place, file) for _, file, place, its in sorted(made) if its == name]
        assert list(zip(frames[name]["place"], frames[name]["cpu"], strict=True)) == expected
