"""Chains longer than their period, simulated: once a cycle, in order, at a constant latency."""

from pathlib import Path

import pytest
from schedules import MS, application

from chainshaper import plan_recording, simulate
from chainshaper.planning import Plan, PlanRequest
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.values.errors import InputError
from chainshaper.verify.measure import measure_latency
from chainshaper.verify.predictions import judge_prediction
from chainshaper.workload.description import Application

TAKE = 10_000  # ns


def chain(executions: list[str], cores: list[int]) -> Application:
    """A node per execution time, on these cores, every 100 ms; and one that gets the output."""
    nodes = []
    for number, (execution, core) in enumerate(zip(executions, cores, strict=True)):
        trigger = f"subscription: /t{number - 1}" if number else "timer: 100ms"
        nodes.append(
            f"  n{number}: {{core: {core}, callbacks: [{{{trigger}, execution: {execution},"
            f" publishes: [/t{number}]}}]}}"
        )
    last = f"/t{len(executions) - 1}"
    listener = f"  actuator: {{core: 9, callbacks: [{{subscription: {last}}}]}}"
    text = "\n".join([f"chain: /t0..{last}", "nodes:", *nodes, listener])
    return application(text, take={"constant": f"{TAKE}ns"})


LONG = ["{uniform: [20ms, 30ms]}", "{uniform: [30ms, 50ms]}", "{uniform: [25ms, 40ms]}"]
LONGER = [*LONG, "{uniform: [35ms, 42ms]}", "{uniform: [60ms, 78ms]}"]
"""Up to 1.2 and 2.4 times the period."""


@pytest.mark.parametrize(
    ("executions", "recorded_on", "cores", "cycles_later"),
    [
        ([*LONG, "{uniform: [30ms, 40ms]}"], [1, 1, 2, 2], None, 1),
        (LONGER, [1, 1, 2, 3, 4], (1, 2, 3), 2),
        (LONGER, [1, 2, 3, 4, 5], (6, 7, 8), 2),
    ],
)
def test_outputs_leave_once_a_cycle_in_order(
    tmp_path: Path,
    executions: list[str],
    recorded_on: list[int],
    cores: tuple[int, ...] | None,
    cycles_later: int,
) -> None:
    described = chain(executions, recorded_on)
    profile = simulate(described, tmp_path / "profile", cycles=300)
    request = PlanRequest(policy="pipelined", cores=cores, epsilon_ns=15 * MS)
    plan = plan_recording(profile, request=request).chains[0]
    measured = measure_latency(profile).analysis.statistics.max_ns
    assert plan.evidence.max_latency_ns == measured, "nothing overlapped on any core"
    assert cycles_until_output(plan) == cycles_later

    shaped = simulate(described, tmp_path / "shaped", Plan.of(plan), cycles=1000)
    analysis = measure_latency(shaped).analysis
    held = judge_prediction(plan, analysis)
    assert held.mean.holds and held.max.holds and held.jitter.holds
    figures = analysis.statistics
    assert (figures.count, figures.incomplete, figures.late) == (1000, 0, 0)
    assert analysis.traversals["latency_ns"].unique().to_list() == [measured + 15 * MS]
    ends = analysis.traversals["end"].diff().drop_nulls()
    assert ends.unique().to_list() == [100 * MS], "once a cycle, in order"


def test_a_recording_in_which_instances_piled_up_tells_the_same(tmp_path: Path) -> None:
    """On one core, 10 instances of 1.6 periods wait for each other: they say what each took."""
    constant = ["{constant: 40ms}"] * 4
    described = chain(constant, [1, 1, 1, 1])
    piled_up = simulate(described, tmp_path / "piled_up", cycles=10)
    assert measure_latency(piled_up).analysis.statistics.max_ns > 300 * MS  # type: ignore[operator]
    request = PlanRequest(policy="pipelined", cores=(1, 2))
    plan = plan_recording(piled_up, request=request).chains[0]
    assert 160 * MS <= plan.evidence.min_latency_ns <= plan.evidence.max_latency_ns
    assert plan.evidence.max_latency_ns <= 160 * MS + 10 * TAKE, "but for what is taken between"

    shaped = simulate(described, tmp_path / "shaped", Plan.of(plan), cycles=100)
    analysis = measure_latency(shaped).analysis
    assert analysis.statistics.late == 0
    assert analysis.traversals["latency_ns"].unique().to_list() == [plan.predicted.max_ns - MS]


VARIED = ["{uniform: [10ms, 60ms]}", *["{uniform: [10ms, 30ms]}"] * 3]
"""The second stage, of three nodes, may get an instance while it works on the one before."""


def test_the_older_instance_comes_first_in_a_stage(tmp_path: Path) -> None:
    described = chain(VARIED, [1, 2, 2, 2])
    profile = simulate(described, tmp_path / "profile", cycles=600)
    plan = plan_recording(profile, request=PlanRequest(policy="pipelined")).chains[0]
    stages = [[thread.node for thread in server.threads] for server in plan.servers[:2]]
    assert stages == [["/n0"], ["/n1", "/n2", "/n3"]]
    shaped = simulate(described, tmp_path / "shaped", Plan.of(plan), cycles=2000)
    figures = measure_latency(shaped).analysis.statistics
    assert (plan.margin.overrun_probability or 1) <= 0.01
    assert (figures.count, figures.incomplete, figures.late) == (2000, 0, 0)


CAMERA_AND_LIDAR = """\
chain: /points../filtered../fused../objects
nodes:
  lidar: {core: 1, callbacks: [{timer: 100ms, execution: {uniform: [20ms, 30ms]},
    publishes: [/points]}]}
  filter: {core: 1, callbacks: [{subscription: /points, execution: {uniform: [20ms, 40ms]},
    publishes: [/filtered]}]}
  camera: {core: 2, callbacks: [{timer: 100ms, phase: 7ms, execution: {uniform: [2ms, 5ms]},
    publishes: [/image]}]}
  detector: {core: 2, callbacks: [{subscription: /image, execution: {uniform: [40ms, 60ms]},
    publishes: [/boxes]}]}
  fusion: {core: CORE, callbacks: [{synchronises: [/filtered, /boxes],
    execution: {uniform: [10ms, 20ms]}, publishes: [/fused]}]}
  tracker: {core: CORE, callbacks: [{subscription: /fused, execution: {uniform: [20ms, 40ms]},
    publishes: [/objects]}]}
  actuator: {core: 9, callbacks: [{subscription: /objects}]}
"""


@pytest.mark.parametrize("cores", [None, (1, 2, 3), (1, 2)])
def test_a_camera_and_a_lidar_are_joined_in_a_stage(
    cores: tuple[int, ...] | None, tmp_path: Path
) -> None:
    """Up to 70 ms of the lidar beside 7 + 65 of the camera, and 60 behind both: 132 every 100."""
    described = application(CAMERA_AND_LIDAR.replace("CORE", "3"))
    profile = simulate(described, tmp_path / "profile", cycles=400)
    plan = plan_recording(profile, request=PlanRequest(policy="pipelined", cores=cores)).chains[0]
    assert 120 * MS < plan.evidence.max_latency_ns < 133 * MS, "on the longest way"
    home = {thread.node: one for one in plan.servers for thread in one.threads}
    assert home["/detector"] is not home["/fusion"], "60 and 20 and 40 ms are more than a cycle"
    shaped = simulate(described, tmp_path / "shaped", Plan.of(plan), cycles=1000)
    analysis = measure_latency(shaped).analysis
    figures = analysis.statistics
    assert (figures.count, figures.incomplete, figures.late) == (1000, 0, 0)
    assert figures.jitter_ns == 0
    assert judge_prediction(plan, analysis).broken == ()


FORKED = """\
chain: /image../left../joined
nodes:
  camera: {core: 1, callbacks: [{timer: 100ms, execution: {uniform: [20ms, 30ms]},
    publishes: [/image]}]}
  left: {core: 1, callbacks: [{subscription: /image, execution: {uniform: [20ms, 40ms]},
    publishes: [/left]}]}
  right: {core: 1, callbacks: [{subscription: /image, execution: {uniform: [30ms, 50ms]},
    publishes: [/right]}]}
  join: {core: 1, callbacks: [{synchronises: [/left, /right],
    execution: {uniform: [20ms, 40ms]}, publishes: [/joined]}]}
  actuator: {core: 9, callbacks: [{subscription: /joined}]}
"""


def test_branches_of_one_beginning_are_cut_although_they_piled_up(tmp_path: Path) -> None:
    """160 ms on one core every 100; on two, a branch runs beside the other."""
    described = application(FORKED, take={"constant": f"{TAKE}ns"})
    profile = simulate(described, tmp_path / "profile", cycles=300)
    plan = plan_recording(profile, request=PlanRequest(policy="pipelined", cores=(1, 2))).chains[0]
    assert 110 * MS < plan.evidence.max_latency_ns < 121 * MS, "30 + 50 + 40"
    shaped = simulate(described, tmp_path / "shaped", Plan.of(plan), cycles=1000)
    figures = measure_latency(shaped).analysis.statistics
    assert (figures.count, figures.incomplete) == (1000, 0)
    assert (figures.late or 0) <= 1000 * (plan.margin.overrun_probability or 0), "of 1 % at most"
    described = application(CAMERA_AND_LIDAR.replace("CORE", "1"))
    piled_up = simulate(described, tmp_path / "piled_up", cycles=50)
    varying = "joins data of /camera, which starts at varying times after /lidar"
    with pytest.raises(InputError, match=varying):
        plan_recording(piled_up, request=PlanRequest(policy="pipelined", cores=(1, 2))).chains[0]
