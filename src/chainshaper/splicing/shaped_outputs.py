"""The outputs that are shaped on this machine at the moment, or go around their shaping node.

Their pages in memory tell (:mod:`chainshaper.robot.handover`).
"""

import os
import re
import time
from collections.abc import Collection, Iterable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from pydantic import TypeAdapter

from chainshaper.linux.processes import run_users, user_name
from chainshaper.linux.threads import innermost_id, parents, read_proc, status_field
from chainshaper.robot.decision import DROPPED
from chainshaper.robot.handover import (
    MOVING,
    NEW_MOVE,
    NEW_PHASE,
    PASSING,
    PUBLISHING,
    STANDING_BY,
    VERSION,
    Change,
    Page,
    page_folders,
)
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import OperationError
from chainshaper.values.yaml_file import FullName

OutputState: TypeAlias = Literal["shaped", "in process", "bypassed", "silent", "no standby"]
_TOPIC: TypeAdapter[str] = TypeAdapter(FullName)
_PAGE = re.compile(rf"/(?:chainshaper/outputs|chainshaper-\d+)/[^/]+\.v{VERSION}$")


@dataclass(frozen=True)
class ShapedOutput:
    """An output with a shaping node, as it is now.

    Numbers count from the launch of the shaping node on, which may have started it several times.

    * ``topic``: the output.
    * ``state``: ``shaped``; ``in process``: by a gate that ends with its publisher; ``no standby``:
      shaped, but the output ends with its shaping node; ``bypassed`` or ``silent`` while no shaping
      node is in force.
    * ``shaping_node``, ``standby``: their process ids; None: it is not there.
    * ``since_ns``: since when it is bypassed or silent (CLOCK_MONOTONIC); None: it is not.
    * ``messages``: how many messages came since then.
    * ``messages_in_all``: how many came without a shaping node since the machine has booted.
    * ``starts``: of the shaping node.
    * ``published``: messages that shaping nodes published.
    * ``lost``: messages that were not published, by reason.
    * ``late``: messages behind the last slot that they were due in, published or lost.
    * ``moved_ns``: by how much its slots, which follow the latencies, are moved from the plan's.
    * ``page``: the file of its page.
    * ``user``: the owner of the page; only this user's outputs can be meant by it.
    """

    topic: str
    state: OutputState
    shaping_node: int | None
    standby: int | None
    since_ns: int | None
    messages: int
    messages_in_all: int
    starts: int
    published: int
    lost: dict[str, int]
    late: int
    moved_ns: int
    page: str
    user: int


def find_outputs(folders: Iterable[str] | None = None) -> tuple[ShapedOutput, ...]:
    """Return the outputs that this user may see; root sees those of all users, and in containers.

    An output whose shaping node and standby have both ended is not there any more.
    """
    pages: list[tuple[str, str, dict[int, int]]] = []
    if folders is None:
        pages, folders = _in_containers(), [*page_folders()]
        if os.geteuid() == 0:
            of_users = [*Path("/run/user").glob("*/chainshaper/outputs")]
            of_users += Path("/dev/shm").glob("chainshaper-*")  # noqa: S108
            folders += sorted({*map(str, of_users)} - {*folders})
    for folder in folders:
        with suppress(OSError):
            pages += [(folder, name, {}) for name in sorted(os.listdir(folder))]  # noqa: PTH208
    outputs = []
    for folder, name, pid_of in pages:
        with suppress(OSError, ValueError), closing(Page(folder, name)) as page:
            output = _output_of(page, pid_of)
            if output is not None:
                outputs.append(output)
    return tuple(outputs)


def _in_containers() -> list[tuple[str, str, dict[int, int]]]:
    """Return pages that processes in other mount namespaces have open, by folder and name in /proc.

    With each are the ids of its processes, by their ids in the container, which the page names.
    """
    namespace = Path("/proc/self/ns/mnt").stat().st_ino
    pages: dict[tuple[int, int], tuple[str, str, dict[int, int]]] = {}  # by device and inode
    for pid in parents():
        folder = f"/proc/{pid}/fd"
        with suppress(OSError):  # it has ended, or is another user's
            if os.stat(f"/proc/{pid}/ns/mnt").st_ino == namespace:  # noqa: PTH116
                continue
            inner = innermost_id(read_proc(f"/proc/{pid}/status")) or pid
            for name in os.listdir(folder):  # noqa: PTH208
                if _PAGE.search(os.readlink(f"{folder}/{name}")):  # noqa: PTH115
                    file = os.stat(f"{folder}/{name}")  # noqa: PTH116
                    page = pages.setdefault((file.st_dev, file.st_ino), (folder, name, {}))
                    page[2][inner] = pid
    return list(pages.values())


def remove_abandoned_pages(folders: Iterable[str] | None = None) -> list[str]:
    """Remove the pages of this user's outputs that no process has open; return their files.

    A page with a right taken stays: its process may be in a container, and not visible here. A node
    whose page was removed finds that out and makes another.
    """
    opened, removed = _opened_pages(), list[str]()
    for folder in page_folders() if folders is None else folders:
        names = list[str]()
        with suppress(OSError):
            names = sorted(os.listdir(folder))  # noqa: PTH208
        for name in names:
            path = f"{folder}/{name}"
            with suppress(OSError):
                state = os.lstat(path)
                used = (state.st_dev, state.st_ino) in opened or _has_rights(folder, name)
                if state.st_uid == os.geteuid() and not used:
                    os.unlink(path)  # noqa: PTH108
                    removed.append(path)
    return removed


def _has_rights(folder: str, name: str) -> bool:
    """Return whether a process has a right of a page; a page without content has none."""
    try:
        with closing(Page(folder, name)) as page:
            return any(map(page.is_locked, (PUBLISHING, STANDING_BY, PASSING, MOVING)))
    except ValueError:
        return False


def _opened_pages() -> set[tuple[int, int]]:
    """Return device and inode of each page that a process has open which this user may see."""
    opened = set[tuple[int, int]]()
    for pid in parents():
        folder = f"/proc/{pid}/fd"
        with suppress(OSError):  # it has ended, or is another user's
            if pid == os.getpid():
                continue
            for name in os.listdir(folder):  # noqa: PTH208
                with suppress(OSError):
                    if _PAGE.search(os.readlink(f"{folder}/{name}")):  # noqa: PTH115
                        file = os.stat(f"{folder}/{name}")  # noqa: PTH116
                        opened.add((file.st_dev, file.st_ino))
    return opened


def output_text(output: ShapedOutput) -> str:
    """Return the state of an output in a line, with what the gate has counted."""
    topic = output.topic
    if output.user not in run_users():  # any user may have a page that names any topic
        topic = f"{topic} of user {user_name(output.user)}"
    shaped = f"{topic} is shaped by process {output.shaping_node}"
    since_ns = 0 if output.since_ns is None else time.monotonic_ns() - output.since_ns
    without_it = (
        f"for {duration_text(since_ns // 1_000_000 * 1_000_000)}, {output.messages} messages"
    )
    text = {
        "shaped": shaped,
        "in process": f"{shaped}, which publishes it",
        "no standby": f"{shaped}, but has no standby: it falls silent when that ends",
        "bypassed": f"{topic} is bypassed {without_it} go around its shaping node",
        "silent": f"{topic} is silent {without_it} were not published",
    }[output.state]
    lost = "".join(f", {count} {reason}" for reason, count in output.lost.items())
    if output.published or lost:
        published = f"{output.published} messages published, {output.late} late{lost}"
        text += f"; in this run so far {published}"
    if output.moved_ns:
        sign = "-" if output.moved_ns < 0 else "+"
        text += f"; its slots are moved by {sign}{duration_text(abs(output.moved_ns))}"
    return text


def ask_phase(topic: str, pids: Collection[int], phase_ns: int) -> None:
    """Ask a gate in its publisher's process to start cycles at another phase (CLOCK_MONOTONIC, ns).

    Raises OperationError: none of these processes publishes the output, or several do.
    """
    with closing(_page_of(topic, pids)) as page:
        page.ask(Change(time.monotonic_ns(), NEW_PHASE, phase_ns))


def gates_of(topic: str, pids: Collection[int]) -> list[ShapedOutput]:
    """Return the gates of an output that one of these processes publishes.

    A gate comes into being when its shaping node has found a publisher. Without processes it is
    one of this user's.
    """
    return [
        output
        for output in find_outputs()
        if output.topic == topic
        and output.shaping_node
        and (output.shaping_node in pids if pids else output.user in run_users())
    ]


def _page_of(topic: str, pids: Collection[int]) -> Page:
    """Open the page of an output's only gate among these processes; see :func:`gates_of`."""
    gates = gates_of(topic, pids)
    if len(gates) != 1:
        raise OperationError(
            f"slots of {topic} cannot follow: {len(gates) or 'no'} gates publish it now that"
            " show their latencies; start the shaping node, one of this version"
            f" (and what publishes {topic}: a gate is there when its node has found a publisher)"
        )
    folder, _, name = gates[0].page.rpartition("/")
    return Page(folder, name, flags=os.O_RDWR)


class FollowedOutput:
    """An output whose latencies are read, and whose slots are moved, until it is closed.

    ``pids`` are processes that it may be of, if they are known. Raises OperationError: no shaping
    node of it runs, several do, or another run moves its slots.
    """

    def __init__(self, topic: str, pids: Collection[int] = ()) -> None:
        self._page = _page_of(topic, pids)
        if not self._page.lock(MOVING):
            self._page.close()
            raise OperationError(
                f"another run has the slots of {topic} follow its latencies: end that first"
            )
        self._seen = self._page["measured"]
        self._decided = 0
        self.move(0, time.monotonic_ns())  # a run before may have moved them, and has ended

    def latencies(self) -> list[int]:
        """Return the latencies of outputs since the last call, from origin to arrival (ns).

        Raises OperationError: the gate's page is not there any more.
        """
        self._look()
        new = self._page.latest("measured", self._seen)
        self._seen = self._page["measured"]
        return new

    def origins(self, cycle_ns: int) -> list[int]:
        """Return where the cycle of the latest message began (ns), unless the last call did.

        The gate notes only the place in the cycle, which is what counts: where it notes it while
        this looks, the origin may be that of the cycle before. Raises OperationError: as
        :meth:`latencies`.
        """
        self._look()
        published, page = self._page["measured"], self._page
        if published == self._decided or not page["phase_known"]:
            return []
        self._decided = published
        until = page["until_ns"]
        return [until - (until - page["phase_ns"]) % cycle_ns]

    def _look(self) -> None:
        try:
            self._page.look()
        except (OSError, ValueError) as error:
            raise OperationError(
                f"{self._page.path}: its gate cannot be followed: {error}; start this run again"
            ) from error

    def move(self, by_ns: int, from_ns: int) -> None:
        """Move slots by this time from where the gate has them, in cycles from an instant on."""
        self._page.ask(Change(from_ns, NEW_MOVE, by_ns))

    def close(self) -> None:
        """Let the slots go back to where the gate has them."""
        self._page.close()


def _is_of(pid: int, user: int) -> bool:
    """Return whether a process has this real user: any user may write any id into a page."""
    with suppress(OSError):
        return status_field(read_proc(f"/proc/{pid}/status"), "Uid")[:1] == [user]
    return False


def _output_of(page: Page, pid_of: Mapping[int, int]) -> ShapedOutput | None:
    """Return the output of a page; None: its processes have ended.

    ``pid_of`` has the process ids here by those that the page names.
    """
    holder = page["holder"] if page.is_locked() else 0
    standby = page["standby"] if page.is_locked(STANDING_BY) else 0
    holder, standby = pid_of.get(holder, holder), pid_of.get(standby, standby)
    holder = holder if _is_of(holder, page.owner) else 0
    standby = standby if _is_of(standby, page.owner) else 0
    if not holder and not standby:
        return None
    since = page["bypassing_since_ns"] if standby else 0
    state: OutputState = "in process" if page["in_process"] else "no standby"
    if since or not holder:
        state = "silent" if page["silent"] else "bypassed"
    elif standby:
        state = "shaped"
    reasons = (*DROPPED, "lost by DDS")
    counts = {reason: page[reason.replace(" ", "_").lower()] for reason in reasons}
    return ShapedOutput(
        topic=_TOPIC.validate_python(page.topic),  # another user may write any text
        state=state,
        shaping_node=holder or None,
        standby=standby or None,
        since_ns=since or None,
        messages=page["bypassed"] - page["bypassed_before"] if since else 0,
        messages_in_all=page["bypassed"],
        starts=page["starts"],
        published=page["published"],
        lost={reason: count for reason, count in counts.items() if count},
        late=page["late"],
        moved_ns=page.moved_ns,
        page=page.path,
        user=page.owner,
    )
