"""What the planner gets of a recorded chain: the story of a graph that synchronises."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from known import known
from reference_traces import DATA
from story import OFFSET, Callback, Publisher, Story

from chainshaper.flow.plan import plan_recording, profile_chains
from chainshaper.planning import (
    CallbackTimes,
    ChainPlan,
    PlanRequest,
    Profile,
    band_choice,
    plan_chain,
    plan_warnings,
)
from chainshaper.planning.late_shares import late_share
from chainshaper.planning.profile import deciding_cycles, interfering_callback, other_beginnings
from chainshaper.planning.request import on_cores
from chainshaper.values import events
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import Recording, RecordingInfo, ThreadInfo

MS = 1_000_000
FRONT = "/front_filter"
CHAIN = "/rear_raw../fused../pose"


INFO: dict[str, Any] = {"source": "simulated", "clock_offset_ns": OFFSET}


def _told(story: Story, *threads: ThreadInfo) -> Recording:
    info = RecordingInfo(**INFO, threads=threads)
    return Recording(Path("story"), info, story.tables())


def _graph(story: Story) -> tuple[dict[str, Callback], dict[str, Publisher]]:
    """Valet parking in small: two timers → two filters → fusion → voxel → localizer."""
    callbacks: dict[str, Callback] = {}
    publishers: dict[str, Publisher] = {}
    throttler, fusion = story.node("/throttler", 1), story.node("/fusion", 4)
    fuses = "message_filters::Subscriber::add"
    for pid, side in ((2, "rear"), (3, "front")):
        callbacks[f"throttle_{side}"] = story.timer(throttler, period=100 * MS)
        publishers[f"throttle_{side}"] = story.publisher(throttler, f"/{side}_raw")
        node = story.node(f"/{side}_filter", pid)
        callbacks[side] = story.subscription(node, f"/{side}_raw")
        publishers[side] = story.publisher(node, f"/{side}_filtered")
        callbacks[f"fuse_{side}"] = story.subscription(fusion, f"/{side}_filtered", symbol=fuses)
    publishers["fusion"] = story.publisher(fusion, "/fused")
    for pid, name, source, output in (
        (5, "voxel", "/fused", "/small"),
        (6, "ndt", "/small", "/pose"),
    ):
        node = story.node(f"/{name}", pid)
        callbacks[name] = story.subscription(node, source)
        publishers[name] = story.publisher(node, output)
    return callbacks, publishers


@cache
def _recorded() -> Recording:
    """Response times in ms: 1, 1, 20, 31, 1 and 3 (fusion), 9, 51 minus the cycle's number."""
    story = Story()
    callbacks, publishers = _graph(story)

    def run(name: str, writer: str | None, start: float, end: float, reads: int | None) -> int:
        sent = int(end * MS) - 1
        writes = () if writer is None else ((publishers[writer], sent),)
        story.runs(callbacks[name], int(start * MS), int(end * MS), reads=reads, writes=writes)
        return sent

    for cycle in range(3):
        t = 1000 + 100 * cycle
        rear = run("throttle_rear", "throttle_rear", t, t + 1, None)
        front = run("throttle_front", "throttle_front", t + 1, t + 2, None)
        rear = run("rear", "rear", t + 2, t + 22, rear)
        front = run("front", "front", t + 2, t + 33, front)
        run("fuse_rear", None, t + 22, t + 23, rear)
        fused = run("fuse_front", "fusion", t + 33, t + 36, front)
        small = run("voxel", "voxel", t + 36, t + 45, fused)
        run("ndt", "ndt", t + 45, t + 96 - cycle, small)
    thread: dict[str, Any] = {"comm": "node", "node": "", "role": "executor"}
    thread |= {"policy": "SCHED_FIFO", "priority": 70}
    cores = {pid: (0 if pid == 3 else 1,) for pid in range(1, 7)}
    return _told(
        story, *(ThreadInfo(tid=n, pid=n, cores=own, **thread) for n, own in cores.items())
    )


@cache
def _profile() -> Profile:
    (profile,) = profile_chains(_recorded(), [CHAIN])
    return profile


def _slots_ms(plan: ChainPlan) -> dict[str, list[tuple[int, int]]]:
    return {server.name: [(a // MS, b // MS) for a, b in server.slots] for server in plan.servers}


def test_branches_that_the_chain_waits_for_are_found() -> None:
    profile = _profile()
    assert [callback.node for callback in profile.callbacks] == [
        *("/throttler", "/throttler", "/rear_filter", "/front_filter"),
        *("/fusion", "/voxel", "/ndt"),
    ]
    assert [callback.after for callback in profile.callbacks] == [
        *((), (), (0,), (1,), (2, 3), (4,), (5,))
    ]
    assert [callback.max_response_ns // MS for callback in profile.callbacks] == [
        *(1, 1, 20, 31),
        4,  # the first input, and the one that completes the set
        *(9, 51),
    ]
    assert profile.core_of["/front_filter"] == 0
    assert profile.fifo_priority == 75
    assert profile.latencies_ns.tolist() == [(96 - cycle) * MS - 1 for cycle in range(3)]


def test_a_publication_takes_until_its_callback_ends_or_publishes_again_or_all_have_it() -> None:
    story = Story()
    node, reader = story.node("/writer", 1), story.node("/reader", 2)
    timer, reads = story.timer(node, period=1000), story.subscription(reader, "/out")
    out, other = story.publisher(node, "/out"), story.publisher(node, "/other")
    story.runs(timer, 1000, 1140, writes=((out, 1100),))
    story.runs(timer, 2000, 2900, writes=((out, 2100), (other, 2150)))
    story.runs(timer, 3000, 3900, writes=((out, 3100),))
    story.runs(reads, 3161, 3200, reads=3100)
    recording = _told(story)
    (profile,) = profile_chains(recording, ["/out"])
    assert profile.longest_publication_ns == 60, "of 40, 50 and 60 ns"
    (profile,) = profile_chains(_stalled(recording, 3110, lasting=20), ["/out"])
    assert profile.longest_publication_ns == 50, "a stall is no part of it"


def test_a_front_filter_is_planned_for_a_core_of_its_own() -> None:
    """As the paper has it in section 5.1; on one core, latencies would be others than measured."""
    for cores, front, said in (((1, 0), 0, 0), ((3, 2), 2, 0), ((1,), 1, 1)):
        (profile,), doubts = on_cores([_profile()], PlanRequest(cores=cores))
        assert profile.core_of == {**dict.fromkeys(_profile().core_of, cores[0]), FRONT: front}
        assert [doubt.startswith(f"{CHAIN} was measured with") for doubt in doubts] == [True] * said
        plan = plan_chain(_profile(), PlanRequest(cores=cores, epsilon_ns=2 * MS))
        homes = {thread.node: server.core for server in plan.servers for thread in server.threads}
        assert {node: homes[node] for node in profile.core_of} == profile.core_of
    with pytest.raises(InputError, match="--cores distributes callbacks, and latencies do not"):
        plan_chain(Profile(np.array([1, 2]), 100 * MS), PlanRequest(cores=(0, 1)))


def test_a_chain_that_no_timer_starts_needs_its_period_and_leaves_out_what_feeds_it() -> None:
    """The throttler feeds the rear filter, and the front filter's branch is followed so far."""
    chain = "/rear_filtered../fused../pose"
    with pytest.raises(InputError, match=r"starts are 100 ms apart, mostly\): add --period"):
        profile_chains(_recorded(), [chain])
    with pytest.raises(InputError, match="cannot have the period 0 ms: give one longer"):
        profile_chains(_recorded(), [chain], period_ns=0)
    (profile,) = profile_chains(_recorded(), [chain], period_ns=100 * MS)
    assert profile.period_ns == 100 * MS
    assert [callback.node for callback in profile.callbacks] == [
        *("/rear_filter", "/front_filter", "/fusion", "/voxel", "/ndt")
    ]
    assert [callback.after for callback in profile.callbacks] == [(), (), (0, 1), (2,), (3,)]
    assert "/throttler" not in profile.core_of
    with pytest.raises(InputError, match="--period goes with --latencies, or with a chain"):
        profile_chains(_recorded(), [CHAIN], period_ns=50 * MS)


def test_a_server_per_callback_is_the_papers_table_4_row_1() -> None:
    plan = plan_chain(_profile(), PlanRequest(policy="server-per-callback", epsilon_ns=0))
    assert _slots_ms(plan) == {
        "throttler": [(0, 2)],
        "rear_filter": [(2, 22)],
        "front_filter": [(2, 33)],
        "fusion": [(33, 37)],
        "voxel": [(37, 46)],
        "ndt": [(46, 97)],
    }
    assert {server.name: server.core for server in plan.servers}["front_filter"] == 0
    # The margin is every callback's.
    slower = replace(_profile(), period_ns=200 * MS)
    plan = plan_chain(slower, PlanRequest(policy="server-per-callback", epsilon_ns=MS // 2))
    assert _slots_ms(plan)["throttler"] == [(0, 4)], "two callbacks, each rounded up to whole ms"
    assert _slots_ms(plan)["rear_filter"] == [(4, 25)]
    with pytest.raises(OperationError, match=r"takes \d+ ms, .* plan with a smaller margin"):
        plan_chain(_profile(), PlanRequest(policy="server-per-callback", epsilon_ns=2 * MS))


def test_shaping_opens_servers_and_reaches_receivers() -> None:
    wishes: dict[str, Any] = {"epsilon_ns": 2 * MS}
    plan = plan_recording(_recorded(), CHAIN, PlanRequest(**wishes)).chains[0]
    servers = [("chain_core1", 1), ("chain_core0", 0), ("output", 1)]
    assert [(server.name, server.core) for server in plan.servers] == servers
    assert [thread.node for thread in plan.servers[1].threads] == ["/front_filter"]
    apart = plan_recording(_recorded(), CHAIN, PlanRequest(**wishes, first_slot_ns=2 * MS)).chains[
        0
    ]
    assert _slots_ms(apart)["first"] == [(0, 2)]
    sink: dict[str, Any] = {"sinks": ["/rear_raw../small"]}
    with pytest.raises(InputError, match=r"pose waits for /small, which"):
        plan_recording(_recorded(), CHAIN, **sink).chains[0]
    with pytest.raises(InputError, match="further sinks are shaped"):
        plan_recording(_recorded(), CHAIN, PlanRequest(policy="server-per-chain"), **sink).chains[0]
    for chain, request, receivers in (
        ("/rear_raw../fused", PlanRequest(), ("/voxel",)),
        ("/rear_raw../fused", PlanRequest(with_receivers=False), ()),
        (CHAIN, PlanRequest(), ()),  # no node takes /pose
    ):
        node = known(plan_recording(_recorded(), chain, request).chains[0].shaping_node)
        assert node.receivers == receivers


def test_who_publishes_decides_what_can_be_gated() -> None:
    plan = plan_recording(_recorded(), CHAIN, PlanRequest(publication="asynchronous")).chains[0]
    assert plan.shaping_node is None
    (thread,) = plan.servers[-1].threads
    assert (thread.node, thread.role) == ("/ndt", "publisher")
    plan = plan_recording(_recorded(), CHAIN, PlanRequest(policy="let-per-callback")).chains[0]
    assert len(plan.further_shaping_nodes) == 4, "a node per topic"
    assert plan.predicted.max_ns == 501 * MS
    with pytest.raises(InputError, match=r"/ndt has no thread that publishes.*ASYNCHRONOUS"):
        plan_chain(replace(_profile(), asynchronous=False), PlanRequest(publication="asynchronous"))
    inside = replace(_profile(), intra_process=True)
    assert plan_chain(inside).shaping_node is not None
    with pytest.raises(InputError, match=r"get its messages inside the process of /ndt.*synchr"):
        plan_chain(inside, PlanRequest(publication="in-process"))


def _stalled(recording: Recording, *times: int, lasting: int = 5 * MS) -> Recording:
    stalls = pl.DataFrame(
        [{"time": time, "cpu": 1, "duration": lasting} for time in times],
        schema_overrides={**events.COMMON_COLUMNS, **events.FIELDS["machine_stall"]},
    )
    return replace(recording, events={**recording.events, "machine_stall": stalls})


@pytest.mark.parametrize("stalls", [1, 2, 3])
def test_stalled_cycles_are_left_out_unless_all_were_disturbed(stalls: int) -> None:
    recording = _stalled(_recorded(), *((1050 + 100 * number) * MS for number in range(stalls)))
    (profile,) = profile_chains(recording, [CHAIN])
    assert profile.disturbed == stalls
    if stalls == 1:
        assert profile.latencies_ns.max() == 95 * MS - 1
        assert profile.callbacks[-1].max_response_ns == 50 * MS
        return
    plan = plan_recording(recording, CHAIN).chains[0]
    assert plan.evidence.all_disturbed
    assert (plan.evidence.samples, plan.evidence.disturbed) == (3, stalls)
    assert plan.servers[0].slots == ((0, 97 * MS - 1),), "1 ms behind the longest of all"
    assert any("disturbed every cycle" in warning for warning in plan_warnings(plan))
    with pytest.raises(OperationError, match="leave out --ideal-machine, or record again"):
        plan_recording(recording, CHAIN, PlanRequest(ideal_machine=True)).chains[0]


def test_a_stall_longer_than_the_cycle_is_not_covered_where_all_cycles_are_disturbed() -> None:
    latencies = np.array([*range(20_000, 20_299), 160_000]) * 1000
    profile = Profile(latencies, 100 * MS, disturbed=300, all_disturbed=True)
    plan = plan_chain(profile, PlanRequest(bands="auto"))
    assert plan.evidence.max_latency_ns == 20_298_000
    assert plan.evidence.max_of_all_ns == 160 * MS
    assert band_choice(plan, profile, PlanRequest(bands="auto")).chosen.mean_ns > 0
    # Where a policy has slots of its own, a latency may exceed the cycle; else it is refused.
    own = replace(profile, callbacks=_profile().callbacks, topics=("/t",))
    per_callback = plan_chain(own, PlanRequest(policy="server-per-callback", epsilon_ns=0))
    assert per_callback.evidence.max_latency_ns == 160 * MS
    with pytest.raises(OperationError, match="do not fit into the cycle"):
        plan_chain(replace(profile, latencies_ns=latencies * 10), PlanRequest())


def test_executions_that_span_cycles_can_be_planned_callback_by_callback() -> None:
    long = replace(_profile(), latencies_ns=np.array([60, 141]) * MS)
    with pytest.raises(OperationError, match="a pipeline of stages"):
        plan_chain(long, PlanRequest())
    for policy in ("server-per-callback", "let-per-callback"):
        plan = plan_chain(long, PlanRequest(policy=policy, epsilon_ns=0))
        assert plan.evidence.max_latency_ns == 141 * MS
        assert any("is not shorter than the cycle" in text for text in plan_warnings(plan))


@pytest.mark.parametrize(
    ("beside", "worker", "period", "expected"),
    [
        (61, 60, 10, ("/t1", "every 50ms")),  # two executors
        (61, 62, 10, ("/t1",)),  # three: nothing else runs in the chain's
        (60, 60, 10, ()),  # one for all
        (61, 61, 50, ("/t1",)),
        (61, 60, 50, ()),  # the timers have one name, so nothing tells them apart
    ],
)
def test_the_executor_of_a_callback_group_is_named_by_its_callbacks(
    beside: int, worker: int, period: int, expected: tuple[str, ...]
) -> None:
    """A relay's subscription runs in thread 60; two timers beside it run where they are told."""
    story = Story()
    source, relay = story.node("/source", 5), story.node("/relay", 6)
    first, t1 = story.timer(source, period=100 * MS), story.publisher(source, "/t1")
    relays, t2 = story.subscription(relay, "/t1"), story.publisher(relay, "/t2")
    timers = [story.timer(relay, each * MS, symbol=f"f{n}") for n, each in enumerate((50, period))]
    for begin in range(1000 * MS, 1300 * MS, 100 * MS):
        story.runs(first, begin, begin + MS, writes=((t1, begin + 1),))
        writes = ((t2, begin + 5 * MS),)
        story.runs(relays, begin + 2 * MS, begin + 6 * MS, reads=begin + 1, writes=writes, tid=60)
        for timer, tid in zip(timers, (worker, beside), strict=True):
            story.runs(timer, begin + 8 * MS + tid, begin + 9 * MS, tid=tid)
    executor: dict[str, Any] = {"comm": "relay", "node": "/relay", "pid": 6, "role": "executor"}
    executor |= {"policy": "SCHED_OTHER", "priority": 0}
    cores = {60: (0,), 61: (1,), 62: (1,)}
    threads = (ThreadInfo(**executor, tid=tid, cores=own) for tid, own in cores.items())
    plan = plan_recording(_told(story, *threads), "/t1../t2").chains[0]
    (thread,) = (t for server in plan.servers for t in server.threads if t.node == "/relay")
    assert thread.callbacks == expected
    (server,) = (server for server in plan.servers if thread in server.threads)
    assert server.core == 0, "that of the executor that is meant"


def _outliers(*places: int, watched: bool = False) -> Profile:
    latencies = 30 * MS + np.random.default_rng(0).permutation(400) * 1000
    latencies[[*places]] = 130 * MS
    return Profile(latencies, 100 * MS, longest_stall_ns=0 if watched else None)


@pytest.mark.parametrize(
    ("profile", "said"),
    [
        (_outliers(0), r"1 of 400 cycles decides .* at 0.0 s: 130.0 ms;.* 30.4 ms.* --skip 1s"),
        (_outliers(0, 12), r"2 of 400 cycles decide .*start-up .*--skip 2s"),
        (_outliers(398), "the application was ending: leave it out with --to 39.8s"),
        (_outliers(5, 200), r"a stall of the machine \(not watched\): .* --percentile 99.5"),
        (_outliers(200, watched=True), "the application's own: .* --percentile 99.7"),
    ],
)
def test_few_cycles_that_decide_are_named_and_how_to_leave_them_out(
    profile: Profile, said: str
) -> None:
    with pytest.raises(OperationError, match=said):
        plan_chain(profile)
    plan = plan_chain(profile, PlanRequest(percentile=99.5))
    assert plan.servers[0].slots[0][1] < 32 * MS
    assert plan.evidence.max_of_all_ns == 130 * MS, "what is late stays known"
    late = late_share(profile.every, plan.evidence.max_latency_ns)
    assert late == plan.margin.overrun_probability


def test_who_begins_what_the_chain_waits_for_is_named() -> None:
    """Front and rear each have a timer; the fusion waits for both."""
    sequence = (("/front", (), "/a"), ("/rear", (), "/b"), ("/fusion", (0, 1), "/c"))
    times = tuple(
        CallbackTimes(node, 1, MS, MS, MS, after, topic) for node, after, topic in sequence
    )
    names: dict[str, Any] = {"nodes": ("/front", "/fusion"), "topics": ("/a", "/c")}
    profile = Profile(np.array([10, 11]) * MS, 100 * MS, spec="/a../c", callbacks=times, **names)
    said = known(other_beginnings(profile))
    assert said.startswith("/front and /rear start at a new offset to each other at each launch")
    alone = (times[0], replace(times[2], after=(0,)))
    assert other_beginnings(replace(profile, callbacks=alone)) is None
    assert other_beginnings(Profile(np.array([10, 11]) * MS, 100 * MS)) is None


def test_what_else_a_thread_of_the_chain_runs_is_named_with_what_keeps_it_away() -> None:
    """/filter also takes /settings, in one cycle while the chain lasts, and between all others."""
    story = Story()
    sensor, filtering, settings = (story.node(f"/{n}", k) for k, n in enumerate("sfg", start=1))
    timer, raw = story.timer(sensor, period=100 * MS), story.publisher(sensor, "/raw")
    read, out = story.subscription(filtering, "/raw"), story.publisher(filtering, "/out")
    set_it, own = story.subscription(filtering, "/settings"), story.publisher(settings, "/settings")
    every, answer = story.timer(settings, period=100 * MS), story.publisher(filtering, "/set")
    for cycle in range(4):
        t = (1000 + 100 * cycle) * MS
        at = t + (3 if cycle == 2 else 50) * MS
        story.runs(every, at - 2, at, writes=((own, at - 1),))
        story.runs(set_it, at, at + 2 * MS, reads=at - 1, writes=((answer, at + MS),))
        story.runs(timer, t, t + MS, writes=((raw, t + MS - 1),))
        begun = t + (5 if cycle == 2 else 1) * MS
        story.runs(read, begun, begun + 4 * MS, reads=t + MS - 1, writes=((out, begun + 3 * MS),))
    (profile,) = profile_chains(_told(story), ["/raw../out"])
    assert profile.interfering == (("/f ← /settings", ("/g",), 0.25, 2 * MS),)
    said = "/raw../out: in 25% of its cycles one of its threads also runs /f ← /settings, which is"
    said += " not part of it, for up to 2.0 ms: "
    behind = "with --best-effort /g what triggers it runs only when the chain does not"
    assert interfering_callback(profile) == said + behind
    (one,) = profile.interfering
    of_a_timer = replace(profile, interfering=(one._replace(origins=()),))
    apart = "give it a callback group and an executor of its own"
    assert interfering_callback(of_a_timer) == said + apart
    within = replace(profile, interfering=(one._replace(origins=("/s",)),))
    assert interfering_callback(within) == said + apart
    assert interfering_callback(replace(profile, interfering=(one._replace(share=0.05),))) is None


def test_many_long_cycles_are_no_outliers() -> None:
    few = Profile(np.array([10, 100]) * MS, 200 * MS)
    for profile in (_outliers(*range(0, 400, 10)), _outliers(), few):
        assert deciding_cycles(profile) is None


@pytest.mark.skipif(not DATA.is_dir(), reason="the reference traces are not here")
def test_a_real_trace_waits_for_both_filters_and_is_planned_without_its_start_up() -> None:
    trace, end = DATA / "jazzy_avp_cyclonedds" / "trace", "/localization/ndt_pose"
    (rear,) = profile_chains(trace, [f"/lidar_rear/points_raw../points_fused..{end}"])
    fusion = rear.callbacks[4]
    assert fusion.node == "/point_cloud_fusion"
    filters = {f"/filter_transform_{side}" for side in ("rear", "front")}
    assert {rear.callbacks[place].node for place in fusion.after} == filters
    chain = f"/lidar_front/points_raw..{end}"
    (whole,) = profile_chains(trace, [chain])
    with pytest.raises(OperationError, match=r"100.2 ms of it .* /point_cloud_fusion; .*--skip 1s"):
        plan_chain(whole)
    (part,) = profile_chains(trace, [chain], since_ns=1000 * MS, until_ns=11_000 * MS)
    assert 95 <= len(part.latencies_ns) <= 100
    assert set(part.latencies_ns) <= set(whole.latencies_ns)
    assert 1000 * MS <= part.starts.min() <= part.starts.max() < 11_000 * MS
    assert plan_chain(part).evidence.max_latency_ns < 43 * MS
