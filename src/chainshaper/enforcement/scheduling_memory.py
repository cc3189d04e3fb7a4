"""Changing the class and cores of threads that are not ours, and putting them back.

Before a change, the journal learns what was there and what is wanted. Putting back looks at each
aspect of a thread (:mod:`chainshaper.linux.scheduling`) by itself. One that is as we set it goes
back to what it was; one that another program has changed since is left, and named. A thread that
has ended is done with; one that has its id by now is recognised by its start.

Threads inherit class and cores from those that create them. What an application starts while it is
changed is put back as well (:func:`restore_inherited`), if it is the application's beyond doubt: a
thread of a process in the journal, that process being the same (its id *and* its start); a process
that descends from one of these, or did when it was last looked (:func:`note_descendants`); a thread
that was born in a cgroup of ours. Of these, what started after the change and has what we gave to
its family gets its parent's original. All others are strangers, whatever class, core and cgroup
they have, and are left alone. So is a daemon whose parent ended before a look; :func:`look_alikes`
names both.

SCHED_DEADLINE has parameters that the kernel admits only together with all others: threads under
it are refused.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from time import CLOCK_BOOTTIME, clock_gettime_ns
from typing import Any, Literal, TypeAlias

from chainshaper.enforcement.freezer_state import groups_of, run_of
from chainshaper.linux.cgroups import threads_in
from chainshaper.linux.processes import descendants
from chainshaper.linux.runs import Journal, process_of
from chainshaper.linux.scheduling import (
    ASPECTS,
    Aspect,
    Scheduling,
    SchedulingState,
    after_wish,
    different_aspects,
    set_state,
    state_from_json,
    state_of,
    state_text,
    with_aspect,
)
from chainshaper.linux.threads import (
    SCHED_DEADLINE,
    TICK_NS,
    Thread,
    find_thread,
    list_threads,
    parents,
    start_of,
)
from chainshaper.values.errors import OperationError, PlatformError

KIND = "scheduling"
DESCENDANTS = "descendant"

Fate: TypeAlias = Literal["restored", "unchanged", "ended", "left", "failed"]
"""``unchanged``: it is as it was already; ``left``: another program has changed it since."""

_GENERATIONS = 5


@dataclass(frozen=True)
class Outcome:
    """What became of one thread when its scheduling was put back."""

    tid: int
    comm: str
    fate: Fate
    reason: str = ""


@dataclass(frozen=True)
class Change:
    """A thread of the journal: what it had at first, and all that it was given since.

    ``changed_at`` counts clock ticks since the machine booted.
    """

    tid: int
    started: int
    pid: int
    comm: str
    changed_at: int
    original: SchedulingState
    given: tuple[SchedulingState, ...]

    @property
    def identity(self) -> tuple[int, int]:
        return (self.tid, self.started)


def change_all(journal: Journal, changes: Iterable[tuple[Thread, Scheduling]]) -> None:
    """Give threads their class and cores, with what was there in the journal, on disk first.

    A thread that has ended meanwhile is no error; one that has what we gave it before is not
    written down again. Raises OperationError: one runs under SCHED_DEADLINE, the journal cannot be
    written (then nothing is changed), or the kernel refuses. PlatformError: a privilege is missing.
    """
    targets = []
    for thread, wanted in changes:
        try:
            targets.append((thread, after_wish(state_of(thread.tid), wanted)))
        except ProcessLookupError:
            continue
    for thread, target in note_scheduling(journal, targets):
        try:
            set_state(thread.tid, target, different_aspects(state_of(thread.tid), target))
        except ProcessLookupError:
            continue
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


def note_scheduling(
    journal: Journal, changes: Iterable[tuple[Thread, SchedulingState]]
) -> tuple[tuple[Thread, SchedulingState], ...]:
    """Write down what threads have before each gets its target; those that are to be changed.

    For what is changed by other means than :func:`change_all`. Raises OperationError: one runs
    under SCHED_DEADLINE, or the journal cannot be written.
    """
    known = {one.identity: one for one in remembered_threads(journal)}
    families = _by_process(known.values())
    noted, entries = [], []
    for thread, target in changes:
        try:
            before = state_of(thread.tid)
        except ProcessLookupError:
            continue
        if start_of(thread.pid, thread.tid) != thread.started:
            continue  # its id belongs to another thread by now
        if before.scheduling_class.policy == SCHED_DEADLINE:
            raise OperationError(
                f"thread {thread.tid} ({thread.comm}) of process {thread.pid} runs under "
                "SCHED_DEADLINE, whose reservation is left alone: take it out of the plan, or give "
                f"it another class first (`chrt --other --pid 0 {thread.tid}`)"
            )
        earlier = known.get(thread.identity)
        if earlier is None:
            # What it has from a thread of ours is not what it shall have afterwards.
            family = families.get(thread.pid, [])
            before = _without_inheritance(before, thread.started, family)
        elif before == target and target in earlier.given:
            continue
        noted.append((thread, target))
        entries.append(_as_entry(thread, before, target))
    if entries:
        journal.note_all(KIND, entries)
    return tuple(noted)


def note_descendants(journal: Journal) -> None:
    """Write down processes that the journal's have started meanwhile, as long as that shows.

    Raises OperationError: the journal cannot be written.
    """
    remembered = remembered_threads(journal)
    known = {one.pid for one in remembered} | {
        pid for pid, _ in journal.read(DESCENDANTS, process_of)
    }
    new = [pid for pid in _families(journal, remembered) if pid not in known]
    started = ((pid, start_of(pid, pid)) for pid in new)
    entries = [{"pid": pid, "started": when} for pid, when in started if when is not None]
    if entries:
        journal.note_all(DESCENDANTS, entries)


def restore_scheduling(journal: Journal) -> tuple[Outcome, ...]:
    """Put back the class and cores of every thread in the journal, and of what inherited them.

    Works from any process, and as often as one likes. The latest changes are undone first, and
    inheritance last: until its parent is restored, a new thread inherits.
    """
    if journal.outdated:
        return ()
    restored = tuple(_restore(one) for one in reversed(remembered_threads(journal)))
    return restored + restore_inherited(journal)


def release_threads(journal: Journal) -> None:
    """:func:`restore_scheduling`, where all has to be put back.

    Raises OperationError: the kernel refuses for some threads; the others are as before.
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

    To be repeated while an application runs; threads in the journal are not touched.
    """
    if journal.outdated:
        return ()
    remembered = remembered_threads(journal)
    done = {one.identity for one in remembered}
    outcomes: list[Outcome] = []
    for _ in range(_GENERATIONS if remembered else 0):
        found = [
            outcome
            for thread, family in _born_of(journal, remembered)
            if thread.identity not in done
            if (outcome := _disinherit(thread, family)) is not None
        ]
        outcomes += found
        # What starts threads all the time may have started one before it was reached itself.
        if not any(one.fate == "restored" for one in found):
            break
    return tuple(outcomes)


def look_alikes(journal: Journal) -> tuple[str, ...]:
    """Threads with a real-time class and cores as we gave them, not known as ours, in words.

    They are strangers, or daemons that left their family before a look. Ask before the undoing.
    """
    remembered = [] if journal.outdated else remembered_threads(journal)
    known = {one.identity for one in remembered}
    known |= {thread.identity for thread, _ in _born_of(journal, remembered)}
    found = []
    for pid in parents() if remembered else ():
        for thread in list_threads(pid):
            if thread.priority == 0 or thread.identity in known:
                continue  # cores alone are no likeness
            try:
                now = state_of(thread.tid)
            except ProcessLookupError:
                continue
            if any(now in one.given and thread.started >= one.changed_at for one in remembered):
                found.append(
                    f"thread {thread.tid} ({thread.comm}) is left as it is: {state_text(now)}, as "
                    "the application had it, but nothing shows that it is the application's; if "
                    f"it is, `chrt --other --pid 0 {thread.tid}`"
                )
    return tuple(found)


def _born_of(journal: Journal, remembered: list[Change]) -> list[tuple[Thread, list[Change]]]:
    """Threads that are the application's, each with those from whom it may have inherited."""
    found = [
        (thread, family)
        for pid, family in _families(journal, remembered).items()
        for thread in list_threads(pid)
    ]
    for folder in groups_of(run_of(journal)):
        members = (find_thread(tid) for tid in threads_in(folder))
        found += [(thread, remembered) for thread in members if thread is not None]
    return found


def _families(journal: Journal, remembered: list[Change]) -> dict[int, list[Change]]:
    """Processes that are the application's, each with the changes that it may have inherited."""
    families = _by_process(remembered)
    # A process that had begun when its thread was changed is still the same.
    families = {
        pid: family
        for pid, family in families.items()
        if (begun := start_of(pid, pid)) is not None
        and begun <= min(one.changed_at for one in family)
    }
    for pid, started in journal.read(DESCENDANTS, process_of):
        if start_of(pid, pid) == started:
            families.setdefault(pid, remembered)
    parent_of = parents() if families else {}
    for ancestor, family in list(families.items()):
        for pid in descendants(parent_of, ancestor):
            families.setdefault(pid, family)
    return families


def _by_process(changes: Iterable[Change]) -> dict[int, list[Change]]:
    families: dict[int, list[Change]] = {}
    for one in changes:
        families.setdefault(one.pid, []).append(one)
    return families


def _restore(one: Change) -> Outcome:
    if start_of(one.pid, one.tid) != one.started:
        return Outcome(one.tid, one.comm, "ended")
    try:
        now = state_of(one.tid)
        different = different_aspects(now, one.original)
        ours = [a for a in different if _has_been_given(now, one, a)]
        set_state(one.tid, one.original, ours)
    except ProcessLookupError:
        return Outcome(one.tid, one.comm, "ended")
    except OSError as error:
        reason = f"the kernel refuses {state_text(one.original)}: {error.strerror}"
        return Outcome(one.tid, one.comm, "failed", reason)
    if ours != different:
        reason = f"another program has changed it since: {state_text(state_of(one.tid))}"
        return Outcome(one.tid, one.comm, "left", reason)
    return Outcome(one.tid, one.comm, "restored" if ours else "unchanged")


def _disinherit(thread: Thread, family: list[Change]) -> Outcome | None:
    """Put back what a thread inherited from one of the family; None when that is nothing."""
    try:
        now = state_of(thread.tid)
        target = _without_inheritance(now, thread.started, family)
        if target == now:
            return None
        set_state(thread.tid, target, different_aspects(now, target))
    except ProcessLookupError:
        return None
    except OSError as error:
        reason = f"inherited; the kernel refuses what its parent had: {error.strerror}"
        return Outcome(thread.tid, thread.comm, "failed", reason)
    return Outcome(thread.tid, thread.comm, "restored", "it had inherited what we had set")


def _without_inheritance(
    state: SchedulingState, started: int, family: list[Change]
) -> SchedulingState:
    """A thread's scheduling with every aspect that is one of ours replaced by its parent's.

    The kernel records no parent of a thread: the first in the journal with that aspect is
    taken. Threads that share a class with us there mostly shared one before.
    """
    for aspect in ASPECTS:
        for one in family:
            if (
                started >= one.changed_at
                and aspect in different_aspects(state, one.original)
                and _has_been_given(state, one, aspect)
            ):
                state = with_aspect(state, aspect, one.original)
                break
    return state


def _has_been_given(state: SchedulingState, one: Change, aspect: Aspect) -> bool:
    return any(getattr(state, aspect) == getattr(given, aspect) for given in one.given)


def read_change(entry: Mapping[str, Any]) -> Change:
    before, given = (state_from_json(entry[name]) for name in ("before", "given"))
    tid, started, pid, at = (int(entry[name]) for name in ("tid", "started", "pid", "at"))
    return Change(tid, started, pid, str(entry["comm"]), at, before, (given,))


def _as_entry(thread: Thread, before: SchedulingState, target: SchedulingState) -> dict[str, Any]:
    return {
        "tid": thread.tid,
        "started": thread.started,
        "pid": thread.pid,
        "comm": thread.comm,
        "at": clock_gettime_ns(CLOCK_BOOTTIME) // TICK_NS,
        "before": asdict(before),
        "given": asdict(target),
    }


def remembered_threads(journal: Journal) -> list[Change]:
    """The threads of a journal, each with its changes joined, in order of their first change.

    Where another program changed an aspect between two changes of ours, theirs is the original.
    """
    threads: dict[tuple[int, int], Change] = {}
    for change in journal.read(KIND, read_change):
        earlier = threads.get(change.identity)
        if earlier is None:
            threads[change.identity] = change
            continue
        original = earlier.original
        for aspect in ASPECTS:
            known = (original, *earlier.given)
            if all(aspect in different_aspects(change.original, one) for one in known):
                original = with_aspect(original, aspect, change.original)
        given = (*earlier.given, *change.given)
        threads[change.identity] = replace(earlier, original=original, given=given)
    return list(threads.values())
