"""Gates in containers, whose pages are in memory that is not ours, as they are seen from here."""

import os
import socket
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from containers import contained, needs_namespaces
from known import known

import chainshaper as cs
from chainshaper.splicing.shaped_outputs import (
    FollowedOutput,
    ShapedOutput,
    ask_phase,
    find_outputs,
)

PROCESS = Path(__file__).parent / "output_process.py"
pytestmark = needs_namespaces


def _of(pids: set[int]) -> list[ShapedOutput]:
    return [one for one in find_outputs() if one.shaping_node in pids]


@pytest.mark.parametrize("user", [False, True], ids=["root", "user namespace"])
def test_outputs_of_two_containers_are_shown_and_asked_to_move(tmp_path: Path, user: bool) -> None:
    """Both gates call themselves process 1, and their pages have one name."""
    command = [sys.executable, str(PROCESS), "/dev/shm/chainshaper-0", "shaping", "t5"]
    environment = {"PYTHONPATH": str(Path(cs.__file__).parents[1])}
    with ExitStack() as both, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        pids = set()
        for _ in range(2):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
                free.bind(("127.0.0.1", 0))
                port = free.getsockname()[1]
            words = [*command, str(port), "1000000"]
            started, process = both.enter_context(contained(words, environment, user=user))
            output = known(started.stdout).fileno()
            assert os.read(output, 9) == b"R" + (1).to_bytes(8, "little")
            sender.sendto((7).to_bytes(8, "little"), ("127.0.0.1", port))
            assert os.read(output, 9) == b"S" + (7).to_bytes(8, "little")
            pids.add(process.pid)
        found = _of(pids)
        assert {one.shaping_node for one in found} == pids
        assert {(one.topic, one.state) for one in found} == {("/t5", "no standby")}
        one = min(pids)
        ask_phase("/t5", {one}, 5_000_000)
        followed = FollowedOutput("/t5", {one})
        followed.move(2_000_000, time.monotonic_ns())
        assert {o.shaping_node: o.moved_ns for o in _of(pids)} == {one: 2_000_000, max(pids): 0}
        followed.close()
    assert _of(pids) == []
