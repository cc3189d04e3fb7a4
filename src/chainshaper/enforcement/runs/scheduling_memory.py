"""Changing the class and cores of threads that are not ours, and putting them back.

Before a change, the journal learns what was there and what is wanted. Putting back looks at each
aspect of a thread (:mod:`.scheduling_state`) by itself. One that is as we set it goes back to what
it was; one that somebody else has changed since is theirs, and is left and said so. A thread that
has ended is done with, and one that has its id by now is recognised by its start.

Threads inherit class and cores from those that create them. What an application starts while we
have changed it is not in the journal, but shows a class that only we have given to its family:
it gets its parent's original (:func:`restore_inherited`). A daemon has left its family, since the
process between them has ended; it is known by the cgroup of the thread that was changed, and by
all that we gave to that one, a real-time class included.

SCHED_DEADLINE has parameters that the kernel admits only together with all others: threads under
it are refused.
"""

from dataclasses import dataclass, replace
from time import CLOCK_BOOTTIME, clock_gettime_ns
from typing import Literal, TypeAlias

from chainshaper.enforcement.runs.journal import Journal
from chainshaper.enforcement.runs.scheduling_state import (
    ASPECTS,
    SchedulingClass,
    SchedulingState,
    set_state,
    state_as_json,
    state_from_json,
    state_of,
    state_text,
    with_aspect,
)
from chainshaper.enforcement.threads.listing import (
    SCHED_DEADLINE,
    TICK_NS,
    Scheduling,
    Thread,
    list_threads,
    parents,
    read_proc,
    start_of,
)
from chainshaper.enforcement.threads.processes import descendants
from chainshaper.errors import OperationError, PlatformError

__all__ = [
    "Outcome",
    "change_scheduling",
    "is_remembered",
    "note_scheduling",
    "release_threads",
    "restore_inherited",
    "restore_scheduling",
]

KIND = "scheduling"

Fate: TypeAlias = Literal["restored", "unchanged", "ended", "left", "failed"]
"""``unchanged``: it is as it was already; ``left``: somebody else has changed it since."""


@dataclass(frozen=True)
class Outcome:
    """What became of one thread when its scheduling was put back."""

    tid: int
    comm: str
    fate: Fate
    reason: str = ""


@dataclass(frozen=True)
class _Remembered:
    """A thread of the journal: what it had at first, and all that it was given since.

    ``changed_at`` counts clock ticks since the machine booted; ``cgroups`` are those in which it
    was then, as /proc shows them.
    """

    tid: int
    started: int
    pid: int
    comm: str
    changed_at: int
    cgroups: str
    original: SchedulingState
    given: tuple[SchedulingState, ...]


def change_scheduling(journal: Journal, thread: Thread, wanted: Scheduling) -> None:
    """Give a thread its class and cores, with what was there in the journal.

    A thread that has ended meanwhile is no error.

    Raises:
        OperationError: it runs under SCHED_DEADLINE, the journal cannot be written (then nothing
            is changed), or the kernel refuses.
        PlatformError: the privilege to change it is missing.
    """
    try:
        target = _target(state_of(thread.tid), wanted)
        if note_scheduling(journal, thread, target):
            now = state_of(thread.tid)
            set_state(thread.tid, target, [a for a in ASPECTS if _differ(now, target, a)])
    except ProcessLookupError:
        return
    except PermissionError as error:
        raise PlatformError(
            f"thread {thread.tid} ({thread.comm}) of process {thread.pid} may not be given "
            f"{state_text(target)}: run as root or with CAP_SYS_NICE, or as the user of that "
            "process with an rtprio limit of 98"
        ) from error
    except OSError as error:
        raise OperationError(
            f"thread {thread.tid} ({thread.comm}) of process {thread.pid}: the kernel refuses "
            f"{state_text(target)}: {error.strerror}"
        ) from error


def note_scheduling(journal: Journal, thread: Thread, target: SchedulingState) -> bool:
    """Write down what a thread has before it gets ``target``; False when it has ended.

    For what is changed by other means than :func:`change_scheduling`.

    Raises:
        OperationError: it runs under SCHED_DEADLINE, or the journal cannot be written.
    """
    try:
        before = state_of(thread.tid)
    except ProcessLookupError:
        return False
    if start_of(thread.pid, thread.tid) != thread.started:
        return False  # its id belongs to another thread by now
    if before.scheduling_class.policy == SCHED_DEADLINE:
        raise OperationError(
            f"thread {thread.tid} ({thread.comm}) of process {thread.pid} runs under "
            "SCHED_DEADLINE, whose reservation is left alone: take it out of the plan, or give it "
            f"another class first (`chrt --other --pid 0 {thread.tid}`)"
        )
    if not is_remembered(journal, thread):
        # What it has from a thread of ours is not what it shall have afterwards.
        family = [one for one in _remembered(journal) if one.pid == thread.pid]
        before = _without_inheritance(before, thread.started, family)
    journal.note(
        KIND,
        tid=thread.tid,
        started=thread.started,
        pid=thread.pid,
        comm=thread.comm,
        at=clock_gettime_ns(CLOCK_BOOTTIME) // TICK_NS,
        cgroups=_cgroups_of(thread.tid),
        before=state_as_json(before),
        given=state_as_json(target),
    )
    return True


def is_remembered(journal: Journal, thread: Thread) -> bool:
    """Whether a thread's scheduling has been changed by way of this journal."""
    return any((one.tid, one.started) == thread.identity for one in _remembered(journal))


def restore_scheduling(journal: Journal) -> tuple[Outcome, ...]:
    """Put back the class and cores of every thread in the journal, and of what inherited them.

    Works from any process, and as often as one likes. The latest changes are undone first, and
    inheritance last: until its parent is restored, a new thread inherits.
    """
    if journal.outdated:
        return ()
    restored = tuple(_restore(one) for one in reversed(_remembered(journal)))
    return restored + restore_inherited(journal)


def release_threads(journal: Journal) -> None:
    """:func:`restore_scheduling`, where all has to be put back.

    Raises:
        OperationError: the kernel refuses for some threads; the others are as before.
    """
    left = [one for one in restore_scheduling(journal) if one.fate == "failed"]
    if left:
        raise OperationError(
            "not everything could be put back: "
            f"{'; '.join(f'{one.tid} ({one.comm}): {one.reason}' for one in left)}; {journal.path} "
            "says what was there, `chainshaper release` tries again"
        )


def restore_inherited(journal: Journal) -> tuple[Outcome, ...]:
    """Give threads that inherited a class or cores of ours what their parent had before.

    They are threads that started after the change, in a process of the journal, in one that it
    started, or in a daemon. To be repeated while an application runs; threads in the journal are
    not touched.
    """
    if journal.outdated:
        return ()
    remembered = _remembered(journal)
    done = {(one.tid, one.started) for one in remembered}
    parent_of = parents() if remembered else {}
    outcomes = []
    for pid in dict.fromkeys(one.pid for one in remembered):
        family = [one for one in remembered if one.pid == pid]
        new = (thread for child in descendants(parent_of, pid) for thread in list_threads(child))
        for thread in new:
            outcome = None if thread.identity in done else _disinherit(thread, family)
            if outcome is not None:
                done.add(thread.identity)
                outcomes.append(outcome)
    strangers = (thread for pid in parent_of for thread in list_threads(pid))
    for daemon in (one for one in strangers if one.identity not in done):
        outcome = _disinherit(daemon, _forebears(daemon, remembered))
        if outcome is not None:
            outcomes.append(outcome)
    return tuple(outcomes)


def _target(now: SchedulingState, wanted: Scheduling) -> SchedulingState:
    """What a thread has after a wish is fulfilled: what the wish leaves open stays."""
    if wanted.priority is not None:
        held = SchedulingClass(wanted.policy, wanted.priority, now.scheduling_class.reset_on_fork)
        now = replace(now, scheduling_class=held)
    return now if wanted.cores is None else replace(now, cores=tuple(sorted(wanted.cores)))


def _restore(one: _Remembered) -> Outcome:
    if start_of(one.pid, one.tid) != one.started:
        return Outcome(one.tid, one.comm, "ended")
    try:
        now = state_of(one.tid)
        different = [aspect for aspect in ASPECTS if _differ(now, one.original, aspect)]
        ours = [a for a in different if any(not _differ(now, given, a) for given in one.given)]
        set_state(one.tid, one.original, ours)
    except ProcessLookupError:
        return Outcome(one.tid, one.comm, "ended")
    except OSError as error:
        reason = f"the kernel refuses {state_text(one.original)}: {error.strerror}"
        return Outcome(one.tid, one.comm, "failed", reason)
    if ours != different:
        reason = f"somebody else has changed it since: {state_text(state_of(one.tid))}"
        return Outcome(one.tid, one.comm, "left", reason)
    return Outcome(one.tid, one.comm, "restored" if ours else "unchanged")


def _disinherit(thread: Thread, family: list[_Remembered]) -> Outcome | None:
    """Put back what a thread inherited from one of the family; None when that is nothing."""
    try:
        now = state_of(thread.tid)
        target = _without_inheritance(now, thread.started, family)
        if target == now:
            return None
        set_state(thread.tid, target, [a for a in ASPECTS if _differ(now, target, a)])
    except ProcessLookupError:
        return None
    except OSError as error:
        reason = f"inherited; the kernel refuses what its parent had: {error.strerror}"
        return Outcome(thread.tid, thread.comm, "failed", reason)
    return Outcome(thread.tid, thread.comm, "restored", "it had inherited what we had set")


def _forebears(thread: Thread, remembered: list[_Remembered]) -> list[_Remembered]:
    """Those of whom a thread has everything that we gave them, which no relation would explain."""
    if thread.priority == 0:
        return []  # cores alone are no evidence
    try:
        now = state_of(thread.tid)
    except ProcessLookupError:
        return []
    return [
        one for one in remembered if now in one.given and _cgroups_of(thread.tid) == one.cgroups
    ]


def _cgroups_of(tid: int) -> str:
    """The cgroups of a thread, in all hierarchies; empty when it has ended."""
    try:
        return read_proc(f"/proc/{tid}/cgroup").decode(errors="replace")
    except OSError:
        return ""


def _without_inheritance(
    state: SchedulingState, started: int, family: list[_Remembered]
) -> SchedulingState:
    """A thread's scheduling with every aspect that is one of ours replaced by its parent's.

    Which thread was the parent nobody records: the first in the journal with that aspect is
    taken. Threads that share a class with us there mostly shared one before.
    """
    for aspect in ASPECTS:
        for one in family:
            if started < one.changed_at or not _differ(state, one.original, aspect):
                continue
            if any(not _differ(state, given, aspect) for given in one.given):
                state = with_aspect(state, aspect, one.original)
                break
    return state


def _remembered(journal: Journal) -> list[_Remembered]:
    """The threads of a journal, each with its changes joined, in order of their first change.

    Where somebody else changed an aspect between two changes of ours, theirs is the original.
    """
    threads: dict[tuple[int, int], _Remembered] = {}
    for entry in journal.entries(KIND):
        before, given = state_from_json(entry["before"]), state_from_json(entry["given"])
        key = (entry["tid"], entry["started"])
        if key not in threads:
            threads[key] = _Remembered(
                *key,
                entry["pid"],
                entry["comm"],
                entry["at"],
                entry["cgroups"],
                before,
                (given,),
            )
            continue
        earlier = threads[key]
        original = earlier.original
        for aspect in ASPECTS:
            if all(_differ(before, known, aspect) for known in (original, *earlier.given)):
                original = with_aspect(original, aspect, before)
        threads[key] = replace(earlier, original=original, given=(*earlier.given, given))
    return list(threads.values())


def _differ(one: SchedulingState, other: SchedulingState, aspect: str) -> bool:
    return bool(getattr(one, aspect) != getattr(other, aspect))
