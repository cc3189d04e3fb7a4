"""How the output of a chain is published, and how it gets to those that receive it."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import polars as pl

from chainshaper.analysis import DataFlow, LatencyAnalysis, executors
from chainshaper.analysis.disturbance import overlapping, stalled_within
from chainshaper.flow.recorded_profile.times import busy_intervals
from chainshaper.planning.profile import Reception
from chainshaper.values import events
from chainshaper.values.application import ApplicationGraph, Chain
from chainshaper.values.middleware import middleware_of, thread_work
from chainshaper.values.recording import Recording


def receivers_of(graph: ApplicationGraph, chain: Chain, nodes: Collection[str]) -> tuple[str, ...]:
    """Return the nodes that subscribe to a chain's output and are not among its ``nodes``.

    Tools such as `ros2 topic echo`, which come and go, have hidden names: they are left out.
    """
    return tuple(
        node
        for node in graph.subscribers.get(chain.topics[-1], ())
        if node not in nodes and not node.rpartition("/")[2].startswith("_")
    )


def reception_of(
    flow: DataFlow,
    analysis: LatencyAnalysis,
    receivers: Sequence[str],
    core_of: Mapping[str, int],
    period_ns: int,
) -> Reception | None:
    """Return how a chain's output gets to those that receive it; None: no message did."""
    output, callbacks = analysis.chain.topics[-1], analysis.graph.callbacks
    receiving = [
        callback.id
        for callback in callbacks
        if callback.trigger == output and callback.node in receivers
    ]
    known = analysis.traversals.filter(pl.col("complete") & ~pl.col("reception_disturbed"))
    known = known.drop_nulls("received")
    if not receiving or not known.height:
        return None
    cores = {core_of.get(node) for node in receivers}
    core = cores.pop() if len(cores) == 1 else None
    on_core = [
        callback.id
        for callback in callbacks
        if core is not None and core_of.get(callback.node) == core
    ]
    ran = flow.instances.drop_nulls("end").sort("start")
    end, received = known["end"].to_numpy(), known["received"].to_numpy()
    began, ended = busy_intervals(ran.filter(pl.col("callback_id").is_in(on_core)))
    waited = stalled_within(end, received, began, ended, np.zeros_like(began))
    shortest = int((received - end).min())
    on_its_way = np.maximum(received - end - waited, shortest)
    of_executors = {
        number
        for executor in executors(flow)
        if not executor.callbacks.isdisjoint(receiving)
        for number in executor.callbacks
    }
    took = pl.coalesce("execution_ns", pl.col("end") - pl.col("start"))
    ran = ran.with_columns(took=took, cycle=pl.col("start") // period_ns)
    of_output = ran.filter(pl.col("callback_id").is_in(receiving))
    beside = ran.filter(pl.col("callback_id").is_in(list(of_executors.difference(receiving))))
    return Reception(
        core=core,
        shortest_ns=int(on_its_way.min()),
        mean_ns=round(float(on_its_way.mean())),
        longest_ns=int(on_its_way.max()),
        time_ns=_longest_in_a_cycle(of_output),
        beside_ns=_longest_in_a_cycle(beside),
        # All of them may be ready as the output comes, and be served first.
        beside_once_ns=int(beside.group_by("callback_id").agg(pl.col("took").max())["took"].sum()),
    )


def _longest_in_a_cycle(instances: pl.DataFrame) -> int:
    """Return the longest time that instances took together in one ``cycle`` (ns)."""
    together = instances.group_by("cycle").agg(pl.col("took").sum())["took"]
    return int(together.max() or 0)  # type: ignore[arg-type]


@dataclass(frozen=True)
class OutputWriter:
    """What a recording shows of the writer of a chain's output. None: it does not show it."""

    longest_publication_ns: int | None
    asynchronous: bool | None  # whether a thread of the process publishes
    intra_process: Literal[True] | None  # subscribers get the output without DDS
    output_depth: int | None  # the history depth


def writer_of(recording: Recording, flow: DataFlow, node: str, topic: str) -> OutputWriter:
    """Return what is seen of a node that writes a topic.

    No event says when a publication was over: not after the end of its callback, the next that the
    callback made, and when all subscribers had the message.
    """
    of_node, time = (pl.col("topic") == topic) & (pl.col("node") == node), pl.col("time")
    readers = flow.takes.drop_nulls("publication").group_by("publication").agg(taken=time.max())
    sent = (
        flow.publications.with_columns(following=time.shift(-1).over("instance"))
        .filter(of_node)
        .join(flow.instances.select("instance", "end").drop_nulls(), on="instance")
        .join(readers, on="publication", how="left")
        .select("time", duration=pl.min_horizontal("end", "following", "taken") - time)
    )
    handed = flow.takes.filter("intra_process").join(
        flow.publications.filter(of_node), on="publication", how="semi"
    )
    writers = flow.objects.publishers.filter(of_node).select("pid", publisher_handle="handle")
    created = events.table(flow.events, "rcl_publisher_init", ["queue_depth"])
    depths = created.join(writers, on=["pid", "publisher_handle"])["queue_depth"]
    return OutputWriter(
        longest_publication_ns=longest_calm(flow, sent),
        asynchronous=_is_asynchronous(recording, node),
        intra_process=True if handed.height else None,
        output_depth=depths.filter(depths > 0).min(),
    )


def _is_asynchronous(recording: Recording, node: str) -> bool | None:
    """Return whether a thread of the node's process publishes; None: it is not known.

    That shows where DDS threads have names; some middleware has no such threads.
    """
    threads = recording.info.threads
    pids = {thread.pid for thread in threads if thread.node == node}
    of_process = [thread for thread in threads if thread.pid in pids]
    if any(thread_work(thread.comm) is not None for thread in of_process):
        return any(thread.role == "publisher" for thread in of_process)
    middleware = middleware_of(recording.info.rmw)
    if middleware is not None and not middleware.has_publisher_threads:
        return False
    return None


def longest_send(flow: DataFlow) -> int | None:
    """Return the longest time for which an asynchronous publisher sent a message (ns)."""
    sends = events.table(flow.events, "asynchronous_send")
    return longest_calm(flow, sends.filter(pl.col("outcome") == "sent"))


def longest_calm(flow: DataFlow, lasted: pl.DataFrame) -> int | None:
    """Return the longest ``duration`` from a ``time`` on that no stall of the machine fell into.

    Where stalls fell into all, it is the longest of all.
    """
    stalls = events.table(flow.events, "machine_stall")
    began, ended = _instants(lasted)
    stalled, over = _instants(stalls)
    calm = lasted.filter(~pl.Series(overlapping(began, ended, stalled, over)))
    return (calm if calm.height else lasted)["duration"].max()  # type: ignore[return-value]


def _instants(lasted: pl.DataFrame) -> tuple[np.typing.NDArray[np.int64], ...]:
    """Return when rows with a ``time`` and a ``duration`` began, and when they ended."""
    return lasted["time"].to_numpy(), (lasted["time"] + lasted["duration"]).to_numpy()
