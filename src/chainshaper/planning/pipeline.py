"""A chain longer than its period, L̄ > CT, as a pipeline (left open in section 3.1 of the paper).

The chain is cut between nodes into stages (:mod:`~chainshaper.planning.stages`), each in a server
of its own, shorter than the cycle. While stage 2 works on one instance, stage 1 works on the next.
The output leaves once a cycle, in order, when the slowest instance would be through: at a constant
latency of several cycles, as the shaping node sees by the stamp.

**What a callback takes** is counted from the message before it to its own, without the time for
which other instances of the chain had its core. So a recording in which instances piled up on one
core tells the same as one in which nothing overlapped, where an instance's times sum up to its
latency; and what took long together stays together, as L̄ has it.
"""

from collections.abc import Mapping, Sequence
from itertools import count, pairwise

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.plan import Plan, Prediction, Server, Slot, Thread, publish_slots, revised
from chainshaper.planning.shaping import CHAIN_PRIORITY, OUTPUT_PRIORITY
from chainshaper.planning.stages import Longest, opened_early, shortest_cut
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.yaml_file import wrong_values_refused


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

    Raises InputError: a plan without a shaping node. OperationError: no cut fits; the message names
    what prevents it.
    """
    before = list(dict.fromkeys(core_of[node] for node in nodes))
    # In the order of the chain, so that nodes stay where they are, if that can be.
    cores = sorted(cores or before, key=lambda one: (*before, one).index(one))
    margin, cycle, node = plan.margin.epsilon_ns, plan.cycle_ns, plan.shaping_node
    if node is None:
        raise InputError(
            "a pipeline needs a shaping node, which sees how many cycles old an output is: plan"
            " from a recording, with --publication synchronous"
        )
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
    done = opens + length
    with wrong_values_refused(Plan):
        servers = tuple(
            Server(
                name=f"stage{number}",
                core=cores[stage.place],
                priority=CHAIN_PRIORITY + cores[: stage.place].count(cores[stage.place]),
                slots=in_cycle(stage.opens_ns, stage.closes_ns, cycle),
                threads=tuple(
                    Thread(node=n) for n in dict.fromkeys(nodes[stage.first : stage.end])
                ),
            )
            for number, stage in enumerate(stages, start=1)
        )
        output = Server(
            name="output",
            core=servers[-1].core,
            priority=OUTPUT_PRIORITY,
            slots=in_cycle(opens, done, cycle),
            threads=(node.thread,),
        )
        return revised(
            plan,
            policy="pipelined",
            servers=(*servers, output),
            shaping_node=node.model_copy(update={"core": output.core}),
            predicted=Prediction(mean_ns=done, max_ns=done, jitter_ns=length, shares=(1.0,)),
        )


def stage_cores(
    nodes: Sequence[str], steps_ns: NDArray[np.int64], cycle_ns: int, cores: Sequence[int]
) -> dict[str, int]:
    """Where to measure nodes, so that instances do not pile up: on the core of their stage, by the
    medians, without a margin. Where no cut fits, the fullest stage has as little to do as can be.
    """
    usual, cuts = _longest(np.median(steps_ns, axis=0, keepdims=True)), _cuts(nodes)
    cycles = (cycle_ns * tenths // 10 for tenths in count(10))
    tried = (shortest_cut(usual, cuts, 0, cycle, len(cores)) for cycle in cycles)
    stages = next(found for found in tried if found)
    return {node: cores[one.place] for one in stages for node in nodes[one.first : one.end]}


def _longest(steps_ns: NDArray[np.floating | np.integer]) -> Longest:
    totals = np.pad(steps_ns.cumsum(axis=1), ((0, 0), (1, 0))).T
    return [[int((until - since).max()) for until in totals] for since in totals]


def _cuts(nodes: Sequence[str]) -> list[int]:
    """Where stages may begin and end: a node's thread is in one stage."""
    places = range(len(nodes) + 1)
    return [place for place in places if set(nodes[:place]).isdisjoint(nodes[place:])]


def in_cycle(opens_ns: int, closes_ns: int, cycle_ns: int) -> tuple[Slot, ...]:
    """A slot of the chain's latency axis as it repeats every cycle: one slot, or two."""
    start = opens_ns % cycle_ns
    end = start + closes_ns - opens_ns
    return ((start, end),) if end <= cycle_ns else ((0, end - cycle_ns), (start, cycle_ns))


def _refuse_too_long(
    longest: Longest, cuts: Sequence[int], nodes: Sequence[str], margin_ns: int, cycle_ns: int
) -> None:
    """What cannot be cut has to fit into a cycle."""
    for first, end in pairwise(cuts):
        needed = longest[first][end] + margin_ns
        if needed > cycle_ns:
            several = ", ".join(dict.fromkeys(nodes[first:end]))
            why = "" if end == first + 1 else " together, which one thread has to run,"
            raise OperationError(
                f"the work of {several}{why} takes up to {format_duration(longest[first][end])},"
                f" with the margin {format_duration(margin_ns)} that is"
                f" {format_duration(needed - cycle_ns)} longer than the cycle of"
                f" {format_duration(cycle_ns)}, and no cut makes it shorter. What helps: a period"
                f" of {format_duration(needed)} or more, or parts of it in nodes of their own"
            )


def _no_room(
    longest: Longest, cuts: Sequence[int], margin_ns: int, cycle_ns: int, cores: Sequence[int]
) -> str:
    named, total = ",".join(map(str, sorted(cores))), longest[0][cuts[-1]]
    most = range(len(cores) + 1, len(cuts))
    enough = next(n for n in most if shortest_cut(longest, cuts, margin_ns, cycle_ns, n))
    return (
        f"no cut of the chain fits on the cores {named}: it takes {format_duration(total)},"
        f" {total / cycle_ns:.2f} times the cycle of {format_duration(cycle_ns)}, and each stage"
        f" {format_duration(margin_ns)} more for the margin. What helps: {enough} cores"
        f" (--cores {named},…), a longer period, or a smaller margin (--epsilon)"
    )
