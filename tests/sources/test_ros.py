"""Asking an application's ROS 2, with its Python and in its environment; rclpy is a stand-in."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from chainshaper.sources.ros import Environment, ask_graph, environment_of, run_with_rclpy, script
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import EndpointInfo

RCLPY = '''
"""As much of rclpy 7.1 (Jazzy) as is used, saying what two nodes over Cyclone DDS said.

SERVERS of a node's parameter service are there.
"""
import enum, os, sys, types

WORDS = "RELIABLE BEST_EFFORT VOLATILE TRANSIENT_LOCAL KEEP_LAST UNKNOWN AUTOMATIC"
Words = enum.Enum("Words", WORDS)

class Duration:
    def __init__(self, nanoseconds):
        self.nanoseconds = nanoseconds

INFINITE = Duration(9223372036854775807)

def endpoint(name, namespace, reliability, durability, history, depth, deadline, lifespan):
    profile = types.SimpleNamespace(
        reliability=Words[reliability], durability=Words[durability], history=Words[history],
        depth=depth, deadline=deadline, lifespan=lifespan, liveliness=Words.AUTOMATIC,
        liveliness_lease_duration=INFINITE,
    )
    return types.SimpleNamespace(node_name=name, node_namespace=namespace,
                                 topic_type="sensor_msgs/msg/Image", qos_profile=profile)

class Node:
    def get_topic_names_and_types(self):
        return [("/t1", ["sensor_msgs/msg/Image"])]
    def get_publishers_info_by_topic(self, topic):
        qos = ("RELIABLE", "VOLATILE", "KEEP_LAST", 10, INFINITE, INFINITE)
        own, one = endpoint("_chainshaper_snapshot", "/", *qos), endpoint("node1", "/", *qos)
        return [own, one, one]
    def get_subscriptions_info_by_topic(self, topic):
        return [endpoint("node2", "/front", "BEST_EFFORT", "TRANSIENT_LOCAL", "UNKNOWN", 0,
                         Duration(100_000_000), Duration(0))]
    def create_client(self, service, name):
        ready = int(os.environ["SERVERS"]) > 0
        return types.SimpleNamespace(service_is_ready=lambda: ready, call_async=lambda _: Answer())
    def destroy_node(self):
        pass

class Parameter:
    Type = enum.Enum("Type", "INTEGER")
    def __init__(self, *_):
        pass
    def to_parameter_msg(self):
        return None

class SetParameters:
    @staticmethod
    def Request(parameters):
        return parameters

class Answer:
    def done(self):
        return True
    def result(self):
        return types.SimpleNamespace(results=[types.SimpleNamespace(successful=True)])

if os.environ.get("COUNTS") == "1":
    Node.count_services = lambda self, name: int(os.environ["SERVERS"])

def init(args):
    print("a library says something first")
    if "LD_PRELOAD" in os.environ or os.environ["RMW_IMPLEMENTATION"] != "rmw_cyclonedds_cpp":
        raise RuntimeError("another environment than the node's")

def create_node(name, enable_rosout, start_parameter_services):
    return Node()

def spin_once(node, timeout_sec):
    pass

shutdown = lambda: None
for name in ("rclpy.parameter", "rcl_interfaces", "rcl_interfaces.srv"):
    sys.modules[name] = sys.modules[__name__]
'''


@pytest.fixture
def application(tmp_path: Path) -> Environment:
    """A node's environment: its own `ros2`, run by a Python that finds this `rclpy`."""
    (tmp_path / "rclpy.py").write_text(RCLPY)
    (tmp_path / "ros2").write_text(f"#!{sys.executable} -B\n")
    (tmp_path / "ros2").chmod(0o755)
    variables = {
        "PATH": str(tmp_path),  # no other Python is on it
        "PYTHONPATH": str(tmp_path),
        "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp",
        "LD_PRELOAD": "/opt/caret/libcaret.so",
    }
    return Environment(variables, os.geteuid())


def test_types_and_qos_of_every_endpoint_are_told(application: Environment) -> None:
    endpoints, problem = ask_graph(application)
    assert problem is None
    common = {"topic": "/t1", "type": "sensor_msgs/msg/Image", "liveliness": "automatic"}
    reliable = {"reliability": "reliable", "durability": "volatile", "history": "keep_last"}
    latched = {"reliability": "best_effort", "durability": "transient_local", "history": "unknown"}
    node1 = {**common, **reliable, "node": "/node1", "kind": "publisher", "depth": 10}
    node2 = {**common, **latched, "node": "/front/node2", "kind": "subscription", "depth": 0}
    publisher = EndpointInfo.model_validate(node1)
    subscription = EndpointInfo.model_validate({**node2, "deadline_ns": 100_000_000})
    assert endpoints == (publisher, publisher, subscription)  # two publishers stay two


def endpoint(node: str, topic: str, depth: str) -> str:
    values = f'"node": {node}, "topic": {topic}, "kind": "publisher", "depth": {depth}'
    return f'{{"endpoints": [{{{values}}}]}}'


@pytest.mark.parametrize(
    ("answer", "count"),
    [
        (endpoint('"/a"', '"/t"', "1"), 1),
        (endpoint('"no_slash"', '"/t"', "1"), 0),
        (endpoint(r'"/\ud800"', '"/t"', "1"), 0),
        (endpoint('"/a"', r'"/\u001b[31m"', "1"), 0),
        (endpoint('"/a"', r'"/t\n"', "1"), 0),
        (endpoint('"/a"', '"/t"', str(10**30)), 0),
        (endpoint('"/a"', '"/t"', "1e400"), 0),
        ('{"endpoints"', 0),
        ('{"endpoints": 7}', 0),
        ('{"endpoints": [7]}', 0),
        ('{"endpoints": ' + "[" * 100_000, 0),
    ],
)
def test_a_strangers_answer_is_no_more_than_ros_2_can_say(
    answer: str, count: int, application: Environment, tmp_path: Path
) -> None:
    (tmp_path / "answer").write_text(answer)
    (tmp_path / "say").write_text(f"exec /bin/cat {tmp_path}/answer")
    (tmp_path / "ros2").write_text(f"#!/bin/sh {tmp_path}/say\n")
    endpoints, problem = ask_graph(application)
    assert len(endpoints) == count
    assert problem is None or "answer" not in problem, "it has been asked"


def test_a_graph_that_cannot_be_asked_is_no_more_than_a_reason(
    application: Environment, tmp_path: Path
) -> None:
    variables = {**application.variables, "RMW_IMPLEMENTATION": "rmw_connextdds"}
    endpoints, problem = ask_graph(replace(application, variables=variables))
    assert (endpoints, problem) == ((), "RuntimeError: another environment than the node's")
    (tmp_path / "rclpy.py").unlink()
    assert ask_graph(application) == ((), "ModuleNotFoundError: No module named 'rclpy'")
    (tmp_path / "ros2").unlink()
    endpoints, problem = ask_graph(application)
    assert endpoints == ()
    assert problem is not None
    assert "python3: not found" in problem


def test_the_environment_of_a_process_is_what_it_was_started_with() -> None:
    process = subprocess.Popen(["sleep", "60"], env={"ROS_DOMAIN_ID": "7", "EMPTY": ""})
    try:
        environment = environment_of(process.pid)
        assert environment == Environment({"ROS_DOMAIN_ID": "7", "EMPTY": ""}, os.geteuid())
    finally:
        process.kill()
        process.wait()
    with pytest.raises(OperationError, match="cannot be read: No such file"):
        environment_of(process.pid)
    assert environment_of(os.getpid()).variables["PATH"]


@pytest.mark.parametrize(
    ("servers", "counts", "problem"),
    [
        ("1", "1", None),
        ("1", "0", None),  # before Jazzy nothing counts them
        ("2", "1", "2 participants answer for /shaper, so none of them is believed"),
    ],
)
def test_an_answer_is_believed_where_one_participant_can_have_given_it(
    servers: str, counts: str, problem: str | None, application: Environment
) -> None:
    variables = {**application.variables, "SERVERS": servers, "COUNTS": counts}
    environment = replace(application, variables=variables)
    arguments = ("parameter", "phase_ns", "7", "/shaper")
    assert run_with_rclpy(environment, script.__file__, *arguments, within_s=30)[1] == problem
