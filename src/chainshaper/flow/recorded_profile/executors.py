"""Which executors run a chain and its branches, on which cores, and what else they run."""

from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain as joined

import polars as pl

from chainshaper.analysis import DataFlow, LatencyAnalysis, executors
from chainshaper.analysis.callback_groups import recorded_groups
from chainshaper.analysis.disturbance import overlapping
from chainshaper.analysis.latency import RecordedExecutor
from chainshaper.flow.recorded_profile.stages import Stage
from chainshaper.planning.profile import Interfering
from chainshaper.values.application import INTERNAL_TOPICS, ApplicationGraph
from chainshaper.values.recording import Recording


@dataclass(frozen=True)
class ChainExecutors:
    """The executors that run a chain and its branches."""

    running: Sequence[RecordedExecutor]
    # Node with several executors → those that take part, each by the names of its callbacks. Only
    # nodes whose callbacks have names of their own are in it.
    named: Mapping[str, tuple[tuple[str, ...], ...]]
    # Those of them that run one callback group → its id, as callback_isolated_executor names it.
    groups: Mapping[tuple[str, tuple[str, ...]], str]
    cores: Mapping[str, int]  # any node whose executor is bound to one core → that core
    priorities: Mapping[str, int]  # any node whose executor has a SCHED_FIFO priority → that


def executors_of_chain(
    recording: Recording, flow: DataFlow, graph: ApplicationGraph, stages: Sequence[Stage]
) -> ChainExecutors:
    """Find the executors that run some stages, with cores and priorities of all nodes'."""
    every, members = executors(flow), {number for stage in stages for number in stage.members}
    running = [executor for executor in every if not members.isdisjoint(executor.callbacks)]
    named = {}
    for node in {stage.node for stage in stages}:
        names = [
            tuple(name for owner, name in executor.names if owner == node) for executor in every
        ]
        taking_part = tuple(
            names_of_executor
            for names_of_executor, executor in zip(names, every, strict=True)
            if names_of_executor and executor in running
        )
        has_several = sum(map(bool, names)) > 1
        if taking_part and has_several and max(Counter(joined(*names)).values()) == 1:
            named[node] = taking_part
    # Of a process with several executors, the last thread counts: sorted, it is one of the chain's.
    chain_threads = {(executor.pid, tid) for executor in running for tid in executor.threads}
    threads = sorted(
        recording.info.threads, key=lambda thread: (thread.pid, thread.tid) in chain_threads
    )
    by_pid = {thread.pid: thread for thread in threads if thread.role == "executor"}
    thread_of = {node.name: by_pid[node.pid] for node in graph.nodes if node.pid in by_pid}
    return ChainExecutors(
        running=running,
        named=named,
        groups={
            (known.group.node, known.names): known.group.id
            for known in recorded_groups(flow)
            if known.certain and known.names in named.get(known.group.node, ())
        },
        cores={
            node: thread.cores[0] for node, thread in thread_of.items() if len(thread.cores) == 1
        },
        priorities={node: thread.priority for node, thread in thread_of.items() if thread.priority},
    )


def nodes_sharing_processes(
    graph: ApplicationGraph, nodes: Collection[str]
) -> tuple[tuple[str, ...], ...]:
    """Return the nodes of each process that hosts several, these ``nodes`` among them.

    They may share an executor.
    """
    hosted = defaultdict[int, list[str]](list)
    for node in graph.nodes:
        hosted[node.pid].append(node.name)
    return tuple(
        tuple(names)
        for names in hosted.values()
        if len(names) > 1 and not set(names).isdisjoint(nodes)
    )


def interfering_callbacks(
    flow: DataFlow,
    analysis: LatencyAnalysis,
    running: Sequence[RecordedExecutor],
    planned: Collection[int],
) -> tuple[Interfering, ...]:
    """Return what else the executors of a chain run while its complete traversals last."""
    cycles = analysis.traversals.filter("complete")
    start, end = (cycles[name].to_numpy() for name in ("start", "end"))
    unplanned = {number for executor in running for number in executor.callbacks}.difference(
        planned
    )
    callbacks, interfering = analysis.graph.callbacks, list[Interfering]()
    for callback in callbacks:
        if callback.id not in unplanned or callback.trigger in INTERNAL_TOPICS:
            continue
        instances = flow.instances.filter(callback_id=callback.id).drop_nulls("end")
        if not instances.height:
            continue
        began, ended = instances["start"].to_numpy(), instances["end"].to_numpy()
        share = float(overlapping(start, end, began, ended).mean())
        writers = (writer.node for writer in callbacks if callback.trigger in writer.publishes)
        interfering.append(
            Interfering(
                label=callback.label,
                origins=tuple(dict.fromkeys(writers)),
                share=share,
                longest_ns=int((ended - began).max()),
            )
        )
    return tuple(interfering)


def utilisation(
    flow: DataFlow,
    graph: ApplicationGraph,
    core_of: Mapping[str, int],
    running: Sequence[RecordedExecutor],
) -> float | None:
    """Return the largest share of a core that the executors of a chain take."""
    ran_ids = {number for executor in running for number in executor.callbacks}
    core = {
        callback.id: core_of[callback.node]
        for callback in graph.callbacks
        if callback.node in core_of and callback.id in ran_ids
    }
    ran = flow.instances.filter(pl.col("callback_id").is_in(list(core))).drop_nulls("execution_ns")
    if not ran.height:
        return None
    lasted = int(ran["end"].max()) - int(ran["start"].min())  # type: ignore[arg-type]
    of_core = ran.group_by(pl.col("callback_id").replace_strict(core))
    busy = of_core.agg(pl.col("execution_ns").sum())["execution_ns"].max()
    return float(busy) / max(1, lasted)  # type: ignore[arg-type]
