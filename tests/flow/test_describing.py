"""Descriptions of recordings: what they say, and that they simulate to the same latencies."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from reference_traces import reference_folder

from chainshaper.analysis import analyse_latency
from chainshaper.flow.describing import application_file
from chainshaper.simulation import simulate
from chainshaper.sources import open_source
from chainshaper.values.recording import Recording, open_recording
from chainshaper.workload.description import Application, load_application

ROBOT = """
name: robot
chain: /rear../command
seed: 3
scheduling:
  executors: {core: 1, priority: 80}
  dds: {core: 0, priority: 90}
nodes:
  rear:
    core: 2
    callbacks: [{timer: 100ms, execution: {uniform: [1ms, 2ms]}, publishes: [/rear]}]
  front:
    core: 3
    callbacks:
      - {timer: 100ms, phase: 7ms, execution: {uniform: [1ms, 2ms]}, publishes: [/front]}
  fusion:
    core: 4
    callbacks:
      - {synchronises: [/rear, /front], execution: {uniform: [3ms, 5ms]}, publishes: [/fused]}
  planner:
    callbacks:
      - subscription: /fused
        execution: {samples: [8ms, 9ms, 10ms, 11ms, 12ms, 9ms, 8ms, 10ms, 9ms, 41ms]}
        publishes: [/command]
  alarm:
    priority: 85
    callbacks: [{timer: 20ms, phase: 3ms, execution: {constant: 2ms}}]
  mapping:
    executor: multi_threaded
    threads: 2
    cores: [5, 6]
    callback_groups: {map: mutually_exclusive}
    callbacks:
      - {timer: 50ms, execution: {constant: 30ms}, group: map}
      - {subscription: /fused, execution: {uniform: [10ms, 20ms]}}
"""
TRACES = {  # and their chains
    "jazzy_chain_cyclonedds": "/t1../t5",
    "jazzy_chain_fastrtps_async": "/t1../t5",
    "jazzy_avp_cyclonedds": "/lidar_rear/points_raw../localization/ndt_pose",
    "humble_sync": "/topic_a../topic_b",
}


@pytest.fixture
def robot(tmp_path: Path) -> Recording:
    (tmp_path / "robot.yaml").write_text(ROBOT)
    described = load_application(tmp_path / "robot.yaml")
    return simulate(described, tmp_path / "robot", cycles=200)


def _described(recording: Recording | Path, folder: Path, chain: str | None = None) -> Application:
    text, _ = application_file(recording, chain)
    (folder / "described.yaml").write_text(text)
    return load_application(folder / "described.yaml")


def _near(recording: Recording, described: Application, folder: Path, chain: str) -> None:
    """The average of what is described is within 2 %, and the longest within 5 %."""
    latencies = analyse_latency(recording, chain).traversals["latency_ns"].drop_nulls()
    again = simulate(described, folder / "again", cycles=3 * len(latencies))
    simulated = analyse_latency(again, chain).traversals["latency_ns"].drop_nulls()
    assert simulated.mean() == pytest.approx(latencies.mean(), rel=0.02)
    assert simulated.max() == pytest.approx(latencies.max(), rel=0.05)


@pytest.mark.parametrize("trace", TRACES)
def test_a_real_trace_is_described_as_it_was(tmp_path: Path, trace: str) -> None:
    source, chain = reference_folder(trace) / "trace", TRACES[trace]
    recording = open_source(source)
    _near(recording, _described(recording, tmp_path, chain), tmp_path, chain)


def test_a_start_up_that_is_not_described_is_said() -> None:
    """Its first message waits a cycle for a set; the next longest latency is 42.9 ms."""
    source = reference_folder("jazzy_avp_cyclonedds") / "trace"
    _, notes = application_file(source, "/lidar_front/points_raw../localization/ndt_pose")
    said = notes[-1]
    assert "42.9" in said
    assert "133.723 ms. The longest was recorded 0.0 s behind the first" in said


def test_synchronisers_whose_sets_one_input_completes_have_a_trigger(tmp_path: Path) -> None:
    """Every fused output of this trace is published inside the callback of the front input."""
    source = reference_folder("jazzy_avp_cyclonedds") / "trace"
    described = _described(source, tmp_path, TRACES["jazzy_avp_cyclonedds"])
    (fusion,) = described.nodes["point_cloud_fusion"].callbacks
    assert {*fusion.synchronises} == {
        "/lidar_front/points_filtered",
        "/lidar_rear/points_filtered",
    }
    assert fusion.triggered_by == "/lidar_front/points_filtered"
    throttler = described.nodes["points_throttler"].callbacks
    assert [one.publishes for one in throttler] == [
        ("/lidar_front/points_raw",),
        ("/lidar_rear/points_raw",),  # registered first, but always called behind the other
    ]


def _without_scheduling(recording: Recording) -> Recording:
    return replace(recording, info=recording.info.model_copy(update={"threads": ()}))


@pytest.mark.parametrize("recorded", [True, False])
def test_a_robot_is_described_as_it_was(tmp_path: Path, robot: Recording, recorded: bool) -> None:
    """Cores, priorities, phases, inputs and threads; also where events alone tell of them."""
    source = robot if recorded else _without_scheduling(robot)
    described = _described(source, tmp_path)
    cores = {name: described.cores_of(name) for name in described.nodes}
    assert {name: cores[name] for name in ("rear", "front", "fusion", "planner", "alarm")} == {
        "rear": (2,),
        "front": (3,),
        "fusion": (4,),
        "planner": (1,),
        "alarm": (1,),
    }
    assert {*cores["mapping"]} == {5, 6}
    priorities = {name: described.scheduling_of(name).priority for name in described.nodes}
    assert priorities["alarm"] > priorities["planner"]
    assert not recorded or (priorities["alarm"], priorities["planner"]) == (85, 80)
    phases = {name: described.nodes[name].callbacks[0].phase_ns for name in ("front", "alarm")}
    assert phases["front"] == pytest.approx(7_000_000, abs=200_000)
    assert phases["alarm"] == pytest.approx(3_000_000, abs=200_000)
    (fusion,) = described.nodes["fusion"].callbacks
    assert {*fusion.synchronises} == {"/rear", "/front"}
    assert fusion.triggered_by is None
    assert described.nodes["mapping"].threads == 2
    groups = [callback.group for callback in described.nodes["mapping"].callbacks]
    assert groups[0] != groups[1]
    _near(robot, described, tmp_path, "/rear../command")


def test_the_longest_and_the_shortest_time_are_in_a_description(
    tmp_path: Path, robot: Recording
) -> None:
    (planner,) = _described(robot, tmp_path).nodes["planner"].callbacks
    times = planner.execution.sequence_ns or ()
    assert min(times) == pytest.approx(8_000_000, rel=0.05)
    assert max(times) == pytest.approx(41_000_000, rel=0.05)
    assert sum(time > 40_000_000 for time in times) == pytest.approx(20, abs=12)  # one of ten


def test_what_a_recording_cannot_tell_is_said(robot: Recording) -> None:
    text, notes = application_file(_without_scheduling(robot))
    assert any(note.startswith("Priorities of") for note in notes)
    assert any(note.startswith("Cores and priorities of DDS threads") for note in notes)
    assert any(note.startswith("Simulated, /rear../command takes") for note in notes)
    head = " ".join(line.lstrip("# ") for line in text.splitlines() if line.startswith("#"))
    assert all(note in head for note in notes)


def test_long_recordings_have_the_cycles_with_extremes_written(
    tmp_path: Path, robot: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("chainshaper.flow.describing.MOST_VALUES", 600)
    whole, _ = application_file(robot)
    values: dict[str, Any] = yaml.safe_load(whole)
    (planner,) = values["nodes"]["planner"]["callbacks"]
    assert len(planner["execution"]["sequence"]) < 150
    described = _described(robot, tmp_path)
    times = described.nodes["planner"].callbacks[0].execution.sequence_ns or ()
    assert max(times) == pytest.approx(41_000_000, rel=0.05)


LOOP = """
name: to the actuator
chain: /scan../controller
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  lidar: {callbacks: [{timer: 20ms, execution: {constant: 1ms}, publishes: [/scan]}]}
  planner: {callbacks: [{subscription: /scan, execution: {constant: 2ms}, publishes: [/command]}]}
  controller: {callbacks: [{loop: 10ms, reads: [/command], execution: {constant: 1ms}}]}
"""


LOOPS = {  # what its loop publishes, and the chain
    "silent": ("", "/scan../controller"),
    "publishing": (", publishes: [/drive]", "/scan../drive"),
    "read by others": (", publishes: [/drive]", "/scan../wheels"),
}
WHEELS = """
  motor:
    callbacks:
      - {subscription: /drive, execution: {constant: 300us}, publishes: [/wheels]}
"""


@pytest.mark.parametrize(("publishes", "chain"), LOOPS.values(), ids=LOOPS)
def test_a_loop_is_described_as_one_and_its_latency_and_ages_come_out_again(
    tmp_path: Path, publishes: str, chain: str
) -> None:
    text = LOOP.replace("{constant: 1ms}}]}", "{uniform: [1ms, 2ms]}" + publishes + "}]}")
    text = text.replace("/scan../controller", chain) + (WHEELS if "wheels" in chain else "")
    (tmp_path / "app.yaml").write_text(text)
    recording = simulate(load_application(tmp_path / "app.yaml"), tmp_path / "r", cycles=100)
    described = _described(recording, tmp_path)
    (loop,) = (c for c in described.nodes["controller"].callbacks if c.loop_ns is not None)
    assert (loop.loop_ns, loop.reads) == (10_000_000, ("/command",))
    again = simulate(described, tmp_path / "again", cycles=100)
    figures = list[tuple[Any, ...]]()
    for measured in (recording, again):
        analysis = analyse_latency(measured, measured.info.chain or "")
        age, latencies = analysis.data_age, analysis.statistics
        assert age is not None
        of_ages = (age.at_loop_ns.mean(), age.at_loop_ns.max())
        figures.append((age.uses, *of_ages, latencies.mean_ns, latencies.max_ns))
    recorded, simulated = figures
    assert simulated[0] == recorded[0]
    assert simulated[1:] == pytest.approx(recorded[1:], rel=0.02)


def test_the_example_of_a_loop_is_described_as_one(tmp_path: Path) -> None:
    """Its subscription has a process with the loop, whose thread is another one."""
    example = Path(__file__).parents[2] / "examples/write_loop.py"
    subprocess.run([sys.executable, str(example), str(tmp_path / "r")], check=True)
    recording = open_recording(tmp_path / "r")
    described = _described(recording, tmp_path, "/scan../command")
    (loop,) = described.nodes["controller"].callbacks
    assert (loop.loop_ns, loop.reads, loop.publishes) == (10_000_000, ("/scan",), ("/command",))
    again = simulate(described, tmp_path / "again", cycles=200)
    figures = []
    for measured in (recording, again):
        analysis = analyse_latency(measured, "/scan../command")
        assert analysis.data_age is not None
        figures.append((analysis.statistics.mean_ns, analysis.data_age.at_loop_ns.mean()))
    assert figures[1] == pytest.approx(figures[0], rel=0.02)
