"""Change the scheduling class and cores of an application's threads, and put them back.

Each aspect of a thread (:mod:`chainshaper.linux.scheduling`) is put back by itself: one that is as
we set it becomes what it was before; one that another program has changed since is left alone.

A thread inherits class and cores from the thread that creates it. So threads that start while the
application's scheduling is changed have to be put back, too: they get what their parent had before.
That is done for a thread that has what we gave, and belongs to the application beyond doubt, by

* its process, which is in the journal (same id *and* start), or descends from one there, or did at
  two looks in a row; or
* its cgroup, which is one of the run.

All others, such as a daemon whose parent has ended, are left alone; :func:`look_alikes` names them.
"""

import os
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from chainshaper.enforcement.journal import Journal, process_of
from chainshaper.linux.cgroups import threads_in
from chainshaper.linux.processes import descendants
from chainshaper.linux.scheduling import (
    ASPECTS,
    SchedulingRequest,
    SchedulingState,
    after_wish,
    different_aspects,
    set_state,
    state_from_json,
    state_of,
    with_aspect,
)
from chainshaper.linux.threads import (
    SCHED_DEADLINE,
    TICK_NS,
    RunningThread,
    find_thread,
    list_threads,
    parents,
    since_boot_ns,
    start_of,
)
from chainshaper.values.errors import OperationError, PlatformError

KIND = "scheduling"  # of a journal's entries
DESCENDANTS = "descendant"
_GENERATIONS = 5  # how often we look for threads that have started while others were put back


@dataclass(frozen=True)
class Change:
    """A thread of the journal, and how its scheduling was changed."""

    tid: int
    started: int  # ticks after the machine booted
    pid: int
    comm: str  # its name
    changed_at: int  # when it was changed first (ticks after the machine booted)
    original: SchedulingState  # what it had until then
    given: tuple[SchedulingState, ...]  # all that it was given, in order

    @property
    def identity(self) -> tuple[int, int]:
        return (self.tid, self.started)


def change_all(
    journal: Journal, changes: Iterable[tuple[RunningThread, SchedulingRequest]]
) -> None:
    """Give threads that still run their class and cores.

    Raises OperationError: as :func:`note_scheduling` (then nothing is changed), or the kernel
    refuses. PlatformError: a privilege is missing.
    """
    wishes = [(thread, partial(after_wish, wanted=wanted)) for thread, wanted in changes]
    for thread, target in note_scheduling(journal, wishes):
        try:
            set_state(thread.tid, target)
        except ProcessLookupError:
            continue
        except PermissionError as error:
            remedy = (
                "CAP_SYS_NICE is missing; or, with control groups of version 1, the group of its"
                " container has no real-time: see its cpu.rt_runtime_us, and those above"
                if os.geteuid() == 0
                else "run as root or with CAP_SYS_NICE, or as the user of that process with an"
                " rtprio limit of 98"
            )
            refused = f"{thread.text} may not be given {target.text}: {remedy}"
            raise PlatformError(refused) from error
        except OSError as error:
            raise OperationError(_refused(thread, target, error)) from error


def _refused(thread: RunningThread, target: SchedulingState, error: OSError) -> str:
    return f"{thread.text}: the kernel refuses {target.text}: {error.strerror}"


def note_scheduling(
    journal: Journal,
    changes: Iterable[tuple[RunningThread, Callable[[SchedulingState], SchedulingState]]],
) -> list[tuple[RunningThread, SchedulingState]]:
    """Write down how threads are scheduled before they are changed.

    Returns the threads that have to be changed, each with what it is to have. Threads under
    SCHED_DEADLINE are left as they are: a class of ours would take their reservation away, and the
    kernel refuses to bind them to a core. Raises OperationError: the journal cannot be written.
    """
    known = {change.identity: change for change in remembered_threads(journal)}
    families = _families(journal, list(known.values()))
    noted, entries = [], []
    for thread, changed in changes:
        try:
            before = state_of(thread.tid)
        except ProcessLookupError:
            continue
        target = changed(before)
        if start_of(thread.pid, thread.tid) != thread.started:
            continue  # its id belongs to another thread by now
        if before.scheduling_class.policy == SCHED_DEADLINE:
            continue
        earlier = known.get(thread.identity)
        if earlier is None:
            # What it has inherited from a changed thread is not what it shall have afterwards.
            family = families.get(thread.pid, ())
            inherited = [change for change in family if thread.started >= change.changed_at]
            before = _given_back(before, inherited)
        elif before == target and target in earlier.given:
            continue
        noted.append((thread, target))
        entry = {name: getattr(thread, name) for name in ("tid", "started", "pid", "comm")}
        entry |= {"before": asdict(before), "given": asdict(target)}
        entries.append({**entry, "at": since_boot_ns() // TICK_NS})
    if entries:
        journal.note(KIND, *entries)
    return noted


def read_change(entry: Mapping[str, Any]) -> Change:
    """Make a change of a journal's entry."""
    before, given = (state_from_json(entry[name]) for name in ("before", "given"))
    tid, started, pid, at = (int(entry[name]) for name in ("tid", "started", "pid", "at"))
    return Change(tid, started, pid, str(entry["comm"]), at, before, (given,))


def remembered_threads(journal: Journal) -> list[Change]:
    """Return the threads of a journal, each with its changes joined, in order of the first change.

    Where another program changed an aspect between two changes of ours, the aspect's original is
    what that program set.
    """
    threads: dict[tuple[int, int], Change] = {}
    for change in journal.read(KIND, read_change):
        earlier = threads.setdefault(change.identity, change)
        if earlier is change:
            continue
        original, known = earlier.original, (earlier.original, *earlier.given)
        for aspect in ASPECTS:
            if all(aspect in different_aspects(change.original, state) for state in known):
                original = with_aspect(original, aspect, change.original)
        given = (*earlier.given, *change.given)
        threads[change.identity] = replace(earlier, original=original, given=given)
    return list(threads.values())


def note_descendants(journal: Journal, before: Collection[tuple[int, int]]) -> set[tuple[int, int]]:
    """Write down processes that those of the journal have started meanwhile.

    Only those are written that an earlier look has returned, which is given as ``before``: helpers
    come and go. Returns all that are not in the journal, by id and start. Raises OperationError:
    the journal cannot be written.
    """
    remembered = remembered_threads(journal)
    known = {change.pid for change in remembered}
    new = set[tuple[int, int]]()
    for pid in _families(journal, remembered):
        started = start_of(pid, pid)
        if pid not in known and started is not None:
            new.add((pid, started))
    new -= set(journal.read(DESCENDANTS, process_of))
    entries = [{"pid": pid, "started": started} for pid, started in sorted(new & set(before))]
    if entries:
        journal.note(DESCENDANTS, *entries)
    return new


def release_threads(journal: Journal, groups: Iterable[Path] = ()) -> None:
    """Put back class and cores of every thread in the journal, and of those that inherited them.

    Any process may do so, any number of times. ``groups`` are the run's cgroups. Raises
    OperationError: the kernel refuses for some threads; the others are as before.
    """
    if journal.outdated:
        return
    remembered, refused = remembered_threads(journal), dict[int, str]()

    def give_back(thread: RunningThread, family: list[Change]) -> bool:
        try:
            now = target = state_of(thread.tid)
            if now.scheduling_class.policy == SCHED_DEADLINE:
                return False  # another program gave it that since, and the kernel keeps its cores
            target = _given_back(now, family)
            set_state(thread.tid, target)
        except ProcessLookupError:
            return False
        except OSError as error:
            refused[thread.tid] = _refused(thread, target, error)
            return False
        return now != target

    for change in reversed(remembered):
        thread = find_thread(change.tid)
        if thread is not None and thread.identity == change.identity:
            give_back(thread, [change])
    # Until its parent was restored, a new thread inherited; and it may itself have started some.
    for _ in range(_GENERATIONS if remembered else 0):
        changed = [
            give_back(thread, family) for thread, family in _born_of(journal, remembered, groups)
        ]
        if not any(changed):
            break
    if refused:
        raise OperationError("; ".join(refused.values()))


def look_alikes(journal: Journal, groups: Iterable[Path] = ()) -> tuple[str, ...]:
    """Name real-time threads that have what a run gives, but are not known as the application's.

    To be called before the run is undone.
    """
    remembered = [] if journal.outdated else remembered_threads(journal)
    known = {change.identity for change in remembered}
    known |= {thread.identity for thread, _ in _born_of(journal, remembered, groups)}
    if not remembered:
        return ()
    lines = []
    for thread in (thread for pid in parents() for thread in list_threads(pid)):
        if thread.priority == 0 or thread.identity in known:
            continue  # any thread may have the same cores
        with suppress(ProcessLookupError):
            now = state_of(thread.tid)
            if any(
                now in change.given and thread.started >= change.changed_at for change in remembered
            ):
                lines.append(
                    f"{thread.text} is left as it is: {now.text}; if it is the application's, which"
                    f" nothing shows, `chrt --other --pid 0 {thread.tid}`"
                )
    return tuple(lines)


def _born_of(
    journal: Journal, remembered: list[Change], groups: Iterable[Path]
) -> list[tuple[RunningThread, list[Change]]]:
    """Find threads of the application that are not in its journal.

    Returns each with the changes of the threads from which it may have inherited.
    """
    noted = {change.identity for change in remembered}
    families = _families(journal, remembered)
    threads = [(thread, family) for pid, family in families.items() for thread in list_threads(pid)]
    members = (find_thread(tid) for folder in groups for tid in threads_in(folder))
    threads += [(thread, remembered) for thread in members if thread is not None]
    return [
        (thread, [change for change in family if thread.started >= change.changed_at])
        for thread, family in threads
        if thread.identity not in noted
    ]


def _families(journal: Journal, remembered: list[Change]) -> dict[int, list[Change]]:
    """Return the processes of the application, each with the changes it may have inherited."""
    families: dict[int, list[Change]] = {}
    for change in remembered:
        families.setdefault(change.pid, []).append(change)
    for pid, family in list(families.items()):
        begun = start_of(pid, pid)
        # A process that had begun when its thread was changed is still the same.
        if begun is None or begun > min(change.changed_at for change in family):
            del families[pid]
    for pid, started in journal.read(DESCENDANTS, process_of):
        if start_of(pid, pid) == started:
            families.setdefault(pid, remembered)
    parent_of = parents() if families else {}
    for ancestor, family in list(families.items()):
        for pid in descendants(parent_of, ancestor):
            families.setdefault(pid, family)
    return families


def _given_back(state: SchedulingState, family: Iterable[Change]) -> SchedulingState:
    """Put back each aspect of a state that is as we set it for a thread of the family.

    The aspect becomes what the first such thread had before.
    """
    for aspect in ASPECTS:
        for change in family:
            was_given = any(
                getattr(state, aspect) == getattr(given, aspect) for given in change.given
            )
            if was_given and aspect in different_aspects(state, change.original):
                state = with_aspect(state, aspect, change.original)
                break
    return state
