"""A loop that no library sees: its wake-ups are counted from outside, and it is not moved."""

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from chainshaper.flow.phase import watch_wake_ups
from chainshaper.linux.threads import find_thread
from chainshaper.values.errors import OperationError

if TYPE_CHECKING:
    from chainshaper.sources.preload.moving import LoopMoved

_TURNS = 24  # of the loop, in one look
_REST_NS = 2_000_000_000  # from one look to the next


@dataclass
class PolledLoop:
    """A loop's thread whose wake-ups the kernel counts (:func:`.watch_wake_ups`)."""

    pid: int
    tid: int
    period_ns: int
    turn_ns: int = 0  # how long its turns last is not seen
    _since_ns: int = 0  # from when on to look again

    @property
    def is_there(self) -> bool:
        thread = find_thread(self.tid)
        return thread is not None and thread.pid == self.pid

    def seen(self) -> "tuple[list[int], list[LoopMoved]]":
        """Watch for some of its turns, and return when it woke up behind a rest (ns).

        Where it waits for a lock within a turn, it wakes up several times. Between two looks it is
        left alone for a while: none is returned then.
        """
        if time.monotonic_ns() < self._since_ns:
            return [], []
        try:
            wake_ups = watch_wake_ups(self.pid, [self.tid], _TURNS * self.period_ns)
        except OperationError:  # it has ended meanwhile
            return [], []
        self._since_ns = time.monotonic_ns() + _REST_NS
        return wake_ups[1:][np.diff(wake_ups) > self.period_ns / 2].tolist(), []

    def move(self, move_ns: int, period_ns: int) -> int:
        """Raise OperationError: it cannot be moved."""
        raise OperationError(
            f"the loop in thread {self.tid} of process {self.pid} cannot be moved by {move_ns} of"
            f" {period_ns} ns: it does not run with the library in front"
        )

    def renew(self) -> None:
        """Do nothing: nothing was asked."""

    def close(self) -> None:
        """Do nothing: nothing was asked."""
