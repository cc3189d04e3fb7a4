"""The real thing: processes, DDS topics, threads as the description allocates them."""

import gc
import os
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from applied_plans import command_line
from calm_runs import calm_run
from known import known
from processes import children_of, real_time_threads
from small_chain import DDS_CORE, EXECUTOR_CORE, NODES, small_chain, small_chain_text

import chainshaper as cs
from chainshaper import measure_latency, run_application
from chainshaper.analysis import data_flow
from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.planning import ChainPlan, publish_slots
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.recording import Recording, ThreadInfo
from chainshaper.workload.description import ExecutionTime, load_application
from chainshaper.workload.execution import ExecutionTimes
from chainshaper.workload.timing import WARM_UP_CYCLES

pytestmark = pytest.mark.timed

CYCLES = 12

needs_fifo = pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here")


@pytest.fixture(scope="module")
def ordinary(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A run without any privilege."""
    folder = tmp_path_factory.mktemp("ordinary")
    before = _own_state()
    recording = run_application(small_chain(folder), folder / "rec", cycles=CYCLES, realtime=False)
    assert _own_state() == before, "the caller is not as it was"
    return recording


@pytest.fixture(scope="module")
def privileged(unshaped: Recording) -> Recording:
    """A run with real-time scheduling."""
    if not may_use_fifo():
        pytest.skip("SCHED_FIFO is not permitted here")
    return unshaped


def _own_state() -> tuple[object, ...]:
    """What a run might change in the process that calls it."""
    return (
        os.sched_getscheduler(0),
        os.sched_getparam(0).sched_priority,
        os.sched_getaffinity(0),
        gc.isenabled(),
        gc.get_freeze_count(),
        os.environ.get("CYCLONEDDS_URI"),
        children_of(os.getpid()),
        real_time_threads([os.getpid()]),
    )


def _count_of(recording: Recording, event: str) -> dict[str, int]:
    """How often each node recorded an event."""
    names = recording.info.processes
    counted = recording.events[event].group_by("pid").len().rows()
    return {names[pid]: count for pid, count in counted}


@needs_fifo
def test_every_cycle_is_recorded_once_in_every_node(privileged: Recording) -> None:
    everywhere = dict.fromkeys((f"/{name}" for name in NODES), CYCLES)
    assert _count_of(privileged, "callback_start") == everywhere
    assert _count_of(privileged, "callback_end") == everywhere
    del everywhere["/actuator"]
    for event in ("rclcpp_publish", "rcl_publish", "rmw_publish"):
        assert _count_of(privileged, event) == everywhere
    takes = privileged.events["rmw_take"]
    assert takes["taken"].to_list() == [1] * (3 * CYCLES)


@pytest.mark.parametrize("run", ["ordinary", "privileged"])
def test_every_traversal_is_complete(run: str, request: pytest.FixtureRequest) -> None:
    recording: Recording = request.getfixturevalue(run)
    statistics = measure_latency(recording).analysis.statistics
    assert statistics.incomplete == 0
    assert statistics.count == _count_of(recording, "callback_start")["/first"]
    assert known(statistics.min_ns) >= 3_000_000, "three callbacks of 1 ms and more"
    for pid in {thread.pid for thread in recording.info.threads}:
        # A stranger may have got its number meanwhile.
        assert pid not in children_of(os.getpid()), "a process is left"
        assert "chainshaper.workload" not in command_line(pid), "a process is left"


def _threads(recording: Recording, role: str) -> list[ThreadInfo]:
    return [thread for thread in recording.info.threads if thread.role == role]


@needs_fifo
def test_threads_are_allocated_as_described(privileged: Recording) -> None:
    executors = {thread.node: thread for thread in _threads(privileged, "executor")}
    assert set(executors) == {f"/{name}" for name in NODES}
    for thread in executors.values():
        assert thread.comm == thread.node.strip("/")
        assert (thread.policy, thread.priority) == ("SCHED_FIFO", 80)
        assert thread.cores == (EXECUTOR_CORE,)
    dds_threads = _threads(privileged, "dds")
    assert {thread.node for thread in dds_threads} == set(executors)
    for thread in dds_threads:
        assert (thread.policy, thread.priority) == ("SCHED_FIFO", 90)
        assert thread.cores == (DDS_CORE,)
    meters = _threads(privileged, "stall-meter")
    assert {thread.cores for thread in meters} == {(DDS_CORE,), (EXECUTOR_CORE,)}
    assert {(thread.policy, thread.priority) for thread in meters} == {("SCHED_FIFO", 98)}
    assert privileged.info.realtime is True
    meter = privileged.info.stall_meter
    assert meter is not None and meter.realtime and meter.wakeups > CYCLES
    assert meter.cores == tuple(sorted({DDS_CORE, EXECUTOR_CORE}))


def test_without_privileges_threads_have_their_cores_and_the_recording_says_so(
    ordinary: Recording,
) -> None:
    info = ordinary.info
    assert {thread.policy for thread in info.threads} == {"SCHED_OTHER"}
    assert {t.cores for t in _threads(ordinary, "executor")} == {(EXECUTOR_CORE,)}
    assert {t.cores for t in _threads(ordinary, "dds")} == {(DDS_CORE,)}
    assert info.realtime is False
    assert any("without real-time scheduling" in note for note in info.notes)
    assert info.stall_meter is None, "ordinary scheduling would look like stalls"
    assert (info.source, info.rmw, info.chain) == ("live", "cyclonedds", "/t1../t3")
    assert set(info.processes.values()) == {f"/{name}" for name in NODES}
    assert known(info.application)["nodes"]["first"]["callbacks"][0]["timer"] == "50ms"
    assert set(ordinary.events["rcl_publisher_init"]["topic_name"]) == {"/t1", "/t2", "/t3"}


@needs_fifo
def test_the_seed_determines_the_execution_times(privileged: Recording, shaped: Recording) -> None:
    """Each instance spends what its place in the sequence says, and little more, shaped or not."""
    for node in ("/first", "/second", "/third"):
        drawn = ExecutionTimes(ExecutionTime(uniform_ns=(1_000_000, 4_000_000)), 7, node, 0)
        expected = np.array([drawn.next() for _ in range(WARM_UP_CYCLES + CYCLES)])
        for recording in (privileged, shaped):
            (pid,) = (pid for pid, name in recording.info.processes.items() if name == node)
            start, end = (
                recording.events[name].filter(pid=pid)["thread_time"].to_numpy()
                for name in ("callback_start", "callback_end")
            )
            excess = (end - start) - expected[WARM_UP_CYCLES:]
            assert (excess >= 0).all(), f"{node} computed for less than was drawn"
            assert np.median(excess) < 500_000, "that is not the drawn sequence"


def test_shaped_outputs_leave_in_their_slot_or_are_counted(
    shaped: Recording, plan: ChainPlan
) -> None:
    """Every message left inside a slot, or overran it and left at once, as the plan has it."""
    releases = shaped.events["gate_release"]
    assert set(releases["anchor"]) == {"stamp"}
    assert releases.height == _count_of(shaped, "callback_start")["/first"]
    ((start, end),) = publish_slots(plan)
    at_once = (pl.col("overrun") == "publish").fill_null(False)
    overran, in_time = releases.filter(at_once), releases.filter(~at_once)
    assert (overran["release"] == overran["arrival"]).all()
    assert (overran["arrival"] - overran["origin"] >= end).all(), "it missed its slot"
    since_start = (in_time["release"] - in_time["origin"]) % plan.cycle_ns
    assert since_start.is_between(start, end - 1).all()
    assert (releases["release"] >= releases["arrival"]).all()
    assert (releases["time"] >= releases["release"]).all(), "it left before its release"
    waited = (releases["release"] - releases["origin"]) // plan.cycle_ns
    assert releases["cycles_waited"].to_list() == waited.to_list()
    measured = measure_latency(shaped)
    overruns = measured.overruns or {}
    assert overruns.get("wait", 0) == (releases["cycles_waited"] > 0).sum()
    assert measured.plan == plan
    assert measured.analysis.statistics.incomplete == 0
    assert measured.analysis.chain.topics == ("/t1", "/t2", "/t3_tmp", "/t3")
    if not overruns:
        # The stamp is read a moment before the callback's start is; 0.1 ms is far above that.
        assert known(measured.analysis.statistics.min_ns) >= start - 100_000


@pytest.mark.skipif(len(available_cores()) < 2, reason="needs two cores")
def test_an_unbound_node_may_run_on_any_core_and_keeps_its_priority(tmp_path: Path) -> None:
    """Events of its executor have no core, which may have been any; all others have theirs."""
    text = small_chain_text().replace("  second:\n", "  second:\n    bound: false\n")
    (tmp_path / "unbound.yaml").write_text(text)
    application = load_application(tmp_path / "unbound.yaml")
    recording = run_application(application, tmp_path / "recording", cycles=8)
    everywhere = tuple(available_cores())
    executors = {one.node: one for one in _threads(recording, "executor")}
    assert executors["/second"].cores == everywhere
    assert {executors[f"/{name}"].cores for name in NODES if name != "second"} == {(EXECUTOR_CORE,)}
    assert all(one.cores == (DDS_CORE,) for one in _threads(recording, "dds"))
    if recording.info.realtime:
        assert {one.priority for one in executors.values()} == {80}
    started = recording.events["callback_start"]
    of_second = started["pid"] == executors["/second"].pid
    assert started.filter(of_second)["cpu"].null_count() == of_second.sum() >= 8
    assert started.filter(~of_second)["cpu"].unique().to_list() == [EXECUTOR_CORE]
    assert measure_latency(recording).analysis.traversals.height == 8


def test_what_cannot_run_is_refused_before_anything_starts(tmp_path: Path) -> None:
    application = small_chain(tmp_path)
    elsewhere = tmp_path / "elsewhere.yaml"
    elsewhere.write_text(small_chain_text().replace("  first:\n", "  first:\n    core: 1023\n"))

    def report(share: float, what: str) -> None:
        pytest.fail(f"{what} began")

    with pytest.raises(InputError, match="0 cycles cannot be recorded"):
        run_application(application, tmp_path / "rec", cycles=0, progress=report)
    with pytest.raises(InputError, match="exists already"):
        run_application(application, tmp_path, progress=report)
    with pytest.raises(PlatformError, match="core 1023, which node first asks for"):
        run_application(load_application(elsewhere), tmp_path / "rec", progress=report)
    assert not (tmp_path / "rec").exists()


def test_a_caller_that_gives_up_leaves_nothing(tmp_path: Path) -> None:
    def give_up(share: float, what: str) -> None:
        if what == "recording":
            raise OperationError("enough")

    before = _own_state()
    with pytest.raises(OperationError, match="enough"):
        run_application(small_chain(tmp_path), tmp_path / "rec", progress=give_up)
    assert _own_state() == before, "the caller is not as it was"
    assert [entry.name for entry in tmp_path.iterdir()] == ["small_chain.yaml"]


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
    """Of the latencies that the machine did not disturb."""
    traversals = cs.measure_latency(recording, "/a../c").analysis.traversals
    latencies = traversals.filter(~pl.col("disturbed"))["latency_ns"]
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
    live = calm_run(
        lambda place: cs.run_application(application, place / "live", cycles=20), tmp_path
    )
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
