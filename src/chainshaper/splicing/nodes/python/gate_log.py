"""What a gate did, a line of comma-separated values per message, and how many it lost.

A process of its own writes the file, so that neither a slow disk nor a full one can delay the
gate: that only puts a line into a pipe, and goes on without it where the pipe is full. What is in
the pipe is written although the gate is killed. Rows are numbered, so that missing ones can be
counted.
"""

import atexit
import fcntl
import inspect
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress

from rclpy.node import Node

from chainshaper.gate.decision import LOG_COLUMNS, Outcome
from chainshaper.splicing.nodes.python.endpoints import parameters_of

LOG_HEADER = f"{','.join(LOG_COLUMNS)}\n".encode()
PIPE_BYTES = 1 << 20
SAID_EVERY_NS = 10_000_000_000


def _write_rows(path: str, header: bytes, most_bytes: int) -> None:
    """Add the lines of standard input to a file until they end; never a part of a line.

    A file that would have more than half of ``most_bytes`` becomes ``….1``, in place of the one
    before it. A file that has been removed is made anew. Lines that cannot be written are missing.
    """
    import os  # this function is all that its process has
    import time

    def opened() -> int:
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)

    def append(text: bytes) -> None:
        file = opened()
        try:
            size = os.fstat(file).st_size
            if size > len(header) and size + len(text) > most_bytes // 2:
                os.replace(path, path + ".1")  # noqa: PTH105 - there is little to import here
                os.close(file)
                file, size = opened(), 0
            whole = text if size else header + text
            try:
                written = os.write(file, whole)
            except OSError:
                written = 0
            if written < len(whole):
                os.ftruncate(file, size)
                raise OSError
        finally:
            os.close(file)

    rest, received = b"", b"\n"
    while received:
        received = os.read(0, 1 << 16)
        lines, newline, rest = (rest + received).rpartition(b"\n")
        try:
            if newline:
                append(lines + newline)
        except OSError:
            time.sleep(1 if received else 0)  # what comes meanwhile is tried together


def _begin(path: str) -> None:
    """Make the file, where there is none."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | os.O_NONBLOCK
    file = os.open(path, flags, 0o644)
    try:
        if os.fstat(file).st_size == 0:
            os.write(file, LOG_HEADER)
    finally:
        os.close(file)


class GateLog:
    """The rows of a gate, numbered, and the sums of what it lost."""

    def __init__(self, node: Node, path: str, most_bytes: int) -> None:
        self._logger = node.get_logger()
        self._pipe: int | None = None
        self._process = f"{os.getpid()},{threading.get_native_id()}"
        self._rows = self._unlogged = self._said_ns = 0
        self._lost: Counter[str] = Counter()
        self._said: Counter[str] = Counter()
        if path:
            try:
                _begin(path)
            except OSError as error:
                self._logger.warning(f"no log is written to {path}: {error.strerror}")
            self._start_writer(path, most_bytes)

    def _start_writer(self, path: str, most_bytes: int) -> None:
        call = f"_write_rows({path!r}, {LOG_HEADER!r}, {most_bytes})"
        rows, self._pipe = os.pipe()
        os.set_blocking(self._pipe, False)
        with suppress(OSError):  # more than a user may have
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        writer = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", f"{inspect.getsource(_write_rows)}\n{call}"],
            stdin=rows,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # it hears no Ctrl-C, and ends behind the last line
        )
        os.close(rows)
        atexit.register(self._end, writer)

    def _end(self, writer: "subprocess.Popen[bytes]") -> None:
        if self._pipe is not None:
            os.close(self._pipe)
            self._pipe = None
        with suppress(subprocess.TimeoutExpired):
            writer.wait(2)

    def write(
        self, outcome: Outcome, published: int | None = None, stalled: int | None = None
    ) -> None:
        """Note what became of a message.

        ``published`` is when publishing returned, ``stalled`` for how long the machine stood still
        behind the release (ns, None: not known).
        """
        release, message = outcome.release, outcome.message
        self._rows += 1
        if outcome.dropped is not None:
            self._lost[outcome.dropped] += 1
        if message.lost:
            self._lost["lost by DDS"] += message.lost
        if self._pipe is not None:
            core = next(iter(os.sched_getaffinity(0)))
            values = (  # of LOG_COLUMNS, in their order
                *(outcome.awake_ns, self._process, core, message.about, message.arrival_ns),
                *(release.origin_ns, release.at_ns, release.slot, release.cycles_waited),
                *(release.anchor, release.overrun, release.mode, published, stalled),
                *(outcome.dropped, message.lost, self._rows),
            )
            line = ",".join("" if value is None else str(value) for value in values) + "\n"
            try:
                os.write(self._pipe, line.encode())
            except OSError:
                self._lost["not in the log"] += 1
        if self._lost != self._said:
            self._say()

    def _say(self) -> None:
        """Warn of what is lost so far, at most every ten seconds."""
        now = time.monotonic_ns()
        if self._said_ns and now - self._said_ns < SAID_EVERY_NS:
            return
        self._said_ns, self._said = now, self._lost.copy()
        lost = ", ".join(f"{count} {why}" for why, count in self._lost.items())
        self._logger.warning(f"of {self._rows} messages so far: {lost}")


def log_of(node: Node) -> GateLog:
    """The log that a node's parameters name."""
    parameters = parameters_of(node)
    return GateLog(node, parameters.log, parameters.log_bytes)
