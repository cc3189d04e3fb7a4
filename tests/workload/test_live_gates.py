"""Gates in live runs: logical execution time, several messages a cycle, and modes."""

import os
from itertools import pairwise
from pathlib import Path

import polars as pl
import pytest
from calm_runs import calm_run
from small_chain import DDS_CORE, EXECUTOR_CORE, PERIOD_NS, small_chain, small_chain_text

from chainshaper import (
    measure_latency,
    plan_recording,
    profile_chains,
    run_application,
    shape_application,
    simulate,
)
from chainshaper.planning import ChainPlan, Modes, Plan, PlanRequest
from chainshaper.planning.chain_plan import revised
from chainshaper.robot.handover import page_folders
from chainshaper.splicing.application import splice_application
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import AS_YAML
from chainshaper.workload.description import Application, load_application

pytestmark = pytest.mark.timed


def test_let_per_callback_has_no_jitter_of_a_period(tmp_path: Path, unshaped: Recording) -> None:
    """The slot of /t1 comes behind the end of fast callbacks, in the same cycle."""
    application = small_chain(tmp_path)
    plan = plan_recording(unshaped, request=PlanRequest(policy="let-per-callback")).chains[0]
    shaped = shape_application(application, Plan.of(plan), tmp_path / "shaped", cycles=20)

    releases = shaped.events["gate_release"].filter(pl.col("overrun").is_null())
    held = releases.select("pid", "cycles_waited", since=pl.col("release") - pl.col("origin"))
    each = held.group_by("pid").agg(pl.all().unique())
    assert sorted(each["cycles_waited"].to_list()) == [[1], [2], [3]], "of the three gates"
    latencies = measure_latency(shaped).analysis.traversals["latency_ns"].drop_nulls()
    # A thread that woke behind its slot is an overrun, and later by whole cycles.
    assert latencies.min() >= 3 * PERIOD_NS  # type: ignore[operator]
    assert (latencies < 3.5 * PERIOD_NS).sum() >= 0.8 * latencies.len()
    simulated = simulate(application, tmp_path / "simulated", Plan.of(plan), cycles=20)
    assert measure_latency(simulated).analysis.statistics.jitter_ns == 0


def test_a_run_that_ends_leaves_no_page_of_its_outputs(tmp_path: Path, plan: ChainPlan) -> None:
    shape_application(small_chain(tmp_path), Plan.of(plan), tmp_path / "run", cycles=5)
    left = [
        page
        for folder in page_folders()
        for page in (Path(folder).iterdir() if Path(folder).exists() else ())
        if page.name.startswith("live.") and page.stat().st_uid == os.geteuid()
    ]
    assert left == []


def application_of(messages: str, depth: int) -> Application:
    """A source with ten messages in every cycle of the gate."""
    timer = {"timer": "5ms", "publishes": ("/in",)}
    gate = {"slots": (("20ms", "45ms"),), "cycle": "50ms", "anchor": "cycle", "depth": depth}
    shape = {"subscription": "/in", "publishes": ("/out",), "gate": {**gate, "messages": messages}}
    described = {
        "name": "fast",
        "chain": "/in../out",
        "scheduling": {
            "executors": {"core": EXECUTOR_CORE, "priority": 80},
            "dds": {"core": DDS_CORE, "priority": 90},
        },
        "nodes": {
            "source": {"callbacks": (timer,)},
            "shaper": {"priority": 85, "callbacks": (shape,)},
            "sink": {"callbacks": ({"subscription": "/out"},)},
        },
    }
    return Application.model_validate(described, context=AS_YAML)


@pytest.mark.parametrize(
    ("messages", "depth", "lost"),
    [
        ("all-in-order", 20, set()),
        ("all-in-order", 2, {"overflowed"}),
        ("newest", 20, {"replaced"}),
    ],
)
def test_what_comes_in_comes_out_or_is_counted(
    tmp_path: Path, messages: str, depth: int, lost: set[str]
) -> None:
    application = application_of(messages, depth)
    recording = run_application(application, tmp_path / "recording", cycles=100)

    def timestamps(node: str) -> set[int]:
        (pid,) = (pid for pid, name in recording.info.processes.items() if name == node)
        return set(recording.events["rmw_publish"].filter(pid=pid)["timestamp"])

    rows = recording.events["gate_release"]
    # What DDS loses on a machine that is busy with others has no row; the traversals count it.
    unseen = timestamps("/source") - set(rows["source_timestamp"])
    measured = measure_latency(recording)
    incomplete, dropped = measured.analysis.incomplete, measured.dropped
    assert len(unseen) == sum(n for why, n in incomplete.items() if why != "discarded")
    assert len(unseen) <= 0.1 * rows.height
    assert dropped is not None
    assert rows.height == len(timestamps("/shaper")) + sum(dropped.values())
    if not lost:  # a gate that a busy machine keeps from its core for long loses some
        assert sum(dropped.values()) <= 0.1 * rows.height
    else:
        assert dropped.keys() >= lost
    left = rows.filter(pl.col("release").is_not_null())
    assert left["source_timestamp"].is_sorted(), "in the order they came"
    assert set(left["anchor"]) == {"cycle"}
    if messages == "first":
        held = left.filter(pl.col("release") > pl.col("arrival"))["release"]
        assert held.len() > 0
        assert set((held - held[0]) % PERIOD_NS) == {0}, "strictly periodic"


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


def with_modes(plan: ChainPlan) -> ChainPlan:
    """The plan of the small chain, with a second slot before its own."""
    servers = tuple(
        server.model_copy(update={"slots": SLOTS}) if server.name == "output" else server
        for server in plan.servers
    )
    return revised(plan, servers=servers, modes=Modes(topic="/mode", default="city", bands=BANDS))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, plan: ChainPlan) -> Recording:
    folder = tmp_path_factory.mktemp("modes")
    application = with_driver(folder)
    return calm_run(
        lambda place: shape_application(
            application, Plan.of(with_modes(plan)), place / "rec", cycles=24
        ),
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


def test_modes_that_nobody_announces_are_refused(tmp_path: Path, plan: ChainPlan) -> None:
    silent = with_driver(tmp_path, DRIVER.replace(f"announces: [{', '.join(ANNOUNCED)}], ", ""))
    with pytest.raises(InputError, match=r"named on /mode, but no callback .*`announces`"):
        splice_application(silent, Plan.of(with_modes(plan)))
