"""Which outputs are shaped on this machine at the moment, and which go around their shaping node:
what their pages of memory say (:mod:`chainshaper.robot.handover`).
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
    PASSING,
    PUBLISHING,
    STANDING_BY,
    VERSION,
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
    """An output with a shaping node, as it is now. It counts since the launch of the shaping node
    began, which may have started that again; ``messages_in_all`` since the machine has booted.

    ``state`` is ``bypassed`` or ``silent`` while no shaping node is in force, and ``no standby``
    when one is, but nothing would stand in for it: a gate ``in process`` ends with its publisher.
    """

    topic: str
    state: OutputState
    shaping_node: int | None  # the process, if there is one
    standby: int | None
    since_ns: int | None  # of CLOCK_MONOTONIC: since when it is bypassed or silent,
    messages: int  # with how many messages,
    messages_in_all: int  # beside those before
    starts: int  # of the shaping node
    published: int  # by shaping nodes
    lost: dict[str, int]  # by reason
    late: int  # of both: behind the last slot that they were due in
    moved_ns: int  # its slots follow the latencies, and are by so much not where the plan has them
    page: str
    user: int  # whose page it is: nobody else's says anything of this user's outputs


def find_outputs(folders: Iterable[str] | None = None) -> tuple[ShapedOutput, ...]:
    """The outputs that this user may see, root those of all users, and in containers; one whose
    processes have both ended is none any more.
    """
    pages: list[tuple[str, str, dict[int, int]]] = []
    if folders is None:
        pages, folders = _in_containers(), [*page_folders()]
        if os.geteuid() == 0:
            others = [*Path("/run/user").glob("*/chainshaper/outputs")]
            others += Path("/dev/shm").glob("chainshaper-*")  # noqa: S108
            folders += sorted({*map(str, others)} - {*folders})
    for folder in folders:
        with suppress(OSError):
            pages += [(folder, name, {}) for name in sorted(os.listdir(folder))]  # noqa: PTH208
    found = []
    for folder, name, pid_of in pages:
        with suppress(OSError, ValueError), closing(Page(folder, name)) as page:
            found += _looked_at(page, pid_of)
    return tuple(found)


def _in_containers() -> list[tuple[str, str, dict[int, int]]]:
    """Pages that processes have open whose files are others than ours: folder and name in /proc.

    With each are its processes, by what they call themselves: a page has them so.
    """
    own = Path("/proc/self/ns/mnt").stat().st_ino
    found: dict[tuple[int, int], tuple[str, str, dict[int, int]]] = {}
    for pid in parents():
        folder = f"/proc/{pid}/fd"
        with suppress(OSError):  # it has ended, or is another user's
            if os.stat(f"/proc/{pid}/ns/mnt").st_ino == own:  # noqa: PTH116
                continue
            inner = innermost_id(read_proc(f"/proc/{pid}/status")) or pid
            for name in os.listdir(folder):  # noqa: PTH208
                if _PAGE.search(os.readlink(f"{folder}/{name}")):  # noqa: PTH115
                    file = os.stat(f"{folder}/{name}")  # noqa: PTH116
                    page = found.setdefault((file.st_dev, file.st_ino), (folder, name, {}))
                    page[2][inner] = pid
    return list(found.values())


def remove_abandoned_pages(folders: Iterable[str] | None = None) -> list[str]:
    """Remove the pages of this user's outputs that no process has open: the files removed.

    One with a right taken stays as well: its process may be in a container, and not to be seen. A
    node that looks for its page meanwhile finds that it is gone, and makes another.
    """
    opened, removed = _opened_pages(), list[str]()
    for folder in page_folders() if folders is None else folders:
        names = list[str]()
        with suppress(OSError):
            names = sorted(os.listdir(folder))  # noqa: PTH208
        for name in names:
            path = f"{folder}/{name}"
            with suppress(OSError):
                there = os.lstat(path)
                used = (there.st_dev, there.st_ino) in opened or _has_rights(folder, name)
                if there.st_uid == os.geteuid() and not used:
                    os.unlink(path)  # noqa: PTH108
                    removed.append(path)
    return removed


def _has_rights(folder: str, name: str) -> bool:
    """Whether a process has a right of a page; of one for which there was no room, none has."""
    try:
        with closing(Page(folder, name)) as page:
            return any(map(page.is_locked, (PUBLISHING, STANDING_BY, PASSING, MOVING)))
    except ValueError:
        return False


def _opened_pages() -> set[tuple[int, int]]:
    """Device and number of each page that another process has open, as far as they are seen."""
    opened = set[tuple[int, int]]()
    for pid in parents():
        folder = f"/proc/{pid}/fd"
        with suppress(OSError):  # it has ended, or is another user's
            for name in os.listdir(folder) if pid != os.getpid() else ():  # noqa: PTH208
                with suppress(OSError):
                    if _PAGE.search(os.readlink(f"{folder}/{name}")):  # noqa: PTH115
                        file = os.stat(f"{folder}/{name}")  # noqa: PTH116
                        opened.add((file.st_dev, file.st_ino))
    return opened


def output_text(output: ShapedOutput) -> str:
    """The state of an output in a line, with what the gate has counted."""
    topic = output.topic
    if output.user not in run_users():  # any user may have a page that names any topic
        topic = f"{topic} of user {user_name(output.user)}"
    shaped = f"{topic} is shaped by process {output.shaping_node}"
    since_ns = 0 if output.since_ns is None else time.monotonic_ns() - output.since_ns
    gone = f"for {duration_text(since_ns // 1_000_000 * 1_000_000)}, {output.messages} messages"
    text = {
        "shaped": shaped,
        "in process": f"{shaped}, which publishes it",
        "no standby": f"{shaped}, but has no standby: it falls silent when that ends",
        "bypassed": f"{topic} is bypassed {gone} go around its shaping node",
        "silent": f"{topic} is silent {gone} were not published",
    }[output.state]
    lost = "".join(f", {count} {why}" for why, count in output.lost.items())
    if output.published or lost:
        published = f"{output.published} messages published, {output.late} late{lost}"
        text += f"; in this run so far {published}"
    if output.moved_ns:
        sign = "-" if output.moved_ns < 0 else "+"
        text += f"; its slots are moved by {sign}{duration_text(abs(output.moved_ns))}"
    return text


def ask_phase(topic: str, pids: Collection[int], phase_ns: int) -> None:
    """Have the cycles of a gate in its publisher's process begin elsewhere (ns of CLOCK_MONOTONIC).

    Raises OperationError: none of these processes publishes the output, or several do.
    """
    with closing(_page_of(topic, pids)) as page:
        page["asked_phase_ns"] = phase_ns
        page["phases_asked"] += 1


def _page_of(topic: str, pids: Collection[int]) -> Page:
    """The page of an output that one of these processes publishes; of any of ours, without them."""
    of_topic = [output for output in find_outputs() if output.topic == topic]
    found = [
        output
        for output in of_topic
        if (output.shaping_node in pids if pids else output.user in run_users())
        and output.shaping_node
    ]
    if len(found) != 1:
        raise OperationError(
            f"slots of {topic} cannot follow: {len(found) or 'no'} gates publish it now that show"
            " their latencies; start the shaping node, one of this version"
        )
    folder, _, name = found[0].page.rpartition("/")
    return Page(folder, name, flags=os.O_RDWR)


class FollowedOutput:
    """An output whose latencies are read, and whose slots are moved, until it is closed.

    ``pids`` are processes that it may be of, if they are known. Raises OperationError: no shaping
    node of it runs, several do, or another run moves its slots.
    """

    def __init__(self, topic: str, pids: Collection[int] = ()) -> None:
        self._page = _page_of(topic, pids)
        if not self._page.is_locked(MOVING):  # by how much a run before moved them is over
            self._page["moved_from_ns"] = 0
        if not self._page.lock(MOVING):
            self._page.close()
            raise OperationError(
                f"another run has the slots of {topic} follow its latencies: end that first"
            )
        self._seen = self._page["measured"]
        self.move(0, time.monotonic_ns())

    def latencies(self) -> list[int]:
        """Those of the outputs that came since the last time, from origin to arrival (ns).

        Raises OperationError: the gate's page is not there any more.
        """
        try:
            self._page.look()
        except (OSError, ValueError) as error:
            raise OperationError(
                f"{self._page.path}: its gate cannot be followed: {error}; start this run again"
            ) from error
        new = self._page.latest("measured", self._seen)
        self._seen = self._page["measured"]
        return new

    def move(self, by_ns: int, from_ns: int) -> None:
        """Have slots be by so much not where the gate has them, in cycles from an instant on."""
        self._page["moved_from_ns"] = 0
        self._page["moved_ns"] = by_ns
        self._page["moved_from_ns"] = from_ns

    def close(self) -> None:
        """The slots go back to where the gate has them."""
        self._page.close()


def _is_of(pid: int, user: int) -> bool:
    """Whether a process has that real user: any user may write its id into a page."""
    with suppress(OSError):
        return status_field(read_proc(f"/proc/{pid}/status"), "Uid")[:1] == [user]
    return False


def _looked_at(page: Page, pid_of: Mapping[int, int]) -> list[ShapedOutput]:
    holder = page["holder"] if page.is_locked() else 0
    standby = page["standby"] if page.is_locked(STANDING_BY) else 0
    holder, standby = pid_of.get(holder, holder), pid_of.get(standby, standby)
    holder = holder if _is_of(holder, page.owner) else 0
    standby = standby if _is_of(standby, page.owner) else 0
    if not holder and not standby:
        return []
    since = page["bypassing_since_ns"] if standby else 0
    state: OutputState = "in process" if page["in_process"] else "no standby"
    if since or not holder:
        state = "silent" if page["silent"] else "bypassed"
    elif standby:
        state = "shaped"
    counts = {why: page[why.replace(" ", "_").lower()] for why in (*DROPPED, "lost by DDS")}
    return [
        ShapedOutput(
            topic=_TOPIC.validate_python(page.topic),  # another user's: no text of any other form
            state=state,
            shaping_node=holder or None,
            standby=standby or None,
            since_ns=since or None,
            messages=page["bypassed"] - page["bypassed_before"] if since else 0,
            messages_in_all=page["bypassed"],
            starts=page["starts"],
            published=page["published"],
            lost={why: count for why, count in counts.items() if count},
            late=page["late"],
            moved_ns=page["moved_ns"] if page["moved_from_ns"] and page.is_locked(MOVING) else 0,
            page=page.path,
            user=page.owner,
        )
    ]
