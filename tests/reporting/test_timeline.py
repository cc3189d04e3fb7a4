"""The rows that timelines draw, in a run whose every instant is known by hand."""

from pathlib import Path

import polars as pl
from known_run import MS, PERIOD_NS, known_plan, known_run

from chainshaper import data_flow, measure_latency
from chainshaper.planning import Plan, publish_slots
from chainshaper.planning.plan import revised
from chainshaper.reporting.timeline import Timeline, timeline_of
from chainshaper.values.recording import Recording


def _timeline(recording: Recording, plan: Plan | None = None) -> Timeline:
    measured = measure_latency(recording, plan=plan)
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    return timeline_of(recording, flow, measured.analysis, measured.plan)


def test_threads_come_in_the_order_of_the_chain_with_their_scheduling(tmp_path: Path) -> None:
    threads = _timeline(known_run(tmp_path / "known")).threads
    gate = f"/{known_plan().shaping_node.name}"  # type: ignore[union-attr]
    assert threads["nodes"].to_list() == ["/first", "/second", gate, "/actuator"]
    assert threads["about"].to_list() == [None, "SCHED_FIFO 80, core 1", None, None]


def test_slots_count_from_the_origin_that_the_gate_recorded(tmp_path: Path) -> None:
    timeline = _timeline(known_run(tmp_path / "known", cycles=2))
    assert timeline.origins["origin"].to_list() == [MS, PERIOD_NS + MS]
    assert not timeline.origins["assumed"].any()
    slots = timeline.slots.select("traversal", "server", "start", "end").rows()
    assert slots == [
        (0, "chain", MS, 31 * MS),
        (0, "output", 31 * MS, 32 * MS),
        (1, "chain", PERIOD_NS + MS, PERIOD_NS + 31 * MS),
        (1, "output", PERIOD_NS + 31 * MS, PERIOD_NS + 32 * MS),
    ]


def test_what_the_gate_held_lies_between_arrival_and_release(tmp_path: Path) -> None:
    held = _timeline(known_run(tmp_path / "known", cycles=2, overran=(1,))).holds
    rows = held.select("traversal", "arrival", "let_go", "slot", "overrun").rows()
    late = PERIOD_NS + MS + 31 * MS
    assert rows == [(0, 17 * MS, 31 * MS + 20_000, 0, None), (1, late, late, None, "publish")]


def test_a_gate_without_callback_events_is_known_by_its_process_and_message(tmp_path: Path) -> None:
    """A Python node's gate names no callback that any other event names."""
    recording = known_run(tmp_path / "known", cycles=2)
    tables = {name: recording.events[name] for name in recording.events}
    nameless = tables["gate_release"].with_columns(callback=pl.lit(0, dtype=pl.UInt64))
    tables["gate_release"] = nameless
    timeline = _timeline(Recording(recording.path, recording.info, tables))
    assert timeline.holds["arrival"].to_list() == [17 * MS, PERIOD_NS + 17 * MS]
    assert not timeline.origins["assumed"].any()


def test_a_cycle_whose_output_never_reached_the_gate_counts_from_its_stamp(tmp_path: Path) -> None:
    origins = _timeline(known_run(tmp_path / "known", untaken=(1,))).origins
    assert origins.rows() == [
        (0, MS, False),
        (1, PERIOD_NS + MS, True),
        (2, 2 * PERIOD_NS + MS, False),
    ]


def test_cycles_that_nothing_tells_are_assumed_to_start_a_wake_up_before_the_chain(
    tmp_path: Path,
) -> None:
    recording = known_run(tmp_path / "known", plan=None)
    tables = {name: recording.events[name] for name in recording.events if name != "gate_release"}
    silent = Recording(recording.path, recording.info, tables)
    timeline = _timeline(silent, revised(known_plan(), anchor="cycle"))
    assert timeline.origins["assumed"].all()
    starts = [MS, PERIOD_NS + MS, 2 * PERIOD_NS + MS]
    before = [
        start - origin for start, origin in zip(starts, timeline.origins["origin"], strict=True)
    ]
    assert len(set(before)) == 1
    assert 0 < before[0] < MS


def test_a_callback_whose_end_was_lost_is_drawn_until_the_next_of_its_thread(
    tmp_path: Path,
) -> None:
    recording = known_run(tmp_path / "known", cycles=2)
    ends = recording.events["callback_end"]
    first_of_second = ends.filter(ends["pid"] == 2)["time"][0]
    tables = {**{name: recording.events[name] for name in recording.events}}
    tables["callback_end"] = ends.filter(ends["time"] != first_of_second)
    slices = _timeline(Recording(recording.path, recording.info, tables)).slices
    (cut,) = slices.filter(~slices["ended"]).rows(named=True)
    assert (cut["pid"], cut["start"], cut["end"]) == (2, 6 * MS, PERIOD_NS + 6 * MS)


def test_without_a_plan_there_are_no_slots(tmp_path: Path) -> None:
    timeline = _timeline(known_run(tmp_path / "known", plan=None))
    assert timeline.slots.height == timeline.origins.height == 0
    assert timeline.stalls.rows() == [(1, PERIOD_NS + 7 * MS, PERIOD_NS + 9 * MS)]


def test_a_live_run_has_a_slot_per_cycle_and_server(shaped: Recording) -> None:
    measured = measure_latency(shaped)
    timeline = _timeline(shaped)
    assert measured.plan is not None
    traversals = measured.analysis.traversals
    slots = sum(len(server.slots) for server in measured.plan.servers)
    assert timeline.slots.height == traversals.height * slots
    complete = traversals.filter("complete")["traversal"]
    assert set(complete) <= set(timeline.holds["traversal"]), "all outputs went through the gate"
    ((opens, _),) = publish_slots(measured.plan)
    late = timeline.holds["release"] - timeline.holds["origin"]
    assert (late >= opens).all()
