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
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from io import FileIO
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chainshaper.enforcement.node_threads import Allocation
from chainshaper.flow.background import Background
from chainshaper.linux.scheduling import become_fifo, set_state, state_of
from chainshaper.linux.threads import has_ended, start_of
from chainshaper.planning.chain_plan import ShapingNode
from chainshaper.splicing.shaped_outputs import ask_phase
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import ChainshaperError, OperationError

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
    """Where in a cycle a thread begins."""

    at_ns: int  # after multiples of the cycle, on CLOCK_MONOTONIC
    spread_ns: int  # how far apart most of the wake-ups at this place lie


def measure_phase(
    pid: int,
    tids: Sequence[int],
    cycle_ns: int,
    cycles: int = 12,
    progress: Callable[[float], None] = lambda _: None,
) -> Phase:
    """Measure where in a cycle an executor begins.

    Raises OperationError: it ended, or does not wake up regularly.
    """
    for _ in range(MOST_TRIES):
        wake_ups = watch_wake_ups(pid, tids, cycles * cycle_ns, progress)
        if (phase := find_phase(wake_ups, cycle_ns, cycles)) is not None:
            return phase
    named = f"thread {', '.join(map(str, tids))} of process {pid}"
    raise OperationError(f"{named} {_irregular(wake_ups, cycle_ns, cycles)}")


def _irregular(wake_ups: npt.NDArray[np.int64], cycle_ns: int, cycles: int) -> str:
    """Say why these wake-ups are no beginning of cycles, and what to do."""
    length, width = duration_text(cycle_ns), duration_text(_width(cycle_ns))
    if not wake_ups.size:
        reason = f"does not wake up: not once in {cycles} cycles of {length}. Start the chain"
    else:
        seen = max(seen for _, seen, _ in _places(wake_ups, cycle_ns))
        reason = (
            f"does not wake up at one place of the cycle {length}: {len(wake_ups)} wake-ups in"
            f" {cycles} cycles, of which {seen} at most have one within the same {width}, and"
            f" {math.ceil(SEEN_IN * cycles)} have to. Plan with the period that the chain has;"
            " on a busy machine, whose cores serve others first, try again when it is calm"
        )
    return f"{reason}; or give its --phase"


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
    """Watch when threads of a process become ready to run (ns of CLOCK_MONOTONIC, in order).

    That is half way between two looks, minus the time that the thread waited for its core. Wake-ups
    after which a thread ran for less than ``least_ns`` are left out. ``rest_ns`` says at any time
    for how long not to look, else it is done every ``poll_ns``. Raises OperationError: a thread has
    ended.
    """
    # When each woke up (0: a rest begins, or the end), and how long it had run by then.
    wake_ups: list[list[tuple[int, int]]] = [[] for _ in tids]
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
                for of_thread, (_, waited, times), (ran, waited_by_now, times_by_now) in zip(
                    wake_ups, before, seen, strict=True
                ):
                    if rest > 0:
                        of_thread.append((0, ran))
                    elif times_by_now > times:
                        of_thread.append(((looked + now) // 2 - (waited_by_now - waited), ran))
                progress(min(1.0, (now - started) / for_ns))
        for tid, began in zip(tids, born, strict=True):
            if began is None or has_ended(tid, began):
                raise ProcessLookupError(tid)  # a zombie
    except (OSError, ValueError) as error:
        raise OperationError(
            f"process {pid}, or its thread {', '.join(map(str, tids))}, ended while its phase was"
            " measured: start the application again"
        ) from error
    when = [
        _long_enough(of_thread, ran, least_ns)
        for of_thread, (ran, _, _) in zip(wake_ups, seen, strict=True)
    ]
    return np.sort(np.concatenate(when))


def _counters(file: FileIO) -> tuple[int, int, int]:
    """Return how long a thread ran, and waited for a core (ns), and how often it was put on one."""
    file.seek(0)
    ran, waited, times = map(int, file.read().split())
    return ran, waited, times


def _long_enough(
    wake_ups: Sequence[tuple[int, int]], ran_in_all: int, least_ns: int
) -> npt.NDArray[np.int64]:
    """Return the wake-ups of a thread after which it ran for at least so long."""
    when, ran_by_then = np.array([*wake_ups, (0, ran_in_all)], dtype=np.int64).T
    worked = np.diff(ran_by_then) >= least_ns
    return np.asarray(when[:-1][worked & (when[:-1] > 0)], dtype=np.int64)


def find_phase(wake_ups: npt.NDArray[np.int64], cycle_ns: int, cycles: int) -> Phase | None:
    """Return the place in the cycle where wake-ups come regularly after the longest rest.

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
    """Return how far apart wake-ups of one place may lie (ns)."""
    return max(1, cycle_ns // 50)


def _places(
    wake_ups: npt.NDArray[np.int64], cycle_ns: int
) -> Iterator[tuple[int, int, npt.NDArray[np.int64]]]:
    """Yield each place of the cycle that begins with a wake-up.

    Of each: how long nothing woke up before it (ns), in how many cycles something did there, and
    where in the cycle.
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
    """Return how far behind ``expected_ns`` a thread begins its cycles (ns); None: it does not.

    Only wake-ups in ``slots`` count, which count from ``expected_ns``, if there are any: a thread
    that is stopped as a slot ends wakes up too.

        >>> find_drift(np.array([1003, 1070, 1103, 1170, 1203, 1270]), 100, 3, 1000, [(0, 70)])
        3
    """
    if slots:
        places = (wake_ups - expected_ns) % cycle_ns
        wake_ups = wake_ups[
            np.any([(start <= places) & (places < end) for start, end in slots], axis=0)
        ]
    phase, half = find_phase(wake_ups, cycle_ns, cycles), cycle_ns // 2
    return None if phase is None else (phase.at_ns - expected_ns + half) % cycle_ns - half


class DriftWatch:
    """Looks every ten seconds, in a thread of its own, where an executor begins its cycles now.

    Looking takes a fifth of a core: it is done on ``cores`` or, where there are none, less often,
    and only near where the cycle began last, unless it is not seen there. It ends with one of the
    threads, or with a failure.

    * ``latest_ns``: how far the beginning is from where it is expected (None: not seen yet).
    * ``looks``: how many looks have seen the thread.
    * ``look_soon``: set it, and the next look comes after a second.
    * ``slots_wait``: set it, and the next look comes at once and is short: slots open early for it.
    """

    EVERY_S, SOON_S, AT_ONCE_S = 10.0, 1.0, 0.05
    CYCLES, FEW_CYCLES = 8, 4
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
        self.looks, self.look_soon, self.slots_wait = 0, False, False
        self._threads, self._cycle_ns, self._expected_ns = (pid, tids), cycle_ns, expected_ns
        self._slots, self._cores = slots, cores
        self._thread = Background("drift-watch", self._look_again, "looking for it", cores)
        self._thread.start()

    @property
    def failure(self) -> ChainshaperError | None:
        """Why the watch has ended; None: it has not, or one of the threads has."""
        return self._thread.failure

    def expect(self, expected_ns: int) -> None:
        """Expect the thread to begin elsewhere from now on; forget where it began until now."""
        self._expected_ns, self._before_ns = expected_ns, 0
        if self.latest_ns is not None:
            self.latest_ns = 0

    def end(self) -> None:
        """Look no more, once the look that is under way is over."""
        self._thread.end(waits=False)

    @property
    def surely_ns(self) -> int | None:
        """The earlier of the last two beginnings; None: not seen yet.

        A busy machine may delay a thread for a whole look, and hastens none.
        """
        return None if self.latest_ns is None else min(self.latest_ns, self._before_ns)

    def _look_again(self) -> None:
        """Look every ten seconds, or after one if it is asked for, until the end."""
        near_ns: int | None = self._expected_ns
        with suppress(OperationError):  # the thread has ended
            while not self._thread.stop.is_set():
                if not self._rests():
                    return
                was_asked, self.look_soon = self.look_soon, False
                had_to_wait, self.slots_wait = self.slots_wait, False
                expected_ns = self._expected_ns
                cycles = self.FEW_CYCLES if had_to_wait else self.CYCLES
                drift = self._look(near_ns, expected_ns, cycles)
                near_ns = None if drift is None else expected_ns + drift
                if expected_ns != self._expected_ns:  # slots have moved during the look
                    near_ns = self._expected_ns
                    self.look_soon |= was_asked
                    self.slots_wait |= had_to_wait
                elif drift is None:
                    self.look_soon |= had_to_wait
                else:
                    self._before_ns = self.latest_ns or 0
                    self.latest_ns = drift
                    self.looks += 1

    def _rests(self) -> bool:
        """Rest until the next look; return whether there is to be one."""
        until, asked = time.monotonic() + self.EVERY_S, False
        while time.monotonic() < until and not asked and not self.slots_wait:
            soon = time.monotonic() + self.SOON_S
            while time.monotonic() < soon and not self.slots_wait:
                if self._thread.stop.wait(self.AT_ONCE_S):
                    return False
            asked = self.look_soon
        return not self._thread.stop.is_set()

    def _look(self, near_ns: int | None, expected_ns: int, cycles: int) -> int | None:
        """Return how far the thread begins from ``expected_ns``; None: it was not seen.

        Look near ``near_ns`` only; None: look all the time.
        """
        cycle_ns, near = self._cycle_ns, round(self.NEAR * self._cycle_ns)

        def until_near(now_ns: int) -> int:
            """How long it is until the place near which to look (ns)."""
            place = (now_ns - (near_ns or 0) + near) % cycle_ns
            return 0 if near_ns is None or place < 2 * near else cycle_ns - place

        least_ns = TO_STOP_NS if self._slots else 0
        pid, tids = self._threads
        seen = watch_wake_ups(
            pid,
            tids,
            cycles * cycle_ns,
            least_ns=least_ns,
            rest_ns=until_near,
            poll_ns=POLL_NS if self._cores else SPARING_POLL_NS,
        )
        return find_drift(seen, cycle_ns, cycles, expected_ns, self._slots)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Give the calling thread, which sleeps nearly always, a high priority if that is permitted."""
    before = state_of(0)
    become_fifo(WATCHER_PRIORITY)
    try:
        yield
    finally:
        set_state(0, before)


@dataclass(frozen=True)
class Telling:
    """A process that gives nodes in ROS 2 the phase."""

    nodes: tuple[str, ...]
    script: "Script | None"  # the process that gives it to them
    begun: float  # when (s of CLOCK_MONOTONIC)
    refused: str | None = None  # why no process could be started

    def is_over(self) -> bool:
        """Return whether the nodes know it by now, or never will."""
        late = time.monotonic() - self.begun > _PATIENCE_S
        return self.script is None or self.script.is_over() or late

    def end(self) -> tuple[str, ...]:
        """End the process, if it still runs; return what went wrong, in sentences."""
        problem = self.refused
        if self.script is not None:
            late = not self.script.is_over()
            _, problem = self.script.end()
            problem = f"ROS 2 did not answer within {_PATIENCE_S} s" if late else problem
        if problem is None:
            return ()
        return (
            f"{', '.join(self.nodes)} did not get where cycles begin ({problem}): outputs without a"
            " stamp of their chain's beginning will not be in time",
        )


NO_NODE = Telling((), None, 0.0)  # none is to get a phase


def _is_asked(node: ShapingNode, pid: int, phase_ns: int) -> bool:
    """Ask for a phase on the page of a gate; return whether there is one.

    Raises OperationError: there is none of a gate in its publisher's process.
    """
    try:
        ask_phase(node.output, {pid}, phase_ns)
    except OperationError:
        if node.in_process:
            raise
        return False
    return True


def tell_phase(nodes: Collection[ShapingNode], allocation: Allocation, phase_ns: int) -> Telling:
    """Give shaping nodes in ROS 2 where their chain begins in every cycle, or begin to.

    It is asked for on the page of a gate that publishes. Only a shaping node whose page is not
    known gets it as a parameter: another process has to join the robot's graph for that, and with
    Fast DDS each publication of the robot may wait for a third of a second then, since whoever
    opens a shared memory port looks at its health (upstream: Fast DDS, `SharedMemGlobal.hpp`,
    `healthy_check`).
    """
    names = [node.thread.node for node in nodes]
    pids = {
        name: listed.thread.pid
        for name in names
        for listed in allocation.threads
        if name in listed.nodes
    }
    if not pids:
        return NO_NODE
    # This reads recordings as well, which is slow to import.
    from chainshaper.sources import ros

    running, environments = tuple(pids), dict[str, ros.Environment]()
    try:
        for node in nodes:
            if node.thread.node in pids and _is_asked(node, pids[node.thread.node], phase_ns):
                pids.pop(node.thread.node)
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
        in_ros = tuple(environments)
        arguments = ("parameter", "phase_ns", str(phase_ns), *in_ros)
        script = ros.start_with_rclpy(environments[in_ros[0]], ros.script.__file__, *arguments)
    except OperationError as error:
        return Telling(running, None, 0.0, str(error))
    return Telling(in_ros, script, time.monotonic())
