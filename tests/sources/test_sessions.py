"""The same events twice, and one trace in several folders: chunks, snapshots, copies."""

import json
import shutil
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from command_line import called, json_of, refused
from ctf_writing import write_lttng_trace
from field_traces import (
    MS,
    STREAM,
    chain_tables,
    field_trace,
    moved,
    packets_of,
    write_chain,
    write_packets,
)
from reference import babeltrace

from chainshaper.sources import open_source
from chainshaper.values.events import CREATION

CHAIN = ("--chain", "/image../objects")


def assert_whole(*folders: Path) -> list[str]:
    """The chain's 20 cycles of 5 ms, and 20 instances of each callback; the notes."""
    figures = json_of("latency", *folders, *CHAIN)
    assert (figures["count"], figures["incomplete"]) == (20, 0)
    assert (figures["min_ns"], figures["max_ns"]) == (5 * MS, 5 * MS)
    assert {row["count"] for row in json_of("callbacks", *folders)} == {20}
    notes: list[str] = json_of("info", *folders)["notes"]
    return notes


def test_snapshots_of_a_ring_buffer_that_overlap(tmp_path: Path) -> None:
    whole = write_chain(tmp_path / "whole", chain_tables())
    packets = packets_of(whole)
    assert len(packets) > 6
    first = write_packets(tmp_path / "both" / "snapshot-1", whole, packets[:5])
    second = write_packets(tmp_path / "both" / "snapshot-2", whole, packets[2:])
    for folders in ([tmp_path / "both"], [first, second], [second, first]):
        (note,) = assert_whole(*folders)
        assert "3 of its " in note
        assert "as well; they count once" in note
    counted = json_of("info", tmp_path / "both")["events"]
    assert counted == json_of("info", whole)["events"]
    reference = babeltrace(whole)
    assert sum(counted.values()) == len(reference["events"])


def test_packets_that_no_snapshot_has_are_lost(tmp_path: Path) -> None:
    """The ring buffer had gone round between the two: packets 4 and 5 were overwritten."""
    whole = write_chain(tmp_path / "whole", chain_tables())
    packets = packets_of(whole)
    write_packets(tmp_path / "both" / "snapshot-1", whole, packets[:4])
    write_packets(tmp_path / "both" / "snapshot-2", whole, packets[6:])
    info = json_of("info", tmp_path / "both")
    assert info["lost"] == {"discarded_events": 0, "lost_packets": 2}
    assert any("2 packets of this stream are missing" in note for note in info["notes"])
    assert babeltrace(tmp_path / "both")["lost"] == 2


def test_what_was_discarded_between_two_chunks_counts(tmp_path: Path) -> None:
    """The counter goes on in the next chunk; what it says there first was lost in between."""
    from ctf_writing import EventRecord, encode_packet, lttng_metadata, write_trace

    from chainshaper.sources.ctf import open_trace
    from chainshaper.sources.ctf.tsdl import parse_tsdl

    text = lttng_metadata({"e": {"n": "u32"}})
    for number, discarded in enumerate((3, 10)):
        events = [EventRecord("e", (number + 1) << 40, {"n": number})]
        about = {"packet_seq_num": number, "events_discarded": discarded}
        packet = encode_packet(parse_tsdl(text), events, about)
        write_trace(tmp_path / f"chunk-{number}", text, {"channel_0": [packet]})
    assert open_trace(tmp_path).discarded_events == 10
    # babeltrace2 does not count what was lost before a stream's first packet.
    assert babeltrace(tmp_path / "chunk-0", tmp_path / "chunk-1")["discarded"] == 7


def test_a_folder_beside_its_copy(tmp_path: Path) -> None:
    whole = write_chain(tmp_path / "traces" / "whole", chain_tables())
    shutil.copytree(whole, tmp_path / "traces" / "whole (copy)")
    (note,) = assert_whole(tmp_path / "traces")
    assert "of its" in note
    stream = whole / STREAM
    shutil.copy(stream, stream.with_name("channel_0.bak"))
    assert_whole(whole)


def test_a_copy_that_was_cut_short(tmp_path: Path) -> None:
    whole = write_chain(tmp_path / "a" / "whole", chain_tables())
    copied = tmp_path / "a" / "copied"
    shutil.copytree(whole, copied)
    data = (copied / STREAM).read_bytes()
    (copied / STREAM).write_bytes(data[: sum(map(len, packets_of(whole)[:4])) + 700])
    for first, second in ((whole, copied), (copied, whole)):
        notes = assert_whole(first, second)
        assert any("cut short by the end of the file" in note for note in notes)


def test_packets_of_one_number_and_time_with_two_contents_are_refused(tmp_path: Path) -> None:
    """A snapshot that was taken while the tracer wrote over the packet."""
    whole = write_chain(tmp_path / "whole", chain_tables())
    packets = packets_of(whole)
    first = write_packets(tmp_path / "both" / "snapshot-1", whole, packets[:5])
    overwritten = packets[4][:400] + bytes(40) + packets[4][440:]
    second = write_packets(tmp_path / "both" / "snapshot-2", whole, [overwritten, *packets[5:]])
    for verb in ("info", "callbacks"):
        said = refused(2, verb, tmp_path / "both")
        assert str(first) in said
        assert str(second) in said
        assert "packet 4 of this stream" in said
        assert "give one folder alone" in said


def test_packets_of_one_number_at_other_times_are_others(tmp_path: Path) -> None:
    """Two sessions of a tracer that always writes the same UUID."""
    tables = chain_tables()
    middle = tables["callback_start"]["time"][21] - MS // 2
    early = {n: t.filter(pl.col("time") < middle) for n, t in tables.items()}
    late = {n: t.filter(pl.col("time") >= middle) for n, t in tables.items()}
    write_chain(tmp_path / "both" / "1", {n: t for n, t in early.items() if t.height})
    write_chain(tmp_path / "both" / "2", {n: t for n, t in late.items() if t.height})
    assert assert_whole(tmp_path / "both") == []


@pytest.mark.parametrize("later_ns", [0, 900, 30_000])
def test_two_sessions_that_recorded_the_same_events_are_refused(
    tmp_path: Path, later_ns: int
) -> None:
    tables = chain_tables()
    first = write_chain(tmp_path / "both" / "one", tables)
    second = write_chain(tmp_path / "both" / "two", moved(tables, later_ns), 17, uuid=7)
    for folders in ([tmp_path / "both"], [first, second]):
        for verb in (["info"], ["callbacks"], ["latency", *CHAIN]):
            said = refused(2, verb[0], *folders, *verb[1:])
            assert str(first) in said
            assert str(second) in said
            assert "hold the same events" in said


def test_kernels_recorded_twice_are_refused(tmp_path: Path) -> None:
    rows = [
        {
            "time": (1 << 40) + 1000 * number, "pid": 0, "tid": 0, "cpu": 0,
            "prev_comm": "a", "prev_tid": 1 + number % 3, "prev_prio": 20, "prev_state": 0,
            "next_comm": "b", "next_tid": 1 + (number + 1) % 3, "next_prio": 20,
        }
        for number in range(50)
    ]  # fmt: skip
    numbers = pl.selectors.integer() - pl.selectors.by_name("time", "prev_state")
    tables = {"sched_switch": pl.DataFrame(rows).with_columns(numbers.cast(pl.Int32))}
    for name, by in (("one", 0), ("two", 400)):
        write_lttng_trace(tmp_path / name, moved(tables, by))
    said = refused(2, "info", tmp_path)
    assert "hold the same events" in said


def test_a_session_with_a_snapshot_of_the_start_beside_it(tmp_path: Path) -> None:
    """Two sessions of LTTng: one has the creation only, the other one all the rest."""
    tables = chain_tables()
    start = {name: frame for name, frame in tables.items() if name in CREATION}
    rest = {name: frame for name, frame in tables.items() if name not in CREATION}
    first = write_chain(tmp_path / "dual" / "snapshot", start)
    second = write_chain(tmp_path / "dual" / "runtime", rest, uuid=7)
    for folders in ([tmp_path / "dual"], [first, second], [second, first]):
        assert assert_whole(*folders) == []


@pytest.mark.parametrize("uuid", [0, 7])
def test_chunks_of_a_rotated_session_given_one_by_one(tmp_path: Path, uuid: int) -> None:
    """Cut in the middle of a cycle; of an own UUID, what runs in the second says it."""
    tables = chain_tables()
    cut = tables["callback_start"]["time"][21] - MS // 2
    chunks = [
        {name: frame.filter((pl.col("time") < cut) == early) for name, frame in tables.items()}
        for early in (True, False)
    ]
    folders = [
        write_chain(
            tmp_path / "archives" / f"{number}",
            {n: t for n, t in c.items() if t.height},
            uuid=which,
        )
        for number, (c, which) in enumerate(zip(chunks, (0, uuid), strict=True), 1)
    ]
    for given in ([tmp_path / "archives"], folders, folders[::-1]):
        assert assert_whole(*given) == []


def test_carets_creation_in_each_session_says_that_they_are_one_application(
    tmp_path: Path,
) -> None:
    tables = chain_tables()
    cut = tables["callback_start"]["time"][20] - MS // 2
    folders = []
    for number, early in enumerate((True, False), 1):
        begin = (1 << 40) if early else cut
        chosen = {}
        for name, frame in tables.items():
            if name in CREATION:
                init = frame.with_columns(init_timestamp=pl.col("time"))
                chosen[name] = init.with_columns(time=pl.lit(begin, pl.Int64))
            else:
                chosen[name] = frame.filter((pl.col("time") < cut) == early)
        folders.append(write_chain(tmp_path / str(number), chosen, uuid=number))
    figures = json_of("latency", *folders, *CHAIN)
    assert (figures["count"], figures["max_ns"]) == (20, 5 * MS)


def test_containers_stay_apart_though_one_was_traced_late(tmp_path: Path) -> None:
    """Of one host name and the same processes; the second one's objects are unknown."""
    write_chain(tmp_path / "1", chain_tables())
    late = {n: t for n, t in chain_tables().items() if n not in CREATION}
    late = {
        n: t.with_columns(pl.col(c) + 4096 for c in t.columns if c in {"callback", "message"})
        for n, t in moved(late, 3 * MS).items()
    }
    write_chain(tmp_path / "2", late, uuid=7)
    recording = open_source(tmp_path / "1", tmp_path / "2")
    assert len(recording.events["callback_start"]["pid"].unique()) == 4


@pytest.mark.parametrize("given", ["whole", "apart", "apart the other way"])
def test_a_public_dual_session(given: str) -> None:
    dual = field_trace("folders_of_one_session") / "dual"
    apart = [dual / "snapshot", dual / "runtime"]
    folders = {"whole": [dual], "apart": apart}.get(given, apart[::-1])
    assert_known(json_of("latency", *folders, *CHAIN))


def assert_known(figures: dict[str, Any]) -> None:
    assert (figures["count"], figures["incomplete"]) == (20, 0), json.dumps(figures)
    assert round(figures["mean_ns"] / 1000) == 13_302
    assert round(figures["max_ns"] / 1000) == 15_825


def test_public_snapshots() -> None:
    folder = field_trace("same_events_twice") / "snap2"
    assert_known(json_of("latency", folder, *CHAIN))
    assert_known(json_of("latency", *sorted(folder.iterdir()), *CHAIN))
    assert {row["count"] for row in json_of("callbacks", folder)} == {20}
    assert "they count once" in called("callbacks", folder).err
