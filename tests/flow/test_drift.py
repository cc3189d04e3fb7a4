"""Slots that follow a timer: an hour of a timer that is some ppm off, as a drift watch sees it."""

import random
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest
from applied_plans import one_server_plan

from chainshaper.enforcement.back_ends import Choice
from chainshaper.flow.apply import _Run
from chainshaper.flow.drift import TimerTrack
from chainshaper.planning.application_plan import whole

MS, S = 1_000_000, 1_000_000_000
LEAD_NS, LOOK_NS, NOISE_NS = 2 * MS, 10 * S, 30_000


def waits_of(ppm: float, *, looks: bool = True) -> tuple[list[int], TimerTrack, int]:
    """How long before its slot the timer expires, look by look for an hour, and how often the
    slots have moved. A thread that waits begins as its slot opens, else with its timer.
    """
    noise, track = random.Random(1), TimerTrack(LEAD_NS, 0, looks=looks)
    waits, moves = [], 0
    for now_ns in range(LOOK_NS, 3600 * S, LOOK_NS):
        opens_ns = track.opens_ns
        waits.append(opens_ns + LEAD_NS - round(ppm * now_ns / 1e6))
        seen_ns = max(0, -waits[-1]) + round(noise.gauss(0, NOISE_NS))
        moves += track.saw(seen_ns, now_ns) != opens_ns
    return waits, track, moves


@pytest.mark.parametrize("ppm", [0, 0.5, 5, -5, 50, -50])
def test_slots_stay_by_their_timer_for_an_hour(ppm: float) -> None:
    """50 ppm off it moves by 180 ms in that time."""
    waits, track, moves = waits_of(ppm)
    assert min(waits[6:]) > -1.2 * MS, "it begins hardly behind the margin of 1 ms"
    assert min(waits[:6]) > -1.6 * MS, "before the rate is known"
    assert max(waits) < 3 * MS
    assert abs(track.rate * 1e6 - ppm) < 0.5
    if abs(ppm) < 1:
        assert moves < 40, "where nothing drifts, slots hardly move"


def test_without_looking_a_timer_that_falls_behind_is_followed() -> None:
    waits, _, _ = waits_of(50, looks=False)
    assert min(waits) > -1.2 * MS
    assert waits_of(0, looks=False)[2] == 0


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("back_end", ["scx", "litmus", "freezer", "fifo"])
def test_every_back_end_that_gates_follows_a_phase_that_was_measured(
    tmp_path: Path, back_end: str, measured: bool
) -> None:
    plan, armed = whole(one_server_plan()), list[int]()
    seen = {"latest_ns": MS, "looks": 1, "expect": lambda _: None}  # the timer, in the open slot
    here: Any = SimpleNamespace(path=tmp_path / "j", strangers=None, arm=armed.append, **seen)
    run = _Run(plan, plan, Choice(back_end, ""), here, (), frozenset(), Event())
    run.waits_ns, run.found = [LEAD_NS] * measured, here
    run.begin_state((), "")
    moved = next(run.follow(here, [here]))
    follows = measured and back_end != "fifo"
    assert (moved, armed) == ((MS + LEAD_NS, [MS + LEAD_NS]) if follows else (0, []))
