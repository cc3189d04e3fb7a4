"""The real `ros2_control_node` with mock hardware: a witness of its own counts the turns."""

import os
import subprocess
import textwrap
from pathlib import Path

import polars as pl
import pytest

from chainshaper.analysis import analyse_latency, graph_of, recorded_flow
from chainshaper.flow.record import record_command

CHAIN = "/forward/commands../controller_manager:write"

WITNESS = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#define WRITE _ZN18controller_manager17ControllerManager5writeERKN6rclcpp4TimeERKNS1_8DurationE
#define TEXT(name) #name
#define NAME(name) TEXT(name)
static long long now(void) {
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return time.tv_sec * 1000000000LL + time.tv_nsec;
}
void WRITE(void *manager, const void *time, const void *period) {
  static FILE *file;
  void (*behind)(void *, const void *, const void *) =
    (void (*)(void *, const void *, const void *))dlsym(RTLD_NEXT, NAME(WRITE));
  if (!file) setlinebuf(file = fopen(getenv("WITNESS"), "w"));
  long long began = now();
  behind(manager, time, period);
  fprintf(file, "%lld %lld\n", began, now());
}
"""
"""A library behind ours that notes when each call of `write()` began and returned."""

ROBOT = """
<robot name="arm"><link name="base"/><link name="tip"/>
<joint name="joint1" type="revolute"><parent link="base"/><child link="tip"/>
<axis xyz="0 0 1"/><limit lower="-9" upper="9" effort="9" velocity="9"/></joint>
<ros2_control name="mock" type="system">
<hardware><plugin>mock_components/GenericSystem</plugin></hardware>
<joint name="joint1"><command_interface name="position"/><state_interface name="position"/></joint>
</ros2_control></robot>
"""

PARAMETERS = """
controller_manager:
  ros__parameters:
    update_rate: 100
    forward: {type: forward_command_controller/ForwardCommandController}
forward:
  ros__parameters: {joints: [joint1], interface_name: position}
"""

ROBOT_RUNS = """
import signal, subprocess, sys, threading, rclpy
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from std_msgs.msg import Float64MultiArray, String
robot, parameters, commands = sys.argv[1:]
run = ["ros2", "run", "controller_manager"]
manager = subprocess.Popen(
    [*run, "ros2_control_node", "--ros-args", "--params-file", parameters], start_new_session=True)
rclpy.init()
node = rclpy.create_node("sensor")
latched = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
described = node.create_publisher(String, "/robot_description", latched)
described.publish(String(data=open(robot).read()))
publisher = node.create_publisher(Float64MultiArray, "/forward/commands", 1)
sent = 0
def send():
    global sent
    sent += 1
    publisher.publish(Float64MultiArray(data=[sent / 1000]))
spawned = []
spawner = threading.Thread(target=lambda: spawned.append(subprocess.run(
    [*run, "spawner", "forward", "--param-file", parameters], timeout=60).returncode))
spawner.start()
while spawner.is_alive():
    rclpy.spin_once(node, timeout_sec=0.1)
node.create_timer(0.02, send)
while sent < int(commands) and spawned == [0]:
    rclpy.spin_once(node)
subprocess.run(["pkill", "-INT", "--session", str(manager.pid)])
manager.wait(30)
sys.exit(spawned != [0])
"""


@pytest.mark.ros2(
    "rclcpp", "controller_manager", "forward_command_controller", "hardware_interface", "ros2run"
)
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("in_ros2")
def test_every_turn_of_ros2_control_is_seen_and_ends_the_chain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    witness, noted = tmp_path / "libwitness.so", tmp_path / "noted"
    gcc = ["gcc", "-shared", "-fPIC", "-x", "c", "-", "-o", str(witness), "-ldl"]
    subprocess.run(gcc, input=WITNESS.encode(), check=True)
    (tmp_path / "robot.urdf").write_text(ROBOT)
    (tmp_path / "parameters.yaml").write_text(PARAMETERS)
    (tmp_path / "robot.py").write_text(textwrap.dedent(ROBOT_RUNS))
    before = [os.environ["LD_PRELOAD"]] if os.environ.get("LD_PRELOAD") else []
    monkeypatch.setenv("LD_PRELOAD", ":".join([*before, str(witness)]))
    monkeypatch.setenv("WITNESS", str(noted))
    words = ("robot.py", "robot.urdf", "parameters.yaml")
    command = ["python3", *(str(tmp_path / word) for word in words), "300"]
    recording = record_command(tmp_path / "recording", command, source="preload").recording
    flow = recorded_flow(recording)
    rows = [tuple(map(int, line.split())) for line in noted.read_text().splitlines()]
    callbacks = graph_of(flow).callbacks
    (loop,) = (
        c for c in callbacks if "/controller_manager:write" in c.publishes and c.kind == "loop"
    )
    turns = flow.instances.filter(callback_id=loop.id).sort("start")
    assert loop.period_ns == 10_000_000
    assert [c.node for c in callbacks if c.kind == "loop" and c.pid == loop.pid] == [loop.node]
    assert turns.height == len(rows), "turns seen of turns made"
    ended = turns["end"].to_list()
    assert all(end >= returned for end, (_, returned) in zip(ended, rows, strict=True))
    analysis = analyse_latency(flow, CHAIN)
    complete = analysis.traversals.filter(pl.col("complete"))
    assert complete.height > 100
    assert analysis.data_age is not None
