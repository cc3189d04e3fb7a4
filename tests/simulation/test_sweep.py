"""Sweeps: axes and what they mean, one point by hand and step by step, and whole sweeps."""

import fcntl
import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from command_line import Running
from processes import wait_for
from quick_chain import quick_chain

from chainshaper import sweep
from chainshaper.flow.plan import plan_recording
from chainshaper.flow.sweep import (
    FIGURES,
    OTHER_RUN,
    application_at,
    changing_nothing,
    grid_of,
    groups_of,
    parse_axis,
    plan_at,
    points_of,
    profile_at,
    request_at,
    row_at,
    rows_beside,
)
from chainshaper.planning import ChainPlan, Plan, PlanRequest
from chainshaper.simulation import simulate, simulate_latencies
from chainshaper.values.errors import InputError, OperationError
from chainshaper.verify.measure import measure_latency
from chainshaper.workload.description import Application, application_as_written

MS = 1_000_000


@pytest.mark.parametrize(
    ("text", "name", "values"),
    [
        ("bands=1..3", "bands", (1, 2, 3)),
        ("bands=1..2,8,auto", "bands", (1, 2, 8, "auto")),
        ("epsilon=0,1ms", "epsilon", (0, "1ms")),
        ("overrun_probability=1e-6,null", "overrun_probability", (1e-6, None)),
        ("chain=/t1../t5", "chain", ("/t1../t5",)),
        ("a.uniform=[1ms, 2ms],[3ms, 4ms]", "a.uniform", (["1ms", "2ms"], ["3ms", "4ms"])),
        ("a={constant: 3ms}", "a", ({"constant": "3ms"},)),
    ],
)
def test_an_axis_is_read_as_yaml_has_its_values(text: str, name: str, values: Any) -> None:
    assert parse_axis(text) == (name, values)


@pytest.mark.parametrize("text", ["bands", "bands=", "=1", "a=[1", "a={"])
def test_what_is_no_axis_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="is no axis: write NAME=VALUE"):
        parse_axis(text)


def test_points_count_up_from_the_last_axis() -> None:
    grid = grid_of(quick_chain(), {"bands": (1, 2), "epsilon": ("0ms", "1ms")}, cycles=1)
    counted = [(1, "0ms"), (1, "1ms"), (2, "0ms"), (2, "1ms")]
    assert points_of(grid) == [{"bands": n, "epsilon": time} for n, time in counted]


def _at(values: dict[str, Any], application: Application | None = None) -> Application:
    axes = {name: (value,) for name, value in values.items()}
    return application_at(grid_of(application or quick_chain(), axes, cycles=1), values)


def test_a_path_leads_to_any_value_of_the_description() -> None:
    found = _at(
        {
            "nodes.second.core": 2,
            "nodes.first.callbacks.0.execution": {"uniform": ["1ms", "3ms"]},
            "topics./t1.depth": 3,
            "seed": 9,
        }
    )
    assert found.nodes["second"].core == 2
    assert found.nodes["first"].callbacks[0].execution.uniform_ns == (1 * MS, 3 * MS)
    assert found.topics["/t1"].depth == 3
    assert found.seed == 9


def test_interference_is_a_load_of_half_the_time_to_all_of_it_below_the_chain() -> None:
    node = _at({"interference": "20ms"}).nodes["interference"]
    assert (node.priority, node.callbacks[0].timer_ns) == (1, 50 * MS)
    assert node.callbacks[0].execution.uniform_ns == (10 * MS, 20 * MS)
    # One that is described keeps what else it has.
    described = _at({"interference": "20ms", "nodes.interference.priority": 15})
    phase = {"nodes.interference.callbacks.0.phase": "3ms"}
    described = _at({"interference": "8ms", **phase}, described)
    node = described.nodes["interference"]
    assert (node.priority, node.callbacks[0].phase_ns) == (15, 3 * MS)
    assert node.callbacks[0].execution.uniform_ns == (4 * MS, 8 * MS)
    idle = _at({"interference": 0}, described).nodes["interference"]
    assert idle.callbacks[0].execution.uniform_ns == (0, 0)


def test_wishes_for_the_plan_are_called_as_options_or_as_in_python() -> None:
    values = {"publish-slot": ("2ms",), "epsilon_ns": (0,), "bands": (3,)}
    grid = grid_of(quick_chain(), {**values, "policy": ("shaped", "none")}, cycles=1)
    shaped, unplanned = points_of(grid)
    wished = PlanRequest(publish_slot_ns=2 * MS, epsilon_ns=0, bands=3, seed=7)
    assert request_at(grid, shaped) == wished
    assert request_at(grid, unplanned) is None
    assert application_at(grid, shaped) == grid.application


def test_a_given_plan_is_varied_by_paths_of_its_own(plan: ChainPlan) -> None:
    axes = {"plan.overrun": ("wait", "discard"), "plan.servers.1.slots.0.1": ("25ms",)}
    grid = grid_of(quick_chain(), axes, plan, cycles=1)
    with pytest.raises(InputError, match="axis bands is a wish for a plan, but a plan is given"):
        grid_of(quick_chain(), {"bands": (1,)}, plan, cycles=1)
    found = [plan_at(grid, point) for point in points_of(grid)]
    assert [one.overrun for one in found if one] == ["wait", "discard"]
    assert all(one and one.servers[1].slots == ((21 * MS, 25 * MS),) for one in found)


def test_points_that_differ_in_the_plan_only_share_a_profile() -> None:
    axes = {
        "bands": (1, 2, 3),
        "seed": (1, 2),
        "policy": ("none", "shaped", "server-per-chain", "server-per-callback"),
    }
    grid = grid_of(quick_chain(), axes, cycles=1)
    found = {
        (values["seed"], frozenset(str(values["policy"]) for _, values in group)): (
            profiled,
            len(group),
        )
        for profiled, group in groups_of(grid, enumerate(points_of(grid)))
        for _, values in group[:1]
    }
    # Callbacks planned one by one need more of a recording.
    sizes = {
        frozenset({"none"}): (False, 3),
        frozenset({"shaped", "server-per-chain"}): (True, 6),
        frozenset({"server-per-callback"}): (True, 3),
    }
    assert found == {(seed, names): size for seed in (1, 2) for names, size in sizes.items()}


@pytest.mark.parametrize(
    ("axes", "said"),
    [
        ({"band": (1,)}, "axis band: no such thing, did you mean bands?"),
        ({"nods.first.core": (1,)}, "did you mean nodes?"),
        ({"bands": ()}, "axis bands: give at least one value"),
        ({"bands": (1, 1)}, "none of them twice"),
        ({"bands": (1,), "bands_ns": (2,)}, "an axis is given twice"),
        ({"bands": ("many",)}, "axis bands: 'many' is no value of it"),
        ({"policy": ("shape",)}, "axis policy: 'shape' is no value of it"),
        ({"epsilon": (1,)}, "axis epsilon: 1 has no unit"),
        ({"epsilon": ("1m",)}, "'1m' is not a duration"),
        ({"interference": (20,)}, "axis interference: 20 has no unit"),
        ({"nodes.third.core": (1,)}, "axis nodes.third.core: the application has no node 'third'"),
        ({"nodes.secnd.core": (1,)}, "no node 'secnd'; did you mean second?"),
        ({"nodes.first.core": (-1,)}, "nodes.first.core=-1: nodes.first.core:"),
        ({"nodes.first.callbacks.5.timer": ("1ms",)}, "nodes.first.callbacks.5.timer=1ms: "),
        ({"plan.overrun": ("wait",)}, "axis plan.overrun is a value of a plan's file: give the"),
    ],
)
def test_mistakes_are_named_before_anything_is_simulated(
    axes: dict[str, tuple[Any, ...]], said: str
) -> None:
    with pytest.raises(InputError) as refused:
        grid_of(quick_chain(), axes, cycles=1)
    assert said in str(refused.value)


VARYING = {"uniform": ["1ms", "4ms"]}


def _rows(
    application: Application, axes: dict[str, Any], cycles: int = 20, plan: Any = None
) -> Any:
    grid = grid_of(application, axes, plan, cycles=cycles)
    return [
        row_at(grid, point, None if plan is not None else profile_at(grid, point))
        for point in points_of(grid)
    ]


def test_a_point_is_what_simulate_plan_simulate_give(tmp_path: Path) -> None:
    application = quick_chain(VARYING, VARYING, wake_up={"uniform": ["10us", "90us"]})
    (row,) = _rows(application, {"bands": (2,), "epsilon": ("500us",)}, cycles=300)
    profile = simulate(application, tmp_path / "profile", cycles=300)
    plan = plan_recording(profile, None, PlanRequest(bands=2, epsilon_ns=500_000, seed=7)).chains[0]
    judged = simulate(
        application,
        tmp_path / "judged",
        Plan.of(plan),
        cycles=300,
        seed=application.seed + OTHER_RUN,
    )
    measured = measure_latency(judged)
    assert list(row) == list(FIGURES)
    assert row["profile_max_ns"] == plan.evidence.max_latency_ns
    assert row["predicted_mean_ns"] == plan.predicted.mean_ns
    for name in ("count", "incomplete", "min_ns", "mean_ns", "max_ns", "jitter_ns", "spread_ns"):
        assert row[name] == getattr(measured.analysis.statistics, name), name
    assert row["p99_ns"] == measured.analysis.statistics.percentiles_ns["99"]
    assert measured.prediction is not None
    assert row["late"] == measured.prediction.late
    for ours, held in zip(row["per_band"], measured.prediction.bands, strict=True):
        assert ours["share"] * row["count"] == pytest.approx(held.count)
        assert ours["jitter_ns"] == held.jitter_ns


def test_a_share_of_late_cycles_is_judged_by_all_cycles_of_the_profile() -> None:
    """Not by the hundred that are recorded for the application's structure."""
    axes = {"overrun_probability": (0.01,), "policy": ("shaped",)}
    few, many = (_rows(quick_chain(VARYING), axes, cycles=cycles)[0] for cycles in (200, 300))
    assert "200 cycles are too few for an overrun probability of 0.01" in few["error"]
    assert many["error"] is None


def test_a_percentile_is_of_all_cycles_of_the_profile() -> None:
    """The 297th of 300 latencies, and the last."""
    application = quick_chain(VARYING)
    some, every = _rows(application, {"percentile": (99, 100)}, cycles=300)
    latencies = np.sort(simulate_latencies(application, cycles=300))
    assert (some["profile_max_ns"], every["profile_max_ns"]) == (latencies[296], latencies[299])


def test_constant_times_by_hand() -> None:
    """2 ms and 2 ms: L̄ = 4 ms; with ε = 1 ms the slot is [5 ms, 6 ms), left at its start."""
    (row,) = _rows(quick_chain(), {"epsilon": ("1ms",)})
    assert (row["profile_min_ns"], row["profile_max_ns"]) == (4 * MS, 4 * MS)
    assert (row["predicted_mean_ns"], row["predicted_max_ns"]) == (6 * MS, 6 * MS)
    assert (row["count"], row["incomplete"], row["late"]) == (20, 0, 0)
    assert (row["min_ns"], row["mean_ns"], row["max_ns"], row["jitter_ns"]) == (5 * MS,) * 3 + (0,)
    slot = {"start_ns": 5 * MS, "end_ns": 6 * MS}
    assert row["per_band"] == [{**slot, "predicted_share": 1.0, "share": 1.0, "jitter_ns": 0}]


def test_outputs_that_outgrow_a_given_plan_are_late_or_lost_by_hand(tmp_path: Path) -> None:
    """10 ms instead of 4 miss the slot [5 ms, 6 ms): they leave 50 ms later, or not at all."""
    plan = plan_recording(simulate(quick_chain(), tmp_path / "profile", cycles=5)).chains[0]
    axes = {
        "nodes.second.callbacks.0.execution.constant": ("2ms", "8ms"),
        "plan.overrun": ("wait", "discard"),
        # The chain may go on outside of its slot, or its second callback waited for the next.
        "plan.servers.0.slots.0.1": ("50ms",),
    }
    in_time, in_time_too, waited, discarded = _rows(quick_chain(), axes, plan=plan)
    for row in (in_time, in_time_too):
        assert (row["count"], row["late"], row["max_ns"]) == (20, 0, 5 * MS)
    assert (waited["count"], waited["late"]) == (20, 20)
    assert [(one["missed"], one["kept"]) for one in (in_time, waited, discarded)] == [
        *((0, True), (20, False), (20, False))
    ]
    assert (waited["min_ns"], waited["max_ns"]) == (55 * MS, 55 * MS)
    assert waited["per_band"][0]["share"] == 0.0
    assert (discarded["count"], discarded["incomplete"], discarded["late"]) == (0, 20, 0)
    assert discarded["mean_ns"] is None


def test_axes_that_change_nothing_are_said(tmp_path: Path) -> None:
    """A load of the lowest priority does not reach a chain that is in front of all others."""
    axes: dict[str, Any] = {"interference": ("0ms", "20ms"), "bands": (1, 2)}
    application = quick_chain(VARYING, VARYING)
    frame = sweep(application, axes, tmp_path / "rows.parquet", cycles=50)
    said = "interference changes nothing: its load has the lowest priority, or another core"
    assert changing_nothing(frame, ["interference_ns", "bands"]) == [said]
    some = frame.with_columns(
        mean_ns=pl.when((pl.col("bands") == 2) & (pl.col("interference_ns") > 0))
        .then(1)
        .otherwise("mean_ns")
    )
    (said,) = changing_nothing(some, ["interference_ns", "bands"])
    assert said.startswith("interference changes nothing where bands is 1: ")


def test_a_chain_is_profiled_in_front_of_all_others() -> None:
    """Unplanned, a load of 10 to 20 ms with a better priority is in the latency; not in L̄."""
    axes = {
        "interference": ("20ms",),
        "nodes.interference.priority": (95,),
        "nodes.interference.callbacks.0.phase": ("500us",),  # while the first callback runs
        "policy": ("none", "server-per-chain"),
    }
    unplanned, planned = _rows(quick_chain(VARYING, VARYING), axes, cycles=50)
    assert unplanned["min_ns"] >= 12 * MS
    assert planned["profile_max_ns"] <= 8 * MS
    assert planned["max_ns"] <= 8 * MS, "its server is in front as well"
    assert unplanned["profile_max_ns"] is None


@pytest.mark.parametrize(
    ("execution", "axes", "reason"),
    [
        ({"constant": "49ms"}, {"bands": (1,)}, "do not fit into the cycle of 50 ms"),
        (VARYING, {"bands": (40,), "grid": ("1ms",)}, "slots"),
        (VARYING, {"bands": (2,), "policy": ("server-per-chain",)}, "places latency bands"),
    ],
)
def test_a_point_that_cannot_be_says_why(execution: Any, axes: Any, reason: str) -> None:
    (row,) = _rows(quick_chain(execution), axes)
    assert reason in row["error"]
    assert row["mean_ns"] is None
    assert list(row) == list(FIGURES)


AXES: dict[str, list[Any]] = {"bands": [1, 2], "interference": ["0ms", "10ms"]}
CYCLES = 50
MANY = "200000"


def varying() -> Application:
    return quick_chain(*[{"uniform": ["1ms", "6ms"]}] * 2)


def swept(output: Path, axes: Any = None, **wishes: Any) -> pl.DataFrame:
    """A short sweep, by this process."""
    return sweep(varying(), axes or AXES, output, **{"cycles": CYCLES, "workers": 1, **wishes})


def compared(frame: pl.DataFrame) -> pl.DataFrame:
    """A frame without what a machine's mood decides."""
    return frame.drop("seconds")


def test_the_frame_has_axes_and_figures_and_is_what_the_file_has(tmp_path: Path) -> None:
    axes = {**AXES, "policy": ["shaped"], "max_gap": [None]}
    frame = swept(tmp_path / "out.parquet", axes)
    names = ["bands", "interference_ns", "policy", "max_gap_ns", "cycles", "seed"]
    assert frame.columns == [*names, *FIGURES]
    assert frame["bands"].to_list() == [1, 1, 2, 2]
    assert frame["interference_ns"].to_list() == [0, 10_000_000] * 2
    assert frame["max_gap_ns"].dtype == pl.Int64
    assert set(frame["seed"]) == {7}
    assert pl.read_parquet(tmp_path / "out.parquet").equals(frame)
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.parquet"]


def test_rows_do_not_depend_on_the_order_of_axes_or_on_who_computes_them(tmp_path: Path) -> None:
    reference = compared(swept(tmp_path / "one.parquet"))
    backwards = {name: AXES[name][::-1] for name in reversed(AXES)}
    turned = compared(swept(tmp_path / "turned.parquet", backwards))
    assert turned.select(reference.columns).sort("bands", "interference_ns").equals(reference)
    assert compared(swept(tmp_path / "two.parquet", workers=2)).equals(reference)


def test_seeds_draw_other_execution_times_and_what_cannot_be_does_not_end_the_others(
    tmp_path: Path,
) -> None:
    frame = swept(tmp_path / "out.parquet", {"seed": [1, 2], "policy": ["none"]})
    assert frame["seed"].to_list() == [1, 2]
    assert frame["mean_ns"].n_unique() == 2
    axes = {"nodes.first.callbacks.0.execution": [{"constant": "60ms"}, {"constant": "1ms"}]}
    frame = swept(tmp_path / "impossible.parquet", axes)
    assert "do not fit into the cycle" in frame["error"][0]
    assert frame["error"][1] is None
    assert frame["nodes.first.callbacks.0.execution"][0] == "{constant: 60ms}"


def _first_rows(output: Path, count: int) -> Path:
    """The file of a sweep that was ended after some rows."""

    def end(share: float, _: str) -> None:
        if share >= count / 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        swept(output, progress=end)
    return rows_beside(output)


def test_a_sweep_that_was_ended_goes_on_with_what_is_missing(tmp_path: Path) -> None:
    output = tmp_path / "out.parquet"
    rows = _first_rows(output, 2)
    assert not output.exists()
    with rows.open("a") as file:
        file.write('{"number": 2, "row": {"mean_')  # a crash in the middle of writing
    first = json.loads(rows.read_text().splitlines()[1])
    assert first["number"] == 0
    marked = rows.read_text().replace(f'"mean_ns": {first["row"]["mean_ns"]}', '"mean_ns": 1', 1)
    rows.write_text(marked)  # so it was not computed again
    shares: list[float] = []
    frame = swept(output, progress=lambda share, _: shares.append(share))
    assert shares == [0.5, 0.75, 1.0]
    assert frame["mean_ns"][0] == 1
    reference = compared(swept(tmp_path / "reference.parquet"))
    assert compared(frame)[1:].equals(reference[1:])
    assert not rows.exists()


@pytest.mark.parametrize(
    ("wishes", "said"),
    [
        ({"cycles": 51}, "the number of cycles changed since"),
        ({"axes": {"bands": [1, 2, 3]}}, "the axes changed since"),
        ({"seed": 8}, "the application or the seed changed since"),
    ],
)
def test_rows_of_another_sweep_are_not_mixed_in(
    tmp_path: Path, wishes: dict[str, Any], said: str
) -> None:
    output = tmp_path / "out.parquet"
    rows = _first_rows(output, 1)
    before = rows.read_bytes()
    with pytest.raises(InputError, match=said) as refused:
        swept(output, **wishes)
    assert "has 1 finished rows of another sweep" in str(refused.value)
    assert rows.read_bytes() == before
    assert not output.exists()


def test_rows_that_are_in_use_or_something_else_are_left_alone(tmp_path: Path) -> None:
    for mine in (b"my notes\n", b'{"a\xff": 1}\nand more'):  # a text, and none
        rows_beside(tmp_path / "mine.parquet").write_bytes(mine)
        with pytest.raises(InputError, match="these are no rows of a sweep"):
            swept(tmp_path / "mine.parquet")
        assert rows_beside(tmp_path / "mine.parquet").read_bytes() == mine
    rows = _first_rows(tmp_path / "out.parquet", 1)
    with rows.open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(OperationError, match="another process works on this sweep"):
            swept(tmp_path / "out.parquet")


def test_nothing_is_overwritten_and_nothing_begun_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "out.parquet").write_text("mine")
    with pytest.raises(InputError, match="exists already and is not overwritten"):
        swept(tmp_path / "out.parquet")
    with pytest.raises(InputError, match=r"write to a file that ends in \.parquet"):
        swept(tmp_path / "out.csv")
    with pytest.raises(InputError, match="0 workers compute nothing"):
        swept(tmp_path / "other.parquet", workers=0)
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.parquet"]


def test_a_full_disk_is_named(full_disk: Path) -> None:
    with pytest.raises(OperationError, match="finished rows cannot be written"):
        swept(full_disk / "out.parquet")


@pytest.fixture
def description(tmp_path: Path) -> Path:
    path = tmp_path / "application.yaml"
    path.write_text(json.dumps(application_as_written(varying())))  # JSON is YAML
    return path


def _under_way(description: Path, output: Path, *options: str) -> Running:
    """A sweep of forty long points, of which at least one is finished."""
    grid = ("--vary", "bands=1..4", "--vary", "seed=1..10", "--cycles", MANY)
    running = Running.start("sweep", description, *grid, "-o", output, *options)
    rows = rows_beside(output)
    wait_for(lambda: rows.exists() and rows.read_bytes().count(b"\n") > 1, "a row", seconds=60)
    return running


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_ended_it_leaves_its_rows_and_no_processes(
    number: signal.Signals, description: Path, tmp_path: Path
) -> None:
    running = _under_way(description, tmp_path / "out.parquet", "--workers", "2")
    running.process.send_signal(number)
    finished = running.end()
    wait_for(lambda: not running.nodes(), f"the end of {running.nodes()}")
    rows = rows_beside(tmp_path / "out.parquet")
    assert 1 <= rows.read_bytes().count(b"\n") - 1 < 40
    assert not (tmp_path / "out.parquet").exists()
    if number == signal.SIGINT:
        assert finished.code not in (0, -signal.SIGINT)
        assert f"finished points are in {rows}" in finished.err
        assert "Traceback" not in finished.err
