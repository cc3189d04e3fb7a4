"""Loops in the simulator: schedules worked out by hand, and beside a second simulator of loops.

What an instance used is seen by the stamp that it passed on, in the rows of a gate behind it.
"""

import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from loops_by_hand import instances_of
from loops_seen import awake, of_node, used
from schedules import MS, application, begin_of, ran, simulated
from test_properties import SETTINGS

from chainshaper.analysis import analyse_latency
from chainshaper.analysis.chains import SeveralPathsError
from chainshaper.simulation import simulate, simulate_latencies
from chainshaper.simulation.simulating import START_NS, with_recorded_times
from chainshaper.values.event_declarations import SLEEPING_CALLS
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application, CallbackDescription
from chainshaper.workload.timing import timing_of

CHAIN = """
chain: /scan../command
nodes:
  sensor: {core: 2, callbacks: [{timer: 20ms, publishes: [/scan]}]}
  controller:
    core: 3
    callbacks:
      - {loop: 8ms, phase: 1ms, core: 1, reads: [/scan], LOOP, publishes: [/command]}
  seen:
    core: 4
    callbacks:
      - subscription: /command
        publishes: [/seen]
        gate: {slots: [[0ms, 1000ms]], cycle: 1000ms}
"""
"""Of the loop's multiples, 105 ms is the first in a recording, which begins at 100 ms."""


def chain(loop: str = "execution: {constant: 2ms}", **simulation: Any) -> Application:
    return application(CHAIN.replace("LOOP", loop), **simulation)


def in_ms(recording: Recording, *times: int) -> tuple[float, ...]:
    return tuple((time - begin_of(recording)) / MS for time in times)


def uses(recording: Recording) -> list[tuple[float, ...]]:
    """When each instance published, and the stamp of what it used (ms)."""
    seen = [in_ms(recording, *pair) for pair in used(recording).items()]
    return [pair for pair in seen if pair[0] >= 0]


def test_a_loop_sleeps_until_multiples_of_its_period_and_uses_the_newest_message(
    tmp_path: Path,
) -> None:
    recording = simulated(tmp_path, chain(delivery={"constant": "3ms"}), cycles=2)
    instances = [in_ms(recording, *times) for times in awake(recording)]
    assert instances[:4] == [(5, 7, 13), (13, 15, 21), (21, 23, 29), (29, 31, 37)]
    stamps = uses(recording)
    # The scan of 0 is there at 3, that of 20 at 23, when the instance of 21 has begun.
    assert stamps[:5] == [(7, 0), (15, 0), (23, 0), (31, 20), (39, 20)]
    (call,) = set(recording.events["thread_sleep"]["call"])
    assert SLEEPING_CALLS[call] == "clock_nanosleep"
    assert recording.events["loop_named"].select("name", "is_thread").rows() == [("/controller", 0)]
    (thread,) = (info for info in recording.info.threads if info.role == "loop")
    assert (thread.comm, thread.cores, thread.priority) == ("loop", (1,), 80)
    assert set(of_node(recording, "rmw_publish", "controller")["tid"]) == {thread.tid}


@pytest.mark.parametrize(("delivery", "stamp"), [("4999999ns", 0), ("5000001ns", -20)])
def test_what_is_stored_a_nanosecond_before_an_instance_begins_is_used(
    tmp_path: Path, delivery: str, stamp: int
) -> None:
    recording = simulated(tmp_path, chain(delivery={"constant": delivery}), cycles=2)
    assert uses(recording)[0] == (7, stamp)


def test_costs_are_those_of_the_loops_thread(tmp_path: Path) -> None:
    costs = {"wake_up": "500us", "take": "250us", "publish": "1ms"}
    each = {name: {"constant": cost} for name, cost in costs.items()}
    loop = "execution: {constant: 2ms}, afterwards: {constant: 1ms}"
    recording = simulated(tmp_path, chain(loop, **each), cycles=2)
    # It wakes up from 5 to 5.5, computes until 7.5, publishes until 8.5, and goes on until 9.5.
    assert in_ms(recording, *awake(recording)[0]) == (5.5, 9.5, 13)
    assert uses(recording)[0] == (7.5, 0.5)


def test_multiples_that_an_instance_missed_are_left_out(tmp_path: Path) -> None:
    """Instances before the recording: 1, 9, …, 97 ms are thirteen."""
    times = [*["1ms"] * 13, "2ms", "11ms", "8ms", "1ms"]
    loop = f"execution: {{sequence: [{', '.join(times)}]}}"
    recording = simulated(tmp_path, chain(loop), cycles=3)
    instances = [in_ms(recording, *times) for times in awake(recording)]
    assert instances[:3] == [(5, 7, 13), (13, 24, 29), (29, 37, 37)]
    assert instances[3] == (37, 38, 45)  # its sleep was over before it began


@pytest.mark.parametrize(
    ("priority", "expected"),
    [
        (90, [("controller", 4, 5), ("loop", 5, 7), ("controller", 7, 10), ("loop", 13, 15)]),
        (70, [("controller", 4, 8), ("loop", 8, 10), ("loop", 13, 15)]),
    ],
)
def test_its_thread_has_a_priority_of_its_own(
    tmp_path: Path, priority: int, expected: list[tuple[str, float, float]]
) -> None:
    text = f"""
    chain: /scan../command
    nodes:
      sensor: {{core: 2, callbacks: [{{timer: 20ms, publishes: [/scan]}}]}}
      controller:
        callbacks:
          - {{timer: 20ms, phase: 4ms, execution: {{constant: 4ms}}}}
          - loop: 8ms
            phase: 1ms
            priority: {priority}
            reads: [/scan]
            execution: {{constant: 2ms}}
            publishes: [/command]
    """
    recording = simulated(tmp_path, application(text))
    assert [stretch for stretch in ran(recording) if 4 <= stretch[1] < 16] == expected


def test_the_stamp_is_that_of_the_first_topic_that_it_reads(tmp_path: Path) -> None:
    text = CHAIN.replace("reads: [/scan], LOOP", "reads: [/late, /scan], LOOP")
    text = text.replace("LOOP", "execution: {constant: 1ms}")
    text += "  late: {core: 5, callbacks: [{timer: 20ms, phase: 4ms, publishes: [/late]}]}\n"
    stamps = uses(simulated(tmp_path, application(text), cycles=2))
    assert stamps[:3] == [(6, 4), (14, 4), (22, 4)]


def test_before_anything_has_arrived_an_instance_stamps_its_message_itself(tmp_path: Path) -> None:
    """The first scan comes at 165 ms, behind the first recorded instances."""
    text = CHAIN.replace("timer: 20ms", "timer: 20ms, phase: 165ms")
    text = text.replace("LOOP", "execution: {constant: 1ms}")
    text = text.replace("chain: /scan../command", "chain: /tick../tock")
    text += "  clock: {core: 5, callbacks: [{timer: 20ms, publishes: [/tick]}]}\n"
    text += "  echo: {core: 5, callbacks: [{subscription: /tick, publishes: [/tock]}]}\n"
    stamps = uses(simulated(tmp_path, application(text), cycles=6))
    assert stamps[0] == (6, 5)
    assert stamps[7:10] == [(62, 61), (70, 65), (78, 65)]


def test_a_loop_that_reads_nothing_ends_with_the_timers(tmp_path: Path) -> None:
    text = "{loop: 20ms, execution: {constant: 1ms}, publishes: [/a]}"
    described = application(f"{{chain: a, nodes: {{a: {{callbacks: [{text}]}}}}}}")
    recording = simulate(described, tmp_path / "recording", cycles=3)
    timing = timing_of(described, 3, START_NS)
    begins = recording.events["thread_wake"]["time"]
    assert begins.to_list() == [timing.anchor_ns + 20 * MS * number for number in (5, 6, 7)]


def test_when_timers_have_ended_only_what_is_new_is_used(tmp_path: Path) -> None:
    """The last scan, of 20 ms, arrives at 53 ms: the loop's last instance is that of 61."""
    recording = simulated(tmp_path, chain(delivery={"constant": "33ms"}), cycles=2)
    assert [begin for begin, _, _ in (in_ms(recording, *each) for each in awake(recording))] == [
        *(5, 13, 21, 29, 37, 61),
    ]
    # The thread wakes up all the same: its last sleep is what the instance was due by.
    slept = of_node(recording, "thread_sleep", "controller")["until"]
    assert in_ms(recording, *slept.filter(slept <= begin_of(recording) + 61 * MS))[-1] == 61


def test_the_first_instance_that_used_a_message_is_the_reaction_to_it() -> None:
    """Scans of 0, 20, 40 and 60 are stored 3 ms later; the loop begins at 5, 29, 45, 69, …"""
    latencies = simulate_latencies(chain(delivery={"constant": "3ms"}), cycles=4)
    assert list(latencies) == [7 * MS, 11 * MS, 7 * MS, 11 * MS]


def test_of_several_messages_before_an_instance_the_newest_is_used() -> None:
    text = CHAIN.replace("timer: 20ms", "timer: 4ms").replace("LOOP", "execution: {constant: 1ms}")
    latencies = simulate_latencies(application(text), cycles=6)
    # From 20 ms on: scans at 20, 24, 28, …; the loop begins at 25, 33, 41.
    assert list(latencies) == [-1, 2 * MS, -1, 2 * MS, -1, 2 * MS]


@pytest.mark.parametrize("chain_text", ["/scan../controller:end", "/scan../command"])
@pytest.mark.parametrize("period", ["20ms", "4ms"])
def test_latencies_are_those_that_the_analysis_finds(
    tmp_path: Path, chain_text: str, period: str
) -> None:
    text = CHAIN.replace("LOOP", "execution: {uniform: [100us, 9ms]}").replace(
        "20ms,", f"{period},"
    )
    text = text.replace("/scan../command", chain_text)
    costs = {"wake_up": {"uniform": ["0us", "100us"]}, "delivery": {"uniform": ["0us", "8ms"]}}
    described = application(text, **costs)
    recording = simulate(described, tmp_path / "recording", cycles=200)
    table = analyse_latency(recording, chain_text).traversals.sort("start")
    latencies = table["latency_ns"].fill_null(-1).to_list()
    assert simulate_latencies(described, cycles=200).tolist() == latencies
    assert len([latency for latency in latencies if latency > 0]) > 80


def test_a_chain_may_end_with_an_instance_that_publishes_nothing(tmp_path: Path) -> None:
    text = """
    chain: /scan../controller
    nodes:
      sensor: {core: 2, callbacks: [{timer: 20ms, publishes: [/scan]}]}
      controller:
        callbacks: [{loop: 8ms, phase: 1ms, reads: [/scan], execution: {constant: 2ms}}]
    """
    described = application(text, delivery={"constant": "3ms"})
    assert list(simulate_latencies(described, cycles=4)) == [7 * MS, 11 * MS, 7 * MS, 11 * MS]
    recording = simulate(described, tmp_path / "recording", cycles=4)
    measured = analyse_latency(recording, described.chain)
    assert measured.chain.topics == ("/scan", "/controller:end")
    assert list(measured.traversals["latency_ns"]) == [7 * MS, 11 * MS, 7 * MS, 11 * MS]


def test_the_first_use_counts_where_an_instance_begins_as_a_message_arrives(tmp_path: Path) -> None:
    """What is stored at the instant at which an instance begins is the next one's."""
    described = chain(delivery={"constant": "5ms"})
    assert list(simulate_latencies(described, cycles=2)) == [15 * MS, 11 * MS]
    recording = simulate(described, tmp_path / "recording", cycles=2)
    latencies = analyse_latency(recording, "/scan../command").traversals["latency_ns"]
    assert list(latencies) == [15 * MS, 11 * MS]


def test_recorded_execution_times_of_a_loop_are_drawn_again(tmp_path: Path) -> None:
    described = chain("execution: {uniform: [1ms, 12ms]}, afterwards: {constant: 1ms}")
    recording = simulate(described, tmp_path / "recording", cycles=50)
    drawn = with_recorded_times(described, recording).nodes["controller"].callbacks[0].execution
    assert drawn.samples_ns is not None
    assert 1 * MS <= min(drawn.samples_ns) < max(drawn.samples_ns) <= 12 * MS


# Random applications beside a simulator of loops that is written for nothing else.

NS = st.integers(1, 3_000_000)


@st.composite
def loops(draw: st.DrawFn) -> dict[str, Any]:
    """Sensors and loops, which may read each other's topics; each thread has a core of its own."""
    sensors, controllers = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    topics = [f"/s{number}" for number in range(sensors)]
    topics += [f"/c{number}" for number in range(controllers)]
    nodes: dict[str, Any] = {}
    for number in range(sensors):
        callback = {
            "timer": f"{draw(st.integers(4_000_000, 30_000_000))}ns",
            "phase": f"{draw(NS)}ns",
            "execution": {"sequence": [f"{draw(NS)}ns" for _ in range(3)]},
            "publishes": [f"/s{number}"],
        }
        nodes[f"s{number}"] = {"core": 10 + number, "callbacks": [callback]}
    for number in range(controllers):
        reads = draw(st.lists(st.sampled_from(topics), min_size=1, max_size=3, unique=True))
        loop = {
            "loop": f"{draw(st.integers(1_000_000, 15_000_000))}ns",
            "phase": f"{draw(NS)}ns",
            "core": 20 + number,
            "reads": reads,
            "execution": {"sequence": [f"{3 * draw(NS)}ns" for _ in range(4)]},
            "publishes": [f"/c{number}"],
        }
        nodes[f"c{number}"] = {"core": 30 + number, "callbacks": [loop]}
        gate = {"slots": [["0ms", "1000s"]], "cycle": "1000s"}
        seen = {"subscription": f"/c{number}", "publishes": [f"/g{number}"], "gate": gate}
        nodes[f"g{number}"] = {"core": 40 + number, "callbacks": [seen]}
    costs = {
        name: {"constant": f"{draw(st.integers(0, 200_000))}ns"} for name in ("take", "publish")
    }
    costs["wake_up"] = {"constant": f"{draw(st.integers(0, 200_000))}ns"}
    costs["delivery"] = {"constant": f"{draw(NS)}ns"}
    return {"chain": "/s0", "nodes": nodes, "simulation": {"interrupts": 0.0, **costs}}


def loop_of(described: Application, name: str) -> CallbackDescription:
    loop = described.nodes[name].loop
    assert loop is not None
    return loop


@SETTINGS
@given(loops())
def test_random_loops_are_those_of_a_second_simulator(description: dict[str, Any]) -> None:
    described = application(yaml.safe_dump(description))
    cycles = 20
    with tempfile.TemporaryDirectory() as folder:
        recording = simulate(described, Path(folder) / "r", cycles=cycles)
        timing = timing_of(described, cycles, START_NS)
        # What is under way at the end is in neither.
        until = timing.stop_ns - 50 * MS
        expected = instances_of(described, timing)
        for name in (name for name in described.nodes if name.startswith("c")):
            stamps = used(recording, name.replace("c", "g"))
            by_hand = [
                each
                for each in expected[name]
                if each.begin >= timing.record_from_ns and each.end < until
            ]
            assert [times for times in awake(recording, name) if times[1] < until] == [
                (each.begin, each.end, each.until) for each in by_hand
            ]
            assert [(each.published, stamps[each.published]) for each in by_hand] == [
                (each.published, each.stamp) for each in by_hand
            ]
            assert by_hand
            topic = loop_of(described, name).reads[0]
            if topic.startswith("/s"):
                first_uses = {each.stamp: each.end for each in reversed(expected[name])}
                with suppress(SeveralPathsError):  # it leads through another loop as well
                    table = analyse_latency(recording, f"{topic}../{name}:end").traversals
                    ends = dict(table.drop_nulls("latency_ns").select("start", "end").iter_rows())
                    assert {start: end for start, end in ends.items() if end < until} == {
                        start: end
                        for start, end in first_uses.items()
                        if start >= timing.record_from_ns and end < until
                    }
                    assert ends
