"""A real `ros2 launch` of C++ nodes that compute, shaped by one command.

``CHAINSHAPER_SHAPED=FOLDER`` has the recordings written there.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Any, TypeAlias

import numpy as np
import polars as pl
import pytest
from processes import wait_for
from ros2 import (
    MIDDLEWARES,
    free_port,
    require_lttng_of_ros2,
    require_packages,
    ros2_environment,
    running_middleware,
    zenoh_router,
    zenoh_variables,
)

from chainshaper import (
    load_application,
    load_plan,
    measure_latency,
    open_recording,
)
from chainshaper.linux.processes import descendants, list_processes
from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.planning.overruns import cycles_until_output

pytestmark = [
    pytest.mark.ros2("rclcpp", "launch_ros"),
    pytest.mark.timeout(900),
    pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here"),
    pytest.mark.skipif(len(available_cores()) < 2, reason="two cores are needed"),
]

HERE = Path(__file__).parent
MS = 1_000_000
LAUNCH = """
import json
import os
from launch import LaunchDescription
from launch_ros.actions import Node
NODES = {nodes!r}
ASYNCHRONOUS = json.loads(os.environ['ASYNCHRONOUS'])

def generate_launch_description():
    nodes = []
    for name, *words in (line.replace('MODES', os.environ['MODES']).split() for line in NODES):
        slow = {'twice_in': 'highway' if name == 'slow' else ''}
        nodes.append(Node(
            executable={program!r}, name=name, arguments=words, parameters=[slow],
            prefix='chrt -f 60' if name == 'reader' else '',  # whatever else runs here
            additional_env=ASYNCHRONOUS if name == 'control' else {},
        ))
    return LaunchDescription(nodes)
"""
PARKING = [
    "throttler    /raw      0.2  0.5  every 100",
    "rear_filter  /rear     1    4    on /raw",
    "front_filter /front    1    5    on /raw",
    "fusion       /fused    0.2  1    on /rear /front",
    "ndt          /pose     1    5    on /fused",
    "planner      -         0    0.01 on /pose",
    "tick         /ticked   0.2  1    every 50",
    "control      /commands 0.5  3    on /ticked",
    "motor        -         0    0.01 on /commands",
]
"""Valley parking in small (section 5.1): the front filter runs beside the rear one on a core of its
own. A second chain shares a core with it."""

WAITING = [
    "camera   /image   40 48  every 100",
    "encoder  /code    30 40  on /image",
    "detector /objects 60 70  after /code",
    "tracker  /tracks  20 25  after /objects",
    "planner  /command 45 55  on /tracks",
    "actuator -        0  0.1 on /command",
]
"""A chain of up to 2.4 periods; two nodes sleep, since two cores could not compute all of it."""

MODES = [
    "camera  /image   1 2 every 100",
    "slow    /objects 5 9 on /image",
    "planner /command 1 3 on /objects",
    "motor   -        0 0.01 on /command",
    "driver  /driving_mode modes 4 MODES",
]


DRIVING = [
    "tick     /ticked    0.2  1     every 100",
    "work     /worked    2    15    on /ticked",
    "control  /commands  1    10    on /worked",
    "reader   -          0    0.01  on /commands",
]
"""What `control` publishes leaves by a thread of Fast DDS, if it is told so (design 1)."""

PROFILES = """
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <data_writer profile_name="{topic}">
    <qos><publishMode><kind>ASYNCHRONOUS</kind></publishMode></qos>
    <historyMemoryPolicy>PREALLOCATED_WITH_REALLOC</historyMemoryPolicy>
  </data_writer>
</profiles></dds>
"""


def described(path: str) -> tuple[str, list[str]]:
    """The chain of a description, and a line for each of its nodes."""
    application, lines = load_application(HERE.parents[1] / path), []
    for name, node in application.nodes.items():
        (callback,) = node.callbacks
        least, most = callback.execution.uniform_ns or [callback.execution.constant_ns or 0] * 2
        inputs = " ".join(callback.synchronises or [callback.subscription or ""])
        how = f"every {callback.timer_ns // MS}" if callback.timer_ns else f"on {inputs}"
        lines.append(f"{name} {(*callback.publishes, '-')[0]} {least / MS} {most / MS} {how}")
    return application.chain, lines


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A node of C++, which is built first."""
    folder = tmp_path_factory.mktemp("nodes")
    for step in (["-S", str(HERE), "-B", str(folder)], ["--build", str(folder)]):
        command = ["env", "cmake", *step]
        run = subprocess.run(
            command, env=ros2_environment(), capture_output=True, text=True, check=False
        )
        assert run.returncode == 0, run.stdout + run.stderr
    return folder / "vertex"


Result: TypeAlias = tuple[dict[str, Any], Path]
"""What a verb says of what launches such nodes, and the folder that it made."""
Attempt: TypeAlias = tuple[subprocess.CompletedProcess[str], Path]


@pytest.fixture
def attempt(program: Path, tmp_path: Path) -> Callable[..., Attempt]:
    def attempt(
        nodes: list[str],
        verb: str,
        name: str,
        *words: str,
        launch_words: tuple[str, ...] = (),
        **variables: str,
    ) -> Attempt:
        known = {"MODES": "", "ASYNCHRONOUS": "{}", "ROS_DOMAIN_ID": str(100 + os.getpid() % 100)}
        environment = {**ros2_environment(), **known, **variables}
        folder = Path(os.environ.get("CHAINSHAPER_SHAPED", tmp_path)) / name
        file, text = tmp_path / "robot.launch.py", LAUNCH.replace("{nodes!r}", repr(nodes))
        file.write_text(text.replace("{program!r}", repr(str(program))))
        command = [sys.executable, "-m", "chainshaper", verb, "-o", str(folder), *words, "--json"]
        command += ["--", "ros2", "launch", *launch_words, str(file)]
        run = subprocess.run(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        return run, folder

    return attempt


@pytest.fixture
def run(attempt: Callable[..., Attempt]) -> Callable[..., Result]:
    def run(*arguments: Any, **variables: str) -> Result:
        done, folder = attempt(*arguments, **variables)
        assert done.returncode == 0, done.stderr[-3000:]
        return json.loads(done.stdout), folder

    return run


@pytest.mark.parametrize("words", [(), ("--noninteractive",)])
def test_nodes_that_are_recorded_without_a_terminal_shut_down_in_order(
    attempt: Callable[..., Attempt], words: tuple[str, ...]
) -> None:
    """Launch signals its nodes itself there: a second SIGINT would kill them, exit code -2."""
    done, _ = attempt(PARKING, "record", "ended", "--duration", "15s", launch_words=words)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said[-3000:]
    assert "process has died" not in said
    assert said.count("process has finished cleanly") == len(PARKING), said[-3000:]


@pytest.mark.parametrize(
    ("source", "publication"),
    [("lttng", "synchronous"), ("preload", "in-process"), ("lttng", "in-process")],
)
def test_two_chains_are_shaped_by_one_command(
    run: Callable[..., Result], source: str, publication: str
) -> None:
    if source == "lttng":
        require_lttng_of_ros2()
    (first, *_, last), chains = available_cores(), ["/raw../rear../pose", "/ticked../commands"]
    options = ["--cores", f"{last},{first}", "--epsilon", "2ms", "--duration", "30s"]
    options += ["--source", source, "--publication", publication]
    options += [word for chain in chains for word in ("--chain", chain)]
    values, folder = run(PARKING, "shape", "shaped", *options)

    cores = values["cores"]
    beside, *others = (cores[f"/{one}"] for one in ("front_filter", "throttler", "fusion", "ndt"))
    assert (beside, {*others}) == (first, {last}), "a branch that the chain waits for"
    assert cores["/rear_filter"] == last
    assert [one["chain"] for one in values["chains"]] == chains
    assert values["recordings"] == values["chains"][0]["recordings"], "as for one chain"
    profiled = [open_recording(folder / name).info for name in ("before", "before_2")]
    raised = [{t.node for t in one.threads if t.policy == "SCHED_FIFO"} for one in profiled]
    assert {"/front_filter", "/ndt"} <= raised[0]
    assert {"/tick", "/control"} <= raised[1]
    assert not raised[0] & raised[1], "each is measured as if it were alone"
    plan = load_plan(folder / "plan.yaml")
    assert [chain.chain.output for chain in plan.chains] == ["/pose", "/commands"]
    assert {server.core for server in plan.chains[0].servers} == {first, last}
    for one in values["chains"]:
        before, after = one["recordings"]
        assert after["count"] > 100
        assert after["prediction"]
        assert after["spread_ns"] < before["spread_ns"]
    assert (folder / "chain_2" / "latency.png").is_file()
    threads = open_recording(folder / "after").info.threads
    publishing = {one.pid for one in threads if one.node in ("/control", "/ndt")}
    gates = {one.node: one.pid for one in threads if one.comm.startswith("gate-")}
    if publication == "in-process":
        assert gates.keys() == {"/chainshaper_pose", "/chainshaper_commands"}
        assert {*gates.values()} == publishing, "threads of the processes that publish"
    else:
        assert not gates


def test_a_graph_of_18_callbacks_runs_on_two_cores(run: Callable[..., Result]) -> None:
    """Section 5.4 of the paper, at its own pace: 764 ms, of which each path takes up to 560."""
    (chain, nodes), (first, *_, last) = described("experiments/dag.yaml"), available_cores()
    options = ("--chain", chain, "--cores", f"{last},{first}", "--duration", "120s")
    values, folder = run(nodes, "shape", "graph", *options)
    cores = values["cores"].values()
    assert (len(cores), {*cores}) == (18, {first, last}), "branches that the chain waits for, too"
    before, after = values["recordings"]
    assert after["count"] > 80
    assert after["undisturbed"]["spread_ns"] < before["spread_ns"] / 10
    servers = load_plan(folder / "plan.yaml").chains[0].servers
    assert [one.name for one in servers] == ["chain_core1", "chain_core0", "output"]


@pytest.mark.parametrize("further_cycles", [1, 2])
def test_a_chain_longer_than_its_period_becomes_a_pipeline(
    run: Callable[..., Result], further_cycles: int
) -> None:
    (first, *_, last), cores = available_cores(), list[str]()
    chain, nodes = described("examples/pipeline.yaml")
    if further_cycles == 2:
        nodes, cores = WAITING, ["--cores", f"{last},{first},{first}"]
    options = ("--chain", chain, "--policy", "pipelined", "--duration", "30s", *cores)
    values, folder = run(nodes, "shape", f"pipelined_{further_cycles}", *options)
    plan = load_plan(folder / "plan.yaml").chains[0]
    assert {one.core for one in plan.servers} == {first, last}
    assert cycles_until_output(plan) == further_cycles
    before, after = values["recordings"]
    assert after["count"] > 100
    assert after["undisturbed"]["spread_ns"] < before["spread_ns"] / 10


@pytest.mark.parametrize(
    "policy", ["server-per-chain", "server-per-callback", "let-per-chain", "let-per-callback"]
)
def test_policies_that_shaping_is_compared_with(run: Callable[..., Result], policy: str) -> None:
    options = ("--chain", "/raw../rear../pose", "--policy", policy, "--duration", "20s")
    values, folder = run(PARKING[:6], "shape", policy, *options, "--overrun", "wait")
    plan = load_plan(folder / "plan.yaml").chains[0]
    before, after = values["recordings"]
    assert (plan.policy, after["count"] > 40) == (policy, True)
    assert after["percentiles_ns"]["50"] // (100 * MS) == cycles_until_output(plan)
    if plan.shaping_node is not None:
        assert after["undisturbed"]["spread_ns"] < before["spread_ns"]


@pytest.mark.parametrize("publication", ["synchronous", "in-process"])
def test_each_mode_has_the_slot_of_its_own_profile(
    run: Callable[..., Result], publication: str
) -> None:
    """Recorded apart, and then in turns, 4 s each."""
    options = ["--publication", publication]
    options += ["--modes", "/driving_mode:city,highway", "--chain", "/image../command"]
    for mode in ("city", "highway"):
        nodes = [word for node in ("camera", "slow", "planner") for word in ("--node", node)]
        _, place = run(MODES, "profile", mode, *nodes, "--duration", "20s", MODES=mode)
        options += ["--mode-profile", f"{mode}={place}"]
    options += ["--epsilon", "2ms", "--duration", "30s"]
    values, folder = run(MODES, "shape", "modes", *options, MODES="city highway")
    plan = load_plan(folder / "plan.yaml").chains[0]
    assert plan.modes is not None
    assert plan.modes.bands == {"city": 1, "highway": 2}
    longest = {mode: one.max_latency_ns for mode, one in (plan.evidence.modes or {}).items()}
    assert longest["city"] < 0.8 * longest["highway"], "each mode has latencies of its own"
    after = open_recording(folder / "after").events["gate_release"]
    assert {*after["mode"]} == {"city", "highway"}
    assert values["recordings"][1]["count"] > 100


@pytest.mark.parametrize("rmw", MIDDLEWARES)
@pytest.mark.parametrize("publication", ["synchronous", "in-process"])
def test_receivers_get_the_output_at_a_constant_time_behind_it(
    attempt: Callable[..., Attempt], publication: str, rmw: str
) -> None:
    options = ("--chain", "/ticked../commands", "--duration", "20s", "--publication", publication)
    with running_middleware(rmw) as variables:
        words = (DRIVING, "shape", "delivered", *options, "--delivery", "2ms")
        done, folder = attempt(*words, **variables)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "process has died" not in done.stderr, "nor do our own nodes, as they end"
    assert open_recording(folder / "after").info.rmw == rmw
    behind, unshaped = (
        measure_latency(folder / name)
        .analysis.traversals.drop_nulls("reception_ns")
        .select(pl.col("reception_ns") - pl.col("latency_ns"))
        .to_series()
        for name in ("after", "before")
    )
    least, most = np.quantile(behind, (0.1, 0.9))
    assert len(behind) > 100
    assert least >= 2 * MS - MS // 20, "the message is stamped as it is written"
    assert most - least < np.subtract(*np.quantile(unshaped, (0.9, 0.1))) / 2


def test_zenohs_router_dies_and_comes_back_while_the_chain_is_shaped(
    run: Callable[..., Result], tmp_path: Path
) -> None:
    """Nodes need it to meet only."""
    require_packages("rmw_zenoh_cpp")
    port, killed, back = free_port(), list[int](), list[int]()
    folder = Path(os.environ.get("CHAINSHAPER_SHAPED", tmp_path)) / "router"

    def connections() -> int:
        """How many of them the router has."""
        lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
        ends = (line.split()[1:4:2] for line in lines)
        return sum(local.endswith(f":{port:04X}") and state == "01" for local, state in ends)

    def gated() -> bool:
        """Whether the chain is shaped, and has been for some cycles."""
        processes = list_processes()
        parents = {process.pid: process.parent for process in processes}
        ours = descendants(parents, os.getpid())
        of_ours = (process for process in processes if process.pid in ours)
        threads = (thread for process in of_ours for thread in process.threads)
        return any(thread.comm.startswith("gate-") for thread in threads)

    def interrupt() -> None:
        with zenoh_router(port) as router:
            wait_for(gated, "the gate", 300, 0.5)
            time.sleep(12)  # until it is measured, and then some
            assert connections() >= len(DRIVING)
            killed.append(time.monotonic_ns())
            router.kill()
        wait_for(lambda: not connections(), "its connections to end")
        time.sleep(3)
        with zenoh_router(port):
            wait_for(lambda: connections() >= len(DRIVING), "nodes that are connected again", 30)
            back.append(time.monotonic_ns())
            ended.wait()

    options = ("--chain", "/ticked../commands", "--duration", "30s", "--publication", "in-process")
    with ThreadPoolExecutor(1) as aside:
        ended, interrupting = Event(), aside.submit(interrupt)
        try:
            run(DRIVING, "shape", "router", *options, **zenoh_variables(port))
        finally:
            ended.set()
        interrupting.result()
    found = measure_latency(folder / "after").analysis.traversals.sort("start")
    before, gone, after = (
        found.filter(pl.col("start").is_between(*span))
        for span in ((0, killed[0] - 200 * MS), (killed[0], back[0]), (back[0] + 5000 * MS, 2**62))
    )
    assert before["complete"].all()
    assert len(before) > 10
    assert len(gone) > 20
    assert gone["complete"].all()
    assert len(after) > 20


def _driving(attempt: Callable[..., Attempt], folder: Path, topic: str, duration: str) -> Attempt:
    """Shape a chain on Fast DDS, whose last node publishes one topic asynchronously."""
    rmw = "rmw_fastrtps_cpp"
    require_packages(rmw)
    profiles = folder / "profiles.xml"
    profiles.write_text(PROFILES.format(topic=topic))
    asked = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(profiles), "RMW_FASTRTPS_USE_QOS_FROM_XML": "1"}
    options = ["--chain", "/ticked../commands", "--publication", "asynchronous", "--epsilon", "2ms"]
    options += ["--publish-slot", "10ms", "--duration", duration]
    variables = {"RMW_IMPLEMENTATION": rmw, "ASYNCHRONOUS": json.dumps(asked)}
    return attempt(DRIVING, "shape", "shaped", *options, **variables)


def test_the_thread_by_which_fast_dds_publishes_is_held_until_its_slot(
    attempt: Callable[..., Attempt], tmp_path: Path
) -> None:
    run, folder = _driving(attempt, tmp_path, "/commands", "30s")
    assert run.returncode == 0, run.stderr[-3000:]
    before, after = json.loads(run.stdout)["recordings"]
    held = open_recording(folder / "after").info.threads
    (thread,) = (one for one in held if one.role == "publisher")
    assert (thread.node, thread.comm) == ("/control", "dds.asyn.0.1")
    assert after["count"] > 200
    assert after["undisturbed"]["spread_ns"] < before["undisturbed"]["spread_ns"] / 4
    assert after["prediction"]["late"] < 5


def test_what_is_published_synchronously_is_not_held_by_anothers_thread(
    attempt: Callable[..., Attempt], tmp_path: Path
) -> None:
    run, folder = _driving(attempt, tmp_path, "/rosout", "15s")
    assert run.returncode == 2
    assert "/control publishes /commands synchronously" in run.stderr
    assert not (folder / "after").exists()
