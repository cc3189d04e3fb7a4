"""Loops of live nodes: when they sleep, what they used, and that the analysis finds just that."""

from itertools import pairwise
from pathlib import Path

import polars as pl
import pytest
from loops_seen import awake, used
from small_chain import DDS_CORE, EXECUTOR_CORE

import chainshaper as cs
from chainshaper.analysis import callback_statistics, data_flow
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.simulation.simulating import with_recorded_times
from chainshaper.values.recording import Recording

pytestmark = pytest.mark.timed

MS = 1_000_000
CYCLES = 40
TEXT = f"""\
name: to the actuator
chain: /scan../command
scheduling:
  executors: {{core: {EXECUTOR_CORE}, priority: 80}}
  dds: {{core: {DDS_CORE}, priority: 90}}
nodes:
  sensor: {{callbacks: [{{timer: 20ms, execution: {{uniform: [1ms, 3ms]}}, publishes: [/scan]}}]}}
  filter:
    callbacks: [{{subscription: /scan, execution: {{uniform: [1ms, 5ms]}}, publishes: [/filtered]}}]
  controller:
    callbacks:
      - loop: 8ms
        phase: 1ms
        priority: 85
        reads: [/filtered]
        execution: {{uniform: [500us, 2ms]}}
        publishes: [/command]
  seen:
    callbacks:
      - subscription: /command
        publishes: [/seen]
        gate: {{slots: [[0ms, 1000s]], cycle: 1000s}}
"""


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("loops")
    (folder / "app.yaml").write_text(TEXT)
    application = cs.load_application(folder / "app.yaml")
    return cs.run_application(application, folder / "live", cycles=CYCLES)


def test_a_loop_sleeps_until_multiples_of_its_period(live: Recording) -> None:
    instances = awake(live)
    assert len(instances) > 2 * CYCLES
    first_until = instances[0][2]
    assert all((until - first_until) % (8 * MS) == 0 for _, _, until in instances)
    assert all(until <= begin for (_, _, until), (begin, _, _) in pairwise(instances))
    loops = callback_statistics(data_flow(live.events)).filter(kind="loop")
    assert loops.select("node", "period_ns").rows() == [("/controller", 8 * MS)]


def test_each_traversal_goes_through_the_instance_that_used_its_message(live: Recording) -> None:
    """The stamp is of the sensor's callback, which began less than a period before or after."""
    stamps = used(live)
    frame = cs.measure_latency(live, "/scan../command").analysis.traversals.filter("complete")
    published = live.events["rmw_publish"].select("time", "timestamp")
    rows = frame.join(published, left_on="end", right_on="time").select("start", "timestamp").rows()
    assert len(rows) > CYCLES // 2
    for start, timestamp in rows:
        assert timestamp in stamps
        assert abs(stamps[timestamp] - start) < 10 * MS
    # No first use is left out, but at the ends of the recording.
    begun = frame["start"].to_list()
    missed = [
        stamp
        for stamp in stamps.values()
        if begun[0] + 20 * MS < stamp < begun[-1] - 20 * MS
        and min(abs(stamp - start) for start in begun) > 10 * MS
    ]
    assert not missed


def test_a_chain_may_end_with_an_instance(live: Recording) -> None:
    ends = cs.measure_latency(live, "/scan../controller:end").analysis.traversals
    publications = cs.measure_latency(live, "/scan../command").analysis.traversals
    both = ends.filter("complete").join(publications.filter("complete"), on="start")
    assert both.height > CYCLES // 2
    assert (both["end"] > both["end_right"]).all()
    assert set(both["end"]) <= {end for _, end, _ in awake(live)}


@pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here")
def test_its_thread_has_its_own_priority(live: Recording) -> None:
    threads = [info for info in live.info.threads if info.node == "/controller"]
    (loop,) = (info for info in threads if info.role == "loop")
    (executor,) = (info for info in threads if info.role == "executor")
    assert (loop.comm, loop.policy, loop.priority) == ("loop", "SCHED_FIFO", 85)
    assert loop.cores == (EXECUTOR_CORE,)
    assert executor.priority == 80
    wakes = live.events["thread_wake"].filter(pl.col("pid") == loop.pid)
    assert set(wakes["tid"]) == {loop.tid}


def test_it_is_simulated_with_the_times_that_it_had(live: Recording, tmp_path: Path) -> None:
    assert live.info.application is not None
    (tmp_path / "app.yaml").write_text(TEXT)
    application = with_recorded_times(cs.load_application(tmp_path / "app.yaml"), live)
    loop = application.nodes["controller"].callbacks[0]
    assert loop.execution.samples_ns is not None
    low, high = min(loop.execution.samples_ns), max(loop.execution.samples_ns)
    assert low > 0.4 * MS and high < 20 * MS
    cs.simulate(application, tmp_path / "simulated", cycles=10)
