"""One description of a multi-threaded executor, live over DDS and simulated: the same schedule."""

from pathlib import Path

import polars as pl
import pytest

import chainshaper as cs
from chainshaper.analysis import data_flow
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.values.recording import Recording

THREADS = """
name: threads
chain: /a../c
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  source: {priority: 85, callbacks: [{timer: 100ms, execution: {constant: 2ms}, publishes: [/a]}]}
  worker:
    executor: multi_threaded
    threads: 2
    cores: [1, 0]
    callback_groups: {slow: mutually_exclusive}
    callbacks:
      - {timer: 100ms, phase: 1ms, execution: {constant: 30ms}, group: slow}
      - {subscription: /a, execution: {constant: 10ms}, publishes: [/b]}
  sink: {priority: 85, callbacks: [{subscription: /b, execution: {constant: 1ms}, publishes: [/c]}]}
"""


def _described(folder: Path, text: str = THREADS) -> cs.Application:
    (folder / "app.yaml").write_text(text)
    return cs.load_application(folder / "app.yaml")


def _median_ms(recording: Recording) -> float:
    latencies = cs.measure_latency(recording, "/a../c").analysis.traversals["latency_ns"]
    return float(latencies.median()) / 1e6  # type: ignore[arg-type]


def _beside_the_timer(recording: Recording) -> pl.DataFrame:
    """Instances of the worker's subscription that began while its timer's callback ran."""
    flow = data_flow(recording.events)
    callbacks = flow.objects.callbacks.filter(node="/worker").select("callback_id", "topic")
    named = flow.instances.join(callbacks.unique(), on="callback_id")
    slow = named.filter(pl.col("topic").is_null())
    return named.filter(topic="/a").join_where(
        slow, pl.col("start") > pl.col("start_right"), pl.col("start") < pl.col("end_right")
    )


@pytest.mark.timed
@pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here")
def test_it_runs_live_as_it_is_simulated(tmp_path: Path) -> None:
    application = _described(tmp_path)
    live = cs.run_application(application, tmp_path / "live", cycles=20)
    simulated = cs.simulate(application, tmp_path / "simulated", cycles=20)
    for recording in (live, simulated):
        both = _beside_the_timer(recording)
        assert len(both) > 17, "the callbacks do not run beside each other"
        assert (both["tid"] != both["tid_right"]).all()
        workers = [one for one in recording.info.threads if one.node == "/worker"]
        executing = {one.tid: one.cores for one in workers if one.role == "executor"}
        assert {*both["tid"], *both["tid_right"]} <= set(executing)
        assert sorted(executing.values()) == [(0,), (1,)]
    alone = THREADS.replace("threads: 2", "").replace("cores: [1, 0]", "")
    alone = alone.replace("executor: multi_threaded", "").replace(", group: slow", "")
    alone = alone.replace("    callback_groups: {slow: mutually_exclusive}\n", "")
    one_thread = cs.simulate(_described(tmp_path, alone), tmp_path / "alone", cycles=20)
    apart = _median_ms(live) - _median_ms(simulated)
    assert abs(apart) < 0.1 * (_median_ms(one_thread) - _median_ms(simulated))
