"""Every executor of rclcpp and rclpy: what is recorded of it is what its messages say themselves.

The nodes of `executing.cpp` and `executing.py` note for each callback instance which origin it
handled, on which thread and when. ``CHAINSHAPER_SHAPED=FOLDER`` has the recordings written there.
"""

import json
import os
import signal
import subprocess
import sys
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import polars as pl
import pytest
from known import known
from ros2 import MIDDLEWARES, require_lttng_of_ros2, ros2_environment, running_middleware

from chainshaper import load_plan, open_recording
from chainshaper.analysis import analyse_latency, data_flow, executors
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.values.recording import Recording

pytestmark = [pytest.mark.ros2, pytest.mark.timeout(600)]
LAUNCHED = pytest.mark.ros2("rclcpp", "launch_ros")

HERE = Path(__file__).parent
LAUNCH = """
from launch import LaunchDescription
from launch_ros.actions import Node

def generate_launch_description():
    return LaunchDescription([
        Node(executable=program, name=name, arguments=words)
        for program, name, *words in {nodes!r}
    ])
"""


class Noted(NamedTuple):
    """A callback instance as it was noted; without a publication `before` and `behind` are 0."""

    callback: str
    tid: int
    origin: int
    began: int
    before: int
    behind: int


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The node of C++, which is built first."""
    folder = tmp_path_factory.mktemp("executing")
    for step in (["-S", str(HERE), "-B", str(folder)], ["--build", str(folder)]):
        words = ["env", "cmake", *step, *(["--target", "executing"] if "--build" in step else [])]
        run = subprocess.run(
            words, env=ros2_environment(), capture_output=True, text=True, check=False
        )
        if "No rule to make target" in run.stdout + run.stderr or "unknown target" in run.stderr:
            pytest.skip("this rclcpp has no events executor")
        assert run.returncode == 0, run.stdout + run.stderr
    return folder / "executing"


def refuse_missing(program: Path | None, language: str, executor: str) -> None:
    """Skip a test of an executor that this distribution has not."""
    module = "experimental" if executor == "events" else "executors"  # Kilted and later
    words = ["python3", "-c", f"import rclpy.{module}"]
    if language == "C++":
        words = [str(program), "/dev/null", executor, "known"]
    run = subprocess.run(["env", *words], env=ros2_environment(), capture_output=True, check=False)
    if run.returncode:
        pytest.skip(f"this distribution has no executor {executor} of {language}")


Ran: TypeAlias = Callable[..., tuple[Path, Any]]


@pytest.fixture
def ran(tmp_path: Path, request: pytest.FixtureRequest) -> Ran:
    def launched(language: str, words: str) -> list[str]:
        """The command that launches the worker, and the actuator in C++."""
        program = request.getfixturevalue("program")
        refuse_missing(program, language, words.split(maxsplit=1)[0])
        worker = tmp_path / "worker"
        worker.unlink(missing_ok=True)
        worker.write_text(f'#!/bin/sh\nexec python3 "{HERE / "executing.py"}" "$@"\n')
        worker.chmod(0o755)
        executable = str(program if language == "C++" else worker)
        nodes = [
            (executable, "worker", str(tmp_path / "notes"), *words.split()),
            (str(program), "actuator", str(tmp_path / "sink"), "single", "sink"),
        ]
        launch = tmp_path / "robot.launch.py"
        launch.write_text(LAUNCH.replace("{nodes!r}", repr(nodes)))
        return ["ros2", "launch", str(launch)]

    def alone(words: str) -> list[str]:
        """The command that starts the worker in Python alone: a recording needs no actuator."""
        refuse_missing(None, "Python", words.split(maxsplit=1)[0])
        started = ["python3", str(HERE / "executing.py"), str(tmp_path / "notes"), *words.split()]
        return [*started, "--ros-args", "-r", "__node:=worker"]

    def ran(verb: str, language: str, words: str, *options: str) -> tuple[Path, Any]:
        # Without a launch that ends it, Jazzy's events executor does not end by SIGINT.
        is_alone = (verb, language) == ("record", "Python") and not words.startswith("events")
        application = alone(words) if is_alone else launched(language, words)
        folder = Path(os.environ.get("CHAINSHAPER_SHAPED", tmp_path)) / f"{tmp_path.name}-{verb}"
        command = [sys.executable, "-m", "chainshaper", verb, "-o", str(folder), *options, "--json"]
        run = subprocess.run(
            [*command, "--", *application],
            env={**ros2_environment(), "ROS_DOMAIN_ID": str(100 + os.getpid() % 100)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 0, run.stderr[-3000:]
        return folder, json.loads(run.stdout)

    return ran


def noted(file: Path) -> list[Noted]:
    lines = (line.split() for line in file.read_text().splitlines())
    return [Noted(name, *map(int, rest)) for name, *rest in lines]


def at_once(notes: list[Noted], *callbacks: str) -> int:
    """How many instances ran beside each other at most."""
    steps = [(one.began, 1) for one in notes if one.callback in callbacks]
    steps += [(one.behind or one.began, -1) for one in notes if one.callback in callbacks]
    return max(accumulate(step for _, step in sorted(steps)))


def check_traversals(recording: Recording, chain: str, names: tuple[str, ...], file: Path) -> int:
    """Every traversal is that of one origin, as the callbacks noted it, and none is missing.

    Returns how many there are.
    """
    notes, of_thread = noted(file), defaultdict[tuple[str, int], list[Noted]](list)
    for one in sorted(notes, key=lambda one: one.began):
        of_thread[one.callback, one.tid].append(one)
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    found, tids = analyse_latency(flow, chain), flow.instances["tid"].to_list()
    hops = found.hops.sort("traversal", "hop").partition_by("traversal", as_dict=True)
    origins = set()
    for row in found.traversals.filter("complete").iter_rows(named=True):
        seen = []
        for name, hop in zip(
            names, hops[row["traversal"],].head(len(names)).iter_rows(named=True), strict=True
        ):
            own = of_thread[name, tids[hop["instance"]]]
            begun_outside = (
                name == "timer" and flow.instances["start"][hop["instance"]] == hop["publish"]
            )
            started = [
                one
                for one in own
                if (
                    one.before <= hop["publish"] <= one.behind
                    if begun_outside
                    else one.began >= hop["start"]
                )
            ]
            seen.append(started[0].origin)
        assert len(set(seen)) == 1, f"one traversal of the origins {seen}"
        end = hops[row["traversal"],]["publish"][len(names) - 1]
        assert any(one.before <= end <= one.behind for one in notes if one.origin == seen[0])
        origins.add(seen[0])
    until = flow.publications.select(pl.col("time").max()).item()
    outputs = {one.origin for one in notes if one.callback in OUTPUTS and 0 < one.behind < until}
    since = min(origins)
    assert {one for one in outputs if one >= since} <= origins
    return len(origins)


OUTPUTS = ("last", "left", "right")


@pytest.mark.parametrize(
    ("language", "executor_and_source", "threads"),
    [
        pytest.param("C++", "multi preload", [4], marks=LAUNCHED),
        pytest.param("C++", "multi lttng", [4], marks=LAUNCHED),
        pytest.param("C++", "static preload", [1], marks=LAUNCHED),
        pytest.param("C++", "events preload", [2], marks=LAUNCHED),
        pytest.param("C++", "events-timers preload", [1, 1], marks=LAUNCHED),
        pytest.param("C++", "cbg preload", [3], marks=LAUNCHED),
        pytest.param("C++", "cbg lttng", [3], marks=LAUNCHED),
        pytest.param("C++", "groups preload", [1, 1, 1], marks=LAUNCHED),
        ("Python", "single preload", [1]),
        ("Python", "single lttng", [1]),
        ("Python", "multi preload", []),
        pytest.param("Python", "events preload", [1], marks=LAUNCHED),
        pytest.param("Python", "events lttng", [1], marks=LAUNCHED),
    ],
)
def test_traversals_and_threads_are_what_the_callbacks_say(
    ran: Ran, tmp_path: Path, language: str, executor_and_source: str, threads: list[int]
) -> None:
    executor, source = executor_and_source.split()
    if source == "lttng":
        require_lttng_of_ros2()
    several = executor == "multi"
    words = f"{executor} line 60 {30 if several else 5} {150 if several else 30} sleep"
    folder, _ = ran("record", language, words, "--source", source, "--duration", "8s")
    recording, names = open_recording(folder), ("timer", "work", "last")
    assert check_traversals(recording, "/begun../done", names, tmp_path / "notes") > 40
    if several:
        assert at_once(noted(tmp_path / "notes"), "work") > 1
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    (worker,) = recording.events["rcl_node_init"].filter(node_name="worker")["pid"]
    own = [one for one in executors(flow) if one.pid == worker]
    ran_by = {one.tid for one in noted(tmp_path / "notes")}
    if threads:
        assert sorted(len(one.threads) for one in own) == threads
        assert ran_by <= {tid for one in own for tid in one.threads}
    else:  # rclpy's pool begins a thread only when none is idle; the main one hands out the work
        assert [{*one.threads} for one in own] == [ran_by | {worker}]


STAGES = {  # callback → topics from which and to which it is a stage of the line
    "timer": ("-", "/begun"),
    "work": ("/begun", "/worked"),
    "last": ("/worked", "/done"),
}


@LAUNCHED
@pytest.mark.parametrize("rmw", MIDDLEWARES)
def test_a_chain_through_processes_is_what_they_noted_on_each_middleware(
    program: Path, tmp_path: Path, rmw: str
) -> None:
    """Recorded and watched at once: the same library is in front of all nodes."""
    nodes: list[tuple[str, ...]] = [
        (str(program), "sink", str(tmp_path / "sink"), "single", "sink")
    ]
    for name, topics in STAGES.items():
        words = ("single", "stage", "60", "5", "20", "sleep", name, *topics)
        nodes.append((str(program), name, str(tmp_path / name), *words))
    launch = tmp_path / "robot.launch.py"
    launch.write_text(LAUNCH.replace("{nodes!r}", repr(nodes)))
    chainshaper, folder = [sys.executable, "-m", "chainshaper"], tmp_path / "recording"
    record = [*chainshaper, "record", "-o", str(folder), "--duration", "10s", "--source", "preload"]
    watch = [*chainshaper, "watch", "--chain", "/begun../done", "--json", "--longest", "1s"]
    with running_middleware(rmw) as variables:
        environment = {**ros2_environment(), "ROS_DOMAIN_ID": str(100 + os.getpid() % 100)}
        environment |= variables
        recording_nodes = subprocess.Popen(
            [*record, "--json", "--", "ros2", "launch", str(launch)],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        with subprocess.Popen(watch, env=environment, stdout=subprocess.PIPE, text=True) as watched:
            _, errors = recording_nodes.communicate()
            watched.send_signal(signal.SIGINT)
            looks = [json.loads(line) for line in known(watched.stdout)]
    assert recording_nodes.returncode == 0, errors[-3000:]
    notes = tmp_path / "notes"
    notes.write_text("".join((tmp_path / name).read_text() for name in STAGES))
    recording = open_recording(folder)
    assert recording.info.rmw == rmw
    assert check_traversals(recording, "/begun../done", tuple(STAGES), notes) > 100
    found = analyse_latency(recording, "/begun../done")
    instances = noted(notes)
    of_origin = {(instance.callback, instance.origin): instance for instance in instances}
    began = {
        instance.began: instance.origin for instance in instances if instance.callback == "timer"
    }
    instants = sorted(began)
    for row in found.traversals.filter("complete").iter_rows(named=True):
        origin = began[instants[bisect_left(instants, row["start"])]]
        first, last = of_origin["timer", origin], of_origin["last", origin]
        assert last.before - first.began <= row["latency_ns"] <= last.behind - row["start"]
    (chain,) = looks[-1]["chains"]
    seen, latencies = chain["spans"]["hour"], {*found.traversals["latency_ns"]}
    assert seen["count"] > 50
    assert {seen["min_ns"], seen["max_ns"]} <= latencies, "the same events, the same figures"


@LAUNCHED
@pytest.mark.parametrize("first", ["left", "right"])
def test_sets_that_several_threads_complete(ran: Ran, tmp_path: Path, first: str) -> None:
    folder, _ = ran("record", "C++", "multi join 20 10 50 sleep", "--duration", "8s")
    notes = noted(tmp_path / "notes")
    assert at_once(notes, "left", "right") > 1
    names, by = ("timer", first), {one.callback for one in notes if one.before} - {"timer"}
    assert by == {"left", "right"}, "which comes last changes"
    found = check_traversals(open_recording(folder), f"/{first}../done", names, tmp_path / "notes")
    assert found > 100


@LAUNCHED
@pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here")
@pytest.mark.parametrize(
    ("language", "executor", "threads"),
    [
        *(("C++", "multi", 4), ("C++", "static", 1), ("C++", "events", 2), ("C++", "cbg", 3)),
        *(("Python", "multi", 5), ("Python", "events", 1)),
    ],
)
def test_one_command_shapes_a_chain_on_this_executor(
    ran: Ran, tmp_path: Path, language: str, executor: str, threads: int
) -> None:
    options = ["--chain", "/begun../done", "--epsilon", "5ms", "--duration", "15s"]
    folder, values = ran("shape", language, f"{executor} line 100 5 30 compute", *options)
    before, after = values["recordings"]
    assert after["count"] > 80
    assert after["undisturbed"]["spread_ns"] < before["spread_ns"] / 10
    servers = {one.name: one for one in load_plan(folder / "plan.yaml").chains[0].servers}
    assert [one.node for one in servers["chain"].threads] == ["/worker"]
    names, recording = ("timer", "work", "last"), open_recording(folder / "after")
    raised = {
        one.tid
        for one in recording.info.threads
        if one.node == "/worker" and one.role == "executor"
    }
    # rclpy's pool begins a thread only when a callback comes while no other is idle.
    assert len(raised) == threads or (language == "Python" and 1 < len(raised) < threads)
    assert {one.tid for one in noted(tmp_path / "notes")} <= raised
    assert check_traversals(recording, "/begun../done", names, tmp_path / "notes") > 80
