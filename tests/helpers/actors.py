"""Processes that do nothing but look like something: threads with names, arguments of nodes.

An actor is a real process with real threads, which sleep. It obeys lines on its standard input:
``thread NAME`` starts one more thread, ``end NAME`` ends one, ``fork`` forks a child that sleeps;
its answer is the new id.
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from chainshaper.linux.threads import RunningThread, list_threads

_PROGRAM = """
import ctypes, json, os, signal, sys, threading
libc = ctypes.CDLL(None)
libc.prctl(1, signal.SIGKILL, 0, 0, 0)  # die with the test
ends = {}

def body(name, ready):
    libc.prctl(15, name.encode(), 0, 0, 0)
    ready.set()
    ends[name].wait()

def start(name):
    ends[name], ready = threading.Event(), threading.Event()
    thread = threading.Thread(target=body, args=(name, ready), daemon=True)
    thread.start()
    ready.wait()
    threads[name] = thread
    return thread.native_id

threads = {}
answer = {name: start(name) for name in json.loads(os.environ["ACTOR_THREADS"])}
while True:
    print(json.dumps(answer), flush=True)
    words = sys.stdin.readline().split(maxsplit=1)
    if not words:
        break
    if words[0] == "thread":
        answer = start(words[1].strip())
    elif words[0] == "end":
        name = words[1].strip()
        ends[name].set()
        threads[name].join()
        while os.path.exists(f"/proc/self/task/{threads[name].native_id}"):
            pass  # Python has done with it a little earlier than the kernel
        answer = None
    elif words[0] == "fork":
        ready, tell = os.pipe()
        answer = os.fork()
        if answer == 0:
            libc.prctl(1, signal.SIGKILL, 0, 0, 0)
            os.write(tell, b".")
            signal.pause()
        os.read(ready, 1)  # a child that is not ready would outlive a killed parent
        os.close(ready)
        os.close(tell)
"""


@dataclass
class Actor:
    """An actor at work; ``tids`` are those of its threads by name."""

    process: "subprocess.Popen[str]"
    tids: dict[str, int] = field(default_factory=dict)

    @property
    def pid(self) -> int:
        return self.process.pid

    def thread(self, name: str) -> RunningThread:
        """One of its threads as the kernel shows it now; ``main`` is the main thread."""
        tid = self.pid if name == "main" else self.tids[name]
        return next(thread for thread in list_threads(self.pid) if thread.tid == tid)

    def begin(self, name: str) -> int:
        """Have it start one more thread."""
        self.tids[name] = self._told(f"thread {name}")
        return self.tids[name]

    def end(self, name: str) -> None:
        """Have it end a thread."""
        self._told(f"end {name}")

    def fork(self) -> int:
        """Have it fork a child, which dies with it."""
        return int(self._told("fork"))

    def _told(self, line: str) -> int:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())  # type: ignore[no-any-return]


@contextmanager
def acting(
    folder: Path, *threads: str, arguments: tuple[str, ...] = (), program: str = "actor.py"
) -> Iterator[Actor]:
    """An actor with these threads and command line arguments, killed at the end."""
    script = folder / program
    script.write_text(_PROGRAM)
    process = subprocess.Popen(
        [sys.executable, "-S", "-E", str(script), *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "ACTOR_THREADS": json.dumps(threads)},
    )
    try:
        assert process.stdout is not None
        yield Actor(process, json.loads(process.stdout.readline()))
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
