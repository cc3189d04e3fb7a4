"""`control`, and the cost of a loop in `plan`, `sweep` and `check`: what is shown and refused."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import called, json_of, refused
from small_chain import small_chain_text

from chainshaper import load_loop, measure_latency
from chainshaper.control.costs import cost_over
from chainshaper.control.steady_state import covariance_of_constant
from chainshaper.values.recording import Recording

MS = 1_000_000
PLANT = """\
plant: {transfer_function: {numerator: [1], denominator: [1, 0, -9]}}
noise: {process: 1, measurement: 0.001}
cost: {output: 1, input: 0.001}
controller: {design: lqg, delay: 8ms}
"""


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    path = tmp_path / "plant.yaml"
    path.write_text(PLANT)
    return path


@pytest.fixture
def latencies(tmp_path: Path) -> Path:
    path = tmp_path / "latencies.txt"
    sample = np.random.default_rng(2).triangular(33, 68, 85, 300)
    path.write_text("".join(f"{latency:.3f}ms\n" for latency in sample))
    return path


def test_the_cost_over_a_recording_is_that_of_its_cycles(plant: Path, simulated: Recording) -> None:
    values = json_of("control", plant, simulated.path)
    (shown,) = values["recordings"]
    traversals = measure_latency(simulated).analysis.traversals
    complete = traversals.filter("complete")
    period = values["period_ns"]
    loop = load_loop(plant).loop(period)
    samples = traversals["start"].to_numpy()
    times = traversals["latency_ns"].fill_null(-1).to_numpy()
    until = int(np.flatnonzero(times >= 0)[-1]) + 1
    typical = round(float(np.percentile(times[:until][times[:until] >= 0], 50)))
    begin = covariance_of_constant(loop, typical / 1e9)
    expected = cost_over(loop, samples[:until], times[:until], begin)
    assert shown["cost"] == pytest.approx(expected.cost, rel=1e-9)
    assert shown["count"] == until
    assert shown["lost"] == until - complete.height
    assert shown["mean_ns"] == pytest.approx(complete["latency_ns"].mean(), abs=1)
    assert [constant["percentile"] for constant in shown["constant"]] == [50, 95, 99, 100]
    later = [constant["cost"] for constant in shown["constant"]]
    assert later == sorted(later), "a longer constant latency costs more"
    for constant in shown["constant"]:
        assert constant["redesigned_cost"] <= constant["cost"] * 1.001


def test_recordings_stand_beside_each_other(plant: Path, simulated: Recording) -> None:
    shown = called("control", plant, simulated.path, simulated.path, "--at", "receiver")
    assert shown.code == 0, shown
    assert "redesigned" in shown.out
    assert "stable with constant latencies from 0 ms" in " ".join(shown.out.split())
    assert "the same controller: cost" in shown.out
    at_output = json_of("control", plant, simulated.path)["recordings"][0]
    at_receiver = json_of("control", plant, simulated.path, "--at", "receiver")["recordings"][0]
    assert at_receiver["mean_ns"] > at_output["mean_ns"]
    designed = json_of("control", plant, simulated.path, "--delay", "40ms")["recordings"][0]
    assert designed["cost"] > at_output["cost"]


def test_modes_have_costs_and_so_have_their_changes(plant: Path, latencies: Path) -> None:
    plant.write_text(PLANT + "period: 100ms\nmodes: {city: 40ms, highway: 80ms}\n")
    modes = json_of("control", plant, "--latencies", latencies)["modes"]
    assert modes["city"]["cost"] < modes["highway"]["cost"]
    assert modes["city"]["switching"].keys() == {"highway"}
    shown = called("control", plant, "--latencies", latencies)
    assert "to highway" in shown.out


def test_the_picture_has_the_run_and_the_map(plant: Path, latencies: Path, tmp_path: Path) -> None:
    plant.write_text(PLANT + "period: 100ms\n")
    picture = tmp_path / "cost.png"
    shown = called("control", plant, "--latencies", latencies, "--figure", picture)
    assert shown.code == 0, shown
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = refused(2, "control", plant, "--latencies", latencies, "--figure", picture)
    assert "is not overwritten" in again


def test_latencies_above_the_period_are_said_to_be_several_under_way(
    plant: Path, tmp_path: Path
) -> None:
    plant.write_text(PLANT + "period: 100ms\n")
    file = tmp_path / "long.txt"
    file.write_text("60ms\n" * 50 + "130ms\n" + "60ms\n" * 50)
    values = json_of("control", plant, "--latencies", file)
    assert "1 outputs came later than a period" in values["notes"][0]
    assert values["recordings"][0]["steady_cost"] is None
    assert values["recordings"][0]["cost"] > 0


def test_what_is_wrong_is_said(plant: Path, latencies: Path, simulated: Recording) -> None:
    assert "either recordings or --latencies" in refused(2, "control", plant)
    assert "has no period" in refused(2, "control", plant, "--latencies", latencies)
    assert "cannot be read" in refused(2, "control", "nothing.yaml", simulated.path)
    plant.write_text(PLANT + "period: 1s\n")
    assert "period is 50 ms" in refused(2, "control", plant, simulated.path)


def test_without_scipy_it_says_what_to_install(
    plant: Path, latencies: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant.write_text(PLANT + "period: 100ms\n")
    importing = importlib.import_module

    def without_scipy(name: str, package: str | None = None) -> Any:
        if name.startswith("scipy"):
            raise ImportError(f"No module named {name!r}")
        return importing(name, package)

    monkeypatch.setattr(importlib, "import_module", without_scipy)
    message = refused(3, "control", plant, "--latencies", latencies)
    assert "needs the Python package scipy" in message
    assert "pip install 'chainshaper[control]'" in message


def test_a_plan_shows_what_it_chose_from(plant: Path, latencies: Path) -> None:
    plan: list[str | Path] = [
        "plan",
        "--latencies",
        latencies,
        "--period",
        "100ms",
        "--plant",
        plant,
    ]
    plan += ["--grid", "1ms"]
    values = json_of(*plan)
    assert values["control"]["chosen"] in values["control"]["alternatives"]
    assert not values["control"]["worth"]
    assert any("shaping is not worth it" in warning for warning in values["warnings"])
    shown = called(*plan)
    assert "Cost of the control loop" in shown.out
    assert "shaping is not worth it" in shown.err


def test_a_sweep_has_the_cost_as_a_figure(plant: Path, tmp_path: Path) -> None:
    application = tmp_path / "application.yaml"
    application.write_text(small_chain_text())
    sweep = ("sweep", application, "--vary", "policy=none,shaped", "--cycles", "200")
    rows = json_of(*sweep, "--plant", plant, "-o", tmp_path / "rows.parquet")
    unshaped, shaped = (row["control_cost"] for row in rows)
    assert 0 < unshaped < shaped, "this loop suffers from the delay, not from jitter"
    without = json_of(*sweep, "-o", tmp_path / "without.parquet")
    assert [row["control_cost"] for row in without] == [None, None]


@pytest.mark.parametrize(("limit", "code"), [(1000.0, 0), (0.000001, 1)])
def test_a_budget_limits_the_cost(
    limit: float, code: int, plant: Path, simulated: Recording, tmp_path: Path
) -> None:
    budget = tmp_path / "budget.yaml"
    chain = measure_latency(simulated).analysis.chain.spec
    control = f"{{plant: {plant.name}, cost: {limit}}}"
    budget.write_text(f"format: 1\nchains:\n- {{chain: {chain}, control: {control}}}\n")
    checked = called("check", simulated.path, "--budget", budget)
    assert checked.code == code, checked
    if code:
        assert "control cost" in checked.out
        assert "limits of" in checked.err
    plant.write_text("plant: {}")
    assert "plant.yaml" in refused(2, "check", simulated.path, "--budget", budget)
