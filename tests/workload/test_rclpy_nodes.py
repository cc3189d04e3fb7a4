"""What starts a described application as rclpy nodes: files, and the script that starts them."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from processes import wait_for
from small_chain import DDS_CORE, EXECUTOR_CORE, small_chain

import chainshaper as cs
from chainshaper.values.errors import InputError
from chainshaper.workload.description import Application
from chainshaper.workload.execution import ExecutionTimes
from chainshaper.workload.rclpy_nodes import WrittenNodes, write_rclpy_nodes

STAND_IN = """\
#!{python}
import signal, sys
from pathlib import Path
from typing import Any
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
Path(sys.argv[2]).with_suffix(".started").touch()
signal.pause()
"""
COMPUTES, SYNCHRONISES = "computes: json:loads", "synchronises: [/t1, /t0]"


def test_nodes_get_the_times_of_the_live_workload_and_their_scheduling(tmp_path: Path) -> None:
    application = small_chain(tmp_path)
    nodes = write_rclpy_nodes(application, tmp_path, realtime=True)
    first, _, third, actuator = described(nodes)
    (callback,) = first["callbacks"]
    times = ExecutionTimes(
        application.nodes["first"].callbacks[0].execution, application.seed, "/first", 0
    )
    assert callback["execution_ns"][:50] == [times.next() for _ in range(50)]
    assert (callback["timer_ns"], callback["publishes"]) == (50_000_000, ["/t1"])
    assert third["topics"].keys() == {"/t2", "/t3"}
    assert actuator["callbacks"][0]["execution_ns"] == [100_000]
    assert actuator["callbacks"][0]["afterwards_ns"] == [0]
    assert first["scheduling"] == {
        "executor": {"core": EXECUTOR_CORE, "priority": 80},
        "dds": {"core": DDS_CORE, "priority": 90},
    }
    fair = write_rclpy_nodes(application, tmp_path, realtime=False)
    assert [node["scheduling"] for node in described(fair)] == [None] * 4


LOOP = """\
name: a loop
chain: /scan../command
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  lidar: {callbacks: [{timer: 20ms, publishes: [/scan]}]}
  controller:
    callbacks:
      - loop: 5ms
        phase: 1ms
        priority: 85
        reads: [/scan]
        execution: {constant: 1ms}
        publishes: [/command]
  arm: {callbacks: [{subscription: /command}]}
"""


def test_a_loop_gets_its_period_what_it_reads_and_its_scheduling(tmp_path: Path) -> None:
    (tmp_path / "app.yaml").write_text(LOOP)
    application = cs.load_application(tmp_path / "app.yaml")
    lidar, controller, _ = described(write_rclpy_nodes(application, tmp_path, realtime=True))
    (loop,) = controller["callbacks"]
    assert (loop["loop_ns"], loop["phase_ns"], loop["reads"]) == (5_000_000, 1_000_000, ["/scan"])
    assert controller["scheduling"]["loop"] == {"core": 1, "priority": 85}
    assert controller["topics"].keys() == {"/scan", "/command"}
    assert lidar["topics"]["/scan"]["is_taken"], "nobody would wait for the loop's subscription"
    assert "loop" not in lidar["scheduling"]


def described(nodes: WrittenNodes) -> list[dict[str, Any]]:
    return [json.loads(file.with_suffix(".json").read_text()) for file in nodes.ready]


def test_the_script_names_nodes_remaps_topics_and_loads_gates_before_a_tracer(
    tmp_path: Path,
) -> None:
    nodes = write_rclpy_nodes(
        small_chain(tmp_path),
        tmp_path,
        realtime=False,
        remaps={"/third": {"/t3": "/t3_tmp"}},
        beside=[["python3", "gate of /t3.py"]],
        environment={"LD_PRELOAD": "/gate.so", "GATES": "a file"},
    )
    text = Path(nodes.command[1]).read_text()
    (third,) = re.findall(r".*__node:=third.*", text)
    assert third.endswith("--ros-args -r __node:=third -r __ns:=/ -r /t3:=/t3_tmp &")
    assert "\npython3 'gate of /t3.py' &\n" in text
    assert "export GATES='a file'\n" in text
    (loading,) = re.findall(r"export LD_PRELOAD=.*", text)
    for before, loaded in (("", "/gate.so"), ("/tracer.so", "/gate.so:/tracer.so")):
        shown = subprocess.run(
            ["bash", "-c", f'{loading}; echo "$LD_PRELOAD" 2> /dev/null'],
            env={**os.environ, "LD_PRELOAD": before},
            capture_output=True,
            text=True,
            check=True,
        )
        assert shown.stdout == f"{loaded}\n"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"execution: {uniform: [1ms, 4ms]}, publishes: [/t1]": f"{COMPUTES}, publishes: [/t1]"},
            "`computes` is a function",
        ),
        (
            {"publishes: [/t1]": "publishes: [/t1, /t0]", "subscription: /t1": SYNCHRONISES},
            "`synchronises` is a set",
        ),
        ({"subscription: /t1,": "kind: service, subscription: /t1,"}, "`kind` is of a service"),
        ({"publication: synchronous": "publication: asynchronous"}, "asynchronous on /t3"),
        (
            {"  first:\n": "  first:\n    executor: multi_threaded\n    threads: 2\n"},
            "first: `executor` is of several threads",
        ),
    ],
)
def test_what_these_nodes_do_not_do_is_refused_with_the_way_to_c_plus_plus(
    tmp_path: Path, change: dict[str, str], said: str
) -> None:
    (tmp_path / "app.yaml").write_text(changed(tmp_path, change))
    application = cs.load_application(tmp_path / "app.yaml")
    with pytest.raises(InputError, match=said + ".*chainshaper generate"):
        write_rclpy_nodes(application, tmp_path, realtime=False)


def changed(folder: Path, change: dict[str, str]) -> str:
    small_chain(folder)
    text = (folder / "small_chain.yaml").read_text()
    for before, after in change.items():
        assert before in text
        text = text.replace(before, after, 1)
    return text


@pytest.fixture
def started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple["subprocess.Popen[bytes]", list[int]]]:
    """The script, with stand-ins for nodes, and the process ids of these."""
    (tmp_path / "bin").mkdir()
    stand_in = tmp_path / "bin/python3"
    stand_in.write_text(STAND_IN.format(python=sys.executable))
    stand_in.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    application: Application = small_chain(tmp_path)
    nodes = write_rclpy_nodes(application, tmp_path, realtime=False)
    with subprocess.Popen(nodes.command, start_new_session=True) as process:
        try:
            wait_for(
                lambda: all(file.with_suffix(".started").exists() for file in nodes.ready),
                "the stand-ins",
            )
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
            yield process, [int(pid) for pid in children.split()]
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


def test_sigint_ends_all_nodes(started: tuple["subprocess.Popen[bytes]", list[int]]) -> None:
    process, nodes = started
    assert len(nodes) == 4
    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 0
    assert not any(Path(f"/proc/{pid}").exists() for pid in nodes)


def test_a_node_that_ends_ends_all_and_that_is_an_error(
    started: tuple["subprocess.Popen[bytes]", list[int]],
) -> None:
    process, nodes = started
    os.kill(nodes[1], signal.SIGTERM)  # it ends with code 0
    assert process.wait(20) == 1
    assert not any(Path(f"/proc/{pid}").exists() for pid in nodes)
