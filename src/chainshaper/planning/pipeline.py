"""A chain longer than its period, L̄ > CT, as a pipeline (left open in section 3.1 of the paper).

The chain, with the branches that it waits for, is cut between nodes into stages, each in a server
of its own, shorter than the cycle. While stage 2 works on one instance, stage 1 works on the next.
The output leaves once a cycle, in order, when the slowest instance would be through: at a constant
latency of several cycles, as the shaping node sees by the stamp.

**What a callback takes** is counted from the message before it to its own, without the time for
which other instances of the chain had its core: the same whether instances piled up or not. Where
branches join, it is counted from the message that came last.

**Stages.** A stage is a set of nodes on one core; none may wait for another that waits for it. On
the axis of the chain's latency it begins when all executions of the stages that it waits for were
over: s_b ≥ s_a + W_a, with W_a the longest time that the callbacks of a took together, in one
instance. The stage with the chain's first callback begins at 0, one with the first callback of
another branch not before that did. As in eq. 1, its slot is [s, s + W + ε); it repeats every cycle,
so it is a cycle long at most, and modulo CT two slots of one core do not overlap: a stage may wait
for its turn. The ε of a stage lies beside the next one, which may be late by it: one ε serves the
whole chain.

**Search.** The shortest cut is that with the earliest end; of several, with the fewest stages, then
the fewest cores. Nodes join stages one after the other, in an order in which none comes before what
it waits for. Once all are in one, turns are chosen, and the starts obey difference constraints
(s_b ≥ s_a + constant), whose least solution is a longest path. What is chosen is searched in depth,
bounded by what the rest takes at least. After :data:`MOST_STEPS` the best so far has to do.

**Slots that open early.** The longest of all stages never come in one instance. So slots open as
soon as the first data may come, unless another stage has the core then, or a slot would be longer
than a cycle. With a core for each stage, all is over by the chain's own L̄ + ε.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, count

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.chain_plan import ChainPlan, in_one_slot, publish_slots, revised
from chainshaper.planning.overruns import in_cycle
from chainshaper.planning.shaping import CHAIN_PRIORITY, OUTPUT_PRIORITY, server_for
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.yaml_file import wrong_values_refused

MOST_STEPS = 60_000  # of the search, which take some seconds
_Key = tuple[int, int, int]  # what is minimal: end, stages, cores
_Turn = tuple[int, int, int]  # stages a and b of one core, and how many cycles lie between


def finished(
    after: Sequence[Sequence[int]],
    steps_ns: NDArray[np.int64],
    begins_ns: Sequence[int],
    cores: Sequence[int] | None = None,
) -> NDArray[np.int64]:
    """When each step of a graph is over at the latest: a row per instance, as in ``steps_ns``, and
    a column per step (ns).

    A step comes behind all those ``after`` which it stands; one that stands after none begins
    ``begins_ns`` behind its instance. With ``cores``, the core of each step, a step waits for its
    core too, in whatever order the core runs what is ready: before it may come every step of the
    same core that is neither before nor behind it in the graph. On one way through the graph each
    of these is waited for once (Graham's bound for list scheduling, 1969, for fixed cores).
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
    """For each step of a graph those of its core that may run before it or behind it."""
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
    """What is cut: units of callbacks that one thread has to run, each behind what it waits for.

    ``nodes`` are those of each unit, ``after`` the units that it waits for, all before it; the last
    one publishes the output. ``steps_ns`` has a row per instance and a column per unit. The chain
    begins with the unit ``first``; any other that waits for none begins its part of an instance
    ``begins_ns`` later.
    """

    nodes: tuple[tuple[str, ...], ...]
    after: tuple[tuple[int, ...], ...]
    steps_ns: NDArray[np.int64]
    begins_ns: tuple[int, ...]
    first: int = 0

    @cached_property
    def finished_ns(self) -> NDArray[np.int64]:
        """When each unit is over in each instance, if it waits for no core."""
        return finished(self.after, self.steps_ns, self.begins_ns)

    def longest_ns(self, members: Sequence[int]) -> int:
        """The longest that these units took together, in one instance."""
        return int(self.steps_ns[:, [*members]].sum(axis=1).max())


@dataclass(frozen=True)
class Stage:
    """Units on a core, and their slot, with the margin, on the latency's axis."""

    members: tuple[int, ...]
    place: int
    opens_ns: int
    closes_ns: int


def work_of(
    nodes: Sequence[str],
    after: Sequence[Sequence[int]],
    steps_ns: NDArray[np.int64],
    begins_ns: Sequence[int],
    first: int = 0,
) -> Work:
    """The work of callbacks, of which those of one node are one unit, and so is what lies between
    them. Each callback comes behind those that it waits for.
    """
    unit_of = _units(nodes, after)
    members = [[k for k, unit in enumerate(unit_of) if unit == u] for u in range(1 + max(unit_of))]
    waits = [
        tuple(sorted({unit_of[before] for k in own for before in after[k]} - {unit}))
        for unit, own in enumerate(members)
    ]
    return Work(
        nodes=tuple(tuple(dict.fromkeys(nodes[k] for k in own)) for own in members),
        after=tuple(waits),
        steps_ns=np.stack([steps_ns[:, own].sum(axis=1) for own in members], axis=1),
        begins_ns=tuple(max(begins_ns[k] for k in own) for own in members),
        first=unit_of[first],
    )


def _units(nodes: Sequence[str], after: Sequence[Sequence[int]]) -> list[int]:
    """The unit of each callback, numbered behind what they wait for."""
    reached = np.eye(len(nodes), dtype=bool)
    for k, before in enumerate(after):
        reached[k, [*before]] = True
    reached |= np.array([[one == two for two in nodes] for one in nodes])
    for between in range(len(nodes)):
        reached |= np.outer(reached[:, between], reached[between])
    together = reached & reached.T
    home = [int(np.argmax(row)) for row in together]
    order: list[int] = []
    while len(order) < len(set(home)):
        ready = (
            unit
            for unit in sorted(set(home))
            if unit not in order
            and all(
                home[before] in (*order, unit)
                for k, own in enumerate(home)
                if own == unit
                for before in after[k]
            )
        )
        order.append(next(ready))
    return [order.index(one) for one in home]


def shortest_cut(
    work: Work, margin_ns: int, cycle_ns: int, places: int
) -> tuple[Stage, ...] | None:
    """The stages of the shortest cut, in the order in which they begin; None where there is none on
    so many cores.
    """
    search = _Search(work, margin_ns, cycle_ns, places)
    search.go_on(0, [], [])
    if search.best is None:
        return None
    _, stages, places_of, starts = search.best
    lengths = [work.longest_ns(own) for own in stages]
    found = [
        Stage(tuple(own), place, start, start + length + margin_ns)
        for own, place, start, length in zip(stages, places_of, starts, lengths, strict=True)
    ]
    return tuple(sorted(found, key=lambda one: (one.opens_ns, one.members)))


class _Search:
    """The search for the shortest cut: the best so far, and how many steps that took."""

    def __init__(self, work: Work, margin_ns: int, cycle_ns: int, places: int) -> None:
        self.work, self.margin_ns, self.cycle_ns, self.places = work, margin_ns, cycle_ns, places
        self.best: tuple[_Key, list[list[int]], list[int], list[int]] | None = None
        self.steps = 0
        self._lasting: dict[tuple[int, ...], int] = {}
        self._least: dict[tuple[tuple[int, ...], int], int] = {}
        behind: list[list[int]] = [[] for _ in work.after]
        for unit, before in enumerate(work.after):
            for one in before:
                behind[one].append(unit)
        self._behind = behind
        self._tail = np.zeros_like(work.steps_ns)  # what comes behind each unit, on its way
        for unit in reversed(range(len(behind))):
            for later in behind[unit]:
                longer = work.steps_ns[:, later] + self._tail[:, later]
                self._tail[:, unit] = np.maximum(self._tail[:, unit], longer)

    def lasting(self, members: Sequence[int]) -> int:
        """W of a stage."""
        key = tuple(members)
        if key not in self._lasting:
            self._lasting[key] = self.work.longest_ns(key)
        return self._lasting[key]

    def least(self, members: Sequence[int], assigned: int) -> int:
        """How long it takes at least from the start of a stage to the end of all, if the units from
        ``assigned`` on may be in it.
        """
        key = tuple(members), assigned
        if key not in self._least:
            took = self.work.steps_ns[:, [*members]].sum(axis=1)
            later = {one for unit in members for one in self._behind[unit] if one >= assigned}
            rest = [self.work.steps_ns[:, one] + self._tail[:, one] for one in later]
            total = took + np.max(rest, axis=0) if rest else took
            self._least[key] = int(total.max())
        return self._least[key]

    def go_on(self, assigned: int, stages: list[list[int]], places_of: list[int]) -> None:
        """Try all stages for the next unit, the most promising first."""
        if assigned == len(self.work.after):
            self._choose_turns(stages, places_of)
            return
        used, ways = max(places_of, default=-1) + 1, []
        options = [(number, place) for number, place in enumerate(places_of)]
        options += [(len(stages), place) for place in range(min(used + 1, self.places))]
        for number, place in options:
            self.steps += 1
            longer = [list(own) for own in stages] + [[]] * (number == len(stages))
            longer[number] = [*longer[number], assigned]
            where = [*places_of, place][: len(longer)]
            if (least := self._bound(longer, where, assigned + 1)) is not None:
                ways.append((least, longer, where))
        for least, longer, where in sorted(ways):
            if self.steps < MOST_STEPS and (self.best is None or least < self.best[0]):
                self.go_on(assigned + 1, longer, where)

    def _bound(self, stages: list[list[int]], places_of: list[int], assigned: int) -> _Key | None:
        """Below which nothing comes of these stages; None: nothing at all."""
        room = [self.cycle_ns] * self.places
        for own, place in zip(stages, places_of, strict=True):
            room[place] -= self.lasting(own) + self.margin_ns
            if room[place] < 0:
                return None
        edges = self._edges(stages)
        starts = self._starts(stages, edges, []) if _acyclic(edges) else None
        if starts is None:
            return None
        ends = (s + self.least(own, assigned) for s, own in zip(starts, stages, strict=True))
        return max(ends), len(stages), len(set(places_of))

    def _edges(self, stages: list[list[int]]) -> list[_Turn]:
        """Which stages wait for which, and how long the former take."""
        home = {unit: number for number, own in enumerate(stages) for unit in own}
        found = {
            (home[before], number)
            for unit, number in home.items()
            for before in self.work.after[unit]
            if home[before] != number
        }
        return [(one, two, self.lasting(stages[one])) for one, two in found]

    def _starts(
        self, stages: list[list[int]], edges: list[_Turn], turns: list[_Turn]
    ) -> list[int] | None:
        """The earliest starts of the stages, None where they cannot take these turns."""
        work, after = self.work, list(edges)
        for one, two, between in turns:
            lasts, other = self.lasting(stages[one]), self.lasting(stages[two])
            after.append((one, two, lasts + self.margin_ns + between * self.cycle_ns))
            after.append((two, one, other + self.margin_ns - (between + 1) * self.cycle_ns))
        starts = [max(0, *(work.begins_ns[unit] for unit in own)) for own in stages]
        for _ in range(len(stages) + 1):
            before = list(starts)
            for one, two, apart in after:
                starts[two] = max(starts[two], starts[one] + apart)
            first = next((k for k, own in enumerate(stages) if work.first in own), None)
            if first is not None and starts[first] > 0:
                return None
            if starts == before:
                return starts
        return None

    def _choose_turns(self, stages: list[list[int]], places_of: list[int]) -> None:
        """All turns in which the stages of one core may follow each other; the best stays.

        With K turns in between, s_a + W_a + ε + K·CT ≤ s_b and s_b + W_b + ε ≤ s_a + (K + 1)·CT. No
        stage of the shortest cut waits for a cycle or more.
        """
        edges, cycle = self._edges(stages), self.cycle_ns
        pairs = [
            (one, two)
            for one, two in combinations(range(len(stages)), 2)
            if places_of[one] == places_of[two]
        ]

        def choose(left: list[tuple[int, int]], turns: list[_Turn]) -> None:
            self.steps += 1
            starts = self._starts(stages, edges, turns)
            if starts is None or self.steps > 2 * MOST_STEPS:
                return
            end = max(s + self.lasting(own) for s, own in zip(starts, stages, strict=True))
            key = end, len(stages), len(set(places_of))
            if self.best is not None and key >= self.best[0]:
                return
            if not left:
                self.best = key, stages, places_of, starts
                return
            (one, two), *others = left
            latest = [start + (len(stages) + 1) * cycle for start in starts]
            least = (starts[two] - latest[one]) // cycle - 1
            most = (latest[two] - starts[one]) // cycle + 1
            ways = sorted(range(least, most + 1), key=abs)
            for between in ways:
                choose(others, [*turns, (one, two, between)])

        choose(pairs, [])


def _acyclic(edges: Sequence[_Turn]) -> bool:
    """Whether no stage waits for another that waits for it."""
    left = {(one, two) for one, two, _ in edges}
    while left:
        waiting = {two for _, two in left}
        following = {(one, two) for one, two in left if one in waiting}
        if following == left:
            return False
        left = following
    return True


def opened_early(
    stages: Sequence[Stage], work: Work, margin_ns: int, cycle_ns: int, room_ns: int = 0
) -> tuple[Stage, ...]:
    """The same stages in slots that open as soon as the first data may come, and close earlier. The
    last slot leaves ``room_ns`` of its core to the publication, where it can.
    """
    opened = list(stages)
    done: dict[int, NDArray[np.int64]] = {}
    for number in _in_order(stages, work):
        stage = opened[number]
        took = work.steps_ns[:, list(stage.members)].sum(axis=1)
        inputs = [
            done[one]
            for unit in stage.members
            for one in work.after[unit]
            if one not in stage.members
        ]
        inputs += [
            np.full(len(took), work.begins_ns[unit])
            for unit in stage.members
            if not work.after[unit]
        ]
        arrives, first = np.max(inputs, axis=0), min(int(one.min()) for one in inputs)
        others = [one for one in opened if one is not stage and one.place == stage.place]
        free = (stage.opens_ns - (stage.opens_ns - one.closes_ns) % cycle_ns for one in others)
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
    """The places of stages, each behind those that it waits for."""
    over: set[int] = set()
    left = list(range(len(stages)))
    while left:
        number = next(
            k
            for k in left
            if all(
                one in over or one in stages[k].members
                for unit in stages[k].members
                for one in work.after[unit]
            )
        )
        left.remove(number)
        over |= {*stages[number].members}
        yield number


@wrong_values_refused(ChainPlan)
def pipelined(
    plan: ChainPlan,
    work: Work,
    core_of: Mapping[str, int],
    cores: Sequence[int] | None = None,
    *,
    room_ns: int = 0,
) -> ChainPlan:
    """A shaped plan's chain in stages, on these cores (default: those of ``core_of``).

    Each slot has ``room_ns`` more, for what may have the core meanwhile: who receives the output.
    A core that is named twice has two stages at a time, of which the first has the better priority:
    right where callbacks wait for something rather than compute. OperationError: no cut fits; the
    message names what prevents it.
    """
    before = list(dict.fromkeys(core_of[node] for own in work.nodes for node in own))
    # In the order of the chain, so that nodes stay where they are, if that can be.
    cores = sorted(cores or before, key=lambda one: (*before, one).index(one))
    margin, cycle, node = plan.margin.epsilon_ns + room_ns, plan.cycle_ns, plan.shaping_node
    if node is None:
        raise InputError("a pipeline needs a shaping node: plan with --publication synchronous")
    _refuse_too_long(work, margin, cycle)
    stages = shortest_cut(work, margin, cycle, len(cores))
    if stages is None:
        raise OperationError(_no_room(work, margin, cycle, cores))
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
        own = (node for unit in stage.members for node in work.nodes[unit])
        servers.append(server_for(own, f"stage{number}", core, urgency, slots))
    core, slots = cores[last.place], in_cycle(opens, opens + length, cycle)
    servers.append(server_for([node.thread.node], "output", core, OUTPUT_PRIORITY, slots))
    return revised(
        plan,
        policy="pipelined",
        servers=tuple(servers),
        shaping_node=node.model_copy(update={"core": core}),
        predicted=in_one_slot((opens, opens + length)),
    )


def stage_places(work: Work, cycle_ns: int, cores: int) -> dict[str, int]:
    """On which of so many cores to measure nodes: on that of their stage, by the medians, without a
    margin. Where no cut fits, the fullest stage has as little to do as can be.
    """
    medians = np.median(work.steps_ns, axis=0, keepdims=True).astype(np.int64)
    usual = replace(work, steps_ns=medians)
    cycles = (cycle_ns * tenths // 10 for tenths in count(10))
    tried = (shortest_cut(usual, 0, cycle, cores) for cycle in cycles)
    stages = next(found for found in tried if found)
    return {node: one.place for one in stages for unit in one.members for node in work.nodes[unit]}


def _refuse_too_long(work: Work, margin_ns: int, cycle_ns: int) -> None:
    """What cannot be cut has to fit into a cycle."""
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
    named, total = ",".join(map(str, sorted(cores))), int(work.steps_ns.sum(axis=1).max())
    most = range(len(cores) + 1, len(work.after) + 1)
    enough = next((n for n in most if shortest_cut(work, margin_ns, cycle_ns, n)), None)
    more = f"{enough} cores (--cores {named},…), " if enough else ""
    return (
        f"no cut of the chain fits on the cores {named}: it takes {duration_text(total)},"
        f" {total / cycle_ns:.2f} times the cycle, and a stage {duration_text(margin_ns)} more."
        f" What helps: {more}a longer period, or a smaller margin"
    )
