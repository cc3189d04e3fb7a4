"""The plant and the controller of live runs, driven by hand: what they cost is what is computed."""

from pathlib import Path
from typing import TypeAlias

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray

from chainshaper.control.plant_file import LoopFile, load_loop
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording, RecordingInfo, write_recording
from chainshaper.verify.live_control import LiveCost, live_cost
from chainshaper.workload.description import Application, application_as_written, load_application
from chainshaper.workload.event_log import EventLog
from chainshaper.workload.live import ProcessLog, event_tables
from chainshaper.workload.live_plant import LiveLoop, LivePlant, carried_bytes

MS = 1_000_000
PERIOD = 100 * MS
ROBOT = str(Path(__file__).parents[2] / "examples" / "balancing_robot.yaml")
NEVER = -1
Numbers: TypeAlias = NDArray[np.int64]


def described(copies: int, **changes: object) -> Application:
    application = load_application(ROBOT)
    assert application.control_loop is not None
    loop = application.control_loop.model_copy(update={"copies": copies, **changes})
    return application.model_copy(update={"control_loop": loop})


def recorded(application: Application, latencies: Numbers, folder: Path, pid: int = 1) -> Recording:
    """Record a plant whose inputs take so long to arrive, each; :data:`NEVER`: it is lost."""
    written = application.control_loop
    assert written is not None
    live, log, now = LiveLoop.described(written, PERIOD, application.seed), EventLog(), [0]
    plant, controller = LivePlant(live, log, clock=lambda: now[0]), live.controller()
    samples = np.arange(len(latencies)) * PERIOD
    happens = [(int(at), 1, number) for number, at in enumerate(samples)]
    happens += [
        (int(at + late), 0, number)
        for number, (at, late) in enumerate(zip(samples, latencies, strict=True))
        if late != NEVER
    ]
    inputs: dict[int, bytes] = {}
    for at, is_sample, number in sorted(happens):
        now[0] = at + 1  # no instant is 0
        if is_sample:
            sampled = plant.sample()
            assert len(sampled) <= carried_bytes(1, 1, written.copies)
            inputs[number] = controller.compute(memoryview(sampled + bytes(16)))
        else:
            plant.drive(memoryview(inputs[number] + bytes(16)))
    tables = event_tables([ProcessLog(pid, None, log.rows, tuple(log.objects))], 0)
    info = RecordingInfo(
        source="live", clock_offset_ns=0, application=application_as_written(application)
    )
    return write_recording(folder, tables, info)


def cost_of(application: Application, latencies: Numbers, folder: Path) -> LiveCost:
    cost = live_cost(recorded(application, latencies, folder))
    assert cost is not None
    return cost


def latencies(count: int, lost: float = 0.0, longest_ns: int = 64 * MS) -> Numbers:
    random = np.random.default_rng(4)
    drawn = random.integers(12 * MS, longest_ns, count)
    drawn[random.random(count) < lost] = NEVER
    return drawn


@pytest.mark.parametrize(("lost", "longest_ns"), [(0.0, 64 * MS), (0.02, 64 * MS), (0.0, 110 * MS)])
def test_what_the_plant_costs_is_what_is_computed(
    lost: float, longest_ns: int, tmp_path: Path
) -> None:
    """Within twice the interval that holds 95 %: the seed is given, so it holds or does not."""
    cost = cost_of(described(200), latencies(400, lost, longest_ns), tmp_path / "rec")
    assert cost.cycles == 400
    assert cost.copies == 200
    assert cost.margin < 0.25 * cost.computed
    assert abs(cost.measured - cost.computed) < 2 * cost.margin
    assert (cost.lost > 0) == (lost > 0)


def test_a_single_plant_measures_with_a_wider_interval(tmp_path: Path) -> None:
    single = cost_of(described(1), latencies(800), tmp_path / "single")
    many = cost_of(described(100), latencies(800), tmp_path / "many")
    assert single.computed == pytest.approx(many.computed, rel=1e-9)
    assert many.margin < 0.35 * single.margin


def test_two_runs_that_are_joined_cost_their_average(tmp_path: Path) -> None:
    application = described(20)
    first = recorded(application, latencies(100), tmp_path / "a", pid=1)
    second = recorded(application, latencies(300)[100:], tmp_path / "b", pid=2)
    tables = {
        "plant_step": pl.concat(
            [recording.events["plant_step"] for recording in (first, second)]
        ).sort("time")
    }
    both = write_recording(tmp_path / "both", tables, first.info)
    costs = [live_cost(recording) for recording in (first, second, both)]
    a, b, joined = (cost for cost in costs if cost is not None)
    assert joined.cycles == 300
    weights = [100 * a.measured, 200 * b.measured]
    assert joined.measured == pytest.approx(sum(weights) / 300, rel=0.01)


def test_an_unstable_loop_costs_without_bound(tmp_path: Path) -> None:
    late = np.full(3_000, 98 * MS)
    cost = cost_of(described(2), late, tmp_path / "rec")
    assert cost.computed == np.inf
    assert cost.measured > 1e12
    assert not cost.agrees


def test_a_recording_without_a_plant_has_no_cost(tmp_path: Path) -> None:
    info = RecordingInfo(source="live", clock_offset_ns=0)
    assert live_cost(write_recording(tmp_path / "rec", {}, info)) is None


def test_both_nodes_begin_in_the_same_states() -> None:
    written = described(3).control_loop
    assert isinstance(written, LoopFile)
    first, second = (LiveLoop.described(written, PERIOD, 7).first for _ in range(2))
    assert (first == second).all()
    assert first.std() > 0


@pytest.mark.parametrize(
    ("was", "becomes", "reason"),
    [
        (", control: drives", "", "no callback has its part `control: drives`"),
        ("{subscription: /torque, control: drives}", "{timer: 1s}", "part `control: drives`"),
        ("{timer: 100ms, control: samples", "{timer: 100ms, control: drives", "write `subscrip"),
        ("control: computes", "control: drives", "a second callback that drives"),
        ("  copies: 64", "  copies: 0", "greater than or equal to 1"),
        ("  copies: 64", "  period: 50ms", "the chain's period is 100 ms"),
        ("denominator: [1, 0, -9]", "denominator: [1]", "denominator"),
        ("numerator: [1]", "numerator: [1, 0, 0]", "not strictly proper"),
        ("    priority: 85", "    executor: multi_threaded\n    threads: 2", "single-threaded"),
    ],
)
def test_a_loop_that_does_not_close_is_refused(
    was: str, becomes: str, reason: str, tmp_path: Path
) -> None:
    text = Path(ROBOT).read_text()
    assert was in text
    path = tmp_path / "robot.yaml"
    path.write_text(text.replace(was, becomes))
    with pytest.raises(InputError, match=reason):
        load_application(path)


def test_a_part_without_a_loop_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    begin, _, end = Path(ROBOT).read_text().partition("control_loop:")
    path.write_text(begin + "nodes:" + end.partition("nodes:")[2])
    with pytest.raises(InputError, match="an application with a `control_loop`"):
        load_application(path)


def test_an_applications_file_is_one_of_its_loop(tmp_path: Path) -> None:
    loop = load_loop(ROBOT)
    assert loop.delay_ns == 66 * MS
    path = tmp_path / "robot.yaml"
    path.write_text(Path(ROBOT).read_text().replace("delay: 66ms", "delay: 66"))
    with pytest.raises(InputError, match=r"robot.yaml:\d+: control_loop.controller.delay"):
        load_loop(path)
