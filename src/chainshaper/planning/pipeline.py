"""A chain longer than its period, L̄ > CT, as a pipeline (left open in section 3.1 of the paper).

The chain is cut between nodes into stages, each in a server of its own, shorter than the cycle.
While stage 2 works on one instance, stage 1 works on the next. The output leaves once a cycle, in
order, when the slowest instance would be through: at a constant latency of several cycles, as the
shaping node sees by the stamp.

**What a callback takes** is counted from the message before it to its own, without the time for
which other instances of the chain had its core: the same whether instances piled up or not.

**Stages.** On the axis of the chain's latency stage j begins when all executions of j − 1 were
over: s_1 = 0 and s_{j+1} ≥ s_j + W_j, with W_j the longest time that its callbacks took together,
in one instance. As in eq. 1, its slot is [s_j, s_j + W_j + ε); it repeats every cycle, so it is a
cycle long at most, and modulo CT two slots of one core do not overlap: a stage may wait for its
turn. The ε of a stage lies beside the next one, which may be late by it: one ε serves the whole
chain.

**Search.** The shortest cut is that with the earliest end; of several, with the fewest stages, then
the fewest cores. Once cut, cores and turns are chosen, the starts obey difference constraints
(s_b ≥ s_a + constant), whose least solution is a longest path. What is chosen is searched in depth,
bounded by the shortest cut of the rest. After :data:`MOST_STEPS` the best so far has to do.

**Slots that open early.** The longest of all stages never come in one instance. So slots open as
soon as the first data may come, unless another stage has the core then, or a slot would be longer
than a cycle. With a core for each stage, all is over by the chain's own L̄ + ε.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import accumulate, count, pairwise, product

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.overruns import in_cycle
from chainshaper.planning.plan import Plan, in_one_slot, publish_slots, revised
from chainshaper.planning.shaping import CHAIN_PRIORITY, OUTPUT_PRIORITY, server_for
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.yaml_file import wrong_values_refused


@dataclass(frozen=True)
class Stage:
    """Callbacks [first, end) on a core, and their slot, with the margin, on the latency's axis."""

    first: int
    end: int
    place: int
    opens_ns: int
    closes_ns: int


Longest = Sequence[Sequence[int]]
"""``longest[i][j]``: the longest that the callbacks [i, j) took together (ns)."""

MOST_STEPS = 100_000  # of the search, which take some seconds

_Piece = tuple[int, int, int]  # of a stage: first, end, place
_Turn = tuple[int, int, int]  # stages a < b of one core, and how many cycles lie between
_Key = tuple[int, int, int]  # what is minimal: end, stages, cores


def shortest_cut(
    longest: Longest, cuts: Sequence[int], margin_ns: int, cycle_ns: int, places: int
) -> tuple[Stage, ...] | None:
    """The stages of the shortest cut; None where there is none on so many cores.

    ``cuts`` are the places where a stage may begin or end, ascending, from 0 to the last.
    """
    best: tuple[_Key, list[_Piece], list[int]] | None = None
    steps = 0

    @cache
    def rest(room_ns: int) -> dict[int, tuple[int, int]]:
        """How long the chain takes from each cut on, in how many stages, with such room for each.

        There is none for a cut from which on no stages are that short.
        """
        found = {cuts[-1]: (0, 0)}
        for first in reversed(cuts[:-1]):
            ways = [
                (longest[first][end] + further, stages + 1)
                for end, (further, stages) in found.items()
                if longest[first][end] + margin_ns <= room_ns
            ]
            found.update({first: min(ways)} if ways else {})
        return found

    def bound(pieces: list[_Piece], starts: list[int]) -> _Key | None:
        """Below which nothing comes of these stages; None: no room on the cores for the others."""
        room = [cycle_ns] * places
        for first, end, place in pieces:
            room[place] -= longest[first][end] + margin_ns
        first, end, _ = pieces[-1]
        further, stages = rest(max(room)).get(end, (0, 0))
        if end < cuts[-1] and (not stages or further + margin_ns > sum(room)):
            return None
        used = len({place for *_, place in pieces})
        return starts[-1] + longest[first][end] + further, len(pieces) + stages, used

    def go_on(pieces: list[_Piece], turns: list[_Turn], starts: list[int]) -> None:
        nonlocal best, steps
        first = pieces[-1][1] if pieces else 0
        used = len({place for *_, place in pieces})
        if first == cuts[-1]:
            best = (starts[-1] + longest[pieces[-1][0]][first], len(pieces), used), pieces, starts
            return
        ways = []
        for end, place in product(reversed(cuts), range(min(used + 1, places))):
            if end <= first or longest[first][end] + margin_ns > cycle_ns:
                continue
            longer = [*pieces, (first, end, place)]
            for more in _turns(longer, longest, margin_ns, cycle_ns):
                steps += 1
                found = _least_starts(longer, [*turns, *more], longest, margin_ns, cycle_ns)
                if found and (least := bound(longer, found)):
                    ways.append((least, (longer, [*turns, *more], found)))
        for least, way in sorted(ways):
            if steps < MOST_STEPS and (best is None or least < best[0]):
                go_on(*way)

    go_on([], [], [])
    if best is None:
        return None
    return tuple(
        Stage(first, end, place, start, start + longest[first][end] + margin_ns)
        for (first, end, place), start in zip(best[1], best[2], strict=True)
    )


def _turns(
    pieces: list[_Piece], longest: Longest, margin_ns: int, cycle_ns: int
) -> Iterator[tuple[_Turn, ...]]:
    """In which turns the last stage may follow those before it on its core.

    With K turns in between, s_a + W_a + ε + K·CT ≤ s_b and s_b + W_b + ε ≤ s_a + (K + 1)·CT. No
    stage of the shortest cut waits for a cycle or more.
    """
    lengths = [longest[first][end] for first, end, _ in pieces]
    last = len(pieces) - 1
    choices = []
    for stage in (one for one in range(last) if pieces[one][2] == pieces[last][2]):
        apart = sum(lengths[stage:last])
        least = max(0, -(-(apart + lengths[last] + margin_ns) // cycle_ns) - 1)
        most = apart // cycle_ns + last - stage
        choices.append([(stage, last, number) for number in range(least, most + 1)])
    return product(*choices)


def _least_starts(
    pieces: list[_Piece], turns: list[_Turn], longest: Longest, margin_ns: int, cycle_ns: int
) -> list[int] | None:
    """The earliest starts of the stages, None where they cannot take these turns."""
    lengths = [longest[first][end] for first, end, _ in pieces]
    after = [(stage, stage + 1, lengths[stage]) for stage in range(len(pieces) - 1)]
    for one, two, between in turns:
        after.append((one, two, lengths[one] + margin_ns + between * cycle_ns))
        after.append((two, one, lengths[two] + margin_ns - (between + 1) * cycle_ns))
    starts = [0, *accumulate(lengths[:-1])]
    for _ in range(len(pieces) + 1):
        before = list(starts)
        for one, two, apart in after:
            starts[two] = max(starts[two], starts[one] + apart)
        if starts[0] > 0:
            return None
        if starts == before:
            return starts
    return None


def opened_early(
    stages: Sequence[Stage],
    steps_ns: NDArray[np.int64],
    margin_ns: int,
    cycle_ns: int,
    room_ns: int = 0,
) -> tuple[Stage, ...]:
    """The same stages in slots that open as soon as the first data may come, and close earlier. The
    last slot leaves ``room_ns`` of its core to the publication, where it can.
    """
    opened = list(stages)
    arrives = np.zeros(len(steps_ns), dtype=np.int64)
    for number, stage in enumerate(stages):
        took = steps_ns[:, stage.first : stage.end].sum(axis=1)
        others = [one for one in opened if one is not stage and one.place == stage.place]
        free = (stage.opens_ns - (stage.opens_ns - one.closes_ns) % cycle_ns for one in others)
        room = room_ns if stage is stages[-1] else 0
        within_a_cycle = int((arrives + took).max()) + margin_ns + room - cycle_ns
        early = min(stage.opens_ns, max(int(arrives.min()), within_a_cycle))
        opens = max(early, *free, 0)
        arrives = np.maximum(arrives, opens) + took
        closes = int(arrives.max()) + margin_ns
        opened[number] = replace(stage, opens_ns=opens, closes_ns=closes)
    return tuple(opened)


@wrong_values_refused(Plan)
def pipelined(
    plan: Plan,
    nodes: Sequence[str],
    steps_ns: NDArray[np.int64],
    core_of: Mapping[str, int],
    cores: Sequence[int] | None = None,
) -> Plan:
    """A shaped plan's chain in stages, on these cores (default: those of ``core_of``).

    ``nodes`` are those of the chain's callbacks, in order; ``steps_ns`` has a row per instance and
    a column per callback. A core that is named twice has two stages at a time, of which the first
    has the better priority: right where callbacks wait for something rather than compute.
    OperationError: no cut fits; the message names what prevents it.
    """
    before = list(dict.fromkeys(core_of[node] for node in nodes))
    # In the order of the chain, so that nodes stay where they are, if that can be.
    cores = sorted(cores or before, key=lambda one: (*before, one).index(one))
    margin, cycle, node = plan.margin.epsilon_ns, plan.cycle_ns, plan.shaping_node
    if node is None:
        raise InputError("a pipeline needs a shaping node: plan with --publication synchronous")
    longest, cuts = _longest(steps_ns), _cuts(nodes)
    _refuse_too_long(longest, cuts, nodes, margin, cycle)
    stages = shortest_cut(longest, cuts, margin, cycle, len(cores))
    if stages is None:
        raise OperationError(_no_room(longest, cuts, margin, cycle, cores))
    ((start, end),) = publish_slots(plan)
    length = end - start
    stages = opened_early(stages, steps_ns, margin, cycle, length + node.pause_ns)
    opens = stages[-1].closes_ns
    if opens % cycle + length > cycle:  # a publish slot does not wrap
        opens = -(-opens // cycle) * cycle
    servers = []
    for number, stage in enumerate(stages, start=1):
        core, slots = cores[stage.place], in_cycle(stage.opens_ns, stage.closes_ns, cycle)
        urgency = CHAIN_PRIORITY + cores[: stage.place].count(core)
        own = dict.fromkeys(nodes[stage.first : stage.end])
        servers.append(server_for(own, f"stage{number}", core, urgency, slots))
    slots = in_cycle(opens, opens + length, cycle)
    servers.append(server_for([node.thread.node], "output", core, OUTPUT_PRIORITY, slots))
    return revised(
        plan,
        policy="pipelined",
        servers=tuple(servers),
        shaping_node=node.model_copy(update={"core": core}),
        predicted=in_one_slot((opens, opens + length)),
    )


def stage_places(
    nodes: Sequence[str], steps_ns: NDArray[np.int64], cycle_ns: int, cores: int
) -> dict[str, int]:
    """On which of so many cores to measure nodes: on that of their stage, by the medians, without a
    margin. Where no cut fits, the fullest stage has as little to do as can be.
    """
    usual, cuts = _longest(np.median(steps_ns, axis=0, keepdims=True)), _cuts(nodes)
    cycles = (cycle_ns * tenths // 10 for tenths in count(10))
    tried = (shortest_cut(usual, cuts, 0, cycle, cores) for cycle in cycles)
    stages = next(found for found in tried if found)
    return {node: one.place for one in stages for node in nodes[one.first : one.end]}


def _longest(steps_ns: NDArray[np.floating | np.integer]) -> Longest:
    totals = np.pad(steps_ns.cumsum(axis=1), ((0, 0), (1, 0))).T
    return [[int((until - since).max()) for until in totals] for since in totals]


def _cuts(nodes: Sequence[str]) -> list[int]:
    """Where stages may begin and end: a node's thread is in one stage."""
    places = range(len(nodes) + 1)
    return [place for place in places if set(nodes[:place]).isdisjoint(nodes[place:])]


def _refuse_too_long(
    longest: Longest, cuts: Sequence[int], nodes: Sequence[str], margin_ns: int, cycle_ns: int
) -> None:
    """What cannot be cut has to fit into a cycle."""
    for first, end in pairwise(cuts):
        needed = longest[first][end] + margin_ns
        if needed > cycle_ns:
            several = ", ".join(dict.fromkeys(nodes[first:end]))
            why = "" if end == first + 1 else " together, which one thread has to run,"
            took, excess = duration_text(longest[first][end]), duration_text(needed - cycle_ns)
            reason = f"{why} takes up to {took}, with its margin {excess} longer than the cycle"
            remedy = (
                f"take a period of {duration_text(needed)}, or parts of it in nodes of their own"
            )
            raise OperationError(f"the work of {several}{reason}: {remedy}")


def _no_room(
    longest: Longest, cuts: Sequence[int], margin_ns: int, cycle_ns: int, cores: Sequence[int]
) -> str:
    named, total = ",".join(map(str, sorted(cores))), longest[0][cuts[-1]]
    most = range(len(cores) + 1, len(cuts))
    enough = next(n for n in most if shortest_cut(longest, cuts, margin_ns, cycle_ns, n))
    return (
        f"no cut of the chain fits on the cores {named}: it takes {duration_text(total)},"
        f" {total / cycle_ns:.2f} times the cycle, and a stage {duration_text(margin_ns)} more."
        f" What helps: {enough} cores (--cores {named},…), a longer period, or a smaller margin"
    )
