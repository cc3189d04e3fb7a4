"""Descriptions of control loops: what they mean, and what is refused, each with its reason."""

from pathlib import Path

import numpy as np
import pytest

from chainshaper.control.plant_file import load_loop
from chainshaper.control.steady_state import cost_of_constant
from chainshaper.values.errors import InputError

MS = 1_000_000
GOOD = """\
format: 1
plant: {transfer_function: {numerator: [1], denominator: [1, 0, -1]}}
noise: {process: 1, measurement: 0.01}
cost: {output: 1, input: 0.01}
period: 100ms
controller: {design: lqg, delay: 20ms}
"""
STATES = "{state_space: {A: [[0, 1], [1, 0]], B: [[0], [1]], C: [[1, 0]]}}"
FUNCTION = "{transfer_function: {numerator: [1], denominator: [1, 0, -1]}}"


def written(folder: Path, *changes: tuple[str, str]) -> Path:
    text = GOOD
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path = folder / "plant.yaml"
    path.write_text(text)
    return path


def test_a_transfer_function_and_its_state_space_are_one_loop(tmp_path: Path) -> None:
    function = load_loop(written(tmp_path)).loop()
    space = load_loop(written(tmp_path, (FUNCTION, STATES))).loop()
    assert function.problem.plant.states == space.problem.plant.states == 2
    for latency in (0.0, 0.02, 0.15):
        assert cost_of_constant(function, latency) == pytest.approx(
            cost_of_constant(space, latency)
        )


def test_costs_and_noises_are_numbers_diagonals_or_matrices(tmp_path: Path) -> None:
    change = ("{output: 1, input: 0.01}", "{state: [1, 2], input: [[0.01]]}")
    noise = ("process: 1,", "process: [4], process_state: [[1, 0.5], [0.5, 1]],")
    problem = load_loop(written(tmp_path, (FUNCTION, STATES), change, noise)).problem()
    assert problem.cost.tolist() == [[1, 0, 0], [0, 2, 0], [0, 0, 0.01]]
    assert problem.process_noise.tolist() == [[1, 0.5], [0.5, 5]]


def test_a_given_controller_is_taken_as_it_is(tmp_path: Path) -> None:
    gains = ("{design: lqg, delay: 20ms}", "{gains: [[3, 2]]}")
    states = STATES.replace(", C: [[1, 0]]", "")  # all states are measured
    loop = load_loop(written(tmp_path, (FUNCTION, states), gains)).loop()
    assert loop.controller.k.tolist() == [[-3, -2]]
    assert np.isfinite(cost_of_constant(loop, 0.01))
    dynamic = "{state_space: {F: [[0.5]], G: [[1]], H: [[-1]], K: [[-4]]}}"
    loop = load_loop(written(tmp_path, ("{design: lqg, delay: 20ms}", dynamic))).loop()
    assert loop.controller.f.tolist() == [[0.5]]


def test_a_loop_without_a_period_takes_that_of_the_chain(tmp_path: Path) -> None:
    described = load_loop(written(tmp_path, ("period: 100ms\n", "")))
    assert described.loop(50 * MS).problem.period_s == 0.05
    with pytest.raises(InputError, match="has no period: add one"):
        described.loop()
    with pytest.raises(InputError, match=r"period is 50.* is for 100"):
        load_loop(written(tmp_path)).loop(50 * MS)


@pytest.mark.parametrize(
    ("before", "after", "reason"),
    [
        ("numerator: [1]", "numerator: [1, 0, 0]", "not strictly proper"),
        ("numerator: [1]", "numerator: [1, 0, 0, 0]", "is not proper"),
        ("denominator: [1, 0, -1]", "denominator: [1]", "too short"),
        ("numerator: [1]", "numerator: [x]", "numerator"),
        (FUNCTION, STATES.replace("C:", "D: [[1]], C:"), "D is not 0"),
        (FUNCTION, STATES.replace("[[0], [1]]", "[[0], [1], [2]]"), "B has 3 rows, and A has 2"),
        (FUNCTION, STATES.replace("[[1, 0]]}", "[[1, 0, 0]]}"), "C has 3 columns, and A has 2"),
        (FUNCTION, STATES.replace("[1, 0]],", "[1, 0, 2]],"), "A is no matrix"),
        (FUNCTION, "{}", "either state_space or transfer_function"),
        ("process: 1", "process: -1", "negative eigenvalue"),
        ("process: 1", "process: [1, 2]", "noise.process is 1 x 2"),
        ("measurement: 0.01", "measurement: .nan", "finite"),
        ("input: 0.01", "input: [[1, 2], [3, 4]]", "cost.input is 2 x 2"),
        ("{design: lqg, delay: 20ms}", "{design: lqg}", "goes with the delay"),
        ("{design: lqg, delay: 20ms}", "{}", "one of design"),
        ("{design: lqg, delay: 20ms}", "{gains: [[1, 2]]}", "from 2 samples to 1 inputs"),
        ("delay: 20ms", "delay: 20", "write a number and a unit"),
        ("period: 100ms", "period: 0s", "longer than 0"),
    ],
)
def test_what_is_wrong_is_named_with_its_reason(
    before: str, after: str, reason: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=reason) as error:
        load_loop(written(tmp_path, (before, after)))
    assert str(error.value).startswith(f"{tmp_path}/plant.yaml")


@pytest.mark.parametrize(
    "states",
    [
        "{state_space: {A: [[1, 0], [0, -1]], B: [[0], [1]], C: [[1, 1]]}}",  # not reached
        "{state_space: {A: [[1, 0], [0, -1]], B: [[1], [1]], C: [[0, 1]]}}",  # not seen
    ],
)
def test_a_plant_that_no_controller_stabilises_is_refused(states: str, tmp_path: Path) -> None:
    noise = ("process: 1,", "process_state: 1,")
    described = load_loop(written(tmp_path, (FUNCTION, states), noise))
    with pytest.raises(InputError, match="check A, B and C"):
        described.loop()


def test_a_delay_that_is_too_long_is_refused(tmp_path: Path) -> None:
    described = load_loop(written(tmp_path, ("delay: 20ms", "delay: 3s")))
    with pytest.raises(InputError, match="no controller is designed for a delay of 3"):
        described.loop()


@pytest.mark.parametrize(
    ("denominator", "period", "doubt"),
    [
        ("[1000, 1]", "10ms", "time constant is 1000 s beside a period of 10"),
        ("[0.00001, 1]", "100ms", "settles within a period"),
        ("[1, 1]", "100ms", None),
    ],
)
def test_units_that_look_wrong_are_doubted(
    denominator: str, period: str, doubt: str | None, tmp_path: Path
) -> None:
    changes = ("[1, 0, -1]", denominator), ("period: 100ms", f"period: {period}")
    path = written(tmp_path, *changes, ("delay: 20ms", "delay: 5ms"))
    doubts = load_loop(path).problem().doubts
    assert bool(doubts) == (doubt is not None)
    assert all(doubt in text for text in doubts if doubt)
