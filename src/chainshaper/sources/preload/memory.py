"""The memory of a traced process, and how it is read while the process writes it.

`preload.c` writes the memory, but any code of the process may write into it, for instance by
mistake. So every record is checked before it is used. At the first record that the library cannot
have written, reading of this process ends: its events from there on are counted as lost.
"""

import fcntl
import functools
import mmap
import os
import time
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chainshaper.linux.threads import list_threads, of_another_clock, time_namespace
from chainshaper.sources.preload.events_header import FORMAT
from chainshaper.sources.system import NEXT_HOST
from chainshaper.values import events
from chainshaper.values.errors import InputError, text_of
from chainshaper.values.event_declarations import events_of_library

RECORD = np.dtype(
    [("time", "<i8"), ("tid", "<u4"), ("cpu", "<u2"), ("event", "<u2"), ("values", "<u8", 6)]
)
"""`struct record` of `preload.c`: an event, or a part of a text.

Fields:
    time: when it happened (CLOCK_MONOTONIC, ns).
    tid: the thread, as its process calls it.
    cpu: the core.
    event: its number; 0: it is being written.
    values: the arguments that are recorded.
"""

# The header of a memory, of 32-bit words first: which format it has, the process's own id, and how
# many rings, records of a ring, and records of creation there is room for.
COUNTS = ("magic", "format", "pid", "rings", "ring_records", "object_records")
HEADER = np.dtype(
    [
        *((name, "<u4") for name in COUNTS),
        ("objects", "<u8"),  # records of creation that were begun
        ("dropped", "<u8"),  # events for which there was no room
        ("clock", "<u8"),  # the time namespace of the process; 0: not known
        ("unused", "<u8", 2),
    ]
)
REQUEST = np.dtype(
    [(name, "<u8") for name in ("number", "tid", "move", "period", "until", "check")]
)
"""`struct request` of `preload.c`: how a loop is asked to be moved (:mod:`.moving`)."""
RING = np.dtype([("written", "<u8"), ("taken", "<u4"), ("unused", "<u4"), ("asked", REQUEST)])
"""The head of a thread's ring: how many records were written, the id of the thread that has it (0:
none has), and what is asked of its loop."""

MAGIC = 0x63687368  # the first word of a memory
# Numbers of events: a part of a text, the tracing library behind ours, then those of ROS 2.
TEXT, LIBRARY, FIRST_EVENT = 1, 2, 3
_PLACES = 16  # of arguments that a text can belong to
_RINGS, _RING_RECORDS, _OBJECT_RECORDS = 64, 1 << 14, 1 << 15  # of this format, no others
# Where in a memory records of creation, and those of rings, begin (bytes); and its size.
HEAD_BYTES = _OF_OBJECTS = HEADER.itemsize + _RINGS * RING.itemsize
_OF_RECORDS = _OF_OBJECTS + _OBJECT_RECORDS * RECORD.itemsize
_SIZE = _OF_RECORDS + _RINGS * _RING_RECORDS * RECORD.itemsize
_F_GET_SEALS, _F_SEAL_SHRINK = 1034, 2  # linux/fcntl.h
_LONGEST_TEXT = 4096  # `LONGEST_TEXT` in preload.c
_MOST_WRITTEN = 1 << 40  # records between two looks: a week of as many as one core can write
_LARGEST_ID = 1 << 22  # of processes and threads: linux/threads.h, PID_MAX_LIMIT


def event_names() -> tuple[str, ...]:
    """Return the events that the library records, in the order of their numbers."""
    return tuple(event.name for event in events_of_library())


@functools.cache
def _events_of_rings() -> NDArray[np.bool_]:
    """Return, by its number, whether an event stands in rings: it happens, nothing is created."""
    known = np.zeros(1 << 16, bool)
    for number, name in enumerate(event_names(), FIRST_EVENT):
        known[number] = name not in events.CREATION
    return known


@functools.cache
def _events_of_objects() -> NDArray[np.bool_]:
    """Return, by its number, whether an event stands behind the rings: something is created.

    0 is an event that is being written.
    """
    known = ~_events_of_rings()
    known[FIRST_EVENT + len(event_names()) :] = False
    return known


class RefusedMemoryError(InputError):
    """The memory of a process cannot be read; ``inner_pid`` is its id in its container."""

    def __init__(self, why: str, inner_pid: int) -> None:
        super().__init__(why)
        self.inner_pid = inner_pid


class TracedProcess:
    """Read the memory of one process.

    Nothing is locked: a reader copies what is new in a ring, then looks again how much has been
    written, and counts as lost what may have been overwritten meanwhile.

    * ``pid``: the process's id here.
    * ``inner_pid``: its id in its container.
    * ``header``: of the memory, which the process goes on writing.
    * ``lost``: events that were overwritten, and those that are not used because of ``damage``.
    * ``damage``: what the library cannot have written, as half a sentence; None: all is sound.

    Raises InputError: the descriptor is of no such memory, or of one that may shrink.
    RefusedMemoryError: it is of another version, or of a process whose times are of another clock.
    """

    def __init__(self, descriptor: int, pid: int = 0) -> None:
        seals = 0
        with suppress(OSError):  # no memfd
            seals = fcntl.fcntl(descriptor, _F_GET_SEALS)
        size = os.fstat(descriptor).st_size
        if not seals & _F_SEAL_SHRINK or size < HEADER.itemsize:
            raise InputError("what was sent is no memory of a traced process")
        header = np.frombuffer(os.pread(descriptor, HEADER.itemsize, 0), HEADER)
        magic, memory_format, self.inner_pid, *counts = header[0].tolist()[: len(COUNTS)]
        # Whatever a process says, no more is read than a memory of this version has.
        known = (MAGIC, FORMAT, [_RINGS, _RING_RECORDS, _OBJECT_RECORDS])
        if (magic, memory_format, counts) != known or size != _SIZE:
            raise RefusedMemoryError(
                "its memory is that of another version of chainshaper: start it again with this"
                " one",
                self.inner_pid,
            )
        memory = mmap.mmap(descriptor, size, prot=mmap.PROT_READ)
        self.header: NDArray[Any] = np.frombuffer(memory, HEADER, 1)
        self.pid = pid or self.inner_pid
        if not (0 < self.pid <= _LARGEST_ID and 0 < self.inner_pid <= _LARGEST_ID):
            raise InputError(f"what was sent says that it is of process {self.inner_pid}")
        clock = int(header["clock"][0])  # the process itself may have ended since
        if clock not in (0, time_namespace()) or (not clock and of_another_clock(self.pid)):
            raise RefusedMemoryError(
                "it has another clock, that of a time namespace: record it in there"
                f" (`nsenter --time --target {self.pid} …`)",
                self.inner_pid,
            )
        self.damage: str | None = None
        self._tids: dict[int, int] = {}
        self._rings = np.frombuffer(memory, RING, _RINGS, HEADER.itemsize)
        self._objects = np.frombuffer(memory, RECORD, _OBJECT_RECORDS, _OF_OBJECTS)
        records = np.frombuffer(memory, RECORD, _RINGS * _RING_RECORDS, _OF_RECORDS)
        self._records = records.reshape(_RINGS, _RING_RECORDS)
        self._read = np.zeros(_RINGS, np.uint64)
        self.lost = 0

    @property
    def dropped(self) -> int:
        """The number of events for which the process itself had no room."""
        dropped = int(self.header["dropped"][0])
        if dropped >= _MOST_WRITTEN:
            self._damaged(f"it says that it had no room for {dropped} events")
            return 1
        return dropped

    def new_records(self, only: int | None = None) -> list[NDArray[Any]]:
        """Return the records that came into each ring since the last time, in order of writing.

        ``only``: the number of a ring; None: all of them.
        """
        new = list[NDArray[Any]]()
        for number in np.flatnonzero(self._rings["written"] != self._read):
            if only not in (None, number):
                continue
            ring, read = self._records[number], int(self._read[number])
            written = int(self._rings["written"][number])
            if not read <= written < read + _MOST_WRITTEN:
                self._damaged(f"it says that it has written {written - read} events at once")
                self._read[number] = written
                self.lost += 1
                continue
            if self.damage is not None:
                self.lost += written - read
                self._read[number] = written
                continue
            oldest = max(read, written - ring.size)
            places = np.arange(oldest, written) % ring.size
            copied = ring.take(places)
            # The process may be writing the next record, which takes the place of the oldest one.
            whole = max(oldest, int(self._rings["written"][number]) + 1 - ring.size)
            self.lost += min(whole, written) - read
            self._read[number] = written
            if whole < written:
                records = copied[whole - oldest :]
                good = self._good(records, _events_of_rings())
                self.lost += records.size - good
                if good:
                    new.append(self._with_tids_here(records[:good]))
        return new

    @property
    def taken(self) -> NDArray[np.uint32]:
        """The thread that has each ring, by its id in its container; 0: none has it."""
        return np.array(self._rings["taken"], np.uint32)

    def _good(self, records: NDArray[Any], known: NDArray[np.bool_]) -> int:
        """Return how many records stand before the first that the library cannot have written.

        ``known`` says, by its number, whether an event may stand there.
        """
        times, tids, numbers = records["time"], records["tid"], records["event"]
        good = (times >= 0) & (times <= time.monotonic_ns()) & known[numbers]
        good &= (tids > 0) & (tids <= _LARGEST_ID)
        good |= known[0] & (numbers == 0)
        if good.all():
            return records.size
        at = int(np.argmin(good))
        self._damaged(
            f"it has a record of event {numbers[at]} in thread {tids[at]} at {times[at]} ns"
        )
        return at

    def _damaged(self, why: str) -> None:
        self.damage = self.damage or why

    def _with_tids_here(self, records: NDArray[Any]) -> NDArray[Any]:
        """Give records the ids that their threads have here, if they run, instead of their own."""
        if self.pid == self.inner_pid:
            return records
        inner, places = np.unique(records["tid"], return_inverse=True)
        if not self._tids.keys() >= set(inner.tolist()):
            self._tids |= {thread.inner_tid: thread.tid for thread in list_threads(self.pid)}
        numbers = [self._tids.setdefault(tid, tid + NEXT_HOST) for tid in inner.tolist()]
        records["tid"] = np.array(numbers, np.uint32)[places]
        return records

    def objects(self) -> tuple[NDArray[Any], dict[int, dict[int, str]]]:
        """Return the events of creation so far, and the texts of each, by its place among them.

        Texts are by the place of the argument. An event that is being written is left out.
        """
        begun = min(int(self.header["objects"][0]), self._objects.size)
        records = self._objects[:begun].copy()
        records = records[: self._good(records, _events_of_objects())]
        lengths, places = np.divmod(records["values"][:, 0], np.uint64(_PLACES))
        is_text = records["event"] == TEXT
        if (long := is_text & (lengths > _LONGEST_TEXT)).any():
            good = int(long.argmax())
            self._damaged(f"it has a text of {lengths[good]} bytes")
            records, is_text = records[:good], is_text[:good]
        created = np.flatnonzero(~is_text)
        texts: dict[int, dict[int, bytes]] = {}
        for at in np.flatnonzero(is_text):
            of_event = texts.setdefault(int(np.searchsorted(created, at)) - 1, {})
            place, length = int(places[at]), int(lengths[at])
            part = records["values"][at, 1:].tobytes()
            of_event[place] = (of_event.get(place, b"") + part)[:length]
        # An event that is being written has texts as well, which are left out with it.
        whole = np.flatnonzero(records["event"][created])
        return self._with_tids_here(records[created[whole]]), {
            number: {place: text_of(text) for place, text in texts.get(behind, {}).items()}
            for number, behind in enumerate(whole.tolist())
        }
