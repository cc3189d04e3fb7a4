"""What of a damaged trace can be believed: nothing is invented, and what is whole is read."""

import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from command_line import called, json_of, refused
from ctf_writing import EventRecord, encode_packet, lttng_metadata, write_trace
from field_traces import STREAM, chain_tables, field_trace, packets_of, write_chain, write_packets
from reference import assert_equal_to_babeltrace
from reference_traces import reference_folder

from chainshaper.sources.ctf import CtfError, count_events, open_trace, read_events
from chainshaper.sources.ctf.tsdl import parse_tsdl

REMEDIES = ("lttng destroy", "disk was full", "babeltrace2", "same set-up", "UUID")


def rows_of(folder: Path) -> tuple[Counter[str], list[str]]:
    """Every event as a text, and what is said about the trace."""
    trace = open_trace(folder)
    frames = read_events(trace)
    rows = Counter(
        f"{name} {sorted(row.items())}"
        for name, frame in frames.items()
        for row in frame.iter_rows(named=True)
    )
    assert sum(count_events(trace)[0].values()) == rows.total()
    return rows, [*trace.warnings, *frames.warnings]


def test_zeros_at_the_end_are_no_events(tmp_path: Path) -> None:
    """However much of the file is missing, every event that is read is a recorded one."""
    whole = write_chain(tmp_path / "whole", chain_tables())
    good, none = rows_of(whole)
    assert none == []
    data = (whole / STREAM).read_bytes()
    last = len(packets_of(whole)[-1])
    for missing in (1, 30, 60, last - 40, last, last + 100, last + 1000, len(data) // 2, len(data)):
        damaged = tmp_path / str(missing)
        write_packets(damaged, whole, [data[: len(data) - missing], bytes(missing)])
        rows, said = rows_of(damaged)
        # The last event may have lost the end of its payload, which nothing shows.
        assert (rows - good).total() <= 1, missing
        assert len(said) > 0 or missing < 40
        # Some packets' sizes lie in what is missing: what is before these is read.
        lost = len(good) - len(rows)
        assert lost <= 25 + missing // 30


def test_public_zeros_at_the_end() -> None:
    trace = field_trace("zeros_at_the_end") / "trace"
    info = json_of("info", trace)
    assert info["events"]["ros2:rcl_init"] == 3
    assert "0" not in info["processes"]
    assert info["lost"]["damaged_packets"] == 2
    assert any("zeros instead of a packet" in note for note in info["notes"])
    assert "2 damaged packets" in called("callbacks", trace).out


@pytest.mark.parametrize("name", ["jazzy_chain_cyclonedds", "humble_sync"])
def test_a_real_trace_whose_end_is_zeros(tmp_path: Path, name: str) -> None:
    """It had 920 events of process 0 more than were recorded, and was 2.4 s longer."""
    shutil.copytree(reference_folder(name) / "trace", tmp_path / "trace")
    whole = read_events(open_trace(tmp_path / "trace"))
    for stream in open_trace(tmp_path / "trace").streams:
        data = stream.path.read_bytes()
        stream.path.write_bytes(data[: len(data) * 2 // 3].ljust(len(data), b"\0"))
    trace = open_trace(tmp_path / "trace")
    frames = read_events(trace)
    assert trace.damaged_places + frames.damaged > 0
    assert sum(map(len, frames.values())) > 0
    for event, frame in frames.items():
        assert 0 not in frame["pid"].to_list()
        left = frame.join(whole[event], on=["time", "pid", "tid"], how="anti")
        assert left.height == 0, f"{event} happened never"


def test_zeros_in_the_middle_cost_the_packets_that_they_are_in(tmp_path: Path) -> None:
    whole = write_chain(tmp_path / "whole", chain_tables())
    packets = packets_of(whole)
    good = rows_of(whole)[0]
    assert len(packets) > 6
    of_packets = [
        rows_of(write_packets(tmp_path / f"{number}", whole, [packet]))[0]
        for number, packet in enumerate(packets)
    ]
    for cut in (0, 4, 24, 60, 300):
        damaged = [*packets[:2], packets[2][:cut].ljust(len(packets[2]), b"\0"), *packets[3:]]
        rows, said = rows_of(write_packets(tmp_path / f"from {cut}", whole, damaged))
        assert good - rows <= of_packets[2]
        assert (rows - good).total() <= 1
        assert any("byte" in text for text in said)
    hole = b"".join(packets)
    start, stop = len(packets[0]) + 500, len(packets[0] + packets[1] + packets[2]) + 30
    hole = hole[:start].ljust(stop, b"\0") + hole[stop:]
    rows, said = rows_of(write_packets(tmp_path / "hole", whole, [hole]))
    assert good - rows <= of_packets[1] + of_packets[2] + of_packets[3]
    assert (rows - good).total() <= 1
    assert any("packets of this stream are missing" in text for text in said)


@pytest.mark.parametrize("bits", [8 * 5_000, 8 * 1_000_000, 1 << 40])
def test_a_size_that_reaches_over_packets_costs_what_nobody_can_know(
    tmp_path: Path, bits: int
) -> None:
    """The packet's size, and its content's, are at bytes 48 and 56."""
    whole = write_chain(tmp_path / "whole", chain_tables())
    packets, good = packets_of(whole), rows_of(whole)[0]
    damaged = packets[1][:48] + 2 * bits.to_bytes(8, "little") + packets[1][64:]
    folder = write_packets(tmp_path / "damaged", whole, [packets[0], damaged, *packets[2:]])
    rows, said = rows_of(folder)
    assert len(rows - good) == 0
    assert len(said) > 0
    last = rows_of(write_packets(tmp_path / "last", whole, [packets[-1]]))[0]
    assert last <= rows, "behind it the file is read on"


def two_packets(folder: Path, context: dict[str, Any], version: str = "") -> list[int]:
    """The numbers of the events that are read; the first packet says these things of itself."""
    text = lttng_metadata({"e": {"n": "u32"}}, header="large").replace(
        'tracer_name = "lttng-ust";', f'tracer_name = "lttng-ust"; {version}'
    )
    declared = parse_tsdl(text)
    first = [EventRecord("e", (1 << 40) + 10 * n, {"n": n}) for n in range(1, 5)]
    second = [EventRecord("e", (1 << 40) + 10 * n, {"n": n}) for n in range(5, 9)]
    packets = [encode_packet(declared, first, context), encode_packet(declared, second)]
    write_trace(folder, text, {"channel_0": packets})
    return read_events(open_trace(folder))["e"]["n"].to_list()


def test_events_behind_their_packets_end_are_left_out(tmp_path: Path) -> None:
    late = {"timestamp_end": (1 << 40) + 25}
    assert two_packets(tmp_path / "a", late) == [1, 2, 5, 6, 7, 8]
    (warning,) = read_events(open_trace(tmp_path / "a")).warnings
    assert "outside the time that its packet says it was open" in warning
    assert two_packets(tmp_path / "b", {"timestamp_end": (1 << 40) + 40}) == [*range(1, 9)]


def test_tracers_that_closed_packets_too_early_are_believed(tmp_path: Path) -> None:
    """Those of LTTng before 2.11, as babeltrace2 does, too; and those of a crash, with no end."""
    late = {"timestamp_end": (1 << 40) + 25}
    old = "tracer_major = 2; tracer_minor = 10;"
    assert two_packets(tmp_path / "old", late, old) == [*range(1, 9)]
    assert_equal_to_babeltrace(tmp_path / "old")
    new = "tracer_major = 2; tracer_minor = 13;"
    assert two_packets(tmp_path / "new", late, new) == [1, 2, 5, 6, 7, 8]
    assert two_packets(tmp_path / "crash", {"timestamp_end": 0}) == [*range(1, 9)]
    beyond = {"timestamp_end": 0, "timestamp_begin": (1 << 40) + 15}
    assert two_packets(tmp_path / "begin", beyond) == [5, 6, 7, 8]


@pytest.mark.parametrize("packetized", [True, False])
def test_metadata_that_is_not_whole(tmp_path: Path, packetized: bool) -> None:
    text = lttng_metadata({"ros2:e": {"s": "string"}}, {"vpid": "s32", "vtid": "s32"})
    record = EventRecord("ros2:e", 1 << 40, {"s": "text"}, {"vpid": 1, "vtid": 1})
    packet = encode_packet(parse_tsdl(text), [record])
    write_trace(tmp_path, text, {"channel_0": [packet]}, packetized=packetized)
    whole = (tmp_path / "metadata").read_bytes()
    filled = len(whole.rstrip(b"\0"))
    read = 0
    for cut in [0, 1, *range(10, filled - 4, 61)]:
        for rest in (b"", bytes(4096 - cut)) if packetized else (b"",):
            (tmp_path / "metadata").write_bytes(whole[:cut] + rest)
            try:
                open_trace(tmp_path)
                read += 1
            except CtfError as error:
                said = str(error)
                assert "metadata is empty" in said or "metadata ends" in said, (cut, said)
                assert all(text in said for text in REMEDIES)
                assert "2a6422d0-6cee-11e0-8c08-cb07d7b3a564" in said
    assert read <= 5, "between two blocks"


def test_metadata_may_be_another_runs(tmp_path: Path) -> None:
    """With this run's UUID in place of its own, as the message has it."""
    whole = write_chain(tmp_path / "whole", chain_tables())
    again = write_chain(tmp_path / "again", chain_tables(5), uuid=7)
    metadata = (again / STREAM).with_name("metadata")
    (whole / STREAM).with_name("metadata").write_bytes(b"")
    said = refused(2, "info", whole)
    uuid = said.partition("write the UUID of this trace, ")[2].partition(",")[0]
    replaced = metadata.read_bytes().replace(b"00000000-0000-0000-0000-000000000007", uuid.encode())
    (whole / STREAM).with_name("metadata").write_bytes(replaced)
    assert json_of("latency", whole, "--chain", "/image../objects")["count"] == 20


@pytest.mark.parametrize(
    ("name", "reason"), [("empty", "is empty"), ("half", "ends in the middle")]
)
def test_public_metadata_that_is_not_whole(name: str, reason: str) -> None:
    for verb in ("info", "callbacks"):
        said = refused(2, verb, field_trace("metadata_not_whole") / name)
        assert reason in said
        assert all(text in said for text in REMEDIES)


@pytest.mark.parametrize("offset", [1 << 63, 1 << 64, 10**30, -(1 << 64), (1 << 62) + 1])
def test_clock_offsets_that_no_time_has_are_refused(tmp_path: Path, offset: int) -> None:
    text = lttng_metadata({"e": {"n": "u32"}}, offset=offset)
    (tmp_path / "metadata").write_text(text)
    for verb in ("info", "callbacks"):
        said = refused(2, verb, tmp_path)
        assert "clock offset of" in said
    most = lttng_metadata({"e": {"n": "u32"}}, offset=1 << 62)
    write_trace(tmp_path / "most", most, {})
    assert open_trace(tmp_path / "most").clock_offset_ns == 1 << 62
