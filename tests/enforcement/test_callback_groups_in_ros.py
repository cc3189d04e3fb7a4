"""A real node with two callback groups on executors of their own: one is gated, the other not."""

import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
from applied_plans import applied, leftovers, needs_fifo, plan_for
from command_line import called, json_of
from gated import needs_cgroups
from ros2 import ros2_environment

from chainshaper.enforcement.node_threads import IN_ORDER
from chainshaper.planning import load_plan
from chainshaper.planning.chain_plan import Thread

pytestmark = [pytest.mark.ros2("rclcpp"), pytest.mark.timeout(300), needs_fifo, needs_cgroups]

SOURCE = Path(__file__).with_name("callback_groups.cpp")
LIBRARIES = ("rclcpp", "rcl", "rmw", "rcutils", "tracetools", "std_msgs__rosidl_typesupport_cpp")
MS = 1_000_000
TICK, CYCLE, SLOT = 10 * MS, 100 * MS, (0, 20 * MS)
LEAD = 2 * MS  # slots begin so long after the phase that is given


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The node, compiled with the ROS 2 that is here."""
    environment, compiler = ros2_environment(), shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not installed, so a node in C++ cannot be compiled")
    prefixes = [Path(one) for one in environment["AMENT_PREFIX_PATH"].split(":")]
    # Behind the system's own: message packages have headers of such names.
    include = [f"-idirafter{path}" for one in prefixes for path in (one / "include").glob("*/")]
    found = [f"-L{one / 'lib'}" for one in prefixes] + [f"-l{name}" for name in LIBRARIES]
    path = tmp_path_factory.mktemp("groups") / "groups"
    allowed = "-Wl,--allow-shlib-undefined"
    command: list[str | Path] = [
        compiler,
        "-std=c++17",
        SOURCE,
        "-o",
        path,
        *include,
        *found,
        allowed,
    ]
    subprocess.run(command, check=True, timeout=150)
    return path


@pytest.mark.usefixtures("in_ros2")
def test_one_callback_group_is_gated_and_the_other_runs_on(
    program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "97")
    command = (str(program), "--ros-args", "-r", "__node:=groups")
    recording, path = tmp_path / "rec", tmp_path / "plan.yaml"
    finished = called("record", "-o", recording, "--duration", "3s", "--", *command)
    assert finished.code == 0, finished
    threads = {one["period_ns"]: one["tids"] for one in json_of("callbacks", recording)}
    assert threads.keys() == {TICK, CYCLE}
    assert set(threads[TICK]).isdisjoint(threads[CYCLE])

    options = ("--policy", "server-per-chain", "-o", path)
    finished = called("plan", recording, "--chain", "/groups../out", *options)
    assert finished.code == 0, finished
    (server,) = load_plan(path).chains[0].servers
    assert server.threads == (Thread(node="/groups", callbacks=("every 100ms",)),)
    server = server.model_copy(update={"slots": (SLOT,)})

    # Another process than was recorded: its threads are told apart by the order of their start.
    known = ("--backend", "freezer", "--phase", "0ms", "--recording", str(recording))
    with applied(plan_for(server), tmp_path, *known, "--", *command) as run:
        since = time.monotonic_ns() + 10 * CYCLE  # what was under way is over
        time.sleep(4)
        run.send_signal(signal.SIGINT)
        until = time.monotonic_ns()
        out, said = run.communicate(timeout=60)
    assert run.returncode == 0, said
    assert IN_ORDER in out + said
    began: dict[str, list[int]] = {"tick": [], "work": []}
    for line in out.splitlines():
        words = line.split()
        if len(words) == 4 and words[0] in began and since < int(words[2]) < until:
            began[words[0]].append((int(words[2]) - LEAD) % CYCLE)
    in_slot = [SLOT[0] <= begin < SLOT[1] for begin in began["work"]]
    assert len(in_slot) > 15
    assert sum(in_slot) >= 0.9 * len(in_slot), sorted(began["work"])  # the machine may stall
    outside = [begin for begin in began["tick"] if begin >= SLOT[1]]
    assert len(outside) > len(began["tick"]) / 2 > 50, "it runs at all times"
    assert {begin // (20 * MS) for begin in outside} == {1, 2, 3, 4}
    assert not leftovers()
