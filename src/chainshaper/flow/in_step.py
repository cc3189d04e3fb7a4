"""A chain's output and the loop that uses it, kept in step while they run.

A loop samples a shaped output at a phase of its own, which is another one at each start, and drifts
where its clock is not the chain's. So both are followed, and one of them is moved:

* the **output**: its slots are moved later within the cycle, so that it leaves a given time, the
  lead, before the loop starts next. The loop is not touched. Where the clocks drift apart, what the
  loop reads gets older, or newer, with the drift, until the output is moved by a whole step.
* the **loop**: its sleeps are moved (:mod:`chainshaper.sources.preload.moving`), so that it starts
  the lead behind the output, which stays in its slots. The age of what it reads is constant, also
  where the clocks drift.

Both repeat in time; what they have in common is the greatest common divisor of their periods, the
**step**: at this distance the chain's output may be placed in the same relation to a start of the
loop. Moves are of less than a step, and later ones small, as the drift has it.
"""

import time
from bisect import bisect_left
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from chainshaper.enforcement.undoing import LoopState, LoopStep
from chainshaper.flow.background import Background
from chainshaper.flow.loop_phase import LoopPhase, PhaseTrack, phase_of
from chainshaper.linux.threads import list_threads
from chainshaper.planning.chain_plan import (
    ChainPlan,
    PlannedLoop,
    loop_common_ns,
    publish_slots,
    revised,
)
from chainshaper.planning.offsets import chain_name
from chainshaper.planning.plan import Plan
from chainshaper.splicing.shaped_outputs import FollowedOutput
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import ChainshaperError, InputError, OperationError, PlatformError

if TYPE_CHECKING:  # it loads tables, which robots without loops in step need not have
    from chainshaper.sources.preload.moving import LoopMoved, LoopMover

TOLERANCE_NS = 30_000  # nothing is moved for less
LOOK_S = 0.1
STEPS = 50  # so many of the latest moves are shown
_ORIGINS_NS = 20_000_000_000  # of the chain's origins, none is older
_RESERVE = 0.05  # of a loop's period: so much more time than for its work is left to it
_MINUTE_NS = 60_000_000_000
_SEARCH_EVERY = 10  # looks from one search for the loop to the next


class LoopStarts(Protocol):
    """A loop's thread that is followed, and perhaps moved: as :class:`.LoopMover`."""

    tid: int

    @property
    def turn_ns(self) -> int: ...
    @property
    def is_there(self) -> bool: ...
    def seen(self) -> "tuple[list[int], list[LoopMoved]]": ...
    def move(self, move_ns: int, period_ns: int) -> int: ...
    def renew(self) -> None: ...
    def close(self) -> None: ...


def next_move(
    now_ns: int,
    wanted_ns: int,
    step_ns: int,
    range_ns: tuple[int, int],
    tolerance_ns: int = 0,
    *,
    otherwise_ns: int,
) -> int:
    """Return by how much to move, so that it is a wanted move but for whole steps.

    ``now_ns`` is the move in force, and is returned where it is near enough. ``range_ns`` has the
    smallest and the largest possible. Of those in the range the nearest is chosen; where none is,
    ``otherwise_ns``.

        >>> next_move(0, 13, 10, (0, 9), 1, otherwise_ns=0)
        3
        >>> next_move(9, 10, 10, (0, 9), otherwise_ns=0)
        0
        >>> next_move(5, 26, 10, (0, 9), 2, otherwise_ns=0)
        5
        >>> next_move(5, 17, 10, (0, 6), otherwise_ns=6)
        6
    """
    least, most = range_ns
    off = (wanted_ns - now_ns + step_ns // 2) % step_ns - step_ns // 2
    if abs(off) <= tolerance_ns and least <= now_ns <= most:
        return now_ns
    moved = now_ns + off
    if moved < least:
        moved = least + (moved - least) % step_ns
    elif moved > most:
        moved = most - (most - moved) % step_ns
    return moved if least <= moved <= most else otherwise_ns


@dataclass
class OwnStarts:
    """When a loop would have started by itself: its starts without what it was moved by."""

    moves: "list[LoopMoved]" = field(default_factory=list)  # the latest ones
    moved_ns: int = 0  # by now

    def of(self, starts_ns: Sequence[int], moves: "Sequence[LoopMoved]") -> list[int]:
        """Return starts (ns, in order) without the moves before each of them."""
        left, own = [*moves], list[int]()
        for start in starts_ns:
            while left and left[0].at_ns <= start:
                self.moved_ns += left.pop(0).added_ns
            own.append(start - self.moved_ns)
        self.moved_ns += sum(move.added_ns for move in left)
        self.moves = [*self.moves, *moves][-STEPS:]
        return own


class InStep:
    """Keeps a chain's output and a loop in step, in a thread of its own, until it ends.

    The thread may end by itself, with a ``failure``.

    * ``steps``: what was moved, and why, the latest ones.
    * ``loop_moves``: what was added to the loop's sleeps, all that was seen.
    * ``chain``: one whose plan has a loop in step.
    * ``pids``: processes of which one may be the gate.
    * ``find``: looks for the loop; it returns its starts until now as well, or None.
    * ``put_in_force``: has servers move their slots by so much (ns), and returns from when on the
      gate has to move its own.
    * ``begins_early``: whether the chain begins sooner for the moment, for its timer to be seen.
      Nothing is moved for these few cycles: output and loop would be out of step behind them.
    * ``cores``: where the thread runs; none: anywhere.

    Raises OperationError: see :class:`.FollowedOutput`.
    """

    def __init__(
        self,
        chain: ChainPlan,
        pids: Collection[int],
        find: Callable[[], LoopStarts | None],
        put_in_force: Callable[[int], int],
        *,
        begins_early: Callable[[], bool] = lambda: False,
        cores: Collection[int] = (),
        tolerance_ns: int = TOLERANCE_NS,
    ) -> None:
        loop, shaping = chain.loop, chain.shaping_node
        assert loop is not None and loop.period_ns is not None  # noqa: S101 - as planned
        assert shaping is not None  # noqa: S101 - else there is no slot to move
        self.steps: tuple[LoopStep, ...] = ()
        self.loop_moves: list[LoopMoved] = []
        self.chain, self.loop, self.period_ns = chain, loop, loop.period_ns
        self.step_ns, self._tolerance_ns = loop_common_ns(chain), tolerance_ns
        self._slot_ns = publish_slots(chain)[0][0]
        starts = loop.starts_ns or (self._slot_ns, self._slot_ns)
        self._reach_ns = starts[0] - self._slot_ns, starts[1] - self._slot_ns
        self._find, self._put_in_force, self._begins_early = find, put_in_force, begins_early
        self._output = FollowedOutput(shaping.output, pids)
        self._origins = PhaseTrack(chain.cycle_ns, _ORIGINS_NS)
        self.tid = 0  # of the loop's thread, the latest that was found
        self._mover: LoopStarts | None = None
        self._loops, self._own, self._restarts = PhaseTrack(self.period_ns), OwnStarts(), 0
        self._moved_ns: int | None = None  # of what is moved; None: it was not, since it started
        self._elsewhere = False  # one of the two starts elsewhere since the latest move
        self._follows = False  # the loop's next instant follows from its last sleep
        self._late_ns = 0  # the loop cannot be where it is to be, and starts so much later
        self._unreachable_ns = self.period_ns  # from here on a move changes the loop's rate
        self._looks = 0
        # When a start was seen, and how far it was off. Others read it while it is followed, so
        # that it is replaced, never changed.
        self._off: tuple[tuple[int, int], ...] = ()
        self._settles = False  # something was moved at the latest look
        self._thread = Background("in-step", self._follow, "following", cores)
        self._thread.start()

    @property
    def failure(self) -> ChainshaperError | None:
        """Why both are not kept in step any more; None: they are."""
        return self._thread.failure

    @property
    def has_loop(self) -> bool:
        """Whether the loop is there."""
        return self._mover is not None

    @property
    def is_in_step(self) -> bool:
        """Whether both have been brought into step since the loop was found, and still are."""
        return self._mover is not None and self._moved_ns is not None and not self._late_ns

    @property
    def waits_for(self) -> str:
        """What is not known yet, or is out of reach."""
        if self._late_ns:
            late = duration_text(self._late_ns)
            return f"the loop has too little time left to be moved, and starts {late} later"
        if self._loops.phase is None:
            return "the loop's phase is being measured, or it sleeps irregularly"
        if self._origins.phase is None:
            return "where the chain begins is being measured, or it begins irregularly"
        return "they are about to be"

    @property
    def loop_phase(self) -> LoopPhase | None:
        """Where the loop would be by itself; None: not known yet."""
        return self._loops.phase

    @property
    def age_ns(self) -> int | None:
        """How old (ns, from the chain's origin) what the loop reads is to be; None: not yet known.

        It is that of a reading just behind the lead; where only every so many of the loop's starts
        have new data, that of the first of them.
        """
        loop, origin = self._loops.phase, self._origins.phase
        if loop is None or origin is None or self._moved_ns is None:
            return None
        start = loop.near(origin.at_ns) + (self._moved_ns if self.loop.in_step == "loop" else 0)
        slot = self._slot_ns + (self._moved_ns if self.loop.in_step == "output" else 0)
        return slot + (start - origin.at_ns - slot) % self.step_ns

    @property
    def error_ns(self) -> int | None:
        """How much later (ns) than the lead behind the output the loop starts; None: not yet known.

        Negative: sooner. Of what is possible for the two periods, the smallest counts.
        """
        loop, origin = self._loops.phase, self._origins.phase
        if loop is None or origin is None or self._mover is None:
            return None
        moved_ns = self._moved_ns or 0
        start = loop.near(origin.at_ns) + (moved_ns if self.loop.in_step == "loop" else 0)
        return self._off_ns(start, origin)

    def _off_ns(self, start_ns: int, origin: LoopPhase) -> int:
        """Return how much later than the lead behind the output a start of the loop is."""
        slot = self._slot_ns + (self._moved_ns or 0 if self.loop.in_step == "output" else 0)
        due = origin.near(start_ns - slot - self.loop.lead_ns) + slot + self.loop.lead_ns
        return (start_ns - due + self.step_ns // 2) % self.step_ns - self.step_ns // 2

    @property
    def state(self) -> LoopState:
        """How both are now."""
        loop, origin, off = self._loops.phase, self._origins.phase, self._off
        drift_ppm = None
        if loop is not None and origin is not None:
            drift_ppm = round(loop.drift_ppm - origin.drift_ppm, 1)
        waits_for = self.waits_for if self.has_loop else "no such loop is seen to sleep"
        return LoopState(
            chain=chain_name(self.chain),
            loop=self.loop.node,
            moves=self.loop.in_step or "",
            lead_ns=self.loop.lead_ns,
            is_there=self.has_loop,
            in_step=self.is_in_step,
            waits_for=None if self.is_in_step else waits_for,
            moved_ns=self._moved_ns,
            error_ns=self.error_ns,
            drift_ppm=drift_ppm,
            age_ns=self.age_ns,
            starts=len(off),
            misses=sum(abs(off_ns) > self.loop.lead_ns for _, off_ns in off),
        )

    def end(self) -> None:
        """Have all be where the plan and the loop have it, and follow no more."""
        self._thread.end()
        self._output.close()
        if self._mover is not None:
            self._mover.close()

    def _follow(self) -> None:
        while not self._thread.stop.wait(LOOK_S):
            self.look()

    def look(self) -> None:
        """Look where both are, and move what is to be moved."""
        self._looks += 1
        restarts, origins = self._origins.restarts, self._output.origins(self.chain.cycle_ns)
        waits = self._begins_early()
        self._origins.saw([] if waits else origins)
        if self._origins.restarts > restarts:
            self._elsewhere = True
            self._note(None, "the chain begins elsewhere now: its phase is measured anew")
        self._look_at_loop()
        loop, origin = self._loops.phase, self._origins.phase
        if waits or self._mover is None or loop is None or origin is None:
            return
        if self.loop.in_step == "loop":
            self._move_loop(self._mover, loop, origin)
        else:
            self._move_output(loop, origin)

    def _look_at_loop(self) -> None:
        """Read what the loop has done; look for it where it has ended."""
        if self._mover is not None and not self._mover.is_there:
            self._note(None, "the loop has ended: its phase is measured anew when it runs again")
            self._mover = None
        if self._mover is None:
            if self._looks % _SEARCH_EVERY != 1:
                return
            self._mover = self._find()
            self._loops, self._own = PhaseTrack(self.period_ns), OwnStarts()
            self._moved_ns = self._moved_ns if self.loop.in_step == "output" else None
            self._follows = False
            self._restarts, self._late_ns, self._unreachable_ns = 0, 0, self.period_ns
            if self._mover is None:
                return
            self.tid = self._mover.tid
        starts, moves = self._mover.seen()
        self.loop_moves += moves
        self._judge(starts, any(self._is_far(move.added_ns) for move in moves))
        self._loops.saw(self._own.of(starts, moves))
        if self._loops.restarts > self._restarts:
            self._restarts, self._elsewhere = self._loops.restarts, True
            self._note(None, "the loop starts elsewhere now: its phase is measured anew")
        if self.loop.in_step == "loop":
            self._mover.renew()
        self._follows |= any(move.why == "followed" for move in moves)
        for move in moves:
            if move.why == "rate changed":
                self._unreachable_ns = min(self._unreachable_ns, move.asked_ns)
                self._moved_ns = 0
                self._note(
                    0,
                    f"moved by {duration_text(move.asked_ns)} it left instances out: too little"
                    " time is left for its work, so it is not moved so far any more",
                )

    def _is_far(self, moved_ns: int) -> bool:
        """Return whether starts may miss while a move by so much comes into force."""
        return abs(moved_ns) > self.loop.lead_ns // 4

    def _judge(self, starts: Sequence[int], has_moved: bool) -> None:
        """Note how far starts were from their place, as far as they were to be there."""
        origin, now = self._origins.phase, time.monotonic_ns()
        recent = self._off[bisect_left(self._off, (now - _MINUTE_NS,)) :]
        # Between two looks the output, or the loop, moves from one place to the next.
        settles, self._settles = self._settles or has_moved, False
        if origin is not None and self.is_in_step and not (settles or self._elsewhere):
            recent += tuple((now, self._off_ns(start, origin)) for start in starts)
        self._off = recent

    def _move_loop(self, mover: LoopStarts, loop: LoopPhase, origin: LoopPhase) -> None:
        output = origin.at_ns + self._slot_ns + self.loop.lead_ns
        period_ns = round(loop.period_ns)
        # A loop with instants of its own gets twice what its turns last, and more, for its work.
        reserve_ns = 2 * mover.turn_ns + round(_RESERVE * period_ns)
        if self._follows or not mover.turn_ns:
            reserve_ns = 0
        range_ns = (0, max(0, min(period_ns - reserve_ns, self._unreachable_ns) - 1))
        before = self._moved_ns
        # The loop's place is that of its own starts; a small step follows a drift, a large one not.
        wanted = output - loop.near(output)
        # Where the loop cannot be, it starts by itself: later than wanted, so it finds the output.
        moved = next_move(
            before or 0, wanted, self.step_ns, range_ns, self._tolerance_ns, otherwise_ns=0
        )
        late_ns = (moved - wanted) % self.step_ns
        is_late = self._tolerance_ns < late_ns < self.step_ns - self._tolerance_ns
        self._late_ns = late_ns if is_late else 0
        if moved != before:
            mover.move(moved, period_ns)
            self._has_moved(before, moved, loop, origin)

    def _move_output(self, loop: LoopPhase, origin: LoopPhase) -> None:
        before = self._moved_ns
        wanted = loop.near(origin.at_ns) - self.loop.lead_ns - origin.at_ns - self._slot_ns
        # Before an instance in the next cycle the output leaves at the latest: it waits there.
        moved = next_move(
            before or 0,
            wanted,
            self.step_ns,
            self._reach_ns,
            self._tolerance_ns,
            otherwise_ns=self._reach_ns[1],
        )
        if moved != before:
            self._output.move(moved, self._put_in_force(moved))
            self._has_moved(before, moved, loop, origin)

    def _has_moved(
        self, before: int | None, moved_ns: int, loop: LoopPhase, origin: LoopPhase
    ) -> None:
        """Note a move, and why."""
        if before is None:
            spread = duration_text(round(loop.spread_ns, -3))
            why = f"its phase was measured in {loop.starts} starts, which spread over {spread}"
        elif self._elsewhere:
            why = "it was measured anew"
        elif abs(moved_ns - before) > self.step_ns // 2:
            why = "the drift has moved it to the end of what is possible, so it goes a step further"
        else:
            why = f"the clocks drift apart by {loop.drift_ppm - origin.drift_ppm:+.1f} ppm"
        self._settles = before is None or self._is_far(moved_ns - before)
        self._moved_ns, self._elsewhere = moved_ns, False
        self._note(moved_ns, why)

    def _note(self, moved_ns: int | None, why: str) -> None:
        loop = self._loops.phase
        step = LoopStep(
            at_ns=time.monotonic_ns(),
            chain=chain_name(self.chain),
            loop=self.loop.node,
            moves=self.loop.in_step or "",
            moved_ns=moved_ns,
            drift_ppm=None if loop is None else round(loop.drift_ppm, 1),
            why=why,
        )
        self.steps = (*self.steps, step)[-STEPS:]


def find_loop(pid: int, loop: PlannedLoop, lease_ns: int = 5_000_000_000) -> "LoopMover | None":
    """Return a planned loop of a process, as the library in front sees it; None: it has none.

    It is the thread of the planned name or, where none is planned, that starts at the period. What
    was seen of the loop before is still to be taken with ``seen``.
    """
    from chainshaper.sources.preload.moving import LoopMover

    for thread in list_threads(pid):
        if loop.thread not in (None, thread.comm):
            continue
        try:
            mover = LoopMover(pid, thread.tid, lease_ns)
        except OperationError:
            continue
        starts, _ = mover.seen()
        if phase_of(starts[-200:], loop.period_ns or 0) is not None:
            return LoopMover(pid, thread.tid, lease_ns)
    return None


def with_loops_as_they_are(plan: Plan) -> Plan:
    """Return a plan for an application whose loops are not moved by its description.

    They are moved while they run, from where they start by themselves.
    """
    chains = (
        chain
        if chain.loop is None or not chain.loop.move_ns
        else revised(chain, loop=chain.loop.model_copy(update={"move_ns": 0}))
        for chain in plan.chains
    )
    return Plan.of(*chains)


def loops_in_step(plan: Plan, adapt: bool = False) -> list[tuple[int, ChainPlan, PlannedLoop]]:
    """Return the chains of a plan that are in step with a loop: place, chain and loop.

    Raises InputError: their slots are to follow latencies as well (``adapt``). PlatformError: what
    the library in front sees cannot be read here.
    """
    chains = [
        (place, chain, chain.loop)
        for place, chain in enumerate(plan.chains)
        if chain.loop is not None and chain.loop.in_step is not None
    ]
    if chains and adapt:
        raise InputError(
            f"slots of {chain_name(chains[0][1])} are in step with a loop, so they cannot follow"
            " latencies: leave out --adapt, or plan without --in-step"
        )
    if chains:
        try:
            import chainshaper.sources.preload.moving  # noqa: F401 - whether it is there
        except ModuleNotFoundError as error:
            raise PlatformError(
                f"a chain in step with a loop needs {error.name}, which is not installed here:"
                " install it, or plan without --in-step and --move-loop"
            ) from error
    return chains
