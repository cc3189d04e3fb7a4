"""A Python node in a process of its own, on a stand-in for rclpy: lines in, lines out."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import yaml
from known import known
from passing import serialized

from chainshaper.planning import ChainPlan, Modes
from chainshaper.planning.chain_plan import revised, with_slots
from chainshaper.splicing.shaped_outputs import ShapedOutput, find_outputs
from chainshaper.splicing.shaping_process import ShapingProcess

MS = 1_000_000
# Wide enough that a busy machine wakes the node within them.
SLOTS = ((15 * MS, 25 * MS), (30 * MS, 45 * MS))
STAND_IN = Path(__file__).parent / "rclpy_stand_in.py"

# As rmw_cyclonedds tells it of a publisher: neither its history nor its depth is known.
RELIABLE = {"history": 3, "depth": 0, "reliability": 1, "durability": 2, "liveliness": 1} | (
    dict.fromkeys(("lifespan", "deadline", "liveliness_lease_duration"), "infinite")
)
PUBLISHERS = {"/t3_tmp": [{"type": "sensor_msgs/msg/Image", "qos": RELIABLE}]}


def leaving_in(plan: ChainPlan, *slots: tuple[int, int], **changes: Any) -> ChainPlan:
    """The plan with these publish slots, and other changes."""
    return revised(plan, servers=with_slots(plan.servers, {"output": slots}), **changes)


def banded(plan: ChainPlan) -> ChainPlan:
    modes = Modes(topic="/mode", default="city", bands={"city": 2, "highway": 1}, late="next-slot")
    return leaving_in(plan, *SLOTS, modes=modes)


def parameters_of(process: ShapingProcess, **changes: object) -> dict[str, Any]:
    """The parameters that were written for a process, which then has others in their place."""
    values: dict[str, Any] = yaml.safe_load(process.parameters_file.read_text())
    written: dict[str, Any] = values["/**"]["ros__parameters"]
    if changes:
        text = yaml.safe_dump({"/**": {"ros__parameters": written | changes}})
        process.parameters_file.write_text(text)
    return written


class NodeRun:
    """A running node: what it said is in ``said``, in the order in which it did."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self.process = process
        self.said: list[dict[str, Any]] = []
        self._lines: Queue[str | None] = Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in known(self.process.stdout):
            self._lines.put(line)
        self._lines.put(None)

    def tell(self, **what: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()

    def send(self, payload: bytes, source: int | None = 1, **more: Any) -> None:
        self.tell(topic="/t3_tmp", payload=payload.hex(), source=source, **more)

    def hear_published(self, payload: bytes | None = None) -> None:
        """Wait until it publishes the output: anything, or that."""
        wanted = {"published": "/t3"} | ({} if payload is None else {"payload": payload.hex()})
        self.hear(lambda words: words.items() >= wanted.items())

    @property
    def published(self) -> list[bytes]:
        found = [words["payload"] for words in self.said if words.get("published") == "/t3"]
        return [bytes.fromhex(payload) for payload in found]

    @property
    def logged(self) -> list[str]:
        return [words["log"] for words in self.said if "log" in words]

    def hear(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        while (line := self._lines.get(timeout=30)) is not None:
            if wanted(words := self._heard(line)):
                return words
        raise AssertionError(f"it ended without saying so: {self.said}")

    def heard(self, wanted: Callable[[dict[str, Any]], bool], within_s: float) -> bool:
        """Whether it says that within so many seconds."""
        until = time.monotonic() + within_s
        while (left := until - time.monotonic()) > 0:
            with suppress(Empty):
                if wanted(self._heard(self._lines.get(timeout=left) or "{}")):
                    return True
        return False

    def _heard(self, line: str) -> dict[str, Any]:
        words: dict[str, Any] = {"text": line.strip()}
        self.said.append(json.loads(line) if line.startswith("{") else words)
        return self.said[-1]

    def end(self, how: signal.Signals | None = None) -> int:
        """End it, by the end of its input or by a signal; its exit code, all said being read."""
        if how is None:
            known(self.process.stdin).close()
        else:
            self.process.send_signal(how)
        while (line := self._lines.get(timeout=30)) is not None:
            self._heard(line)
        return self.process.wait(30)


@contextmanager
def running_node(
    process: ShapingProcess,
    folder: Path,
    publishers: dict[str, list[dict[str, Any]]] | None = None,
    *,
    spinning: bool = True,
    environment: Mapping[str, str] | None = None,
) -> Iterator[NodeRun]:
    """A Python node that runs where only the stand-in and PyYAML can be imported.

    What it agrees on with its standby is in a folder of the test. ``spinning``: once it has begun
    to work.
    """
    modules = folder / "modules"
    modules.mkdir(exist_ok=True)
    shutil.copyfile(STAND_IN, modules / "rclpy.py")
    assert process.command is not None
    script = Path(process.command[1])
    text = script.read_text().replace("/run/chainshaper/outputs", str(folder / "outputs"))
    script.write_text(text)
    rules = [f"{match}:={target}" for match, target in process.remappings]
    child = subprocess.Popen(
        [sys.executable, script, "--params-file", process.parameters_file, *rules],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={
            **os.environ,
            "PYTHONPATH": str(modules),
            "XDG_RUNTIME_DIR": str(folder),
            "STAND_IN_PUBLISHERS": json.dumps(PUBLISHERS if publishers is None else publishers),
            **(environment or {}),
        },
    )
    try:
        run = NodeRun(child)
        if spinning:
            run.hear(lambda words: words.get("event") == "spinning")
        yield run
    finally:
        child.kill()
        child.wait()


def outputs(folder: Path) -> tuple[ShapedOutput, ...]:
    return find_outputs([str(folder / "outputs"), str(folder / "chainshaper" / "outputs")])


def stamped(rest: bytes = b"rest", age_ns: int = 0) -> bytes:
    """A serialized message whose chain began when this is called, or so long before."""
    return serialized(time.time_ns() - age_ns, rest)
