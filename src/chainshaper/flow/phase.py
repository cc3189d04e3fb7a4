"""Where in a cycle a chain begins: measured from outside, watched, and given to shaping nodes.

The slot of a chain's server has to open just after its timer (DESIGN section 6). That wakes the
executor of the chain's first node, which the kernel counts in `/proc/PID/task/TID/schedstat`. The
wake-ups that come once in every cycle at the same place are the timer's; of several such places the
one after the longest rest is the beginning. Of an executor with several threads any may begin.

Outputs without a stamp are released by the cycle, whose beginning no message carries: shaping nodes
in ROS 2 get it as a parameter, by a process of its own, as the user and in the environment of one
of them; as whom we may not run, in ours.
"""

import math
import os
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from io import FileIO
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chainshaper.enforcement.node_threads import Allocation
from chainshaper.linux.scheduling import become_fifo, set_state, state_of
from chainshaper.linux.threads import has_ended, start_of
from chainshaper.planning.chain_plan import ShapingNode
from chainshaper.splicing.shaped_outputs import ask_phase
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import OperationError

if TYPE_CHECKING:
    from chainshaper.sources.ros import Script


POLL_NS = 100_000
SPARING_POLL_NS = 250_000  # on a core that the chain needs, whose work a look would delay
WATCHER_PRIORITY = 95
TO_STOP_NS = 20_000  # stopping and continuing a thread takes 5 to 7 us of its time, a timer tens
SEEN_IN = 0.8  # a place counts when wake-ups come there in this share of the cycles
MOST_TRIES = 5
_HAS_ROS = "AMENT_PREFIX_PATH"  # in a process's environment
_PATIENCE_S = 20  # ROS 2 has found the nodes by then, however busy the machine is, or never will


@dataclass(frozen=True)
class Phase:
    """Where in a cycle a thread begins: ``at_ns`` after multiples of it, on CLOCK_MONOTONIC."""

    at_ns: int
    spread_ns: int  # how far apart most of the wake-ups at this place lie


def measure_phase(
    pid: int,
    tids: Sequence[int],
    cycle_ns: int,
    cycles: int = 12,
    progress: Callable[[float], None] = lambda _: None,
) -> Phase:
    """The phase of an executor. Raises OperationError: it ended, or does not wake up regularly."""
    for _ in range(MOST_TRIES):
        wake_ups = watch_wake_ups(pid, tids, cycles * cycle_ns, progress)
        if (phase := find_phase(wake_ups, cycle_ns, cycles)) is not None:
            return phase
    named = f"thread {', '.join(map(str, tids))} of process {pid}"
    raise OperationError(f"{named} {_irregular(wake_ups, cycle_ns, cycles)}")


def _irregular(wake_ups: npt.NDArray[np.int64], cycle_ns: int, cycles: int) -> str:
    """Why these wake-ups are no beginning of cycles, and what to do: how many there were says
    nothing of where they lie.
    """
    length, width = duration_text(cycle_ns), duration_text(_width(cycle_ns))
    if not wake_ups.size:
        said = f"does not wake up: not once in {cycles} cycles of {length}. Start the chain"
    else:
        seen = max(seen for _, seen, _ in _places(wake_ups, cycle_ns))
        said = f"does not wake up at one place of the cycle {length}: {len(wake_ups)} wake-ups in"
        said += f" {cycles} cycles, of which {seen} at most have one within the same {width}, and"
        said += f" {math.ceil(SEEN_IN * cycles)} have to. Plan with the period that the chain has;"
        said += " on a busy machine, whose cores serve others first, try again when it is calm"
    return f"{said}; or give its --phase"


def watch_wake_ups(
    pid: int,
    tids: Sequence[int],
    for_ns: int,
    progress: Callable[[float], None] = lambda _: None,
    *,
    least_ns: int = 0,
    rest_ns: Callable[[int], int] = lambda _: 0,
    poll_ns: int = POLL_NS,
) -> npt.NDArray[np.int64]:
    """When threads of a process became ready to run (ns of CLOCK_MONOTONIC, in order): half way
    between two looks, minus the time that one waited for its core. Raises OperationError: one has
    ended.

    Wake-ups after which a thread ran for less than ``least_ns`` are left out. ``rest_ns`` says at
    any time for how long not to look, else it is done every ``poll_ns``.
    """
    # When each woke up (0: a rest begins, or the end), and how long it had run by then.
    found: list[list[tuple[int, int]]] = [[] for _ in tids]
    started = now = time.monotonic_ns()
    born = [start_of(pid, tid) for tid in tids]
    try:
        with _undisturbed(), ExitStack() as until:
            paths = (f"/proc/{pid}/task/{tid}/schedstat" for tid in tids)
            files = [until.enter_context(FileIO(path)) for path in paths]
            seen = [_counters(file) for file in files]
            while now < started + for_ns:
                rest = rest_ns(now)
                time.sleep(max(rest, poll_ns) / 1e9)
                before, seen = seen, [_counters(file) for file in files]
                looked, now = now, time.monotonic_ns()
                for own, (_, waited, times), (ran, waited_by_now, times_by_now) in zip(
                    found, before, seen, strict=True
                ):
                    if rest > 0:
                        own.append((0, ran))
                    elif times_by_now > times:
                        own.append(((looked + now) // 2 - (waited_by_now - waited), ran))
                progress(min(1.0, (now - started) / for_ns))
        for tid, began in zip(tids, born, strict=True):
            if began is None or has_ended(tid, began):
                raise ProcessLookupError(tid)  # a zombie
    except (OSError, ValueError) as error:
        raise OperationError(
            f"process {pid}, or its thread {', '.join(map(str, tids))}, ended while its phase was"
            " measured: start the application again"
        ) from error
    when = [_after_rests(own, ran, least_ns) for own, (ran, _, _) in zip(found, seen, strict=True)]
    return np.sort(np.concatenate(when))


def _counters(file: FileIO) -> tuple[int, int, int]:
    """How long a thread ran, how long it waited for a core (ns), how often it was put on one."""
    file.seek(0)
    ran, waited, times = map(int, file.read().split())
    return ran, waited, times


def _after_rests(
    found: Sequence[tuple[int, int]], ran_in_all: int, least_ns: int
) -> npt.NDArray[np.int64]:
    """The wake-ups of one thread after which it ran for so long."""
    when, ran_by_then = np.array([*found, (0, ran_in_all)], dtype=np.int64).T
    worked = np.diff(ran_by_then) >= least_ns
    return np.asarray(when[:-1][worked & (when[:-1] > 0)], dtype=np.int64)


def find_phase(wake_ups: npt.NDArray[np.int64], cycle_ns: int, cycles: int) -> Phase | None:
    """The place in the cycle where wake-ups come regularly after the longest rest.

        >>> find_phase(np.array([1020, 1030, 1090, 1120, 1131, 1220, 1229, 1320]), 100, 4).at_ns
        20

    None when there is no place that has some in four of five cycles.
    """
    best, longest_rest = None, -1
    for rest, seen, here in _places(wake_ups, cycle_ns):
        if seen >= SEEN_IN * cycles and rest > longest_rest:
            longest_rest = rest
            # The first of each cycle: what follows it is the same thread going on.
            low, at, high = np.percentile(here[: max(1, seen)], (10, 50, 90))
            best = Phase(int(at) % cycle_ns, int(high - low))
    return best


def _width(cycle_ns: int) -> int:
    """How far apart wake-ups of one place may lie."""
    return max(1, cycle_ns // 50)


def _places(
    wake_ups: npt.NDArray[np.int64], cycle_ns: int
) -> Iterator[tuple[int, int, npt.NDArray[np.int64]]]:
    """Each place of the cycle that begins with a wake-up: how long nothing woke up before it, in
    how many cycles something did there, and where in the cycle.
    """
    width, places = _width(cycle_ns), np.sort(wake_ups % cycle_ns)
    # A circle has no first place: the first two turns of it have every neighbour.
    turned = np.concatenate([places, places + cycle_ns])
    for number, place in enumerate(places):
        here = turned[number : int(np.searchsorted(turned, place + width, side="right"))]
        inside = (wake_ups - place) % cycle_ns <= width
        seen = len(np.unique((wake_ups[inside] - place) // cycle_ns))
        before = turned[number - 1 + len(places)] - cycle_ns
        rest = int(place - before) if len(places) > 1 else cycle_ns
        yield rest, seen, here


def find_drift(
    wake_ups: npt.NDArray[np.int64],
    cycle_ns: int,
    cycles: int,
    expected_ns: int,
    slots: Sequence[tuple[int, int]] = (),
) -> int | None:
    """How far behind ``expected_ns`` a thread begins its cycles (ns), if it does: in ``slots``,
    which count from there, if there are any, since being stopped as one ends wakes a thread too.

        >>> find_drift(np.array([1003, 1070, 1103, 1170, 1203, 1270]), 100, 3, 1000, [(0, 70)])
        3
    """
    if slots:
        places = (wake_ups - expected_ns) % cycle_ns
        wake_ups = wake_ups[np.any([(s <= places) & (places < e) for s, e in slots], axis=0)]
    phase, half = find_phase(wake_ups, cycle_ns, cycles), cycle_ns // 2
    return None if phase is None else (phase.at_ns - expected_ns + half) % cycle_ns - half


class DriftWatch:
    """Looks every ten seconds, in a thread of its own, where an executor begins its cycles now.

    ``latest_ns`` is how far that is from where it is expected (None: not seen yet), by look number
    ``looks``; the next one comes earlier where it is to ``look_soon``. A busy machine may delay a
    thread for a whole look, and hastens none: ``surely_ns`` is the earlier of the last two. Looking
    takes a fifth of a core: it is done on ``cores`` or, where there are none, less often, and only
    near where the cycle began last, unless it is not seen there. It ends with one of the threads,
    or with a ``failure``: why, as half a sentence.
    """

    EVERY_S, SOON_S = 10.0, 1.0
    CYCLES = 8
    NEAR = 0.04  # so much of the cycle before and after

    def __init__(
        self,
        pid: int,
        tids: Sequence[int],
        cycle_ns: int,
        expected_ns: int,
        slots: Sequence[tuple[int, int]] = (),
        *,
        cores: Collection[int] = (),
    ) -> None:
        self.latest_ns: int | None = None
        self._before_ns = 0  # what the look before saw
        self.looks, self.look_soon = 0, False
        self.failure: str | None = None
        self._threads, self._cycle_ns, self._expected_ns = (pid, tids), cycle_ns, expected_ns
        self._slots, self._cores, self._stop = slots, cores, threading.Event()
        threading.Thread(target=self._look_until_over, name="drift-watch", daemon=True).start()

    def expect(self, expected_ns: int) -> None:
        """The thread is to begin elsewhere from now on; what is seen of it till then is void."""
        self._expected_ns, self._before_ns = expected_ns, 0
        if self.latest_ns is not None:
            self.latest_ns = 0

    def end(self) -> None:
        """Look no more, when a look that is under way is over."""
        self._stop.set()

    @property
    def surely_ns(self) -> int | None:
        return None if self.latest_ns is None else min(self.latest_ns, self._before_ns)

    def _look_until_over(self) -> None:
        try:
            self._look_again()
        except Exception as error:  # a thread that ends in silence sees no drift
            self.failure = f"looking for it has failed ({type(error).__name__}: {error})"

    def _look_again(self) -> None:
        if self._cores:
            os.sched_setaffinity(0, self._cores)  # the calling thread's alone
        near_ns: int | None = self._expected_ns
        with suppress(OperationError):  # the thread has ended
            while not self._stop.is_set():
                until = time.monotonic() + self.EVERY_S
                while time.monotonic() < until and not self.look_soon:
                    if self._stop.wait(self.SOON_S):
                        return
                self.look_soon = False
                expected_ns = self._expected_ns
                drift = self._look(near_ns, expected_ns)
                near_ns = None if drift is None else expected_ns + drift
                if expected_ns != self._expected_ns:
                    near_ns = self._expected_ns
                elif drift is not None:
                    self._before_ns = self.latest_ns or 0
                    self.latest_ns = drift
                    self.looks += 1

    def _look(self, near_ns: int | None, expected_ns: int) -> int | None:
        """The drift, if the thread was seen; near where it was expected, None: anywhere."""
        cycle_ns, near = self._cycle_ns, round(self.NEAR * self._cycle_ns)

        def until_near(now_ns: int) -> int:
            place = (now_ns - (near_ns or 0) + near) % cycle_ns
            return 0 if near_ns is None or place < 2 * near else cycle_ns - place

        least_ns, cycles = TO_STOP_NS if self._slots else 0, self.CYCLES
        seen = watch_wake_ups(
            *(*self._threads, cycles * cycle_ns),
            least_ns=least_ns,
            rest_ns=until_near,
            poll_ns=POLL_NS if self._cores else SPARING_POLL_NS,
        )
        return find_drift(seen, cycle_ns, cycles, expected_ns, self._slots)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """The calling thread, which sleeps nearly always, at a high priority if that is permitted."""
    before = state_of(0)
    become_fifo(WATCHER_PRIORITY)
    try:
        yield
    finally:
        set_state(0, before)


@dataclass(frozen=True)
class Telling:
    """Nodes get the phase by a ``script``, if it was not ``refused``, since ``begun`` (s)."""

    nodes: tuple[str, ...]
    script: "Script | None"
    begun: float
    refused: str | None = None

    def is_over(self) -> bool:
        """Look whether the nodes know, or never will."""
        late = time.monotonic() - self.begun > _PATIENCE_S
        return self.script is None or self.script.is_over() or late

    def end(self) -> tuple[str, ...]:
        """What went wrong, in words: to be called when it is over, or no longer waited for."""
        problem = self.refused
        if self.script is not None:
            late = not self.script.is_over()
            _, problem = self.script.end()
            problem = f"ROS 2 did not answer within {_PATIENCE_S} s" if late else problem
        if problem is None:
            return ()
        named = f"{', '.join(self.nodes)} did not get where cycles begin ({problem})"
        why = "outputs without a stamp of their chain's beginning will not be in time"
        return (f"{named}: {why}",)


NO_NODE = Telling((), None, 0.0)  # none is to get a phase


def tell_phase(nodes: Collection[ShapingNode], found: Allocation, phase_ns: int) -> Telling:
    """Begin to give shaping nodes in ROS 2 where their chain begins in every cycle."""
    names = [node.thread.node for node in nodes]
    pids = {node: one.thread.pid for node in names for one in found.threads if node in one.nodes}
    if not pids:
        return NO_NODE
    # Who reads what ROS 2 shows reads recordings as well, which is slow to import.
    from chainshaper.sources import ros

    asked, environments = tuple(pids), dict[str, ros.Environment]()
    try:
        for node in nodes:
            if node.in_process and node.thread.node in pids:
                ask_phase(node.output, {pids.pop(node.thread.node)}, phase_ns)
        for name, pid in pids.items():
            try:
                environment = ros.environment_of(pid)
            except OperationError:  # nothing of the node's may be run
                environment = ros.own_environment()
                if _HAS_ROS not in environment.variables:
                    raise
            if _HAS_ROS in environment.variables:  # else it is the live workload's
                environments[name] = environment
        if not environments:
            return NO_NODE
        ours = tuple(environments)
        arguments = ("parameter", "phase_ns", str(phase_ns), *ours)
        script = ros.start_with_rclpy(environments[ours[0]], ros.script.__file__, *arguments)
    except OperationError as error:
        return Telling(asked, None, 0.0, str(error))
    return Telling(ours, script, time.monotonic())
