"""Slots of modes, placed from each mode's own latencies; the length Δ of a publish slot."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper import load_plan, plan_recording, profile_chains, save_plan, simulate
from chainshaper.planning import (
    Modes,
    Plan,
    PlanRequest,
    Profile,
    plan_chain,
    plan_warnings,
    publish_slots,
)
from chainshaper.planning.request import place_modes
from chainshaper.values.errors import InputError, OperationError
from chainshaper.workload.description import load_application

MS = 1_000_000
CITY_HIGHWAY = Modes(topic="/mode", default="city", bands={"city": 2, "highway": 1}, late="publish")
FOUND = PlanRequest(modes=CITY_HIGHWAY, bands_of_modes="found", epsilon_ns=MS)
# In the city a tracker, more urgent than the planner, takes 8 ms of each cycle; a change is
# announced in the middle of a cycle, four cycles after the one before.
ROBOT = """\
name: robot
chain: /scan../command
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  lidar: {callbacks: [{timer: 40ms, execution: {uniform: [2ms, 4ms]}, publishes: [/scan]}]}
  planner:
    callbacks:
      - {subscription: /scan, execution: {uniform: [3ms, 9ms]}, publishes: [/command]}
  driver:
    callbacks:
      - {timer: 160ms, phase: 140ms, announces: [highway, city], publishes: [/mode]}
  tracker:
    priority: 85
    callbacks:
"""
ROBOT += "".join(
    f"      - {{timer: 320ms, phase: {cycle * 40 + 4}ms, execution: {{constant: 8ms}}}}\n"
    for cycle in range(4)
)


def _profile(**more: Any) -> Profile:
    """City: 20 … 30 ms; highway: 5 … 12 ms, and a cycle of 15 ms that the machine disturbed."""
    latencies = {"city": np.arange(20, 31) * MS, "highway": np.arange(5, 13) * MS}
    apart = {mode: Profile(own, 100 * MS) for mode, own in latencies.items()}
    every = np.append(latencies["highway"], 15 * MS)
    apart["highway"] = replace(apart["highway"], every_latency_ns=every, disturbed=1)
    whole = np.concatenate(list(latencies.values()))
    return Profile(whole, 100 * MS, topics=("/out",), nodes=("/n",), of_modes=apart, **more)


def test_each_mode_has_the_slot_of_its_own_latencies(tmp_path: Path) -> None:
    """Eq. 1 for each: [13, 14) behind 12 ms, [31, 32) behind 30 ms."""
    for request in (replace(FOUND, bands_of_modes="given", bands=2), FOUND):
        plan = plan_chain(_profile(), request)
        assert publish_slots(plan) == ((13 * MS, 14 * MS), (31 * MS, 32 * MS))
        assert plan.servers[0].slots == ((0, 31 * MS),), "the chain's server covers all modes"
        assert plan.modes == CITY_HIGHWAY
    measured, promised = plan.evidence.modes or {}, plan.predicted.modes or {}
    own = measured["highway"]
    assert (own.samples, own.min_latency_ns, own.max_latency_ns) == (8, 5 * MS, 12 * MS)
    assert (own.disturbed, plan.evidence.samples, plan.evidence.disturbed) == (1, 19, 1)
    assert (promised["city"].max_ns, promised["city"].jitter_ns) == (32 * MS, MS)
    assert plan.predicted.shares == pytest.approx((8 / 19, 11 / 19))
    assert plan.predicted.mean_ns == round((8 * 14 + 11 * 32) / 19 * MS)
    save_plan(Plan.of(plan), tmp_path / "plan.yaml")
    assert load_plan(tmp_path / "plan.yaml") == Plan.of(plan)
    # By default each mode's margin covers its own disturbed cycles: 1 ms behind 15 ms.
    plan = plan_chain(_profile(), replace(FOUND, epsilon_ns=None))
    assert publish_slots(plan) == ((16 * MS, 17 * MS), (31 * MS, 32 * MS))
    assert any("small: 9 cycles of a mode" in warning for warning in plan_warnings(plan))
    shared = CITY_HIGHWAY.model_copy(update={"bands": {"city": 1, "highway": 1}})
    plan = plan_chain(_profile(), PlanRequest(modes=shared, epsilon_ns=MS))
    assert publish_slots(plan) == ((31 * MS, 32 * MS),), "modes that share a band are both covered"
    said = "the modes city, highway have the same slot, [31.000, 32.000) ms"
    assert any(said in warning for warning in plan_warnings(plan))


@given(
    starts=st.dictionaries(st.sampled_from("abcdef"), st.integers(0, 60), min_size=1),
    length=st.integers(1, 12),
    numbers=st.data(),
)
def test_slots_cover_their_modes_and_do_not_overlap(
    starts: dict[str, int], length: int, numbers: st.DataObject
) -> None:
    found, found_slots = place_modes(starts, length)
    drawn = {mode: numbers.draw(st.integers(1, len(starts))) for mode in starts}
    places = sorted(set(drawn.values()))
    for wanted in (None, {mode: places.index(band) + 1 for mode, band in drawn.items()}):
        bands, slots = place_modes(starts, length, wanted)
        assert bands == (wanted or found)
        assert len(slots) == max(bands.values())
        assert all(slots[band - 1][0] >= starts[mode] for mode, band in bands.items())
        assert all(before[1] <= after[0] for before, after in pairwise(slots))
    # Who waits for a mode of the same band, or for the slot before, waits less than 2 Δ.
    assert all(found_slots[found[m] - 1][0] - starts[m] < 2 * length for m in starts)


def test_what_no_mode_asks_for_is_refused() -> None:
    gap = Modes(topic="/m", default="city", bands={"city": 3, "highway": 1})
    for profile, request, reason in (
        (_profile(), replace(FOUND, bands=3), r"--bands places .* here 2: leave it out"),
        (_profile(), replace(FOUND, max_gap_ns=20 * MS), "--max-gap places latency bands, but"),
        (replace(_profile(), of_modes={}), FOUND, "nothing says which mode .*--mode-profile"),
        (_profile(), PlanRequest(modes=gap), "no mode has the band 2"),
    ):
        with pytest.raises(InputError, match=reason):
            plan_chain(profile, request)


def test_no_output_is_late_in_any_mode(tmp_path: Path) -> None:
    """From one recording; the gates of another run take each cycle for one of the same mode."""
    path = tmp_path / "robot.yaml"
    path.write_text(ROBOT)
    robot = load_application(path)
    recording = simulate(robot, tmp_path / "profile", cycles=2000)
    plan = plan_recording(recording, request=replace(FOUND, epsilon_ns=None)).chains[0]
    assert plan.modes is not None and plan.modes.bands == CITY_HIGHWAY.bands
    (whole,) = profile_chains(recording, modes=CITY_HIGHWAY)
    of_modes = [one.latencies_ns for one in whole.of_modes.values()]
    assert sorted(np.concatenate(of_modes)) == sorted(whole.latencies_ns)
    # With the first announcement, four cycles are left out, and no cycle has another mode.
    (later,) = profile_chains(recording, modes=CITY_HIGHWAY, since_ns=160 * MS)
    for mode, one in later.of_modes.items():
        assert 995 <= (size := one.latencies_ns.size) <= 1000
        assert np.array_equal(one.latencies_ns, whole.of_modes[mode].latencies_ns[-size:])
    shaped = simulate(robot, tmp_path / "shaped", Plan.of(plan), cycles=2000)
    releases = shaped.events["gate_release"]
    assert releases["overrun"].null_count() == releases.height == 2000
    for mode, (start, _) in zip(("highway", "city"), publish_slots(plan), strict=True):
        own, latencies = releases.filter(mode=mode), whole.of_modes[mode].latencies_ns
        assert own.height == 1000 == latencies.size
        assert start == latencies.max() + MS
        assert (own["time"] - own["origin"]).unique().to_list() == [start], "constant in each mode"
        assert (start < 16 * MS) == (mode == "highway"), (
            "9 + 4 ms and what messages take; or 8 more"
        )
    sea = CITY_HIGHWAY.model_copy(update={"bands": {**CITY_HIGHWAY.bands, "sea": 3}})
    with pytest.raises(OperationError, match=r"mode sea: .*/command none .*--mode-profile sea="):
        profile_chains(recording, modes=sea)
    (tmp_path / "sea.txt").write_text("30ms\n33ms\n")
    given_apart = {"sea": tmp_path / "sea.txt", "city": recording.path}
    (whole,) = profile_chains(recording, modes=sea, mode_recordings=given_apart)
    assert [whole.of_modes[mode].latencies_ns.size for mode in sea.bands] == [2000, 1000, 2]
    assert len(publish_slots(plan_chain(whole, replace(FOUND, modes=sea)))) == 3
    with pytest.raises(InputError, match="air: none of the modes city, highway"):
        profile_chains(recording, modes=CITY_HIGHWAY, mode_recordings={"air": recording.path})


@pytest.mark.parametrize(
    ("measured", "wishes", "length_ns", "source"),
    [
        ({"longest_publication_ns": 210_000}, {}, MS, "least"),
        ({"longest_publication_ns": 2_300_500}, {}, 2_301_000, "measured"),
        ({"longest_publication_ns": 2_300_500}, {"grid_ns": MS}, 3 * MS, "measured"),
        ({"longest_publication_ns": 2 * MS}, {"publish_slot_ns": 500_000}, 500_000, "given"),
        ({"longest_publication_ns": 9 * MS}, {"publication": "asynchronous"}, MS, "least"),
        ({"longest_send_ns": 600_000}, {"publication": "asynchronous"}, 2_400_000, "measured"),
        ({"longest_send_ns": 600_000}, {}, MS, "least"),
    ],
)
def test_a_publish_slot_is_as_long_as_the_longest_publication(
    measured: dict[str, Any], wishes: dict[str, Any], length_ns: int, source: str
) -> None:
    profile = replace(_profile(), of_modes={}, **measured)
    plan = plan_chain(profile, PlanRequest(**wishes))
    ((start, end),) = publish_slots(plan)
    assert (end - start, plan.evidence.publish_slot) == (length_ns, source)
    synchronous = wishes.get("publication") != "asynchronous"
    longest = measured.get("longest_publication_ns") if synchronous else None
    assert plan.evidence.longest_publication_ns == longest
