"""Outputs that missed their slot: counted by what was done about them, recorded live."""

import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from applied_plans import leftovers, needs_fifo
from calm_runs import calm_run
from command_line import called, json_of
from gated import needs_cgroups
from known import known
from small_chain import EXECUTOR_CORE, PERIOD_NS, small_chain, small_chain_plan, with_times

from chainshaper import LatencyAnalysis, measure_latency, save_plan, shape_application, simulate
from chainshaper.flow.apply import apply_plan
from chainshaper.planning import ChainPlan, Plan, plan_shaping, publish_slots
from chainshaper.planning.chain_plan import revised
from chainshaper.planning.shaping import let_per_chain
from chainshaper.reporting.latency import doubts_text, latency_json
from chainshaper.robot.clocks import sleep_until
from chainshaper.robot.gate import Overrun
from chainshaper.values.recording import Recording
from chainshaper.verify.overruns import (
    OverrunOutcome,
    dropped_text,
    gate_releases,
    overruns_in,
    overruns_text,
)
from chainshaper.workload import live
from chainshaper.workload.description import Application, ExecutionTime
from chainshaper.workload.live import Enforcement, StartedNodes

pytestmark = pytest.mark.timed

MS = 1_000_000


def _too_early(overrun: str = "wait", until_ns: int | None = None, **changes: Any) -> ChainPlan:
    """A publish slot in the midst of the small chain's latencies; the chain itself may run on.

    Until ``until_ns``: 1 ms later.
    """
    plan = small_chain_plan(4 * MS, 6 * MS)
    chain, output = plan.servers
    ((start, end),) = output.slots
    slots = ((0, PERIOD_NS),), ((start, until_ns or end),)
    servers = [
        one.model_copy(update={"slots": own})
        for one, own in zip((chain, output), slots, strict=True)
    ]
    return revised(plan, servers=tuple(servers), overrun=overrun, **changes)


def test_discarded_outputs_are_not_published_and_not_lost(tmp_path: Path) -> None:
    plan = _too_early("discard")
    recording = simulate(small_chain(tmp_path), tmp_path / "rec", Plan.of(plan), cycles=24)
    measured, releases = measure_latency(recording), recording.events["gate_release"]
    discarded = releases.filter(pl.col("overrun") == "discard")
    count = discarded.height
    assert 0 < count < releases.height
    assert discarded["release"].null_count() == discarded["slot"].null_count() == count
    assert measured.overruns == {"discard": count}
    assert measured.analysis.incomplete == {"discarded": count}
    assert measured.analysis.statistics.count == releases.height - count
    # Nothing was let go outside the slot of its own cycle.
    ((start, end),) = publish_slots(plan)
    let_go = releases.drop_nulls("release").select(pl.col("time") - pl.col("origin")).to_series()
    assert let_go.is_between(start, end, "left").all()
    # What was let go as the slot ended leaves a moment later, and is late.
    at_the_end = measured.analysis.traversals.filter(pl.col("latency_ns") >= end - MS // 10)
    assert known(measured.prediction).late <= at_the_end.height
    # It is reported wherever the latency is.
    shown = " ".join(called("latency", recording.path).out.split())
    assert overruns_text({"discard": count}) in shown
    values = json_of("latency", recording.path)
    assert (values["overruns"], values["overruns_by_policy"]) == (count, {"discard": count})
    # Where one follows the other, the next cycle was hit.
    behind = list(pairwise(releases["overrun"].fill_null("-")))
    hit, followed = behind.count(("discard",) * 2), sum(one == "discard" for one, _ in behind)
    assert 0 < hit < followed
    outcome = {"late": 0, "discarded": count, "followed": followed, "next_hit": hit}
    assert values["overrun_outcomes"] == {"discard": outcome}
    assert f"the next cycle was hit in {hit} of {followed}" in doubts_text(measured)
    compared = ("compare", recording.path, recording.path)
    assert f"{count} ({count} discard)" in (shown := called(*compared).out)
    assert re.search(rf"next cycle hit +│ +{hit} of {followed} │", shown)
    both = json_of(*compared)["recordings"]
    assert [one["overruns_by_policy"] for one in both] == [{"discard": count}] * 2


def _with_long_executions(folder: Path) -> Application:
    """The small chain, in which every tenth callback of /second takes 36 ms, the others 2 ms."""
    second = ExecutionTime(samples_ns=(2 * MS,) * 9 + (36 * MS,), block=10)
    others = dict.fromkeys(("first", "third"), ExecutionTime(constant_ns=2 * MS))
    return with_times(small_chain(folder), {"second": second, **others})


def _frozen_outside_slots(plan: ChainPlan) -> Enforcement:
    """The chain's executors run in the slots of their server, by the freezer."""

    @contextmanager
    def in_force(nodes: StartedNodes) -> Iterator[None]:
        stop, in_force = threading.Event(), threading.Event()
        how: dict[str, Any] = {"back_end": "freezer", "phase_ns": nodes.anchor_ns, "stop": stop}
        how |= {"wait_ns": 1000 * MS, "watch": lambda _: in_force.set()}
        with ThreadPoolExecutor(1) as pool:
            run = pool.submit(apply_plan, Plan.of(plan), **how)
            while not in_force.wait(0.05) and not run.done():
                pass
            try:
                yield
            finally:
                stop.set()
                run.result()

    return in_force


@needs_fifo
@needs_cgroups
@pytest.mark.parametrize("policy", ["publish", "wait", "discard"])
def test_whatever_becomes_of_an_overrun_the_next_output_is_in_its_slot(
    tmp_path: Path, policy: Overrun
) -> None:
    """Stopped at the end of its slot, the chain would take 24 of the next slot's 18 ms."""
    application, wishes = _with_long_executions(tmp_path), {"epsilon_ns": 9 * MS, "overrun": policy}
    plan = small_chain_plan(6 * MS, 9 * MS, core=EXECUTOR_CORE, publish_slot_ns=4 * MS, **wishes)
    simulated = simulate(application, tmp_path / "simulated", Plan.of(plan), cycles=40)
    for attempt in range(3):  # unless the machine stands still for long
        place, enforcement = tmp_path / f"live{attempt}", _frozen_outside_slots(plan)
        live = shape_application(
            application, Plan.of(plan), place, cycles=40, enforcement=enforcement
        )
        found = measure_latency(live).outcomes
        if [one.next_hit for one in found.values()] == [0]:
            break
    count = 3  # as drawn, live and simulated
    late = 0 if policy == "discard" else count
    expected = {policy: OverrunOutcome(late, discarded=count - late, followed=count, next_hit=0)}
    assert measure_latency(simulated).outcomes == found == expected
    assert not leftovers()


@pytest.mark.parametrize("policy", ["publish", "wait"])
def test_of_a_gated_publisher_too_what_missed_its_slot_is_counted(
    tmp_path: Path, policy: Overrun
) -> None:
    application = _with_long_executions(tmp_path)
    topic = application.topic("/t3").model_copy(update={"publication": "asynchronous"})
    application = application.model_copy(update={"topics": {"/t3": topic}})
    wishes: dict[str, Any] = {"publication": "asynchronous", "publish_slot_ns": 10 * MS}
    plan = small_chain_plan(6 * MS, 9 * MS, core=EXECUTOR_CORE, overrun=policy, **wishes)
    measured = measure_latency(simulate(application, tmp_path / "rec", Plan.of(plan), cycles=40))
    assert measured.outcomes == {
        policy: OverrunOutcome(late=3, discarded=0, followed=3, next_hit=0)
    }
    assert measured.overruns == {policy: 3}


def test_outputs_published_at_once_wait_for_nothing(tmp_path: Path) -> None:
    plan = _too_early("publish")
    recording = simulate(small_chain(tmp_path), tmp_path / "rec", Plan.of(plan), cycles=24)
    measured = measure_latency(recording)
    late = recording.events["gate_release"].drop_nulls("overrun")
    assert measured.overruns == {"publish": late.height}
    assert measured.analysis.incomplete == {}
    assert (late["release"] == late["arrival"]).all()
    assert late["slot"].null_count() == late.height
    assert known(measured.prediction).late > 0


def test_what_comes_into_an_open_slot_leaves_at_once_and_is_counted(tmp_path: Path) -> None:
    plan, application = _too_early(until_ns=PERIOD_NS), small_chain(tmp_path)
    ((start, _),) = publish_slots(plan)

    def shaped(plan: ChainPlan, name: str) -> tuple[Recording, pl.DataFrame, pl.Series]:
        recording = simulate(application, tmp_path / name, Plan.of(plan), cycles=24)
        releases = recording.events["gate_release"]
        behind = releases["arrival"] - releases["origin"] > start
        assert 0 < behind.sum() < releases.height
        return recording, releases, behind

    recording, _, behind = shaped(plan, "rec")
    measured = measure_latency(recording)
    assert (measured.into_open_slots, measured.overruns) == (behind.sum(), {})
    shown = called("compare", recording.path, recording.path).out
    assert re.search(rf"arrived during their slot +│ +{measured.into_open_slots} │", shown)
    assert json_of("latency", recording.path)["into_open_slots"] == measured.into_open_slots
    # Or it waits for the next slot, which is none of this cycle: only one instant of it is used.
    waiting, releases, behind = shaped(revised(plan, into_open_slot="next-slot"), "strict")
    assert releases["overrun"].to_list() == ["wait" if late else None for late in behind]
    assert measure_latency(waiting).into_open_slots == 0
    waited = releases.filter(pl.col("overrun") == "wait")
    assert set(waited["time"] - waited["origin"]) == {PERIOD_NS + start}, "as the next one begins"


def test_the_plan_says_what_is_done_about_overruns_and_the_live_run_reports_it(
    tmp_path: Path,
) -> None:
    latencies, plan_file = tmp_path / "latencies.txt", tmp_path / "plan.yaml"
    latencies.write_text("4ms\n6ms\n")
    made = json_of("plan", "--latencies", latencies, "--period", "50ms", "--overrun", "discard")
    assert made["overrun"] == "discard"
    wishes = ("plan", "--latencies", latencies, "--period", "50ms", "--into-open-slot", "next-slot")
    made = json_of(*wishes)
    assert (made["into_open_slot"], made["predicted"]["jitter_ns"]) == ("next-slot", 0)
    save_plan(Plan.of(_too_early("discard")), plan_file)
    small_chain(tmp_path)
    output, described = tmp_path / "rec", tmp_path / "small_chain.yaml"
    shaped = called("shape", described, plan_file, "-o", output, "--cycles", "12")
    assert shaped.code == 0, shaped
    assert overruns_text(measure_latency(output).overruns or {}) in shaped.err


def test_what_a_gate_lost_is_shown_wherever_recordings_are_compared(tmp_path: Path) -> None:
    """An overrun that waits meets the output of the next cycle, which takes its place."""
    application = small_chain(tmp_path)
    profile = simulate(application, tmp_path / "profile", cycles=24)
    plan = _too_early(messages="newest")
    shaped = simulate(application, tmp_path / "shaped", Plan.of(plan), cycles=24)
    dropped = known(measure_latency(shaped).dropped)
    count = dropped["replaced"]
    assert dropped == {"replaced": count}

    said = dropped_text({"replaced": count})
    assert said in " ".join(called("latency", shaped.path).out.split())
    both = json_of("compare", profile.path, shaped.path, "--json")["recordings"]
    assert [one["dropped"] for one in both] == [None, count]
    assert both[1]["dropped_by_reason"] == {"replaced": count}
    table = called("compare", profile.path, shaped.path).out
    assert re.search(rf"messages lost at the gate .*{count} \(", table)
    page = tmp_path / "page.html"
    called("report", profile.path, shaped.path, "-o", page)
    assert f"{count} ({count} replaced)" in page.read_text()


AROUND = "2 went around the shaping node, which was not there"


@pytest.mark.parametrize(
    ("text", "counts", "said"),
    [
        (dropped_text, {"overflowed": 1}, "1 message was lost at the gate (1 overflowed)"),
        (dropped_text, {"replaced": 2, "lost by DDS": 1}, "3 messages were lost at the gate"),
        (overruns_text, {"discard": 2, "publish": 3}, "5 outputs were too late for their slot"),
        (overruns_text, {"wait": 1, "bypass": 2}, f"(1 waited for the next slot); {AROUND}"),
        (overruns_text, {"silence": 3}, "3 were not published, since the shaping node"),
    ],
)
def test_counts_in_words(
    text: Callable[[dict[str, int]], str], counts: dict[str, int], said: str
) -> None:
    assert said in text(counts)


def test_an_unshaped_recording_has_no_overruns(unshaped: Recording) -> None:
    measured = measure_latency(unshaped)
    assert (measured.overruns, measured.into_open_slots, measured.dropped) == (None, None, None)


def _overran(
    recording: Recording, plan: ChainPlan | None, analysis: LatencyAnalysis
) -> dict[str, int] | None:
    return overruns_in(recording, plan, analysis, gate_releases(recording, plan, analysis))


def _without_column(recording: Recording, cycles_waited: list[int]) -> Recording:
    """A recording from before there was a choice."""
    table = recording.events["gate_release"].drop("overrun").head(len(cycles_waited))
    waited = pl.Series("cycles_waited", cycles_waited, dtype=pl.Int32)
    return replace(
        recording, events={**recording.events, "gate_release": table.with_columns(waited)}
    )


def test_older_recordings_are_read_by_the_cycles_their_outputs_waited(
    shaped: Recording, plan: ChainPlan
) -> None:
    old = _without_column(shaped, [0, 1, 2, 0])
    analysis = measure_latency(old).analysis
    decided = known(gate_releases(old, plan, analysis))
    assert decided["overrun"].to_list() == [None, "wait", "wait", None]
    assert _overran(old, plan, analysis) == {"wait": 2}
    assert _overran(old, None, analysis) == {"wait": 2}
    late = _overran(old, let_per_chain(plan), analysis)
    assert late == {"wait": 1}, "they are due a cycle later"


def test_of_a_gated_publisher_what_was_not_sent_was_discarded(unshaped: Recording) -> None:
    wishes: dict[str, Any] = {"output": "/t3", "publisher": "/third", "overrun": "discard"}
    wishes["publication"] = "asynchronous"
    plan = plan_shaping(np.array([4, 20]) * MS, PERIOD_NS, **wishes)
    outcomes = ["sent", "expired", "sent", "overwritten"]
    pids = {node: pid for pid, node in unshaped.info.processes.items()}
    sends = pl.DataFrame({"outcome": outcomes, "pid": [pids["/third"]] * 4})
    gated = replace(unshaped, events={**unshaped.events, "asynchronous_send": sends})
    analysis = measure_latency(unshaped).analysis
    assert _overran(gated, plan, analysis) == {"discard": 2}
    took = pl.Series([PERIOD_NS - 1, PERIOD_NS, *[5 * MS] * (analysis.traversals.height - 2)])
    late = replace(analysis, traversals=analysis.traversals.with_columns(latency_ns=took))
    assert _overran(gated, plan, late) == {"wait": 1, "discard": 2}


@contextmanager
def _stopped_once(nodes: StartedNodes) -> Iterator[None]:
    """/second stands still from the start of cycle 15 on, for more than two periods."""

    def stop() -> None:
        sleep_until(nodes.anchor_ns + 15 * PERIOD_NS)
        os.kill(nodes.pids["/second"], signal.SIGSTOP)
        sleep_until(nodes.anchor_ns + 17 * PERIOD_NS + 20 * MS)
        os.kill(nodes.pids["/second"], signal.SIGCONT)

    thread = threading.Thread(target=stop)
    thread.start()
    yield
    thread.join()


def test_a_late_output_is_not_hidden_by_a_stall_after_it_was_due(
    tmp_path: Path, plan: ChainPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node is stopped; the machine is said to stall while its output waits."""
    monkeypatch.setattr(live, "ENFORCING_NS", 0)  # so that cycles count from the given anchor
    application = small_chain(tmp_path)

    def shape(place: Path) -> Recording:
        output = place / "rec"
        return shape_application(
            application, Plan.of(plan), output, cycles=24, enforcement=_stopped_once
        )

    recording = calm_run(shape, tmp_path)
    stopped = measure_latency(recording).analysis.traversals.filter("late").row(0, named=True)
    assert stopped["latency_ns"] > PERIOD_NS
    ((opens, _),) = publish_slots(plan)
    assert abs(stopped["due_at"] - stopped["start"] - opens) < 2 * MS
    fields = {"time": stopped["due_at"] + 2 * MS, "cpu": 1, "duration": 15 * MS}
    whole = dict.fromkeys(("pid", "tid", "cpu"), pl.Int32)
    stall = pl.DataFrame({"pid": 1, "tid": 1, **fields}, schema_overrides=whole)
    measured = measure_latency(
        replace(recording, events={**recording.events, "machine_stall": stall})
    )
    cycles, values = measured.analysis.traversals, latency_json(measured)
    assert cycles.filter(start=stopped["start"])["disturbed"].to_list() == [False]
    assert measured.analysis.undisturbed.late
    late, longest = int(cycles["late"].sum()), cycles["latency_ns"].max()
    assert values["late"] == late >= 1
    assert values["max_all_ns"] == longest >= stopped["latency_ns"]
    assert values["jitter_all_ns"] == values["max_all_ns"] - values["min_ns"]
    judged = known(measure_latency(recording).prediction)
    assert (judged.outputs.late, judged.outputs.due) == (late, values["count"])


def test_of_gates_in_one_process_each_chain_has_its_own_rows(
    shaped: Recording, plan: ChainPlan
) -> None:
    rows = shaped.events["gate_release"]
    own, others = (rows.with_columns(gate=pl.lit(name)) for name in ("chainshaper_t3", "another"))
    both = replace(shaped, events={**shaped.events, "gate_release": pl.concat([own, others])})
    decided = known(gate_releases(both, plan, measure_latency(shaped).analysis))
    assert decided.height == rows.height
