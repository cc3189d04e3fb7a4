"""Streams are merged by time, and at one time by the order of their files."""

import random
from pathlib import Path

import pytest
from ctf_writing import EventRecord, encode_packet, lttng_metadata, write_trace

from chainshaper.sources.ctf import open_trace, read_events
from chainshaper.sources.ctf.layout import AHEAD
from chainshaper.sources.ctf.tsdl import parse_tsdl

EVENTS = {"ros2:number": {"place": "u64"}, "ros2:text": {"place": "u64", "text": "string"}}


@pytest.mark.parametrize("streams", [1, 2, 3, 5, 8, 13])
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
        time, found = 1 << 40, []
        for _ in range(chance.choice([0, 1, AHEAD, AHEAD + 1, 5 * AHEAD])):
            time += chance.choice([0, 0, 1, 3])
            name = chance.choice(["ros2:number"] * 30 + ["ros2:text"])
            payload = {"place": len(made)} | ({"text": "x"} if name == "ros2:text" else {})
            made.append((time, file, len(made), name))
            found.append(EventRecord(name, time, payload, {}))
        sizes = [found[n : n + 100] for n in range(0, len(found), 100)]
        encoded[f"channel_{file:02}"] = [
            encode_packet(
                declared,
                part,
                {"cpu_id": file, "packet_seq_num": n, "events_discarded": 0},
                instance=file,
            )
            for n, part in enumerate(sizes)
        ]
    write_trace(tmp_path / "trace", lttng_metadata(EVENTS, {}), encoded)
    frames = read_events(open_trace(tmp_path / "trace"), threads=threads)
    for name in EVENTS:
        expected = [(place, file) for _, file, place, its in sorted(made) if its == name]
        assert list(zip(frames[name]["place"], frames[name]["cpu"], strict=True)) == expected
