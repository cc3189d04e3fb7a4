"""The colcon package of a description: its files by hand, its distributions, and in ROS 2."""

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from command_line import called
from ros2 import ros2_environment

import chainshaper as cs
from chainshaper.analysis import data_flow
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.workload.description import ExecutionTime
from chainshaper.workload.execution import draw

ROOT = Path(__file__).parents[2]
SMALL = r"""
name: "<small> & 'odd'\n*/"
chain: /scan../fused
seed: 18446744073709551615
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
topics:
  /scan: {depth: 3, reliability: best_effort, lifespan: 20ms, payload: 7}
  /fused: {publication: asynchronous}
nodes:
  front/lidar:
    core: 0
    priority: 70
    callbacks: [{timer: 50ms, phase: 5ms, execution: {constant: 2ms}, publishes: [/scan, /map]}]
  fusion:
    dds_priority: 60
    callbacks:
      - synchronises: [/scan, /map]
        execution: {normal: [8ms, 2ms], within: [4ms, 14ms]}
        publishes: [/fused]
  log: {callbacks: [{subscription: /fused, execution: {samples: [1ms, 2ms], block: 2}}]}
  driver: {callbacks: [{timer: 4s, publishes: [/mode], announces: [city, 'a"\é']}]}
  threads:
    executor: multi_threaded
    threads: 3
    cores: [1, 0]
    callback_groups: {slow: reentrant, one: mutually_exclusive}
    callbacks: [{timer: 1s, group: slow}, {timer: 2s, group: one}, {timer: 3s}]
"""
DISTRIBUTIONS: dict[str, dict[str, Any]] = {
    "constant": {"constant_ns": 5_000_000},
    "uniform": {"uniform_ns": (1_000, 9_000)},
    "normal": {"normal_ns": (8_000, 2_000), "within_ns": (5_000, 9_000)},
    "samples": {"samples_ns": (10, 20, 20, 70, 100)},
    "stretches": {"samples_ns": tuple(range(50)), "block": 7},
}


def written(tmp_path: Path, text: str = SMALL) -> cs.Application:
    (tmp_path / "app.yaml").write_text(text)
    return cs.load_application(tmp_path / "app.yaml")


def test_a_package_has_what_the_description_says(tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    files = cs.generate_package(written(tmp_path), folder)
    assert {*files} == {path for path in folder.rglob("*") if path.is_file()}
    assert folder.stat().st_mode & 0o777 == 0o755
    package = ElementTree.parse(folder / "package.xml")  # noqa: S314 - our own
    assert package.findtext("name") == "robot"
    assert package.findtext("description") == "<small> & 'odd' */"
    assert "project(robot CXX)" in (folder / "CMakeLists.txt").read_text()
    table = (folder / "src/application.hpp").read_text()
    scan, data = '{"/scan", 3, false, 20000000, 7}', '{"/map", 10, true, 0, 1024}'
    fused, none = '{"/fused", 10, true, 0, 1024}', "{Distribution::constant, {}, 1}"
    started = "0, {}, -1, {Distribution::constant, {0}, 1}"
    for line in (
        '  {"/front/lidar", {0, 70}, {0, 90}, {0}, {',
        f"    {{50000000, 5000000, {{}}, -1, {{Distribution::constant, {{2000000}}, 1}}, {none}, "
        f'{{{scan}, {data}}}, {{}}, "", false}}',
        '  {"/fusion", {1, 80}, {0, 60}, {1}, {',
        f"    {{0, 0, {{{scan}, {data}}}, -1, {{Distribution::normal, "
        f'{{8000000, 2000000, 4000000, 14000000}}, 1}}, {none}, {{{fused}}}, {{}}, "", false}}',
        f"    {{0, 0, {{{fused}}}, -1, {{Distribution::samples, {{1000000, 2000000}}, 2}}, {none}, "
        '{}, {}, "", false}',
        '  {"/threads", {1, 80}, {0, 90}, {1, 0, 1}, {',
        f'    {{1000000000, {started}, {none}, {{}}, {{}}, "slow", true}}',
        f'    {{2000000000, {started}, {none}, {{}}, {{}}, "one", false}}',
        f'    {{3000000000, {started}, {none}, {{}}, {{}}, "", false}}',
        r'{"city", "a\042\134\303\251"}, "", false}}',
    ):
        assert line in table
    launch = (folder / "launch/robot.launch.py").read_text()
    assigned = {
        node.targets[0].id: node.value
        for node in ast.parse(launch).body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    assert ast.literal_eval(assigned["NODES"]) == [
        "/front/lidar", "/fusion", "/log", "/driver", "/threads",
    ]  # fmt: skip
    assert ast.literal_eval(assigned["ASYNCHRONOUS"]) == ["/fusion"]
    assert ast.literal_eval(assigned["LEAD_NS"]) == 7_000_000_000, "3 s and the longest period"
    assert "default_value='18446744073709551615'" in launch
    profiles = ElementTree.parse(folder / "launch/asynchronous.xml").iter()  # noqa: S314
    assert [one.get("profile_name") for one in profiles if one.get("profile_name")] == ["/fused"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"execution: {samples: [1ms, 2ms], block: 2}": "computes: json:loads"},
            "log: callback 0: `computes` .* describe its `execution`",
        ),
        (
            {"log: {callbacks: [{subscription": "log: {callbacks: [{kind: service, subscription"},
            "log: callback 0: `kind` .* remove `kind`",
        ),
        ({"[{subscription: /fused": "[{subscription: /mode"}, "`subscription` .* names of modes"),
        ({"[/scan, /map]}]": "[/scan, /map, /mode]}]"}, "front/lidar: .*`publishes` .* modes"),
        (
            {
                ", execution: {samples: [1ms, 2ms], block: 2}": ", publishes: [/out], "
                "gate: {cycle: 50ms, slots: [[0ms, 2ms]]}"
            },
            "log: callback 0: `gate` .* `chainshaper shape`",
        ),
        (
            {"[{subscription: /fused": "[{loop: 5ms, reads: [/fused]"},
            "log: callback 0: `loop` .* describe a `timer`",
        ),
    ],
)
def test_what_a_generated_node_cannot_do_is_refused(
    tmp_path: Path, change: dict[str, str], said: str
) -> None:
    ((old, new),) = change.items()
    assert old in SMALL
    with pytest.raises(cs.InputError, match=said):
        cs.generate_package(written(tmp_path, SMALL.replace(old, new)), tmp_path / "robot")
    assert [path.name for path in tmp_path.iterdir()] == ["app.yaml"]


@pytest.mark.parametrize("name", ["Robot", "1robot", "my-robot", "a__b", "robot_", "rclcpp", "r"])
def test_a_name_that_is_no_packages_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(cs.InputError, match=f"'{name}' cannot be the name of a package"):
        cs.generate_package(written(tmp_path), tmp_path / name)


def test_the_command_writes_a_package_once(tmp_path: Path) -> None:
    written(tmp_path)
    command = ["generate", str(tmp_path / "app.yaml"), "-o", str(tmp_path / "robot")]
    value = json.loads(called(*command, "--json").out)
    assert (value["package"], value["folder"]) == ("robot", str(tmp_path / "robot"))
    assert all(Path(file).is_file() for file in value["files"])
    again = called(*command)
    assert (again.code, "exists already" in again.err) == (2, True)


TRIGGERED = """
name: triggered
chain: /lidar../fused
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  camera: {callbacks: [{timer: 20ms, execution: {constant: 1ms}, publishes: [/camera]}]}
  lidar:
    callbacks:
      - timer: 100ms
        phase: 10ms
        execution: {constant: 1ms}
        afterwards: {constant: 7ms}
        publishes: [/lidar]
  fusion:
    callbacks:
      - {synchronises: [/lidar, /camera], triggered_by: /lidar, publishes: [/fused]}
  motor: {callbacks: [{subscription: /fused}]}
"""


def test_what_a_described_recording_has_is_generated(tmp_path: Path) -> None:
    """Work behind the publications, and the input that triggers a set, by its number."""
    cs.generate_package(written(tmp_path, TRIGGERED), tmp_path / "robot")
    text = (tmp_path / "robot/src/application.hpp").read_text()
    (lidar,) = (line for line in text.splitlines() if "100000000, 10000000" in line)
    assert "{Distribution::constant, {1000000}, 1}, {Distribution::constant, {7000000}, 1}" in lidar
    (fusion,) = (line for line in text.splitlines() if '"/camera"' in line and '"/lidar"' in line)
    assert '{"/camera", 10, true, 0, 1024}}, 0, {Distribution' in fusion


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_times_are_drawn_and_spent_as_the_live_workload_does(tmp_path: Path) -> None:
    nodes = "".join(
        f"\n  {name}: {{callbacks: [{{timer: 1s, execution: {json.dumps(_yaml(one))}}}]}}"
        for name, one in DISTRIBUTIONS.items()
    )
    head = "name: d\nchain: constant\nscheduling: {executors: {core: 0, priority: 1}, "
    application = written(tmp_path, head + "dds: {core: 0, priority: 1}}\nnodes:" + nodes)
    cs.generate_package(application, tmp_path / "robot")
    (tmp_path / "draw.cpp").write_text(
        '#include <cstdio>\n#include "application.hpp"\n'
        "int main() {\n"
        "  const auto cpu = [] { return clock_ns(CLOCK_THREAD_CPUTIME_ID); };\n"
        "  const auto begun = cpu();\n"
        "  spend(3'000'000, begun);\n"
        '  std::printf("%ld\\n", static_cast<long>(cpu() - begun));\n'
        "  for (unsigned node = 0; node < application.size(); ++node)\n"
        "    for (unsigned callback : {0u, 0u, 1u}) {\n"
        "      ExecutionTimes times{application[node].callbacks[0].execution, 9, node, callback};\n"
        "      for (int i = 0; i < 20000; ++i)\n"
        '        std::printf("%ld ", static_cast<long>(times.next()));\n'
        '      std::printf("\\n");\n    }\n}\n'
    )
    program, include = str(tmp_path / "draw"), f"-I{tmp_path / 'robot/src'}"
    warnings = ["-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror"]
    source = str(tmp_path / "draw.cpp")
    subprocess.run(["g++", *warnings, include, source, "-o", program], check=True)
    said = subprocess.run([program], check=True, capture_output=True, text=True).stdout
    spent, *lines = said.splitlines()
    assert 3_000_000 <= int(spent) < 3_500_000
    drawn = [np.array(line.split(), dtype=np.int64) for line in lines]
    for number, (name, described) in enumerate(DISTRIBUTIONS.items()):
        first, again, other = drawn[3 * number : 3 * number + 3]
        expected = draw(ExecutionTime(**described), 20_000, np.random.default_rng(1))
        assert (first == again).all(), "the same seed"
        assert (first == other).all() == (name in ("constant", "stretches")), name
        assert (first.min(), first.max()) == pytest.approx(
            (expected.min(), expected.max()), rel=0.01
        )
        levels = [0.05, 0.25, 0.5, 0.75, 0.95]
        for level in levels:  # of a distribution with steps, by its share below
            bound = np.quantile(expected, level)
            shares = [(values <= bound).mean() for values in (first, expected)]
            assert shares[0] == pytest.approx(shares[1], abs=0.02), (name, level)
    stretches = drawn[-1][: 20_000 // 7 * 7].reshape(-1, 7)
    assert (np.diff(stretches, axis=1) % 50 == 1).all()


def _yaml(described: dict[str, Any]) -> dict[str, Any]:
    given = {key: [f"{ns}ns" for ns in np.atleast_1d(ns)] for key, ns in described.items()}
    own = {
        key.removesuffix("_ns"): many if len(many) > 1 else many[0] for key, many in given.items()
    }
    return own | ({"block": described["block"]} if "block" in described else {})


GRAPH = """
name: graph
chain: /raw../fused
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  sensor: {callbacks: [{timer: 100ms, execution: {uniform: [1ms, 2ms]}, publishes: [/raw]}]}
  left: {callbacks: [{subscription: /raw, execution: {uniform: [1ms, 5ms]}, publishes: [/left]}]}
  right:
    callbacks: [{subscription: /raw, execution: {constant: 3ms}, publishes: [/right]}]
  fusion:
    callbacks:
      - {synchronises: [/left, /right], execution: {constant: 4ms}, publishes: [/fused]}
  motor: {callbacks: [{subscription: /fused, execution: {constant: 100us}}]}
  late: {callbacks: [{timer: 50ms, phase: 20ms, execution: {constant: 1ms}, publishes: [/late]}]}
  threads:
    executor: multi_threaded
    threads: 2
    cores: [1, 0]
    priority: 70
    callback_groups: {other: mutually_exclusive}
    callbacks:
      - {timer: 100ms, phase: 50ms, execution: {constant: 20ms}, publishes: [/slow], group: other}
      - {timer: 100ms, phase: 51ms, execution: {constant: 2ms}, publishes: [/quick]}
"""


@pytest.mark.ros2("rclcpp", "launch_ros")
@pytest.mark.timeout(400)
@pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here")
def test_a_built_package_runs_as_the_live_workload_does(tmp_path: Path) -> None:
    application, environment = written(tmp_path, GRAPH), ros2_environment()
    (tmp_path / "ws/src").mkdir(parents=True)
    cs.generate_package(application, tmp_path / "ws/src/graph")
    shell = ["env", "bash", "-c"]
    build = subprocess.run(
        [*shell, "colcon build"], cwd=tmp_path / "ws", env=environment, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert build.returncode == 0, build.stdout + build.stderr
    environment["ROS_DOMAIN_ID"] = str(100 + os.getpid() % 100)
    words = [sys.executable, "-m", "chainshaper", "record", "-o", str(tmp_path / "ros")]
    words += ["--duration", "16s", "--", "ros2", "launch", "graph", "graph.launch.py"]
    command = 'source install/setup.bash && exec "$@"'
    run = subprocess.run(
        [*shell, command, "bash", *words, "scheduling:=true"], cwd=tmp_path / "ws",
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-3000:]
    real = cs.open_recording(tmp_path / "ros")
    live = cs.run_application(application, tmp_path / "live", cycles=100)
    ways = ["/raw../left../fused", "/raw../right../fused", "/slow", "/quick"]
    medians: list[dict[str, float]] = []
    for recording in (real, live):
        assert _beside_slow_ones(recording) > 0.9, "the other thread runs /quick meanwhile"
        measured = [cs.measure_latency(recording, way) for way in ways]
        medians.append({})
        for way, one in zip(ways, measured, strict=True):
            values = one.analysis.traversals["latency_ns"]
            assert len(values) > 80
            medians[-1][way] = float(np.median(values.to_numpy())) / 1e6
    for way in ways:
        assert medians[0][way] == pytest.approx(medians[1][way], abs=1.0), medians


def _beside_slow_ones(recording: cs.Recording) -> float:
    """The share of those that publish /quick which start while another thread is about /slow."""
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    slow, quick = (
        flow.instances.join(flow.publications.filter(topic=topic), on="instance", how="semi")
        for topic in ("/slow", "/quick")
    )
    met = quick.join_asof(slow, on="start")
    beside = (met["end_right"] > met["start"]) & (met["tid_right"] != met["tid"])
    return float(beside.sum()) / len(quick)
