"""What a description is made from: a recording, and what its analyses say."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import polars as pl

from chainshaper.analysis import DataFlow, graph_of, recorded_flow
from chainshaper.analysis.chains import find_chain
from chainshaper.analysis.occupation import (
    Occupation,
    deliveries,
    occupation,
    publication_that_counts,
    taken_first,
)
from chainshaper.flow.exploration import list_chains
from chainshaper.flow.recorded_description.timers import blocker_of
from chainshaper.values import events
from chainshaper.values.application import (
    INTERNAL_TOPICS,
    LOOP_ENDS,
    ApplicationGraph,
    Callback,
    Chain,
)
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording


@dataclass(frozen=True)
class Evidence:
    """What a description is made from."""

    recording: Recording
    flow: DataFlow
    graph: ApplicationGraph
    chain: Chain
    callbacks: Mapping[int, Callback]  # by id
    occupation: Occupation
    hops: pl.DataFrame  # as of :func:`~chainshaper.analysis.occupation.deliveries`
    first: Mapping[tuple[int, int], int]  # as of :func:`~.occupation.taken_first`
    origin: int  # the callback with which cycles begin
    start_ns: int  # when the first cycle starts, from which all sequences count
    notes: list[str] = field(default_factory=list)  # which come up on the way

    def instances(self, callbacks: Iterable[int]) -> pl.DataFrame:
        """Return the instances of some callbacks, from the first cycle on."""
        chosen = pl.col("callback_id").is_in([*callbacks]) & (pl.col("start") >= self.start_ns)
        return self.occupation.instances.filter(chosen)


def own_topics(callback: Callback) -> list[str]:
    """Return the topics that a callback publishes itself; the end of a loop's instance is none."""
    ends = {callback.node + ending for ending in LOOP_ENDS}
    left_out = INTERNAL_TOPICS | {*callback.passes_on, *ends}
    return [topic for topic in callback.publishes if topic not in left_out]


def evidence_of(recording: Recording, chain: str | None) -> Evidence:
    """Return what a recording's description is made from.

    ``chain`` defaults to the recording's own, else the heaviest. Raises InputError: there is none.
    """
    flow = recorded_flow(recording)
    graph, heaviest = graph_of(flow), list_chains(flow).heaviest
    if heaviest is None:
        raise InputError(f"{recording.path}: no chain is in it, see `chainshaper graph`")
    path = find_chain(graph, chain or recording.info.chain or heaviest.spec)
    counting = publication_that_counts(flow, frozenset(path.topics))
    occupied = occupation(flow, recording.info, counting)
    callbacks = {callback.id: callback for callback in graph.callbacks}
    origin, starts = _beginning(graph, path, occupied)
    begun = starts.filter(pl.col("start") >= occupied.settled_ns)
    origin = int(begun["callback_id"][0]) if len(begun) else origin
    start_ns = int(begun["start"][0]) if len(begun) else 0
    blocker = blocker_of(callbacks, occupied, begun.filter(callback_id=origin))
    if blocker is not None and callbacks[blocker].period_ns == callbacks[origin].period_ns:
        before = occupied.instances.filter(pl.col("start") < start_ns, callback_id=blocker)
        if len(before):
            origin, start_ns = blocker, int(before["start"][-1])
    evidence = Evidence(
        recording=recording,
        flow=flow,
        graph=graph,
        chain=path,
        callbacks=callbacks,
        occupation=occupied,
        hops=deliveries(flow, occupied),
        first=taken_first(flow, occupied),
        origin=origin,
        start_ns=start_ns,
    )
    _note_limits(evidence, starts=len(starts), begun=len(begun))
    return evidence


def _beginning(
    graph: ApplicationGraph, chain: Chain, occupied: Occupation
) -> tuple[int, pl.DataFrame]:
    """Return the chain's first callback, and instances with which cycles can begin, by start.

    They are those of the chain's first callback, if it is a timer's, else those of all timers.
    """
    timers = [callback.id for callback in graph.callbacks if callback.kind == "timer"]
    origin = chain.callbacks[0]
    beginning = [origin] if origin in timers or not timers else timers
    starts = occupied.instances.filter(pl.col("callback_id").is_in(beginning)).sort("start")
    return origin, starts


def _note_limits(evidence: Evidence, *, starts: int, begun: int) -> None:
    """Note what the recording does not show; of ``starts`` cycles, ``begun`` are described."""
    text = (
        "Execution times are response times, without those of callbacks that were seen to pre-empt"
        " them on their core: "
    )
    others = evidence.occupation.others
    if others is None:
        text += "CPU times are not in the recording (no sched_switch, no CPU clock)."
    else:
        text += (
            f"in {100 * others:.1f} % of them interrupts, threads without callbacks or"
            " the machine had the core."
        )
    evidence.notes.append(text)
    if evidence.flow.instances["assumed"].any():
        evidence.notes.append(
            "Some callbacks have no events of their own (Python nodes, threads that publish): they"
            " last until they publish, as far as the description knows."
        )
    if begun < starts:
        evidence.notes.append(
            "Cycles before all threads were on their cores are left out:"
            f" {starts - begun} of {starts}."
        )
    gates = events.table(evidence.recording.events, "gate_release")
    if len(gates):
        evidence.notes.append(
            "The recording is of a shaped application: a shaping node is described as one that"
            " computes while it holds a message. Describe a recording without it."
        )
