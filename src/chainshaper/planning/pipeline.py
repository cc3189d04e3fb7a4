"""A chain longer than its period, L̄ > CT, as a pipeline (left open in section 3.1 of the paper).

The chain, with the branches that it waits for, is cut between nodes into stages, each in a server
of its own, shorter than the cycle. While stage 2 works on one instance, stage 1 works on the next.
The output leaves once a cycle, in order, when the slowest instance would be through: at a constant
latency of several cycles, as the shaping node sees by the stamp.

**How long a callback takes** is counted from the message before it to its own, without the time for
which other instances of the chain had its core. So it is the same whether instances piled up or
not. Where branches join, it is counted from the message that came last.

**Stages.** A stage is a set of nodes on one core; no two stages may wait for each other. On the
axis of the chain's latency a stage b begins when all executions of each stage a that it waits for
were over: s_b ≥ s_a + W_a, with W_a the longest time that the callbacks of a took together, in one
instance. The stage with the chain's first callback begins at 0; a stage with the first callback of
another branch begins no earlier than that callback did. As in eq. 1, the slot of a stage is [s, s +
W + ε). It repeats every cycle, so it is a cycle long at most, and modulo CT two slots of one core
do not overlap: a stage may wait for its turn. The ε of a stage lies beside the next stage, which
may be late by it: one ε serves the whole chain.

**Search.** The shortest cut is that with the earliest end; of several, that with the fewest stages,
then the fewest cores. Nodes join stages one after the other, in an order in which each comes behind
those it waits for. Once all nodes are in stages, turns are chosen. Then the starts obey difference
constraints (s_b ≥ s_a + constant), whose least solution is a longest path. The search goes depth
first, and gives up a branch when even the least that the rest takes is too long. After
:data:`MOST_STEPS` it takes the best cut so far.

**Slots that open early.** The longest executions of all stages never come in one instance. So slots
open as soon as the first data may come, unless another stage has the core then, or a slot would be
longer than a cycle. With a core for each stage, all is over by the chain's own L̄ + ε.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, count

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.chain_plan import (
    ChainPlan,
    ShapingNode,
    in_one_slot,
    meet,
    publish_slots,
    revised,
)
from chainshaper.planning.overruns import in_cycle
from chainshaper.planning.shaping import CHAIN_PRIORITY, OUTPUT_PRIORITY, server_for
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.yaml_file import wrong_values_refused

MOST_STEPS = 60_000  # of the search: they take some seconds
_Key = tuple[int, int, int]  # what is minimised: end, number of stages, number of cores
_Turn = tuple[int, int, int]  # stages a and b of one core, and how many cycles lie between


def finished(
    after: Sequence[Sequence[int]],
    steps_ns: NDArray[np.int64],
    begins_ns: Sequence[int],
    cores: Sequence[int] | None = None,
) -> NDArray[np.int64]:
    """Return when each step of a graph is over at the latest (ns).

    There is a row for each instance, as in ``steps_ns``, and a column for each step. A step comes
    behind all steps in its ``after``; one without such begins ``begins_ns`` behind its instance.

    With ``cores``, the core of each step, a step waits for its core too, in whatever order the core
    runs what is ready: every step of the same core that is neither before nor behind it in the
    graph may come before it. On one way through the graph each of these is waited for once
    (Graham's bound for list scheduling, 1969, for fixed cores).
    """
    beside = _beside(after, cores) if cores else [frozenset[int]()] * len(after)
    done = np.zeros_like(steps_ns)
    waited_for: list[frozenset[int]] = []  # on every way to a step
    for step, inputs in enumerate(after):
        if not inputs:
            core_free = steps_ns[:, sorted(beside[step])].sum(axis=1)
            done[:, step] = begins_ns[step] + core_free + steps_ns[:, step]
            waited_for.append(beside[step])
            continue
        for before in inputs:
            once_more = sorted(beside[step] - waited_for[before])
            ends = done[:, before] + steps_ns[:, once_more].sum(axis=1) + steps_ns[:, step]
            done[:, step] = np.maximum(done[:, step], ends)
        ways = (waited_for[before] | beside[step] for before in inputs)
        waited_for.append(frozenset.intersection(*ways))
    return done


def _beside(after: Sequence[Sequence[int]], cores: Sequence[int]) -> list[frozenset[int]]:
    """Return, for each step of a graph, those of its core that may run before it or behind it."""
    before: list[set[int]] = []
    for inputs in after:
        before.append(set(inputs).union(*(before[step] for step in inputs)))
    steps = range(len(after))
    return [
        frozenset(
            rival
            for rival in steps
            if cores[rival] == cores[step]
            and rival != step
            and rival not in before[step]
            and step not in before[rival]
        )
        for step in steps
    ]


@dataclass(frozen=True)
class Work:
    """What is cut into stages: units of callbacks that one thread has to run.

    Each unit comes behind those it waits for; the last one publishes the output.
    """

    nodes: tuple[tuple[str, ...], ...]  # of each unit
    after: tuple[tuple[int, ...], ...]  # the units that each unit waits for
    steps_ns: NDArray[np.int64]  # how long each unit took: a row per instance, a column per unit
    begins_ns: tuple[int, ...]  # when each unit that waits for none begins, behind its instance
    first: int = 0  # the unit with which the chain begins

    @cached_property
    def finished_ns(self) -> NDArray[np.int64]:
        """When each unit is over in each instance, if it waits for no core (as ``steps_ns``)."""
        return finished(self.after, self.steps_ns, self.begins_ns)

    def longest_ns(self, members: Sequence[int]) -> int:
        """Return the longest time that these units took together, in one instance."""
        return int(self.steps_ns[:, [*members]].sum(axis=1).max())


@dataclass(frozen=True)
class Stage:
    """Units on a core, and their slot on the axis of the chain's latency."""

    members: tuple[int, ...]  # its units
    place: int  # of its core among the cores of the pipeline
    opens_ns: int
    closes_ns: int  # the margin is in it


def work_of(
    nodes: Sequence[str],
    after: Sequence[Sequence[int]],
    steps_ns: NDArray[np.int64],
    begins_ns: Sequence[int],
    first: int = 0,
) -> Work:
    """Return the work of callbacks, each of which comes behind those it waits for.

    The callbacks of one node are one unit, together with those that lie between them.
    """
    unit_of = _units(nodes, after)
    members: list[list[int]] = [[] for _ in range(1 + max(unit_of))]
    for callback, unit in enumerate(unit_of):
        members[unit].append(callback)
    waits = [
        tuple(sorted({unit_of[before] for member in of_unit for before in after[member]} - {unit}))
        for unit, of_unit in enumerate(members)
    ]
    return Work(
        nodes=tuple(tuple(dict.fromkeys(nodes[member] for member in unit)) for unit in members),
        after=tuple(waits),
        steps_ns=np.stack([steps_ns[:, unit].sum(axis=1) for unit in members], axis=1),
        begins_ns=tuple(max(begins_ns[member] for member in unit) for unit in members),
        first=unit_of[first],
    )


def _units(nodes: Sequence[str], after: Sequence[Sequence[int]]) -> list[int]:
    """Return the unit of each callback; a unit's number is larger than those it waits for.

    Two callbacks are in one unit where each is reached from the other, by what it waits for or by
    being of one node.
    """
    reached = np.eye(len(nodes), dtype=bool)
    for callback, before in enumerate(after):
        reached[callback, [*before]] = True
    reached |= np.array([[node == other_node for other_node in nodes] for node in nodes])
    for between in range(len(nodes)):
        reached |= np.outer(reached[:, between], reached[between])
    together = reached & reached.T
    home = [int(np.argmax(row)) for row in together]  # the first callback of each one's unit
    order: list[int] = []
    while len(order) < len(set(home)):
        ready = (
            unit
            for unit in sorted(set(home))
            if unit not in order
            and all(
                home[before] in (*order, unit)
                for callback, unit_home in enumerate(home)
                if unit_home == unit
                for before in after[callback]
            )
        )
        order.append(next(ready))
    return [order.index(unit) for unit in home]


def shortest_cut(
    work: Work, margin_ns: int, cycle_ns: int, places: int
) -> tuple[Stage, ...] | None:
    """Return the stages of the shortest cut, in the order in which they begin.

    None: there is no cut on so many cores (``places``).
    """
    search = _Search(work, margin_ns, cycle_ns, places)
    search.assign_next(0, [], [])
    if search.best is None:
        return None
    _, stages, places_of, starts = search.best
    cut = [
        Stage(tuple(units), place, start, start + work.longest_ns(units) + margin_ns)
        for units, place, start in zip(stages, places_of, starts, strict=True)
    ]
    return tuple(sorted(cut, key=lambda stage: (stage.opens_ns, stage.members)))


class _Search:
    """The search for the shortest cut.

    A stage is a list of its units here; ``places_of`` are the places of the stages' cores.
    """

    def __init__(self, work: Work, margin_ns: int, cycle_ns: int, places: int) -> None:
        self.work, self.margin_ns, self.cycle_ns, self.places = work, margin_ns, cycle_ns, places
        # The best cut so far: its key, its stages, the places of their cores, their starts.
        self.best: tuple[_Key, list[list[int]], list[int], list[int]] | None = None
        self.steps = 0
        self._lasting: dict[tuple[int, ...], int] = {}
        self._least: dict[tuple[tuple[int, ...], int], int] = {}
        behind: list[list[int]] = [[] for _ in work.after]
        for unit, inputs in enumerate(work.after):
            for before in inputs:
                behind[before].append(unit)
        self._behind = behind
        # How long the longest way behind each unit takes: a row per instance, a column per unit.
        self._tail = np.zeros_like(work.steps_ns)
        for unit in reversed(range(len(behind))):
            for later in behind[unit]:
                longer = work.steps_ns[:, later] + self._tail[:, later]
                self._tail[:, unit] = np.maximum(self._tail[:, unit], longer)

    def lasting(self, units: Sequence[int]) -> int:
        """Return W of a stage."""
        key = tuple(units)
        if key not in self._lasting:
            self._lasting[key] = self.work.longest_ns(key)
        return self._lasting[key]

    def least(self, units: Sequence[int], assigned: int) -> int:
        """Return how long it takes at least from the start of a stage to the end of all.

        The units from ``assigned`` on are in no stage yet, and may come into this one.
        """
        key = tuple(units), assigned
        if key not in self._least:
            took = self.work.steps_ns[:, [*units]].sum(axis=1)
            later = {after for unit in units for after in self._behind[unit] if after >= assigned}
            rest = [self.work.steps_ns[:, unit] + self._tail[:, unit] for unit in later]
            total = took + np.max(rest, axis=0) if rest else took
            self._least[key] = int(total.max())
        return self._least[key]

    def assign_next(self, assigned: int, stages: list[list[int]], places_of: list[int]) -> None:
        """Try all stages for the next unit, ``assigned``, the most promising first."""
        if assigned == len(self.work.after):
            self._choose_turns(stages, places_of)
            return
        ways = []
        used = max(places_of, default=-1) + 1
        for number in range(len(stages)):  # into a stage that is there
            longer = [list(units) for units in stages]
            longer[number].append(assigned)
            ways.append((longer, places_of))
        for place in range(min(used + 1, self.places)):  # into a new stage
            ways.append(([*map(list, stages), [assigned]], [*places_of, place]))
        bounded = []
        for longer, places in ways:
            self.steps += 1
            least = self._bound(longer, places, assigned + 1)
            if least is not None:
                bounded.append((least, longer, places))
        for least, longer, places in sorted(bounded):
            if self.steps < MOST_STEPS and (self.best is None or least < self.best[0]):
                self.assign_next(assigned + 1, longer, places)

    def _bound(self, stages: list[list[int]], places_of: list[int], assigned: int) -> _Key | None:
        """Return the least key of any cut with these stages; None: there is no such cut."""
        room = [self.cycle_ns] * self.places
        for units, place in zip(stages, places_of, strict=True):
            room[place] -= self.lasting(units) + self.margin_ns
            if room[place] < 0:
                return None
        edges = self._edges(stages)
        starts = self._starts(stages, edges, []) if _acyclic(edges) else None
        if starts is None:
            return None
        end = max(
            start + self.least(units, assigned) for start, units in zip(starts, stages, strict=True)
        )
        return end, len(stages), len(set(places_of))

    def _edges(self, stages: list[list[int]]) -> list[_Turn]:
        """Return stages a and b of which b waits for a, with how long a takes."""
        home = {unit: number for number, units in enumerate(stages) for unit in units}
        pairs = {
            (home[before], number)
            for unit, number in home.items()
            for before in self.work.after[unit]
            if home[before] != number
        }
        return [(former, later, self.lasting(stages[former])) for former, later in pairs]

    def _starts(
        self, stages: list[list[int]], edges: list[_Turn], turns: list[_Turn]
    ) -> list[int] | None:
        """Return the earliest starts of the stages; None: they cannot take these turns."""
        work, distances = self.work, list(edges)  # the second starts so long after the first
        for former, later, between in turns:
            lasts = self.lasting(stages[former]) + self.margin_ns
            distances.append((former, later, lasts + between * self.cycle_ns))
            lasts = self.lasting(stages[later]) + self.margin_ns
            distances.append((later, former, lasts - (between + 1) * self.cycle_ns))
        starts = [max(0, *(work.begins_ns[unit] for unit in units)) for units in stages]
        for _ in range(len(stages) + 1):
            before = list(starts)
            for former, later, distance in distances:
                starts[later] = max(starts[later], starts[former] + distance)
            for units, start in zip(stages, starts, strict=True):
                if work.first in units and start > 0:
                    return None  # the chain begins at 0
            if starts == before:
                return starts
        return None

    def _choose_turns(self, stages: list[list[int]], places_of: list[int]) -> None:
        """Try all turns in which the stages of one core may follow each other; keep the best.

        With K turns in between, s_a + W_a + ε + K·CT ≤ s_b and s_b + W_b + ε ≤ s_a + (K + 1)·CT. No
        stage of the shortest cut waits for a cycle or more.
        """
        edges, cycle = self._edges(stages), self.cycle_ns
        pairs = [
            (former, later)
            for former, later in combinations(range(len(stages)), 2)
            if places_of[former] == places_of[later]
        ]

        def choose(left: list[tuple[int, int]], turns: list[_Turn]) -> None:
            self.steps += 1
            starts = self._starts(stages, edges, turns)
            if starts is None or self.steps > 2 * MOST_STEPS:
                return
            end = max(
                start + self.lasting(units) for start, units in zip(starts, stages, strict=True)
            )
            key = end, len(stages), len(set(places_of))
            if self.best is not None and key >= self.best[0]:
                return
            if not left:
                self.best = key, stages, places_of, starts
                return
            (former, later), *rest = left
            latest = [start + (len(stages) + 1) * cycle for start in starts]
            least = (starts[later] - latest[former]) // cycle - 1
            most = (latest[later] - starts[former]) // cycle + 1
            for between in sorted(range(least, most + 1), key=abs):
                choose(rest, [*turns, (former, later, between)])

        choose(pairs, [])


def _acyclic(edges: Sequence[_Turn]) -> bool:
    """Whether no stage waits for another that waits for it."""
    left = {(former, later) for former, later, _ in edges}
    while left:
        waiting = {later for _, later in left}
        following = {(former, later) for former, later in left if former in waiting}
        if following == left:
            return False
        left = following
    return True


def opened_early(
    stages: Sequence[Stage], work: Work, margin_ns: int, cycle_ns: int, room_ns: int = 0
) -> tuple[Stage, ...]:
    """Return the stages in slots that open as soon as the first data may come, and close earlier.

    The last slot leaves ``room_ns`` of its core to the publication, where it can.
    """
    opened = list(stages)
    done: dict[int, NDArray[np.int64]] = {}
    for number in _in_order(stages, work):
        stage = opened[number]
        took = work.steps_ns[:, list(stage.members)].sum(axis=1)
        inputs = [
            done[before]
            for unit in stage.members
            for before in work.after[unit]
            if before not in stage.members
        ]
        inputs += [
            np.full(len(took), work.begins_ns[unit])
            for unit in stage.members
            if not work.after[unit] or work.begins_ns[unit]  # a callback that begins by itself
        ]
        arrives, first = np.max(inputs, axis=0), min(int(instants.min()) for instants in inputs)
        # When the slots of its core's other stages close last before this one opened.
        free = [
            stage.opens_ns - (stage.opens_ns - beside.closes_ns) % cycle_ns
            for beside in opened
            if beside is not stage and beside.place == stage.place
        ]
        room = room_ns if len(work.after) - 1 in stage.members else 0
        within_a_cycle = int((arrives + took).max()) + margin_ns + room - cycle_ns
        early = min(stage.opens_ns, max(first, within_a_cycle))
        opens = max(early, *free, 0)
        over = np.maximum(arrives, opens) + took
        done |= dict.fromkeys(stage.members, over)
        closes = int(over.max()) + margin_ns
        opened[number] = replace(stage, opens_ns=opens, closes_ns=closes)
    return tuple(opened)


def _in_order(stages: Sequence[Stage], work: Work) -> Iterator[int]:
    """Yield the numbers of stages, each behind those that it waits for."""
    over: set[int] = set()  # units
    left = list(range(len(stages)))
    while left:
        for number in left:
            members = {*stages[number].members}
            if all(before in over | members for unit in members for before in work.after[unit]):
                break
        left.remove(number)
        over |= members
        yield number


@wrong_values_refused(ChainPlan)
def pipelined(
    plan: ChainPlan,
    work: Work,
    core_of: Mapping[str, int],
    cores: Sequence[int] | None = None,
    *,
    room_ns: int = 0,
    gate_ns: int = 0,
) -> ChainPlan:
    """Return a shaped plan with its chain in stages, on these cores (default: of ``core_of``).

    Each slot is ``room_ns`` longer, for what may have the core meanwhile: receivers of the output.
    It is ``gate_ns`` longer still where the gate, whose priority is better than the stages', may
    publish while a stage has the same core.
    A core that is named twice has two stages at a time, of which the first has the better priority:
    that is right where callbacks wait for something rather than compute.

    Raises OperationError: no cut fits; the message names what prevents it.
    """
    before = list(dict.fromkeys(core_of[node] for unit in work.nodes for node in unit))
    # In the order of the chain, so that nodes stay where they are, if that can be.
    cores = sorted(cores or before, key=lambda core: (*before, core).index(core))
    node = plan.shaping_node
    if node is None:
        raise InputError("a pipeline needs a shaping node: plan with --publication synchronous")
    staged = _in_stages(plan, node, work, cores, room_ns)
    if _publishes_during_stage(staged):
        staged = _in_stages(plan, node, work, cores, room_ns + gate_ns)
    return staged


def _in_stages(
    plan: ChainPlan, node: ShapingNode, work: Work, cores: Sequence[int], room_ns: int
) -> ChainPlan:
    """Return the plan with the stages of the shortest cut, as :func:`pipelined` says."""
    margin, cycle = plan.margin.epsilon_ns + room_ns, plan.cycle_ns
    _refuse_too_long(work, margin, cycle)
    stages = shortest_cut(work, margin, cycle, len(cores))
    if stages is None:
        named = f"{plan.chain.spec}: " if plan.chain.spec else ""
        raise OperationError(named + _no_room(work, margin, cycle, cores))
    ((start, end),) = publish_slots(plan)
    length = end - start
    stages = opened_early(stages, work, margin, cycle, length + node.pause_ns)
    last = next(stage for stage in stages if len(work.after) - 1 in stage.members)
    opens = last.closes_ns
    if opens % cycle + length > cycle:  # a publish slot does not wrap
        opens = -(-opens // cycle) * cycle
    servers = []
    for number, stage in enumerate(stages, start=1):
        core, slots = cores[stage.place], in_cycle(stage.opens_ns, stage.closes_ns, cycle)
        urgency = CHAIN_PRIORITY + cores[: stage.place].count(core)
        nodes = (name for unit in stage.members for name in work.nodes[unit])
        servers.append(server_for(nodes, f"stage{number}", core, urgency, slots))
    core, slots = cores[last.place], in_cycle(opens, opens + length, cycle)
    servers.append(server_for([node.thread.node], "output", core, OUTPUT_PRIORITY, slots))
    return revised(
        plan,
        policy="pipelined",
        servers=tuple(servers),
        shaping_node=node.model_copy(update={"core": core}),
        predicted=in_one_slot((opens, opens + length)),
    )


def _publishes_during_stage(plan: ChainPlan) -> bool:
    """Return whether a stage runs on the gate's core while the output's slot is open."""
    *stages, output = plan.servers
    return any(
        stage.core == output.core and meet(stage_slot, publish_slot)
        for stage in stages
        for stage_slot in stage.slots
        for publish_slot in output.slots
    )


def stage_places(work: Work, cycle_ns: int, cores: int) -> dict[str, int]:
    """Return on which of so many cores to measure each node: on that of its stage.

    The stages are cut by medians, without a margin. Where no cut fits, the fullest stage has as
    little to do as can be.
    """
    medians = np.median(work.steps_ns, axis=0, keepdims=True).astype(np.int64)
    usual = replace(work, steps_ns=medians)
    cycles = (cycle_ns * tenths // 10 for tenths in count(10))
    tried = (shortest_cut(usual, 0, cycle, cores) for cycle in cycles)
    stages = next(cut for cut in tried if cut)
    return {
        node: stage.place for stage in stages for unit in stage.members for node in work.nodes[unit]
    }


def _refuse_too_long(work: Work, margin_ns: int, cycle_ns: int) -> None:
    """Refuse work of which a unit, which cannot be cut, does not fit into a cycle."""
    for unit, nodes in enumerate(work.nodes):
        longest = work.longest_ns([unit])
        needed = longest + margin_ns
        if needed > cycle_ns:
            why = "" if len(nodes) == 1 else " together, which one thread has to run,"
            took, excess = duration_text(longest), duration_text(needed - cycle_ns)
            reason = f"{why} takes up to {took}, with its margin {excess} longer than the cycle"
            remedy = (
                f"take a period of {duration_text(needed)}, or parts of it in nodes of their own"
            )
            raise OperationError(f"the work of {', '.join(nodes)}{reason}: {remedy}")


def _no_room(work: Work, margin_ns: int, cycle_ns: int, cores: Sequence[int]) -> str:
    """Say that no cut fits on the cores, and what helps."""
    named, total = ",".join(map(str, sorted(cores))), int(work.steps_ns.sum(axis=1).max())
    most = range(len(cores) + 1, len(work.after) + 1)
    enough = next((n for n in most if shortest_cut(work, margin_ns, cycle_ns, n)), None)
    more = f"{enough} cores (--cores {named},…), " if enough else ""
    return (
        f"no cut of the chain fits on the cores {named}: it takes {duration_text(total)},"
        f" {total / cycle_ns:.2f} times the cycle, and a stage {duration_text(margin_ns)} more."
        f" What helps: {more}a longer period, or a smaller margin"
    )
