"""The border to the engine in C++: names alike on both sides, and no description that hurts it."""

import numpy as np
import pytest

from chainshaper import _core
from chainshaper.workload.event_log import LAYOUT


def described(**fields: object) -> _core.Description:
    """A timer that expires every 10 ns, up to 100."""
    timer = _core.EntityDescription(kind=_core.EntityKind.timer, period_ns=10, due_ns=10)
    description = _core.Description(
        cores=[_core.CoreDescription()],
        threads=[_core.ThreadDescription(tid=7, pid=6, cpu=5)],
        processes=[_core.ProcessDescription(entity_count=1)],
        entities=[timer],
        streams=[0],
        stop_ns=100,
        last_timer_ns=100,
    )
    for name, value in fields.items():
        setattr(description, name, value)
    return description


def no_draws(stream: int) -> np.ndarray:
    raise AssertionError(stream)


def test_the_log_has_the_names_of_live_ones() -> None:
    simulation = _core.Simulation(described(), no_draws)
    assert simulation.run(1000) == _core.Pause.over
    log = simulation.take_log()
    beside = {"time", "thread", "pid", "tid", "cpu"}
    for name, columns in log.items():
        if name != "context_switch":
            assert tuple(field for field in columns if field not in beside) == LAYOUT[name]
    # A simulated machine has no stalls, and its messages carry no plant's numbers.
    assert LAYOUT.keys() - log.keys() == {"machine_stall", "plant_step"}
    ended = log["callback_end"]
    assert ended["time"].tolist() == list(range(10, 101, 10))
    assert (set(ended["tid"]), set(ended["pid"]), set(ended["cpu"])) == ({7}, {6}, {5})
    assert simulation.take_log()["callback_end"]["time"].size == 0


def test_numbers_are_drawn_block_by_block() -> None:
    asked = []

    def draw(stream: int) -> np.ndarray:
        asked.append(stream)
        return np.array([3, 1, 2])

    timer = _core.EntityDescription(
        kind=_core.EntityKind.timer, period_ns=10, due_ns=10, execution=1
    )
    simulation = _core.Simulation(described(entities=[timer], streams=[0, None]), draw)
    assert simulation.run(1000) == _core.Pause.over
    ends = simulation.take_log()["callback_end"]["time"]
    assert ends.tolist()[:5] == [13, 21, 32, 43, 51]
    assert asked == [1] * 4


@pytest.mark.parametrize("drawn", [[-1], []])
def test_what_is_drawn_must_be_times(drawn: list[int]) -> None:
    simulation = _core.Simulation(
        described(streams=[None]), lambda _: np.array(drawn, dtype=np.int64)
    )
    with pytest.raises(ValueError, match=r"time|numbers"):
        simulation.run(1000)


def test_an_error_in_drawing_is_the_callers() -> None:
    simulation = _core.Simulation(described(streams=[None]), no_draws)
    with pytest.raises(AssertionError):
        simulation.run(1000)


@pytest.mark.parametrize(
    "wrong",
    [
        {"streams": []},
        {"threads": []},
        {"processes": []},
        {"cores": []},
        {"quantum_ns": 0},
        {"stop_ns": -1},
        {"log_rows": 0},
        {"processes": [_core.ProcessDescription(first_entity=1, entity_count=2**60)]},
    ],
    ids=str,
)
def test_a_description_without_sense_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="cannot have"):
        _core.Simulation(described(**wrong), no_draws)


def test_fields_and_words_that_there_are_not_are_refused() -> None:
    with pytest.raises(AttributeError):
        _core.CoreDescription(slots=[])  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="'soon' is not a word"):
        _core.GateDescription(overrun="soon")
