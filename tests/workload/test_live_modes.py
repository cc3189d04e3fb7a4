"""Modes in a real run: a node announces them, and the shaping node changes its slot."""

from itertools import pairwise
from pathlib import Path

import polars as pl
import pytest
from calm_runs import calm_run
from small_chain import EXECUTOR_CORE, small_chain_text

from chainshaper import measure_latency, profile_chains, shape_application
from chainshaper.planning import Modes, Plan
from chainshaper.planning.plan import revised
from chainshaper.splicing.application import splice_application
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application, load_application

MS = 1_000_000
SLOTS = ((20 * MS, 21 * MS), (35 * MS, 36 * MS))
BANDS = {"city": 2, "highway": 1}
ANNOUNCED = ("highway", "city")
# The driver's timer expires in the middle of a cycle, once in three.
DRIVER = f"""\
  driver:
    core: {EXECUTOR_CORE}
    callbacks:
      - {{timer: 150ms, phase: 25ms, announces: [{", ".join(ANNOUNCED)}], publishes: [/mode]}}
topics:
"""


def with_driver(folder: Path, driver: str = DRIVER) -> Application:
    path = folder / "with_driver.yaml"
    path.write_text(small_chain_text().replace("topics:\n", driver))
    return load_application(path)


def with_modes(plan: Plan) -> Plan:
    """The plan of the small chain, with a second slot before its own."""
    servers = tuple(
        server.model_copy(update={"slots": SLOTS}) if server.name == "output" else server
        for server in plan.servers
    )
    return revised(plan, servers=servers, modes=Modes(topic="/mode", default="city", bands=BANDS))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, plan: Plan) -> Recording:
    folder = tmp_path_factory.mktemp("modes")
    application = with_driver(folder)
    return calm_run(
        lambda place: shape_application(application, with_modes(plan), place / "rec", cycles=24),
        folder,
    )


def test_each_output_leaves_in_the_slot_of_its_mode(recording: Recording) -> None:
    releases = recording.events["gate_release"].filter(pl.col("overrun").is_null())
    assert set(releases["mode"]) == set(BANDS)
    for mode, band in BANDS.items():
        own = releases.filter(pl.col("mode") == mode)
        assert set(own["slot"]) == {band - 1}
        since_start = own["release"] - own["origin"]
        start, end = SLOTS[band - 1]
        assert since_start.is_between(start, end - 1).all()
    measured = measure_latency(recording)
    assert measured.analysis.chain.topics == ("/t1", "/t2", "/t3_tmp", "/t3")
    assert measured.analysis.statistics.incomplete == 0


def test_a_change_is_in_force_from_the_next_cycle_on(recording: Recording) -> None:
    listening = recording.events["rcl_subscription_init"].filter(topic_name="/mode")
    own = ["pid", "rmw_subscription_handle"]
    heard = recording.events["rmw_take"].join(listening, on=own, how="semi")["time"].to_list()
    releases = recording.events["gate_release"].select("mode", "origin").rows()
    changes = [(before, after) for (old, before), (new, after) in pairwise(releases) if old != new]
    assert len(changes) >= len(heard) - 2 > 2, "each announcement is another mode"
    for before, after in changes:
        # It was heard after the last cycle of the old mode began, and before the new one's did.
        assert any(before - MS <= time <= after + MS for time in heard)


def test_the_gate_and_the_profile_take_each_cycle_for_one_of_the_same_mode(
    recording: Recording,
) -> None:
    """The gate read the announcements, the profile counts them, from before the recording on."""
    modes = Modes(topic="/mode", default="city", bands=BANDS)
    (profile,) = profile_chains(recording, modes=modes)
    measured = measure_latency(recording).analysis
    complete = measured.traversals.filter("complete")
    decided = measured.releases.join(complete, on="traversal", how="semi")
    for mode in BANDS:
        assert profile.of_modes[mode].every.size == decided.filter(mode=mode).height > 0


def test_modes_that_nobody_announces_are_refused(tmp_path: Path, plan: Plan) -> None:
    silent = with_driver(tmp_path, DRIVER.replace(f"announces: [{', '.join(ANNOUNCED)}], ", ""))
    with pytest.raises(InputError, match=r"named on /mode, but no callback .*`announces`"):
        splice_application(silent, with_modes(plan))
