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
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.plan import (
    Plan,
    Prediction,
    Server,
    Slot,
    Thread,
    publish_slots,
    revised,
)
from chainshaper.planning.shaping import CHAIN_PRIORITY, OUTPUT_PRIORITY
from chainshaper.planning.stages import Longest, Stage, opened_early, shortest_cut
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
    cores = tuple(cores or ()) or tuple(sorted({core_of[node] for node in nodes}))
    margin, cycle, node = plan.margin.epsilon_ns, plan.cycle_ns, plan.shaping_node
    if node is None:
        raise InputError(
            "a pipeline needs a shaping node, which sees how many cycles old an output is: plan"
            " from a recording, with --publication synchronous"
        )
    totals = np.pad(steps_ns.cumsum(axis=1), ((0, 0), (1, 0))).T
    longest = [[int((until - since).max()) for until in totals] for since in totals]
    cuts = [
        place
        for place in range(len(nodes) + 1)  # a node's thread is in one stage
        if set(nodes[:place]).isdisjoint(nodes[place:])
    ]
    _refuse_too_long(longest, cuts, nodes, margin, cycle)
    stages = shortest_cut(longest, cuts, margin, cycle, len(cores))
    if stages is None:
        raise OperationError(_no_room(longest, cuts, margin, cycle, cores))
    ((start, end),) = publish_slots(plan)
    length = end - start
    stages = opened_early(stages, steps_ns, margin, cycle, length + node.pause_ns)
    servers = tuple(
        Server(
            name=f"stage{number}",
            core=core,
            priority=priority,
            slots=in_cycle(stage.opens_ns, stage.closes_ns, cycle),
            threads=tuple(Thread(node=n) for n in dict.fromkeys(nodes[stage.first : stage.end])),
        )
        for number, (stage, (core, priority)) in enumerate(
            zip(stages, _named_cores(stages, nodes, core_of, cores), strict=True), start=1
        )
    )
    opens = stages[-1].closes_ns
    if opens % cycle + length > cycle:  # a publish slot does not wrap
        opens = -(-opens // cycle) * cycle
    slot = (opens % cycle, opens % cycle + length)
    # On the last stage's core, unless another stage is there at that moment and not elsewhere.
    candidates = dict.fromkeys([servers[-1].core, *cores])
    core = next((one for one in candidates if _free(servers, one, slot)), servers[-1].core)
    output = Server(
        name="output", core=core, priority=OUTPUT_PRIORITY, slots=(slot,), threads=(node.thread,)
    )
    with wrong_values_refused(Plan):
        return revised(
            plan,
            policy="pipelined",
            servers=(*servers, output),
            shaping_node=node.model_copy(update={"core": core}),
            predicted=Prediction(
                mean_ns=opens + length, max_ns=opens + length, jitter_ns=length, shares=(1.0,)
            ),
        )


def in_cycle(opens_ns: int, closes_ns: int, cycle_ns: int) -> tuple[Slot, ...]:
    """A slot of the chain's latency axis as it repeats every cycle: one slot, or two."""
    start = opens_ns % cycle_ns
    end = start + closes_ns - opens_ns
    return ((start, end),) if end <= cycle_ns else ((0, end - cycle_ns), (start, cycle_ns))


def _free(servers: Sequence[Server], core: int, slot: Slot) -> bool:
    taken = (one for server in servers if server.core == core for one in server.slots)
    return all(slot[1] <= start or end <= slot[0] for start, end in taken)


def _named_cores(
    stages: Sequence[Stage],
    nodes: Sequence[str],
    core_of: Mapping[str, int],
    cores: Sequence[int],
) -> list[tuple[int, int]]:
    """Core and priority of each stage: a place has the core that most of its callbacks ran on."""
    free, chosen = list(range(len(cores))), dict[int, int]()
    for place in dict.fromkeys(stage.place for stage in stages):
        own = [one for s in stages if s.place == place for one in nodes[s.first : s.end]]
        before = [core_of.get(one) for one in own]
        chosen[place] = max(free, key=lambda number: before.count(cores[number]))
        free.remove(chosen[place])
    numbers = [chosen[stage.place] for stage in stages]
    return [(cores[n], CHAIN_PRIORITY + cores[:n].count(cores[n])) for n in numbers]


def _refuse_too_long(
    longest: Longest, cuts: Sequence[int], nodes: Sequence[str], margin_ns: int, cycle_ns: int
) -> None:
    """What cannot be cut has to fit into a cycle."""
    for first, end in pairwise(cuts):
        if (needed := longest[first][end] + margin_ns) > cycle_ns:
            one = f"the callback of {nodes[first]}"
            several = f"the callbacks of {', '.join(dict.fromkeys(nodes[first:end]))} together"
            why = "" if end == first + 1 else ", which one thread has to run,"
            raise OperationError(
                f"{several if why else one}{why} take up to"
                f" {format_duration(longest[first][end])}, which with the margin"
                f" {format_duration(margin_ns)} is {format_duration(needed - cycle_ns)} longer than"
                f" the cycle of {format_duration(cycle_ns)}: no cut makes that shorter. What helps:"
                f" a period of {format_duration(needed)} or more, or to divide this work between"
                " nodes with a topic between them"
            )


def _no_room(
    longest: Longest, cuts: Sequence[int], margin_ns: int, cycle_ns: int, cores: Sequence[int]
) -> str:
    named, total = ",".join(map(str, cores)), longest[0][cuts[-1]]
    most = range(len(cores) + 1, len(cuts))
    cut = (shortest_cut(longest, cuts, margin_ns, cycle_ns, places) for places in most)
    stages = next(filter(None, cut), ())
    further = len({stage.place for stage in stages}) - len(cores)
    then = "" if not stages else f", {format_duration(stages[-1].closes_ns)} long then"
    return (
        f"no cut of the chain fits on the cores {named}: it takes {format_duration(total)},"
        f" {total / cycle_ns:.2f} times the cycle of {format_duration(cycle_ns)}, and each stage"
        f" {format_duration(margin_ns)} more for the margin. What helps: {further} more"
        f" {'core' if further == 1 else 'cores'} (--cores {named},…{then}), a longer period, or a"
        " smaller margin (--epsilon)"
    )
