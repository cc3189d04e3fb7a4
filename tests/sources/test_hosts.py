"""Traces of several hosts, containers mostly: process numbers mean something on one host only."""

from pathlib import Path

import polars as pl
from command_line import json_of
from ctf_writing import write_lttng_trace
from story import OFFSET
from test_lttng_trace import chain_story, shifted, written

from chainshaper.analysis import analyse_latency, application_graph
from chainshaper.sources import open_source
from chainshaper.sources.lttng.trace import NEXT_HOST


def container(folder: Path, host: str, names: tuple[str, str], shift: int) -> None:
    """A container's own trace: its processes are 10 and 11, as in every other container."""
    tables = {
        name: frame.with_columns(
            pl.col(column) + shift
            for column in ("time", "timestamp", "source_timestamp")
            if column in frame.columns
        )
        for name, frame in shifted(chain_story(names=names)).items()
    }
    write_lttng_trace(folder, tables, clock_offset_ns=OFFSET, host=host)


def test_containers_with_the_same_process_numbers_are_told_apart(tmp_path: Path) -> None:
    container(tmp_path / "trace" / "one", "one", ("a", "b"), 0)
    container(tmp_path / "trace" / "two", "two", ("c", "d"), 120)
    recording = open_source(tmp_path / "trace")
    moved = NEXT_HOST + 10
    assert recording.info.host == "one, two"
    assert recording.info.processes == {10: "/a", 11: "/b", moved: "/c", moved + 1: "/d"}
    assert [note for note in recording.info.notes if "host two" in note]
    graph = application_graph(recording.events)
    assert {(c.node, c.pid) for c in graph.callbacks} == {
        ("/a", 10),
        ("/b", 11),
        ("/c", moved),
        ("/d", moved + 1),
    }
    for chain in ("/a../b../y", "/c../d../y"):
        figures = analyse_latency(recording, chain).statistics
        assert (figures.count, figures.min_ns, figures.max_ns) == (5, 300, 300)
    together = json_of("info", tmp_path / "trace")["events"]
    alone = json_of("info", tmp_path / "trace" / "one")["events"]
    assert together == {name: 2 * count for name, count in alone.items()}


def test_hosts_with_different_process_numbers_keep_them(tmp_path: Path) -> None:
    tables = shifted(chain_story())
    for pid, host in ((10, "one"), (11, "two")):
        own = {name: frame.filter(pid=pid) for name, frame in tables.items()}
        write_lttng_trace(tmp_path / "trace" / host, own, clock_offset_ns=OFFSET, host=host)
    recording = open_source(tmp_path / "trace")
    assert recording.info.processes == {10: "/a", 11: "/b"}
    assert recording.info.notes == ()
    assert analyse_latency(recording, "/x../y").statistics.count == 5


def test_threads_of_a_container_are_not_the_kernels_of_the_same_numbers(tmp_path: Path) -> None:
    """The kernel's thread 11 runs now and then, never while the container's 11 does."""
    story = chain_story(cycles=4)
    for cycle in range(4):
        now = 1000 + 1000 * cycle
        for time, before, after in ((now + 500, 0, 11), (now + 600, 11, 0)):
            story.event("sched_switch", time, before, prev_comm="", prev_tid=before, prev_prio=20,
                        prev_state=0, next_comm="", next_tid=after, next_prio=20)  # fmt: skip
    rows = json_of("callbacks", written(tmp_path / "trace", story))
    assert [row["execution_ns"] for row in rows] == [None, None]
