"""Setting a parameter of nodes: who answers, and who only says so. A stand-in is rclpy here."""

import os
import sys
from pathlib import Path

import pytest

from chainshaper.sources.ros import Environment, run_with_rclpy, script

RCLPY = '''
"""As much of rclpy (Jazzy) as is used; SERVERS of the node's service are there."""
import enum, os, sys, types

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

class Node:
    def create_client(self, service, name):
        ready = int(os.environ["SERVERS"]) > 0
        return types.SimpleNamespace(service_is_ready=lambda: ready, call_async=lambda _: Answer())
    def destroy_node(self):
        pass

if os.environ["COUNTS"] == "1":
    Node.count_services = lambda self, name: int(os.environ["SERVERS"])

def create_node(name, enable_rosout, start_parameter_services):
    return Node()

def init(args):
    pass

def spin_once(node, timeout_sec):
    pass

shutdown = lambda: None
for name in ("rclpy.parameter", "rcl_interfaces", "rcl_interfaces.srv"):
    sys.modules[name] = sys.modules[__name__]
'''


@pytest.mark.parametrize(
    ("servers", "counts", "problem"),
    [
        ("1", "1", None),
        ("1", "0", None),  # before Jazzy nothing counts them
        ("2", "1", "2 participants answer for /shaper, so none of them is believed"),
    ],
)
def test_an_answer_is_believed_where_one_participant_can_have_given_it(
    servers: str, counts: str, problem: str | None, tmp_path: Path
) -> None:
    (tmp_path / "rclpy.py").write_text(RCLPY)
    (tmp_path / "ros2").write_text(f"#!{sys.executable} -B\n")
    (tmp_path / "ros2").chmod(0o755)
    variables = {"PATH": str(tmp_path), "PYTHONPATH": str(tmp_path)}
    environment = Environment({**variables, "SERVERS": servers, "COUNTS": counts}, os.geteuid())
    arguments = ("parameter", "phase_ns", "7", "/shaper")
    assert run_with_rclpy(environment, script.__file__, *arguments, within_s=30)[1] == problem
