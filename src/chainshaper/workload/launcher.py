"""Starting processes of the live workload, talking with them, and leaving none behind.

A launcher and a child talk in lines of JSON on pipes, and bytes at the end:

1. launcher → child: what the child is;
2. child → launcher: that it is ready;
3. launcher → child: when to start and stop (ns of CLOCK_MONOTONIC);
4. child → launcher: a line with the size of its events, then the events;
5. launcher → child: an empty line, after which the child leaves.

Between 3 and 4 neither touches a pipe, so that talking never disturbs what is measured.
"""

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import IO, TYPE_CHECKING, Any, TextIO, TypeVar

from chainshaper.linux.child_processes import end_in_words, module_command
from chainshaper.values.errors import OperationError

if TYPE_CHECKING:  # a stall meter runs with the standard library alone
    from pydantic import BaseModel

ENOUGH = signal.SIGUSR1  # has a child end its run early, and send what it recorded
ANSWER_S = 60.0  # a child that is silent for longer, discovery included, hangs
DYING_S = 2.0  # how long a child that has closed its pipe may take to end
Model = TypeVar("Model", bound="BaseModel")
WORKER_NAME = "executor"  # of a node's threads that execute beside its main one
LOOP_NAME = "loop"  # of the thread of a node's loop


@dataclass(frozen=True)
class Child:
    """A process that the launcher has started."""

    name: str  # in messages
    process: subprocess.Popen[bytes]
    errors: IO[bytes]  # its error output
    received: bytearray = field(default_factory=bytearray, repr=False)  # output not yet taken

    @property
    def pid(self) -> int:
        return self.process.pid

    def tell(self, **fields: Any) -> None:
        """Send a line.

        That the child has ended is no error here: :meth:`hear` or :func:`first_casualty` says it.
        """
        self._send(json.dumps(fields))

    def tell_model(self, model: "BaseModel") -> None:
        """Send a model, as :meth:`tell` does, without the fields that were not set.

        So validators see the same fields set at both ends.
        """
        self._send(model.model_dump_json(exclude_unset=True))

    def _send(self, line: str) -> None:
        assert self.process.stdin is not None  # noqa: S101 - start_child opens it
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(line.encode() + b"\n")
            self.process.stdin.flush()

    def hear(self, within_s: float = ANSWER_S) -> dict[str, Any]:
        """Receive the child's next line; each part of it may take ``within_s``.

        Raises OperationError: the child has ended, or is silent.
        """
        line = self._take(lambda received: received.find(b"\n") + 1, within_s)
        heard = None
        with contextlib.suppress(ValueError):
            heard = json.loads(line)
        if not isinstance(heard, dict):
            raise OperationError(self.obituary())
        return heard

    def hear_bytes(self, size: int, within_s: float = ANSWER_S) -> bytes:
        """Receive the bytes that follow a line. Raises OperationError: as :meth:`hear`."""
        if not size:
            return b""
        return self._take(lambda received: size if len(received) >= size else 0, within_s)

    def _take(self, enough: Callable[[bytearray], int], within_s: float) -> bytes:
        """Wait until ``enough`` says how many of the received bytes to take, and take them.

        It waits in `select`, which a signal always ends, and so does Ctrl-C. A `read` the kernel
        would start again where a library has installed signal handlers that ask for it.
        """
        assert self.process.stdout is not None  # noqa: S101 - start_child opens it
        pipe = self.process.stdout.fileno()
        while not (length := enough(self.received)):
            if not select.select([pipe], [], [], within_s)[0]:
                silent = f"has not answered for {within_s:g} s: it hangs, or was stopped"
                raise OperationError(f"{self.name} (pid {self.pid}) {silent}")
            arrived = os.read(pipe, 1 << 20)
            if not arrived:
                raise OperationError(self.obituary())
            self.received.extend(arrived)
        taken = bytes(self.received[:length])
        del self.received[:length]
        return taken

    def obituary(self) -> str:
        """Say in a sentence how the child has ended, with the last line of its error output."""
        try:
            code = self.process.wait(timeout=DYING_S)
        except subprocess.TimeoutExpired:
            return f"{self.name} (pid {self.pid}) sends something that is not part of the protocol"
        self.errors.seek(0)
        said = self.errors.read().decode(errors="replace").strip().splitlines()
        last = f": {said[-1]}" if said else ""
        return f"{self.name} (pid {self.pid}) {end_in_words(code)} before the run was over{last}"


def start_child(
    name: str,
    module: str,
    environment: dict[str, str],
    arguments: Sequence[str] = (),
    libraries: Sequence[str] = (),
) -> Child:
    """Start ``python -m module ARGUMENTS`` with pipes to talk to it.

    ``libraries`` are what it imports beyond Python's standard library. It has a session of its own,
    so that Ctrl-C reaches the launcher only, which ends its children in order.
    """
    errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the child
    try:
        process = subprocess.Popen(
            [*module_command(module, libraries), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env={**os.environ, **environment},
            start_new_session=True,
        )
    except OSError as error:
        errors.close()
        raise OperationError(f"{name} cannot be started: {error}") from error
    return Child(name, process, errors)


def first_casualty(children: Iterable[Child]) -> Child | None:
    """Return a child that has ended although it should run; None: all run."""
    return next((child for child in children if child.process.poll() is not None), None)


def end_all(children: Iterable[Child], patience_s: float = 2.0) -> None:
    """End all children: ask them, wait for ``patience_s``, and kill those that are left."""
    children = list(children)
    for child in children:
        child.tell()
    deadline = time.monotonic() + patience_s
    for child in children:
        try:
            child.process.wait(timeout=max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            child.process.kill()
            child.process.wait()
        for stream in (child.process.stdin, child.process.stdout, child.errors):
            if stream is not None:
                with contextlib.suppress(OSError):  # unsent bytes of a broken pipe
                    stream.close()


# The other end


def receive() -> dict[str, Any]:
    """Read the launcher's next line; end this process when the launcher is gone."""
    received: dict[str, Any] = json.loads(_receive_line())
    return received


def receive_model(model: type[Model]) -> Model:
    """Read a model that the launcher sent by :meth:`Child.tell_model`."""
    return model.model_validate_json(_receive_line())


def _receive_line() -> str:
    line = sys.stdin.readline()
    if not line:
        sys.exit(0)
    return line


def own_output() -> TextIO:
    """Return the pipe to the launcher; from now on what is printed goes to the error output."""
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return output


def send(output: TextIO, **fields: Any) -> None:
    """Send a line to the launcher."""
    output.write(json.dumps(fields) + "\n")
    output.flush()


def send_events(output: TextIO, events: bytes, **fields: Any) -> None:
    """Send what was recorded, behind a line that says how many bytes it is."""
    send(output, bytes=len(events), **fields)
    # A process that is frozen while it writes has written a part only. Without a buffer
    # (PYTHONUNBUFFERED) nothing else writes the rest.
    left = memoryview(events)
    while left:
        left = left[output.buffer.write(left) :]
    output.buffer.flush()


def wait_for_leave() -> None:
    """Wait until the launcher lets this process end: one that leaves early disturbs the others."""
    sys.stdin.readline()
