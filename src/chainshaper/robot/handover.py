"""Which process publishes a shaped output: the shaping node, or the standby beside it.

The standby receives the same messages as the shaping node, and publishes them while no shaping node
is in force. For each message one of the two is responsible, whenever either is killed, stopped or
started:

* The **lock** of a file says whether a shaping node is in force; the kernel frees it when the node
  dies. The node takes it with the first message that it receives, when its output is ready; the
  standby takes it while it publishes.
* The file itself is a **page** that both read and write: which messages each of them has dealt with
  (by their source timestamps), and until when the node may hold the message that it has.

The standby publishes what the node had received and not released when it died, or when it hung for
longer than a given patience. The node leaves out what the standby has published. A node that dies
in the microseconds between a publication and its note on the page has it published twice.

Other processes change a gate's schedule through the page: a ring has what was asked for, from when
on, and the gate takes it over with each message (`schedules.py`). `apply` asks for the phase of a
gate that has no ROS parameters. `apply --adapt` reads latencies from another ring and asks for
moved slots; it has a lock of its own while it does. When that lock is free, however the process
ended, the gate uses the planned slots.

Standard library only, as the gate. `handover.hpp`, the node's side in C++, has this layout.
"""

import fcntl
import os
import select
import stat
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import NamedTuple

from chainshaper.robot.decision import DROPPED, Release
from chainshaper.robot.shaper import Shaper
from chainshaper.robot.waiting import Outcome, Queue, Waiting

FIELDS = (
    "holder",  # the process id of the shaping node in force; 0 while the standby has the lock
    "taken",  # how many messages shaping nodes have begun with
    "first",  # the first message of the shaping node in force
    "acknowledged",  # the same, once the standby has passed on all that came before it
    "until_ns",  # when the node releases the message it has; CLOCK_MONOTONIC, as all times here
    "released",  # how many messages shaping nodes have dealt with: so many are in their ring
    "phase_ns",  # where cycles start; a node that its launch starts again goes on from there
    "phase_known",  # 1: the number before is one
    "mode",  # the mode in force, from 1 in their order; 0: there are no modes
    "started_ns",  # when a shaping node started last
    "failed_starts",  # starts in quick succession after which the node dealt with no message
    "starts",  # starts of shaping nodes in this launch
    "standby",  # the process id of the standby
    "listening",  # 1: the standby has received a message, and so receives all later ones
    "silent",  # 1: the standby publishes nothing, it counts what is lost
    "bypassing_since_ns",  # since when no shaping node is in force; 0: one is
    "bypassed",  # how many messages the standby has dealt with: so many are in its ring
    "bypassed_before",  # how many of these it had before the present time without a shaping node
    "published",  # how many messages shaping nodes of this launch have published
    *DROPPED,  # how many they have dropped, for each of the gate's reasons
    "lost_by_dds",  # messages that DDS lost before they reached shaping nodes
    "late",  # messages that came behind the last slot that they were due in
    "measured",  # how many latencies, from origin to arrival, are in their ring
    "asked",  # how many changes of the schedule were asked for: so many are in their ring
    "in_process",  # 1: the gate is in the publisher's process, and needs no standby
    "parent",  # of the shaping node that started last: the process that launched it
)
"""Numbers of 8 bytes at the beginning of a page, in this order."""

VERSION = 5  # of the page's layout: part of its name
RING = 1024
RELEASED, BYPASSED, MEASURED = 32, 32 + RING, 32 + 2 * RING  # places of rings of numbers
ASKED = 32 + 3 * RING  # place of the ring of changes that were asked for, of three numbers each:
CHANGES = 64  # the room of that ring
NEW_PHASE, NEW_MOVE = 0, 1  # kinds of changes
TOPIC = ASKED + 3 * CHANGES  # place of the output's name
TOPIC_BYTES = 256
PUBLISHING, STANDING_BY, PASSING, MOVING, ASKING = 0, 1, 2, 3, 4
"""The bytes of the file that are locked. Each stands for a right: to publish; to be the standby; to
publish as the standby although the shaping node has the first; to move slots, for as long as it is
held; to add to the changes that are asked for."""
_RINGS = {"released": RELEASED, "bypassed": BYPASSED, "measured": MEASURED}
"""The place of each ring, by the name of the field that counts its numbers."""
_COUNTS = ("starts", "published", *DROPPED, "lost_by_dds", "late")
"""These start at 0 with each launch."""
_AT = {name: place for place, name in enumerate(FIELDS)}
_SIZE = 8 * TOPIC + TOPIC_BYTES
_FLOCK = "hhqqi4x"  # struct flock: type, whence, start, length, process

GIVE_UP_NS = 50_000_000  # how long a node waits for a standby, which needs the lock a moment only
AT_ONCE_NS = 30_000_000_000  # a node that ran for longer has not failed at once
BACK_OFF_AFTER = 3  # starts that may fail at once; each further one waits twice as long


def page_folders() -> Iterator[str]:
    """Yield the folders in memory that pages may be in: root's, a login session's, any user's."""
    user, session = os.geteuid(), os.environ.get("XDG_RUNTIME_DIR")
    if user == 0:
        yield "/run/chainshaper/outputs"
    elif session:
        yield f"{session}/chainshaper/outputs"
    yield f"/dev/shm/chainshaper-{user}"  # noqa: S108 - owner and mode are checked


def open_page(name: str, topic: str) -> "Page":
    """Open the page of an output, or make it.

    All processes that publish the ``topic`` in this domain use the same ``name``. Raises OSError:
    no folder is this user's alone, or the file is not.
    """
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    problem = OSError("no folder")
    for flags in (0, os.O_CREAT):
        for folder in page_folders():
            try:
                file = f"{name}.{int(domain)}.v{VERSION}"
                return Page(_private(folder, flags), file, topic, os.O_RDWR | flags)
            except (OSError, ValueError) as error:
                problem = OSError(f"{folder}: {error}")
    raise problem


def _private(folder: str, flags: int) -> str:
    """Return the folder if it is this user's alone; make it where a page is to be made.

    Raises OSError: it is not.
    """
    if flags & os.O_CREAT:
        _make_private(folder)
    state = os.lstat(folder)
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != os.geteuid() or state.st_mode & 0o077:
        raise PermissionError("it is not a folder of this user alone (mode 0700)")
    return folder


def _make_private(folder: str) -> None:
    # Others may not write to the folder above, whatever the umask: pages of all outputs are below.
    os.makedirs(os.path.dirname(folder), 0o755, exist_ok=True)  # noqa: PTH103, PTH120 - of a node's file
    with suppress(FileExistsError):
        os.mkdir(folder, 0o700)  # noqa: PTH102


class Change(NamedTuple):
    """A change of a gate's schedule that was asked for.

    * ``from_ns``: it is in force in cycles that start then or later (CLOCK_MONOTONIC).
    * ``kind``: :data:`NEW_PHASE`: where cycles start, or :data:`NEW_MOVE`: by how much slots are
      moved from where the gate has them.
    * ``value``: that time (ns).
    """

    from_ns: int
    kind: int
    value: int


class Page:
    """A page and its locks; numbers are read and written under the names of :data:`FIELDS`.

    The file is read and written, never mapped: SIGBUS ends a process that maps a file which another
    process cuts short, or for which the disk has no room. Numbers that are not there read as 0,
    those that cannot be written are missing, and shaping goes on.
    """

    def __init__(
        self, folder: str, name: str, topic: str | None = None, flags: int = os.O_RDONLY
    ) -> None:
        """Open a page with the ``flags`` of `open`.

        Without a ``topic`` the page is only read, as it was at the last :meth:`look`. In `/proc`,
        the folder of a process's open files, all files are links.

        Raises OSError: it cannot be opened, or it is not a file of the folder's owner. ValueError:
        it is too short for a page.
        """
        self.path = f"{folder}/{name}"
        flags |= os.O_CLOEXEC | os.O_NONBLOCK
        if not folder.startswith("/proc/"):
            flags |= os.O_NOFOLLOW
        self._file = os.open(self.path, flags, 0o600)
        self._seen: bytes | None = None
        try:
            state = os.fstat(self._file)
            if not stat.S_ISREG(state.st_mode) or state.st_uid != os.lstat(folder).st_uid:
                raise PermissionError(f"{name} is not a file of the folder's owner")
            if topic is None:
                self.look()
            else:  # a page that has no room on its disk is of no use to others
                os.posix_fallocate(self._file, 0, _SIZE)
                text = topic.encode()[:TOPIC_BYTES].ljust(TOPIC_BYTES, b"\0")
                os.pwrite(self._file, text, 8 * TOPIC)
        except BaseException:
            os.close(self._file)
            raise
        self._identity, self.owner = (state.st_dev, state.st_ino), state.st_uid

    def _read(self, at: int, size: int) -> bytes:
        """Return ``size`` bytes of the page from ``at`` on; zeros for those that are not there."""
        if self._seen is None:
            return self._stored(at, size)
        return self._seen[at : at + size].ljust(size, b"\0")

    def _stored(self, at: int, size: int) -> bytes:
        """Return bytes as they are now, also to a process that only reads the page."""
        content = b""
        with suppress(OSError):
            content = os.pread(self._file, size, at)
        return content.ljust(size, b"\0")

    def _numbers(self, place: int, count: int) -> tuple[int, ...]:
        return struct.unpack(f"={count}q", self._read(8 * place, 8 * count))

    def _write(self, place: int, value: int) -> None:
        with suppress(OSError):
            os.pwrite(self._file, value.to_bytes(8, sys.byteorder, signed=True), 8 * place)

    def __getitem__(self, field: str) -> int:
        return self._numbers(_AT[field], 1)[0]

    def __setitem__(self, field: str, value: int) -> None:
        self._write(_AT[field], value)

    def look(self) -> None:
        """Read the page again, for a process that only reads it.

        Raises ValueError: it has become shorter, or was removed.
        """
        if not os.fstat(self._file).st_nlink:
            raise ValueError(f"{self.path} was removed")
        content = os.pread(self._file, _SIZE, 0)
        if len(content) < _SIZE:
            raise ValueError(f"{self.path} is no page of an output")
        self._seen = content

    def add(self, ring: str, value: int) -> None:
        """Put a number into a ring, and count it."""
        number = self[ring]
        self._write(_RINGS[ring] + number % RING, value)
        self[ring] = number + 1

    def noted(self, ring: str) -> list[int]:
        """Return the latest numbers of a ring, in no order."""
        return [*self._numbers(_RINGS[ring], RING)]

    def latest(self, ring: str, since: int) -> list[int]:
        """Return the numbers of a ring behind the first ``since`` that are still there."""
        last, numbers = self[ring], self.noted(ring)
        return [numbers[number % RING] for number in range(max(since, last - RING), last)]

    def ask(self, change: Change) -> None:
        """Ask the gate for a change of its schedule."""
        give_up = time.monotonic_ns() + GIVE_UP_NS
        while not self.lock(ASKING) and time.monotonic_ns() < give_up:
            time.sleep(0.0001)
        (number,) = struct.unpack("=q", self._stored(8 * _AT["asked"], 8))  # others ask as well
        place = ASKED + 3 * (number % CHANGES)
        with suppress(OSError):
            os.pwrite(self._file, struct.pack("=3q", *change), 8 * place)
        self["asked"] = number + 1
        self.unlock(ASKING)

    def asked(self, since: int = 0) -> list[Change]:
        """Return the changes behind the first ``since`` that are still there."""
        last, numbers = self["asked"], self._numbers(ASKED, 3 * CHANGES)
        places = (3 * (number % CHANGES) for number in range(max(since, last - CHANGES, 0), last))
        return [Change(*numbers[place : place + 3]) for place in places]

    @property
    def moved_ns(self) -> int:
        """By how much another process has the slots moved."""
        if not self.is_locked(MOVING):
            return 0
        moves = [change.value for change in self.asked() if change.kind == NEW_MOVE]
        return moves[-1] if moves else 0

    @property
    def topic(self) -> str:
        """The name of the output."""
        return self._read(8 * TOPIC, TOPIC_BYTES).rstrip(b"\0").decode(errors="replace")

    @property
    def is_current(self) -> bool:
        """Whether other processes find this page, and whole.

        The folders of a session are removed when its user logs out.
        """
        try:
            state = os.stat(self.path)  # noqa: PTH116
        except OSError:
            return False
        return (state.st_dev, state.st_ino) == self._identity and state.st_size >= _SIZE

    # Locks of open files (F_OFD_…): several in one file, each visible without taking it.

    def lock(self, byte: int = PUBLISHING) -> bool:
        """Take a right; return False if another process has it. It ends with this process."""
        try:
            self._ask(fcntl.F_OFD_SETLK, fcntl.F_WRLCK, byte)
        except BlockingIOError:
            return False
        return True

    def unlock(self, byte: int = PUBLISHING) -> None:
        """Give the right back."""
        self._ask(fcntl.F_OFD_SETLK, fcntl.F_UNLCK, byte)

    def is_locked(self, byte: int = PUBLISHING) -> bool:
        """Return whether another process has the right."""
        return self._ask(fcntl.F_OFD_GETLK, fcntl.F_WRLCK, byte) != fcntl.F_UNLCK

    def _ask(self, command: int, kind: int, byte: int) -> int:
        answer = fcntl.fcntl(self._file, command, struct.pack(_FLOCK, kind, 0, byte, 1, 0))
        return int(struct.unpack(_FLOCK, answer)[0])

    def close(self) -> None:
        """Close the page, which gives up all its locks."""
        os.close(self._file)


class Turn:
    """The shaping node's side: whether it is this node's turn to publish a message.

    The key of a message is its source timestamp; where that is not known (None), the node leaves no
    message out.
    """

    def __init__(self, name: str, topic: str) -> None:
        self._name, self._topic = name, topic
        self._gave_up = False
        self._has_moved = False  # slots are where another process has asked for them
        self._open()
        page, now = self.page, time.monotonic_ns()
        if now - page["started_ns"] > AT_ONCE_NS:
            page["failed_starts"] = 0
        page["started_ns"] = now
        page["starts"] += 1
        page["failed_starts"] += 1

    def _open(self) -> None:
        page, parent = open_page(self._name, self._topic), os.getppid()
        # Phase and mode belong to one launch, which is known by its parent process. In some
        # containers, and under systemd, all launches have the same parent: there it is taken for
        # the same launch if little time has passed.
        idle_ns = abs(time.monotonic_ns() - page["until_ns"])
        if parent != page["parent"] or idle_ns > AT_ONCE_NS:
            page["mode"] = page["phase_known"] = 0
            if not page.is_locked():  # else the counts are those of another launch's node
                for count in _COUNTS:
                    page[count] = 0
        page["parent"] = parent
        self.page, self._in_force = page, False
        # At the last look: how many messages the standby had dealt with (-1: no look yet), which,
        # and the message before which it has dealt with all.
        self._seen, self._bypassed, self._oldest = -1, frozenset[int](), 0
        # How many changes had been asked for at the last look. A phase that was asked for before
        # is that of another gate; a move is in force for as long as its process lives.
        self._asked = page["asked"]
        self._moves_before = [change for change in page.asked() if change.kind == NEW_MOVE]

    @property
    def wait_s(self) -> float:
        """How long to wait before the start, since nodes before this one have failed at once."""
        failed = self.page["failed_starts"] - 1 - BACK_OFF_AFTER
        if failed < 0:
            return 0.0
        wait_s: float = 0.5 * 2 ** min(failed, 10)  # `failed` is limited: a page may say anything
        return min(10.0, wait_s)

    def go_on(self, shaper: Shaper) -> None:
        """Give a gate the phase and the mode of the gate before it in the same launch.

        From now on the page shows each of its decisions, and changes its schedule.
        """
        modes = [] if shaper.gate.modes is None else [*shaper.gate.modes.slots]
        queue, cycle_ns = shaper.queue, shaper.gate.cycle_ns

        def decided(release: Release) -> None:
            mode = 0 if release.mode is None else modes.index(release.mode) + 1
            self.hold(release.at_ns, release.origin_ns % cycle_ns, mode)

        shaper.follow, shaper.on_decision = partial(self.follow, queue), decided
        if self.page["phase_known"]:  # from now on, not the next cycle
            queue.set_phase(self.page["phase_ns"], time.monotonic_ns() - cycle_ns)
        if 0 < (mode := self.page["mode"]) <= len(modes):
            queue.switch(modes[mode - 1], 0)

    def take(self, key: int | None) -> bool:
        """Return whether this node deals with a message that it received."""
        if not self._in_force and not self._come_into_force(key):
            return False
        self.page["until_ns"] = time.monotonic_ns()
        self.page["taken"] += 1
        return not self.was_bypassed(key)

    def hold(self, until_ns: int | None, phase_ns: int, mode: int = 0) -> None:
        """Note when the message is released (None: never), and the mode, from 1 (0: no modes)."""
        self.page["mode"] = mode
        if until_ns is not None:
            self.page["until_ns"] = until_ns
        self.page["phase_ns"], self.page["phase_known"] = phase_ns, 1

    def was_bypassed(self, key: int | None) -> bool:
        """Return whether the standby has dealt with a message."""
        count = self.page["bypassed"]
        if count != self._seen:
            # Messages that the standby is about to publish come first.
            give_up = time.monotonic_ns() + GIVE_UP_NS
            while self.page.is_locked(PASSING) and time.monotonic_ns() < give_up:
                time.sleep(0.0001)
            self._bypassed = frozenset(self.page.noted("bypassed"))
            if self._seen >= 0 and count - self._seen > RING:
                self._oldest = min(self._bypassed)  # it has dealt with all older ones, too
            self._seen = count
        if key is None or (key not in self._bypassed and key >= self._oldest):
            self._oldest = 0  # later messages are newer, even if the clock is set back
            return False
        self.page["taken"] += 1  # which tells the standby that this node does not hang
        return True

    def is_overtaken_by(self, key: int | None) -> bool:
        """Return whether the standby has dealt with this message, which waits behind the oldest.

        The oldest message, which the node is about to publish, would come after it: the standby
        started later than this node, and did not receive the oldest. To be called after
        :meth:`was_bypassed`.
        """
        return key in self._bypassed

    def done(self, key: int | None) -> None:
        """Note that a message has been published or discarded."""
        self.page.add("released", key or 0)
        self.page["until_ns"] = time.monotonic_ns()
        self.page["failed_starts"] = 0
        if not self.page.is_current:
            left = self.page
            with suppress(OSError):  # where there is no folder, the node stays with this page
                self._open()
                for key_before in left.noted("released"):  # for a standby that lags behind
                    self.page.add("released", key_before)
                left.close()

    def follow(self, queue: Queue) -> None:
        """Take over what was asked for since the last call into the schedules of a gate.

        Slots go back to the planned ones where the process that had them moved has ended, or where
        it did so on a page that this node has left. A phase is asked of a gate that runs: a new one
        does not take it over.
        """
        asked, changes, self._moves_before = self.page["asked"], self._moves_before, []
        if asked != self._asked:
            changes += self.page.asked(self._asked)
            self._asked = asked
        self._has_moved = self._has_moved or any(change.kind == NEW_MOVE for change in changes)
        is_following = self._has_moved and self.page.is_locked(MOVING)
        for from_ns, kind, value in changes:
            if kind == NEW_PHASE:
                queue.set_phase(value, from_ns)
            elif kind == NEW_MOVE and is_following:
                queue.move_slots(value, from_ns)
        if self._has_moved and not is_following:
            queue.move_slots(0, time.monotonic_ns())
            self._has_moved = False

    def count(self, outcome: Outcome) -> None:
        """Count a message that has been published or dropped, and its latency to its arrival."""
        message, release = outcome.message, outcome.release
        self.page.add("measured", message.arrival_ns - release.origin_ns)
        self.page[release.dropped or "published"] += 1
        self.page["lost_by_dds"] += message.lost or 0
        self.page["late"] += release.overrun is not None

    def _come_into_force(self, key: int | None) -> bool:
        page, give_up = self.page, time.monotonic_ns() + GIVE_UP_NS
        while not page.lock():
            holder = page["holder"]
            if holder not in (0, os.getpid()) and os.path.exists(f"/proc/{holder}"):  # noqa: PTH110
                return False  # another shaping node is in force
            if self._gave_up or time.monotonic_ns() > give_up:
                self._gave_up = True  # the standby was stopped while it published
                break
            time.sleep(0.001)
        else:
            self._in_force, self._gave_up = True, False
        page["until_ns"] = time.monotonic_ns()
        page["first"], page["holder"] = key or 0, os.getpid()
        # The standby still deals with the messages before this node's first one.
        if page["listening"] and key is not None and not self._gave_up:
            while page.is_locked(STANDING_BY) and time.monotonic_ns() < give_up:
                if key == page["acknowledged"] or key in page.noted("bypassed"):
                    break
                time.sleep(0.0002)
        return True


class Standby:
    """The standby's side: it publishes messages while no shaping node is in force.

    * ``publish`` gets the payload, the source timestamp and the arrival of each such message.
    * ``changed`` gets a text when a shaping node goes or is back.
    * ``patience_ns``: a shaping node that is late by more than this is taken to hang.
    * ``silent``: the page says that ``publish`` publishes nothing.
    """

    def __init__(  # noqa: PLR0917 - each is used once
        self,
        name: str,
        topic: str,
        publish: Callable[[bytes, int | None, int], None],
        changed: Callable[[str], None],
        patience_ns: int,
        depth: int = 1000,
        *,
        silent: bool = False,
    ) -> None:
        self._name, self._topic, self._publish = name, topic, publish
        self._changed, self._patience_ns = changed, patience_ns
        self._pending: deque[Waiting] = deque(maxlen=depth)  # about: the source timestamp, or 0
        self._mutex = threading.Lock()
        self._reason = ""  # of the bypass that was reported last
        self._silent = silent
        self._woken, self._wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._open()

    def _open(self) -> None:
        self.page = open_page(self._name, self._topic)
        give_up = time.monotonic() + 1.0
        while not self.page.lock(STANDING_BY):
            if time.monotonic() > give_up:
                raise OSError(f"{self.page.path}: another process is the standby of this output")
            time.sleep(0.01)
        self.page["standby"], self.page["listening"] = os.getpid(), 0
        self.page["bypassing_since_ns"], self.page["silent"] = 0, int(self._silent)
        self._stuck_at = -1  # how many messages the node had taken when it was found to hang

    def arrived(self, payload: bytes, key: int | None) -> None:
        """Take a message, which the shaping node receives too."""
        now = time.monotonic_ns()
        with self._mutex:
            self._follow()
            self.page["listening"] = 1
            self._pending.append(Waiting(payload, now, None, 0, about=key or 0))
            if key is not None:
                self._look(now)
            elif self._none_in_force():
                self._pass_on(len(self._pending))
                self.page.unlock()
            else:
                self._pending.clear()  # the messages of the shaping node are lost if it dies
        with suppress(BlockingIOError):
            os.write(self._wake, b".")

    def look(self) -> None:
        """Look whether the shaping node still deals with its messages."""
        with self._mutex:
            self._follow()
            self._look(time.monotonic_ns())

    def _follow(self) -> None:
        """Go to a new page where this one was removed and the shaping node has left it."""
        left = self.page
        if not left.is_current and not left.is_locked():
            with suppress(OSError):
                self._forget()  # the new page names no message yet
                self._open()
                left.close()

    def watch(self) -> None:
        """Look when the shaping node dies, and when it is late for a release; for ever."""
        ended_pid = 0  # a process that has ended can be opened until its parent waits for it
        while True:
            with self._mutex:  # the page may be left meanwhile
                self._forget()
                holder = self.page["holder"]
                left_ms = -1 if holder else 1000
                if self._pending:
                    left_ms = max(1, (self._due_ns() - time.monotonic_ns()) // 1_000_000 + 1)
            poll, died = select.poll(), -1
            poll.register(self._woken, select.POLLIN)
            with suppress(OSError):  # there is no such process
                if holder not in (0, ended_pid):
                    died = os.pidfd_open(holder)
                    poll.register(died, select.POLLIN)
            ended = (died, select.POLLIN) in poll.poll(left_ms)
            with suppress(BlockingIOError):
                os.read(self._woken, 4096)
            if died >= 0:
                os.close(died)
            self.look()
            if ended:
                ended_pid = holder
                time.sleep(0.001)  # another node may have the lock and be about to write its name

    def _due_ns(self) -> int:
        """Return when the shaping node is too late with its message."""
        return max(self.page["until_ns"], self._pending[0].arrival_ns) + self._patience_ns

    def _look(self, now: int) -> None:
        """Publish the pending messages if no shaping node is in force, or if it hangs."""
        alone = self._none_in_force()
        self._forget()
        taken = self.page["taken"]
        if alone:
            self._report_bypass("is not there")
            self._pass_on(len(self._pending))
            self.page.unlock()
        elif self._pending and (now > self._due_ns() or taken == self._stuck_at):
            self._stuck_at = taken
            self._report_bypass("is late for its own release: it hangs, or was stopped")
            self.page.lock(PASSING)
            for waiting in self._pending:  # noted first: the node could go on at any time
                self.page.add("bypassed", waiting.about)
            self._pass_on(len(self._pending), noted=True)
            self.page.unlock(PASSING)
        elif taken != self._stuck_at:
            self._report_return()
            # Messages before the first one of the node in force came to this process alone.
            first, keys = self.page["first"], [waiting.about for waiting in self._pending]
            if first != self.page["acknowledged"] and first in keys:
                self._pass_on(keys.index(first))
                self.page["acknowledged"] = first

    def _none_in_force(self) -> bool:
        """Take the lock; return False if a shaping node has it."""
        if not self.page.lock():
            return False
        self.page["holder"] = 0
        return True

    def _forget(self) -> None:
        """Forget messages that were dealt with, and those before them: order must not break."""
        noted = {*self.page.noted("released"), *self.page.noted("bypassed")}
        dealt_with = [
            count for count, waiting in enumerate(self._pending, 1) if waiting.about in noted
        ]
        for _ in range(max(dealt_with, default=0)):
            self._pending.popleft()

    def _pass_on(self, count: int, *, noted: bool = False) -> None:
        """Publish the oldest pending messages; note them on the page, unless they are ``noted``."""
        for _ in range(count):
            waiting = self._pending.popleft()
            self._publish(waiting.payload, waiting.about or None, waiting.arrival_ns)
            if not noted:
                self.page.add("bypassed", waiting.about)

    def _report_bypass(self, reason: str) -> None:
        """Say that messages go around the shaping node, once for each reason."""
        if not self.page["bypassing_since_ns"]:
            self.page["bypassed_before"] = self.page["bypassed"]
            self.page["bypassing_since_ns"] = time.monotonic_ns()
            self._reason = ""
        if reason != self._reason:
            self._changed(reason)
            self._reason = reason

    def _report_return(self) -> None:
        """Say that a shaping node is in force again, if none was."""
        if since := self.page["bypassing_since_ns"]:
            self.page["bypassing_since_ns"] = 0
            passed = self.page["bypassed"] - self.page["bypassed_before"]
            after_s = (time.monotonic_ns() - since) / 1e9
            self._changed(f"is back after {after_s:.2f} s, in which {passed} messages came")
