"""Watching real processes that run with the library in front: attached to, left, recorded."""

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import datetime
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Event, Thread
from types import SimpleNamespace
from typing import Any, ClassVar
from urllib.request import urlopen

import numpy as np
import polars as pl
import pytest
from command_line import called
from known import known
from opentelemetry.proto.collector.metrics.v1.metrics_service_pb2 import ExportMetricsServiceRequest
from own_memories import follow_only_children_of, program
from processes import wait_for
from prometheus_client.parser import text_string_to_metric_families
from traced_program import built

from chainshaper.analysis import LatencyStatistics, analyse_latency, data_flow, latency_statistics
from chainshaper.cli import runs
from chainshaper.monitor import watch as watch_module
from chainshaper.monitor.budgets import load_budget
from chainshaper.monitor.metrics import SCRAPERS
from chainshaper.monitor.watch import SECOND, SPANS, ChainNow, Hop, Seen, Watch, exporting
from chainshaper.planning import plan_shaping, publish_slots
from chainshaper.planning.plan import Plan
from chainshaper.robot.clocks import clock_offset
from chainshaper.sources.preload import (
    VARIABLE,
    PreloadTracer,
    TracedProcess,
    event_names,
    installed_library,
    memories,
)
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.events import CREATION
from chainshaper.values.recording import open_recording
from chainshaper.verify.measure import PARTS, measure_latency
from chainshaper.verify.promises import OutputsDue

pytestmark = pytest.mark.waiting

CHAIN, PERIOD_NS = "/ebpf1../ebpf2", 50_000_000
LONGEST_NS = SECOND // 5
PATIENT_NS = 2 * SECOND
"""No cycle takes longer, on a busy machine either: for where each has to be complete."""


@pytest.fixture(autouse=True)
def only_our_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other checkouts' tests may run the same chain as the same user."""
    monkeypatch.setattr(watch_module, "memories", vars(watch_module)["memories"])  # put back
    follow_only_children_of(os.getpid())


@contextmanager
def running(cycles: int, **environment: str) -> "Iterator[subprocess.Popen[str]]":
    """The application, with the library in front; its chain begins when this is entered."""
    variables = {**os.environ, "LD_PRELOAD": str(installed_library()), **environment}
    words = built().command("chain", str(cycles), "wait")
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, env=variables, **pipes) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.stdin.write("\n")
        process.stdin.flush()
        # Who prints into a full pipe stands still: after 430 cycles.
        reader = Thread(target=process.stdout.read)
        reader.start()
        try:
            yield process
        finally:
            process.kill()
            reader.join()


def watched(watch: Watch, what: str, is_enough: Callable[[Seen], bool]) -> list[Seen]:
    """All looks, four a second, until one shows enough, however busy the machine is."""
    seen = list[Seen]()

    def look() -> bool:
        seen.append(watch.look())
        return is_enough(seen[-1])

    deadline = time.monotonic() + 120
    while not look():
        assert time.monotonic() < deadline, f"waited 120 s in vain for {what}: {seen[-1]}"
        next_look = time.monotonic() + 0.25
        while time.monotonic() < next_look:
            time.sleep(0.02)
            watch.read()
    return seen


def cycles(seen: Seen) -> int:
    """How many cycles were complete, of the first chain."""
    return seen.chains[0].counted["complete"]


def own_watch(
    *chains: str, plan: Plan | None = None, callbacks: bool = False, longest_ns: int = LONGEST_NS
) -> Watch:
    wishes: dict[str, Any] = {"longest_ns": longest_ns, "plan": plan, "callbacks": callbacks}
    return Watch(chains or (CHAIN,), users={os.geteuid()}, **wishes)


def test_figures_are_those_of_a_recording_of_the_same_time(tmp_path: Path) -> None:
    """Attached in the middle, two at a time: cycle by cycle what the whole recording has."""
    (tmp_path / "trace").mkdir()
    tracer = PreloadTracer(tmp_path / "trace", ["command"], ())
    with running(10_000, **{VARIABLE: tracer.start()[VARIABLE]}) as process:
        time.sleep(0.5)
        watch = own_watch(callbacks=True, longest_ns=PATIENT_NS)
        other = own_watch(longest_ns=PATIENT_NS)
        seen = watched(watch, "30 cycles", lambda seen: cycles(seen) >= 30)[-1]
        other_seen = other.look()
        process.kill()
        process.wait()
    tracer.remove()
    tables, info = tracer.recording()
    analysis = analyse_latency(tables, CHAIN, info.clock_offset_ns)
    whole = analysis.traversals
    (chain,) = watch.chains
    latencies = dict(whole.select("start", "latency_ns").iter_rows())
    begun, found, count = chain.cycles["start"], chain.cycles["latency_ns"], chain.cycles.height
    assert count >= 30
    assert [latencies[one] for one in begun] == found.to_list()
    same_time = whole.filter(whole["start"].is_between(begun[0], begun[-1]))
    assert same_time.height == count, "none is passed over, none counted twice"
    last = seen.chains[0]
    assert (last.spans["hour"].count, last.spans["hour"].max_ns) == (count, found.max())
    assert last.rate_hz == pytest.approx((count - 1) * SECOND / (begun[-1] - begun[0]))
    total = sum(h.communication_ns + h.computation_ns + h.waiting_ns for h in last.hops)
    assert total == pytest.approx(found.mean(), rel=1e-6)
    own = analysis.hops.join(same_time, on="traversal", how="semi").group_by("hop")
    most = own.agg(pl.col("communication_ns", "computation_ns", "waiting_ns").max()).sort("hop")
    assert [hop.node for hop in last.hops] == ["/first", "/second"]
    assert [hop.longest_ns for hop in last.hops] == most.drop("hop").rows()
    (second,) = (one for one in seen.callbacks if one.node == "/second")
    (ran,) = (one for one in analysis.graph.callbacks if one.node == "/second")
    flow = data_flow(tables, info.clock_offset_ns)
    since, until = watch._began_ns, seen.at_ns - PATIENT_NS  # its own cycles' and no others
    within = pl.col("start").is_between(since, until, "right")
    times = flow.instances.filter(within, callback_id=ran.id)
    assert second.starts == "/ebpf1"
    assert second.longest_ns[0] == (times["end"] - times["start"]).max()
    # A busy machine has the second look later: it is judged by the cycles until then.
    until = other_seen.at_ns - PATIENT_NS
    due = whole.filter(pl.col("start").is_between(other._began_ns, until, "right")).height
    assert abs(other_seen.chains[0].spans["hour"].count - due) <= 2
    assert seen.lost == 0


def test_a_process_that_ends_or_is_killed_is_left_and_another_is_found(tmp_path: Path) -> None:
    watch = own_watch()
    assert watch.look().chains[0].problem is not None
    with pytest.raises(OperationError, match="no event has been seen"):
        watch.save(tmp_path / "nothing")
    for number in (1, 2):
        with running(10_000):
            watch._searched_ns = 0
            enough = 8 * number

            def counted(seen: Seen, enough: int = enough) -> bool:
                return cycles(seen) > enough

            looks = watched(watch, "its cycles", counted)
            # That the first is still there is what makes the second run worth a look.
            assert len(watch.processes) == number
            assert looks[-1].chains[0].problem is None, "what has ended is no second path"
    watch.read()  # what they wrote until they ended
    watch._searched_ns = 0
    watch._latest = dict.fromkeys(watch._latest, 0)  # as twelve seconds later
    watch.read()
    assert not watch.processes


def test_processes_of_another_checkout_are_not_watched_here() -> None:
    """Its tests are no children of ours: as if they ran there, one is started by a process that
    ends at once."""
    words = built().command("chain", "100000")
    variables = {**os.environ, "LD_PRELOAD": str(installed_library())}
    script = '"$@" >/dev/null 2>&1 </dev/null & echo $!'
    started = subprocess.run(
        ["sh", "-c", script, "sh", *words],
        env=variables,
        capture_output=True,
        text=True,
        check=True,
    )
    stranger = int(started.stdout)
    try:
        everyone = {os.geteuid()}
        wait_for(lambda: stranger in dict(memories(everyone, ())), "the stranger's memory")
        with running(10_000) as process:
            seen = watched(own_watch(), "a process", lambda seen: bool(seen.processes))[-1]
        assert {*seen.processes} == {process.pid}
    finally:
        with suppress(ProcessLookupError):
            os.kill(stranger, signal.SIGKILL)


def test_late_outputs_and_shares_are_counted_beside_a_plan(tmp_path: Path) -> None:
    """The plan's slot is behind what a calm machine takes; then a cycle that no output can hold."""
    with running(10_000):
        watch = own_watch(longest_ns=PATIENT_NS)
        watched(watch, "25 cycles", lambda seen: cycles(seen) >= 25)
        recording = watch.save(tmp_path / "flight", reasons=["too slow"])
        with pytest.raises(InputError, match="exists"):
            watch.save(tmp_path / "flight")
        latencies = np.array([1, 40]) * 1_000_000
        plan = plan_shaping(latencies, PERIOD_NS, spec=CHAIN, output="/ebpf2")
        (slot,) = publish_slots(plan)
        beside = own_watch(CHAIN, "/first../second", plan=Plan.of(plan))
        in_time, by_nodes = watched(beside, "15 cycles", lambda seen: cycles(seen) > 15)[-1].chains
        beside.due = [replace(beside.due[0], cycle_ns=1_000_000, slots=())]
        until = cycles(beside.look()) + 10
        too_late = watched(beside, "ten more", lambda seen: cycles(seen) > until)[-1].chains[0]
    assert in_time.promised_ns == by_nodes.promised_ns == slot[1]
    assert in_time.shares == by_nodes.shares
    first, later = in_time.spans["hour"], too_late.spans["hour"]
    places = beside.chains[0].cycles.drop_nulls("latency_ns")["place_ns"][: first.count]
    opens_ns = slot[0] - 100_000
    assert in_time.shares == (places.is_between(opens_ns, slot[1], "left").mean(),)
    assert in_time.early == (places < opens_ns).mean(), "an unshaped program holds no output back"
    assert first.late == (places >= PERIOD_NS).sum(), "of a machine that stands still"
    assert known(later.late) - known(first.late) == later.count - first.count
    measured = measure_latency(recording).analysis
    happened = recording.events.keys() - CREATION
    since = min(int(recording.events[name]["time"][0]) for name in happened)
    assert (
        measured.statistics.count
        >= watch.chains[0].cycles.filter(pl.col("start") > since).height
        > 5
    )
    assert recording.info.notes[-1] == "too slow"
    assert list(recording.info.processes.values()) == ["/first, /second"]
    (worst_ns,) = recording.info.worst_ns
    worst = measured.traversals.filter(start=worst_ns)["latency_ns"].item()
    until_then = measured.traversals.filter(pl.col("start") <= watch._over_ns)
    assert (worst is not None) == until_then["complete"].all()
    assert worst in (None, until_then["latency_ns"].max())
    shown = called("latency", recording.path)
    assert shown.code == 0, shown.err


def test_shares_are_of_outputs_within_slots() -> None:
    ms = 1_000_000
    (chain,) = own_watch().chains
    chain.slots = ((10 * ms, 12 * ms), (20 * ms, 22 * ms))
    places = [5 * ms, 10 * ms - 50_000, 11 * ms, 12 * ms, 15 * ms, 20 * ms, 22 * ms, 60 * ms]
    rows = {"start": range(8), "latency_ns": places, "late": [False] * 8, "place_ns": places}
    chain.cycles = pl.DataFrame(rows, schema=chain.cycles.schema)
    assert chain.shares() == ((2 / 8, 1 / 8), 1 / 8)


def test_a_node_that_dies_in_a_callback_leaves_a_cycle_that_is_incomplete() -> None:
    watch = own_watch(longest_ns=PATIENT_NS)
    began_ns = time.monotonic_ns()
    with running(10_000) as process:
        seen = watched(watch, "eleven cycles", lambda seen: cycles(seen) > 10)[-1].chains[0]
        (memory,) = (one for pid, one in watch.processes.items() if pid == process.pid)
        kill_in_a_callback(process, memory)
        # What was read to see that is no part of what is watched: a watch that begins now has it.
        late = own_watch(longest_ns=PATIENT_NS)
        late.processes, late._latest = {process.pid: memory}, {process.pid: 0}
        memory._read[:] = 0
        late._over_ns = began_ns  # what began before the watch is none of its cycles
        killed_ns = time.monotonic_ns()
        after = watched(late, "it to be over", lambda seen: seen.at_ns - killed_ns > PATIENT_NS)
        counted = after[-1].chains[0].counted
    assert (seen.counted["incomplete"], counted["incomplete"], late.lost) == (0, 1, 0)
    assert counted["complete"] > 10, "cycles that were complete before are counted as such"


def kill_in_a_callback(process: "subprocess.Popen[str]", memory: TracedProcess) -> None:
    """Stop it again and again until a callback's start is the last that it has written."""
    start = event_names().index("callback_start") + 3  # numbers begin with 3
    last, deadline = 0, time.monotonic() + 60
    while last != start:
        assert time.monotonic() < deadline, "it was never stopped in a callback"
        process.send_signal(signal.SIGCONT)
        time.sleep(0.003)
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        for part in memory.new_records():
            last = part["event"][-1] if part.size else last
    process.kill()
    process.wait()


def test_a_full_disk_stops_neither_the_watch_nor_loses_what_it_has(
    tmp_path: Path, full_disk: Path
) -> None:
    with running(10_000):
        watch = own_watch()
        before = cycles(watched(watch, "a cycle", lambda seen: cycles(seen) > 0)[-1])
        with pytest.raises(OperationError, match=r"cannot be written: .*No space left"):
            watch.save(full_disk / "flight")
        assert [one.name for one in full_disk.iterdir()] == ["filling"]
        counted = cycles(watched(watch, "another", lambda seen: cycles(seen) > before)[-1])
        recording = watch.save(tmp_path / "flight")
    assert measure_latency(recording, CHAIN).analysis.statistics.count >= counted


REALTIME_STEPS = """
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>
int clock_gettime(clockid_t clock, struct timespec *time) {
    if (clock == CLOCK_REALTIME) {
        int is_set = syscall(SYS_faccessat, AT_FDCWD, getenv("IS_SET"), F_OK) == 0;
        syscall(SYS_clock_gettime, clock, time);
        if (is_set && (time->tv_nsec -= 60000000) < 0) time->tv_sec--, time->tv_nsec += 1000000000;
        return 0;
    }
    return (int)syscall(SYS_clock_gettime, clock, time);
}
"""
"""CLOCK_REALTIME as the application sees it: set back by 60 ms, more than a cycle, by a file."""


@pytest.mark.parametrize("version", ["4.1.1", "8.2.3"])
def test_a_clock_that_is_set_spoils_no_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    """Only Humble's publications have no stamp: its cycles around the step are counted apart."""
    (tmp_path / "clock.c").write_text(REALTIME_STEPS)
    words = ["gcc", "-shared", "-fPIC", "-o", str(tmp_path / "clock.so"), str(tmp_path / "clock.c")]
    subprocess.run(words, check=True)
    is_set, real = tmp_path / "is set", clock_offset
    monkeypatch.setattr(watch_module, "clock_offset", lambda: real() - 60_000_000 * is_set.exists())
    program = built("-DHUMBLE", version=version) if version == "4.1.1" else built()
    watch = own_watch(longest_ns=PATIENT_NS)
    libraries = f"{installed_library()}:{tmp_path / 'clock.so'}"
    variables = {**os.environ, "LD_PRELOAD": libraries, "IS_SET": str(is_set)}
    process = subprocess.Popen(
        program.command("chain", "120"), env=variables, stdout=subprocess.PIPE, text=True
    )
    before = watched(watch, "20 cycles", lambda seen: cycles(seen) > 20)[-1]
    is_set.touch()
    watch.look()
    at_ns = time.monotonic_ns()  # the look reads the clock's offset behind its `at_ns`
    wait_for(lambda: process.poll() is not None, "the program's end", 60)
    over_ns = time.monotonic_ns() + PATIENT_NS
    counted = watched(watch, "its cycles", lambda seen: seen.at_ns > over_ns)[-1].chains[0].counted
    printed = [line.split("\t") for line in process.communicate()[0].splitlines()]
    starts = [int(row[2]) for row in printed if row[0] == "instance"][::2]
    outputs = [int(row[2]) for row in printed if row[:2] == ["publication", "/ebpf2"]]
    (chain,) = watch.chains
    begun, latency = (chain.cycles[one].to_numpy() for one in ("start", "latency_ns"))
    first = np.searchsorted(starts, begun) - 1  # the program reads the clock before the event
    expected = np.array(outputs)[first] - np.array(starts)[first]
    whole = latency >= 0  # none: NaN
    assert (np.abs(latency - expected)[whole] < PERIOD_NS // 2).all(), "of its own cycle"
    assert first[-1] - first[0] + 1 <= first.size + counted["unclear"], "none is passed over"
    assert first.size > 30
    assert counted["incomplete"] <= 1
    assert (counted["unclear"] > 0) == (version == "4.1.1")
    around = [start for start in starts if before.at_ns - PATIENT_NS < start <= at_ns]
    assert counted["unclear"] <= len(around)


def test_memory_does_not_grow() -> None:
    """An hour of cycles stays: hours are simulated by setting the clock on."""
    (chain,) = own_watch().chains
    names = ["traversal", "hop", "communication_ns", "computation_ns", "waiting_ns"]
    hops = pl.DataFrame(schema=dict.fromkeys(names, pl.UInt32))
    minute = pl.DataFrame({"start": range(0, 60 * SECOND, SECOND // 10)}).with_columns(
        latency_ns=pl.lit(5_000_000),
        place_ns=pl.lit(5_000_000),
        late=False,
        complete=True,
        traversal=pl.int_range(pl.len(), dtype=pl.UInt32()),
    )
    for number in range(1, 121):
        chain.take_over(minute, hops, number * 60 * SECOND)
        minute = minute.with_columns(pl.col("start") + 60 * SECOND)
    assert chain.cycles.height == pytest.approx(3600 * 10, rel=0.001)
    assert chain.cycles.n_chunks() == 1, "looks get no slower with the hour"


def test_the_command_shows_and_streams(tmp_path: Path) -> None:
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with running(10_000) as process:
        words = [sys.executable, "-c", program(), "watch", "--chain", CHAIN, "--longest"]
        words += ["200ms", "--every", "500ms"]
        streaming = subprocess.Popen([*words, "--json", "--recorder", str(tmp_path)], **pipes)
        counted, last = 0, dict[str, Any]()
        while counted <= 5:
            last = json.loads(known(streaming.stdout).readline())
            counted = last["chains"][0]["spans"]["hour"]["count"]
        streaming.send_signal(signal.SIGQUIT)
        wait_for(lambda: any(tmp_path.glob("watch-*/recording.json")), "the flight recorder", 60)
        streaming.send_signal(signal.SIGINT)
        assert streaming.wait(60) == 0
        assert process.poll() is None, "what is watched runs on"
        assert last["processes"] == {str(process.pid): "/first, /second"}
        (tmp_path / "budget.yaml").write_text(
            f"format: 1\nchains:\n- {{chain: {CHAIN}, maximum: 1us, jitter: 10s,"
            " hops: [{topic: /ebpf2, communication: 10s, computation: 1us}]}\n"
            "callbacks:\n- {node: /second, starts: /ebpf1, response: 1us, execution: 10s}\n"
            "- {node: /ended, starts: /other, response: 1us}\n"
        )
        (tmp_path / "broken").mkdir()
        words += ["--budget", str(tmp_path / "budget.yaml"), "--recorder", str(tmp_path / "broken")]
        shown = subprocess.Popen(words, **pipes)
        wait_for(
            lambda: any((tmp_path / "broken").glob("watch-*/recording.json")), "what broke", 60
        )
        time.sleep(1)  # a look or two
        shown.send_signal(signal.SIGINT)
        text, said = shown.communicate(timeout=60)
    assert f"{CHAIN}: maximum" in said, "the limit that is broken, once"
    assert said.count("budget 1 us") == 3
    assert f"{CHAIN}: computation of /ebpf2" in said
    assert "/second (/ebpf1): response" in said
    (broken,) = (tmp_path / "broken").glob("watch-*")
    assert open_recording(broken).info.chain == CHAIN
    assert re.search(rf"{CHAIN}: \d\d\.\d\d cycles a second", text)
    assert "incomplete" in text
    assert "/second" in text


def test_the_python_example_of_the_documentation_records_again_and_again(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/watch.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    for wanted, shorter in (("/t1../t5", CHAIN), ("80_000_000", "1"), ("600", "60")):
        assert wanted in example
        example = example.replace(wanted, shorter)
    with running(1000):
        words = [sys.executable, "-c", program(example)]
        run = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert len([*tmp_path.glob("slow_*/recording.json")]) > 1


def test_the_flight_recorder_takes_the_next_free_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Several watch in a folder, or Ctrl-\\ comes in the second in which a limit breaks."""
    now = datetime(2026, 1, 2, 3, 4, 5)
    monkeypatch.setattr(runs, "datetime", SimpleNamespace(now=lambda: now))
    with running(200):
        watch = own_watch()
        watched(watch, "an event", lambda seen: bool(seen.processes))
        for _ in range(3):
            runs._save(watch, tmp_path)
    names = sorted(one.parent.name for one in tmp_path.glob("watch-*/recording.json"))
    assert names == [f"watch-20260102-030405{end}" for end in ("", "-2", "-3")]
    runs._save(own_watch(), tmp_path)
    assert "no event has been seen" in capsys.readouterr().err
    assert len([*tmp_path.glob("watch-*")]) == 3, "no empty folder is left"


def test_the_command_that_fails_and_names_that_never_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = called("watch", "--chain", CHAIN, "--", "sh", "-c", "exit 3")
    assert (failed.code, "the command ended with code 3" in failed.err) == (1, True)
    assert called("watch", "--chain", CHAIN, "--", "true").code == 0
    gone = called("watch", "--chain", CHAIN, "--recorder", tmp_path / "gone", "--", "true")
    assert (gone.code, "no such folder" in gone.err) == (2, True)
    monkeypatch.setattr(runs, "PATIENCE_NS", SECOND)
    budget = tmp_path / "budget.yaml"
    budget.write_text(
        f"format: 1\nchains: [{{chain: {CHAIN}}}, {{chain: /ebpf1../other}}]\ncallbacks:\n"
        "- {node: /second, starts: /ebpf1, response: 10s}\n"
        "- {node: /ended, starts: /other, response: 1us}\n"
    )
    words = ("--longest", "200ms", "--every", "200ms", "--recorder", tmp_path)
    program = built().command("chain", "50")
    said = called("watch", "--budget", budget, *words, "--", *program).err
    notes = [line for line in said.splitlines() if line.startswith("note: ")]
    assert len(notes) == 2, said
    assert "/ebpf1../other has not run yet: " in notes[0]
    assert "/ended (/other) has not run yet" in notes[1]


def seen_with(figures: LatencyStatistics, at_ns: int = 0, hops: tuple[Hop, ...] = ()) -> Seen:
    """A look at one chain, which has the same figures over all spans."""
    counted = {"complete": figures.count, "late": figures.late or 0, "incomplete": 0, "unclear": 0}
    spans = dict.fromkeys(SPANS, figures)
    outputs = OutputsDue.of(figures.count, figures.late, figures.incomplete)
    about = {"problem": None, "outputs": outputs, "kept": outputs.kept}
    chain = ChainNow(CHAIN, spans, 20.0, hops, (), 0.0, None, 0, counted, **about)  # type: ignore[arg-type]
    return Seen(at_ns, {1: "/first"}, 0, (chain,))


def test_a_limit_that_breaks_for_ever_does_not_fill_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(runs, "MOST_RECORDED", 2)
    written: list[list[str]] = []
    monkeypatch.setattr(runs, "_save", lambda _, __, reasons: written.append(reasons))
    (tmp_path / "budget.yaml").write_text(
        f"format: 1\nchains: [{{chain: {CHAIN}, maximum: 10ms}}]\n"
    )
    judged = runs._judging(load_budget(tmp_path / "budget.yaml"), own_watch(), tmp_path)
    for look in range(8):
        minute = latency_statistics(np.array([5, 25 if look % 2 else 6]) * 1_000_000)
        assert bool(judged(seen_with(minute, look * SECOND))) == bool(look % 2)
    assert [len(reasons) for reasons in written] == [1, 1]
    said = capsys.readouterr().err
    assert said.count("2 recordings are there") == 1
    assert said.count("25 ms") == 4, "every break is a line"


class Collector(BaseHTTPRequestHandler):
    """Takes OTLP over HTTP, as an OpenTelemetry collector does."""

    received: ClassVar[list[bytes]] = []

    def do_POST(self) -> None:
        self.received.append(self.rfile.read(int(self.headers["Content-Length"])))
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


def test_metrics_are_the_figures_that_are_shown() -> None:
    hour = latency_statistics(np.arange(5, 25) * 1_000_000, late=1)
    first = Hop("/first", "/ebpf1", 0.0, 2e6, 0.0, (0, 2, 0))
    hops = (first, Hop("/second", "/ebpf2", 1e6, 3e6, 0.0, (1, 3, 0)))
    seen = seen_with(hour, 0, hops)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with HTTPServer(("127.0.0.1", 0), Collector) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        endpoint = f"http://127.0.0.1:{server.server_port}/v1/metrics"
        with exporting(port, endpoint) as export:
            export(seen)
            with pytest.raises(OperationError, match="cannot be served"), exporting(port):
                pass
            text = urlopen(f"http://127.0.0.1:{port}/metrics").read().decode()
        server.shutdown()
    families = {one.name: one.samples for one in text_string_to_metric_families(text)}
    found = {
        (one.labels["span"], one.labels["statistic"]): one.value
        for one in families["chainshaper_chain_latency_seconds"]
    }
    assert found["hour", "max"] == known(hour.max_ns) / SECOND
    assert found["hour", "p50"] == hour.percentiles_ns["50"] / SECOND
    cycles = families["chainshaper_chain_cycles"]
    counted = {one.labels["outcome"]: one.value for one in cycles}
    assert counted == seen.chains[0].counted
    assert len(families["chainshaper_hop_time_seconds"]) == 2 * len(PARTS)
    request = ExportMetricsServiceRequest.FromString(Collector.received[-1])
    (metrics,) = request.resource_metrics[0].scope_metrics
    sent = {
        one.name: {
            tuple(sorted((a.key, a.value.string_value) for a in point.attributes)): point
            for point in (one.gauge.data_points or one.sum.data_points)
        }
        for one in metrics.metrics
    }
    key = (("chain", CHAIN), ("span", "hour"), ("statistic", "max"))
    assert sent["chainshaper.chain.latency"][key].as_double == known(hour.max_ns) / SECOND
    assert "chainshaper.events.lost" in sent


@contextmanager
def exported(*, port: int | None = None, endpoint: str | None = None) -> "Iterator[list[str]]":
    """Metrics of a look while this is entered; what there was to say about the collector."""
    said: list[str] = []
    with exporting(port, endpoint) as export:
        until = Event()

        def look() -> None:
            while not until.wait(0.05):
                said.extend(export(seen_with(latency_statistics(np.arange(5, 9)), 0, ())))

        thread = Thread(target=look)
        thread.start()
        try:
            yield said
        finally:
            until.set()
            thread.join()


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def test_whoever_scrapes_disturbs_neither_the_watch_nor_others(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Connections that are reset, nonsense, and more that say nothing than the port serves."""
    port, slow = free_port(), list[socket.socket]()
    with exported(port=port):
        for _ in range(20):
            for request in (os.urandom(200), b"GET /metrics HTTP/1.1\r\n\r\n", b"G" * 70_000):
                with socket.create_connection(("127.0.0.1", port)) as rude, suppress(OSError):
                    rude.setsockopt(
                        socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0)
                    )  # closing it is a reset
                    rude.sendall(request)
        for _ in range(3 * SCRAPERS):
            slow.append(socket.create_connection(("127.0.0.1", port), timeout=60))
            slow[-1].sendall(b"GET /metr")
        serving = [one for one in threading.enumerate() if "process_request" in one.name]
        assert len(serving) <= 2 * SCRAPERS, "those that were closed may be about to end"
        url, deadline = f"http://127.0.0.1:{port}/metrics", time.monotonic() + 60
        while b"chainshaper_" not in urlopen(url, timeout=60).read():  # until the first look
            assert time.monotonic() < deadline
        assert slow[0].recv(1) == b"", "it was closed for those that came later"
    for connection in slow:
        connection.close()
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("collector", ["nobody listens", "it hangs", "it closes"])
def test_a_collector_that_is_away_is_named_once_and_holds_nobody_up(
    collector: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watch_module, "EVERY_MS", 100)
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "1")  # of an attempt, with all its retries
    with socket.create_server(("127.0.0.1", 0)) as listening:
        endpoint = f"http://127.0.0.1:{listening.getsockname()[1]}/v1/metrics"
        if collector == "nobody listens":
            listening.close()
        elif collector == "it closes":
            Thread(target=_close_all, args=(listening,), daemon=True).start()
        with exported(endpoint=endpoint) as said:
            wait_for(lambda: bool(said), "it to be told")
            time.sleep(1.5)  # for another attempt or two
    assert [one.partition(" (")[0] for one in said] == [f"metrics do not arrive at {endpoint}"]
    assert capfd.readouterr().err == ""


def _close_all(listening: socket.socket) -> None:
    with suppress(OSError):  # it is closed
        while True:
            listening.accept()[0].close()


def test_a_collector_that_comes_back_gets_metrics_and_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(watch_module, "EVERY_MS", 100)
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "1")
    port = free_port()
    with exported(endpoint=f"http://127.0.0.1:{port}/v1/metrics") as said:
        wait_for(lambda: bool(said), "it to be missed")
        with HTTPServer(("127.0.0.1", port), Collector) as server:
            Thread(target=server.serve_forever, daemon=True).start()
            wait_for(lambda: len(said) > 1, "it to be found again")
            server.shutdown()
    assert said[1] == f"metrics arrive at http://127.0.0.1:{port}/v1/metrics again"


@pytest.mark.parametrize(
    "option",
    [
        *(f"--metrics={port}" for port in ("0", "65536", "80x")),
        *(f"--otlp={url}" for url in ("collector:4318", "ftp://host/", "http://", "http://[::1")),
        "--otlp=http://host:99999/",
    ],
)
def test_no_port_and_no_address_are_wrong_use(option: str) -> None:
    said = called("watch", "--chain", CHAIN, option)
    assert said.code == 2
    assert "Traceback" not in said.err


def test_wrong_use_and_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    said = called("watch", "--environment")
    assert said.code == 0
    loaded, options = said.out.splitlines()
    assert options == "export ASAN_OPTIONS=verify_asan_link_order=0"
    library = Path(loaded.removeprefix("export LD_PRELOAD="))
    assert library.is_file()
    assert library == installed_library()
    assert [*tmp_path.iterdir()] == [], "nothing is built on the robot"
    unnamed = called("watch")
    assert unnamed.code == 2
    assert "no chain is named" in unnamed.err
