"""Move a loop that the library in front sees: its sleeps get longer, so that it wakes up later.

The request stands in the memory of the loop's process, in the ring of its thread; `preload.c` reads
it when the thread goes to sleep. Nothing of the application changes, and a thread that no request
names does nothing for this. What was added to which sleep the event `loop_moved` says.

* A loop that sleeps until instants of its own (ros2_control's, `rclcpp::Rate`) has the move added
  to each sleep, so it has the less time for its work: with the move, an instance must still end
  within the loop's period. Where the move makes it leave instances out, the library takes it back
  ("rate changed" in LOOP_MOVES), and nothing is moved until another request.
* In any other loop one sleep is longer, and all later ones follow.

Not moved are loops that sleep by `poll`, `epoll_wait`, `select`, `sleep`, or in an executor's wait
for work.
"""

import mmap
import time
from collections import deque
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np

from chainshaper.linux.threads import list_threads
from chainshaper.sources.preload.memory import (
    FIRST_EVENT,
    HEAD_BYTES,
    HEADER,
    RING,
    TracedProcess,
    event_names,
)
from chainshaper.sources.preload.running import memory_to_write
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.event_declarations import LOOP_MOVES

_CHECK = 0x6D6F76656C6F6F70  # `CHECK` in preload.c
_TURNS = 1024  # of a loop, whose durations are remembered
_SHORTEST_NS, _LONGEST_NS = 10_000, 10_000_000_000  # periods that preload.c takes


@dataclass(frozen=True)
class LoopMoved:
    """A change of what is added to a loop's sleeps: the event `loop_moved`.

    * ``at_ns``: when (CLOCK_MONOTONIC).
    * ``number``: of the request.
    * ``asked_ns``: how much later than by itself it is to wake up.
    * ``added_ns``: to one sleep, beside what was added to each before.
    * ``kept_ns``: what is added to each sleep from this one on.
    * ``why``: one of LOOP_MOVES.
    """

    at_ns: int
    number: int
    asked_ns: int
    added_ns: int
    kept_ns: int
    why: str


class LoopMover:
    """Moves the loop of a thread, until it is closed; then the loop is at its own instants again.

    A process that ends without closing it has its request in force until the ``lease_ns`` of its
    last :meth:`move` or :meth:`renew` is over (0: for ever).

    Raises OperationError: the thread does not run, its process has no library of this version in
    front or may not be written to, or the library has not seen the thread.
    """

    def __init__(self, pid: int, tid: int, lease_ns: int = 5_000_000_000) -> None:
        self.pid, self.tid, self._lease_ns = pid, tid, lease_ns
        self._memory, self.process = _writable(pid)
        rings = (HEAD_BYTES - HEADER.itemsize) // RING.itemsize
        heads = np.frombuffer(self._memory, RING, rings, HEADER.itemsize)
        self._inner_tid = next(
            (thread.inner_tid for thread in list_threads(pid) if thread.tid == tid), 0
        )
        taken = np.flatnonzero(self.process.taken == self._inner_tid)
        if not self._inner_tid or not taken.size:
            raise OperationError(
                f"the loop in thread {tid} of process {pid} cannot be moved: the library in front"
                " has seen no such thread sleep for a time outside callbacks. Name it"
                " (`record --loop`), or see `chainshaper threads`"
            )
        self.ring = int(taken[0])
        self._asked: Any = heads["asked"][self.ring]
        self._number = int(self._asked["number"])
        self._has_asked = False
        self._turns_ns = deque[int](maxlen=_TURNS)  # how long the latest ones lasted
        self._woke_ns: int | None = None  # when a turn began that has not ended yet

    def __enter__(self) -> "LoopMover":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def number(self) -> int:
        """The number of the latest request: `loop_moved` names it."""
        return self._number

    @property
    def is_there(self) -> bool:
        """Whether the thread still has its ring: it has not ended."""
        return bool(self.process.taken[self.ring] == self._inner_tid)

    def seen(self) -> tuple[list[int], list[LoopMoved]]:
        """Return when the loop has woken up since the last call (ns), and how it was moved.

        The first call returns what the memory still has from before.
        """
        names, wanted = event_names(), ("thread_wake", "thread_sleep", "loop_moved")
        wake, sleep, moved = (FIRST_EVENT + names.index(name) for name in wanted)
        starts, moves = list[int](), list[LoopMoved]()
        for records in self.process.new_records(self.ring):
            is_wake = (records["event"] == wake) & (records["values"][:, 0] != 0)
            starts += records["time"][is_wake].tolist()
            is_turn = is_wake | (records["event"] == sleep)
            for number, at in records[is_turn][["event", "time"]].tolist():
                if number == sleep and self._woke_ns is not None:
                    self._turns_ns.append(at - self._woke_ns)
                self._woke_ns = at if number == wake else None
            for record in records[records["event"] == moved]:
                number, asked, added, kept, why = record["values"][:5].astype("<i8").tolist()
                reason = LOOP_MOVES[why] if why < len(LOOP_MOVES) else ""
                moves.append(LoopMoved(int(record["time"]), number, asked, added, kept, reason))
        return starts, moves

    @property
    def turn_ns(self) -> int:
        """How long the loop's turns last, from waking up to the next sleep (ns): 99.5 % of them.

        0: none was seen yet.
        """
        return int(np.percentile(self._turns_ns, 99.5)) if self._turns_ns else 0

    def move(self, move_ns: int, period_ns: int) -> int:
        """Have the loop wake up ``move_ns`` later than it would by itself; return the number.

        A further move replaces the one before: it counts from the loop's own instants, too.

        Raises InputError: the move is not shorter than the period, or the period is none.
        """
        if not _SHORTEST_NS <= period_ns <= _LONGEST_NS:
            raise InputError(f"a loop with a period of {period_ns} ns cannot be moved")
        if not 0 <= move_ns < period_ns:
            raise InputError(
                f"a loop is moved by less than its period of {period_ns} ns, not by {move_ns} ns"
            )
        self._number += 1
        self._has_asked = True
        self._write(move_ns, period_ns)
        return self._number

    def renew(self) -> None:
        """Have this process's latest request, if there is one, in force for another lease."""
        if self._has_asked:
            self._write(int(self._asked["move"]), int(self._asked["period"]))

    def close(self) -> None:
        """Let the loop go back to its own instants, if it was moved."""
        if self._has_asked and int(self._asked["tid"]) == self._inner_tid:
            self._write(int(self._asked["move"]), int(self._asked["period"]), until_ns=1)

    def _write(self, move_ns: int, period_ns: int, until_ns: int | None = None) -> None:
        if until_ns is None:
            until_ns = time.monotonic_ns() + self._lease_ns if self._lease_ns else 0
        fields = {
            "number": self._number,
            "tid": self._inner_tid,
            "move": move_ns,
            "period": period_ns,
            "until": until_ns,
        }
        check = _CHECK
        for name, value in fields.items():
            check ^= value
            self._asked[name] = value
        self._asked["check"] = check


def move_loop(pid: int, tid: int, move_ns: int, period_ns: int) -> int:
    """Have the loop in a thread wake up ``move_ns`` later than it would by itself, for ever.

    ``period_ns`` is the loop's period. Returns the number of the request, which the event
    `loop_moved` names when it is carried out, at the loop's ninth sleep from now on at the latest.
    A later call replaces the move.

    Raises OperationError, InputError: as :class:`LoopMover` and its ``move``.
    """
    return LoopMover(pid, tid, lease_ns=0).move(move_ns, period_ns)


def _writable(pid: int) -> tuple[mmap.mmap, TracedProcess]:
    """Return the head of a process's memory, to be written, and the memory, to be read."""
    why = "it does not run with the library in front (`chainshaper record`, `watch -- COMMAND`)"
    try:
        if (memory := memory_to_write(pid)) is not None:
            return memory
    except OSError as error:
        why = f"its memory cannot be written to ({error.strerror})"
    raise OperationError(f"the loops of process {pid} cannot be moved: {why}")
