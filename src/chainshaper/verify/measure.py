"""Measuring a chain in a recording, and comparing the same chain in several recordings.

:func:`hop_breakdown` shows where the latency goes. A hop is a callback of the chain, with three
parts:

* *communication*, from the publication before it to its start: transport, and waiting for its
  executor;
* *computation*, from its start to its publication, without the waiting: execution and pre-emption;
* *waiting*: for another callback of the node that publishes for it (a synchroniser that waits for
  its other input, a timer that publishes a stored message), for a slot in a gate, or for the thread
  of an asynchronous publisher.

Over a complete traversal the three add up to the latency, so their mean shares add up to 1.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import polars as pl

from chainshaper.analysis import (
    LatencyAnalysis,
    analyse_latency,
    enumerate_chains,
    graph_of,
    recorded_flow,
)
from chainshaper.analysis.chains import chain_until
from chainshaper.analysis.flow import DataFlow, left_when_taken
from chainshaper.analysis.graph import with_possible_hand_overs
from chainshaper.analysis.latency import summary
from chainshaper.planning import ChainPlan, Plan
from chainshaper.planning.chain_plan import publisher_servers
from chainshaper.planning.plan import declared_in, plan_of_chain
from chainshaper.planning.plan_file import plan_in
from chainshaper.sources import open_source, with_declared
from chainshaper.values import events
from chainshaper.values.application import Chain
from chainshaper.values.durations import duration_text, milliseconds
from chainshaper.values.errors import InputError, shown
from chainshaper.values.notebook import notebook_html
from chainshaper.values.recording import Recording
from chainshaper.verify.ages import JudgedAge, judge_age
from chainshaper.verify.overruns import (
    OverrunOutcome,
    dropped_in,
    gate_releases,
    into_open_slots,
    outcomes_in,
    overruns_in,
)
from chainshaper.verify.predictions import JudgedPrediction, due_of, judge_prediction

MOST_PROPOSED = 3  # chains that a message proposes


@dataclass(frozen=True)
class LeftOut:
    """How much of a recording is left out, because the plan was not in force then."""

    before_ns: int = 0  # before the plan came into force
    after_ns: int = 0  # after its release

    @property
    def text(self) -> str | None:
        """The same in words; None: nothing is left out."""
        parts = []
        if before := round(self.before_ns, -6):
            parts.append(f"the first {duration_text(before)}, before the plan came into force")
        if after := round(self.after_ns, -6):
            parts.append(f"the last {duration_text(after)}, after it was released")
        return f"left out: {' and '.join(parts)}" if parts else None


@dataclass(frozen=True)
class Measurement:
    """A chain in a recording, measured over the time in which the plan was in force."""

    recording: Recording
    analysis: LatencyAnalysis
    longest_stall_ns: int | None  # of the machine; None: it was not watched
    overruns: dict[str, int] | None
    """Number of outputs that came too late for their publish slot, by policy; None: no gate."""
    outcomes: dict[str, OverrunOutcome]  # what became of overruns, and of the next cycles
    into_open_slots: int | None  # number of outputs that came when their slot had opened already
    dropped: dict[str, int] | None  # number of messages lost at a gate, by reason; None: no gate
    plan: ChainPlan | None  # in force
    # The plan's, beside this measurement; of a chain through a loop, of its output before the loop.
    prediction: JudgedPrediction | None
    left_out: LeftOut  # of the recording
    age: JudgedAge | None = None  # of the data of the plan's loop; None: the plan has no loop
    flow: DataFlow | None = None  # of the recording, where the caller wanted to keep it

    def __repr__(self) -> str:
        about = f"{self.analysis.chain.spec}: {self.analysis.statistics.text}"
        return shown(f"Measurement({self.recording.path.name}: {about})")

    _repr_html_ = notebook_html


@dataclass(frozen=True)
class Comparison:
    """The same chain in several recordings, usually before and after shaping."""

    chain: str
    measurements: tuple[Measurement, ...]

    def __repr__(self) -> str:
        jitters = []
        for measurement in self.measurements:
            jitter_ns = measurement.analysis.undisturbed.jitter_ns
            jitter = "no cycle" if jitter_ns is None else f"{milliseconds(jitter_ns)} ms"
            jitters.append(f"{jitter} ({measurement.recording.path.name})")
        return shown(f"Comparison({self.chain}: undisturbed jitter {' → '.join(jitters)})")

    _repr_html_ = notebook_html

    @property
    def remark(self) -> str | None:
        """A warning that the chain has different periods in the recordings; None: it has not."""
        periods = {
            measurement.recording.path.name: measurement.analysis.period_ns
            for measurement in self.measurements
        }
        if len({*periods.values()} - {None}) < 2:
            return None
        starts = ", ".join(
            f"every {duration_text(period)} in {name}" for name, period in periods.items() if period
        )
        return f"{self.chain} starts {starts}: these are different applications"


class SeveralChainsError(InputError):
    """No chain was named, and the recording does not have exactly one."""


def chain_of(recording: Recording, chain: str | None, flow: DataFlow | None = None) -> str:
    """The text of the chain: ``chain``, or the one that the recording names, or its only one.

    ``flow`` is the recording's data flow, if it has been resolved already. Raises
    SeveralChainsError: no chain was named, and the recording has several, or none.
    """
    named = chain or recording.info.chain
    if named is not None:
        return named
    flow = flow or recorded_flow(recording)
    enumeration = enumerate_chains(graph_of(flow), limit=MOST_PROPOSED)
    if enumeration.complete and len(enumeration.chains) == 1:
        return enumeration.chains[0].spec
    known = " or ".join(f"--chain {proposed.spec}" for proposed in enumeration.chains)
    more = "" if enumeration.complete else ", or others (`chainshaper chains`)"
    raise SeveralChainsError(
        f"{recording.path} names no chain of interest: "
        + (f"add {known}{more}" if known else "and no chain is in it, see `chainshaper graph`")
    )


def taken_chain(recording: Recording, chain: str | None, spec: str) -> tuple[str, ...]:
    """A note that ``spec`` was taken because it is the only chain; () if a chain was named."""
    if chain is not None or recording.info.chain is not None:
        return ()
    return (f"no --chain was given: {spec} is the only chain in {recording.path}.",)


def measure_latency(
    recording: Recording | str | Path,
    chain: str | None = None,
    plan: Plan | None = None,
    flow: DataFlow | None = None,
) -> Measurement:
    """Measure the end-to-end latency of a chain in a recording.

    ``plan`` is the plan in force, for a recording without it; ``flow`` is the recording's data
    flow, if it has been resolved already.
    """
    return _measured(opened(recording), (chain,), plan, flow)[0]


def _declaring(flow: DataFlow, plan: Plan | None) -> DataFlow:
    """Add what is declared in a plan, as far as it can be in the recording."""
    declared = () if plan is None else declared_in(plan)
    missing = tuple(pair for pair in declared if pair not in flow.through)
    possible, _ = with_possible_hand_overs(replace(flow, through=missing))
    return replace(flow, through=(*flow.through, *possible.through))


def opened(recording: Recording | str | Path) -> Recording:
    """The recording itself, or the one at a path."""
    return recording if isinstance(recording, Recording) else open_source(recording)


def _plan_of(recording: Recording, plan: Plan | None) -> Plan | None:
    """The plan in force: the given one, or else that in the recording."""
    if plan is not None:
        return plan
    known = recording.info.plan
    return None if known is None else plan_in(known, f"{recording.path}, its plan in force")


def _measured(
    recording: Recording,
    chains: Sequence[str | None],
    plan: Plan | None,
    flow: DataFlow | None = None,
    *,
    declaring: Plan | None = None,
    with_flow: bool = False,
) -> list[Measurement]:
    """Measure several chains in a recording; its events are resolved once.

    Keep what they were resolved to in the measurements if ``with_flow``, and all was measured.
    """
    joint, info = _plan_of(recording, plan), recording.info
    due = [] if joint is None else [due for planned in joint.chains for due in due_of(planned)]
    spell, left_out = _in_force(recording)
    flow = _declaring(flow or recorded_flow(recording), joint or declaring)
    recording = with_declared(recording, flow.through)
    kept = flow if with_flow and spell is None else None
    if (
        gated := [planned for planned in joint.chains if any(publisher_servers(planned))]
        if joint
        else []
    ):
        flow = left_when_taken(flow, [planned.chain.output for planned in gated])
    if spell is not None:
        recording = replace(recording, events=events.happened(recording.events, *spell))
    measurements = []
    for chain in chains:
        spec = chain_of(recording, chain, flow)
        begun = _in_front(spec, joint)
        measured = analyse_latency(flow, begun, due=due, between=spell, pauses=info.pauses_ns)
        notes = (*taken_chain(recording, chain, spec), *info.notes, *measured.notes)
        analysis = replace(measured, notes=notes)
        output = analysis.chain.topics[-1]
        own_plan = None if joint is None else plan_of_chain(joint, output)
        through_loop = None if joint is None else _through_loop(joint, analysis)
        own_plan = through_loop or own_plan
        planned_for = own_plan is not None and own_plan.chain.output in (None, output)
        if own_plan is not None and planned_for:
            _refuse_other_period(own_plan, analysis, recording)
        decided = gate_releases(recording, own_plan, analysis)
        # The plan is of the chain before its loop, the age of the data of the chain through it.
        shaped, whole = analysis, None
        if own_plan is not None and own_plan.loop is not None:
            traversed = partial(
                analyse_latency, flow, due=due, between=spell, pauses=info.pauses_ns
            )
            if through_loop is not None:
                shaped, whole = traversed(_before_loop(analysis, own_plan)), analysis
            elif own_plan.loop.chain is not None and planned_for:
                with suppress(InputError):  # the loop was not seen in this recording
                    whole = traversed(_in_front(own_plan.loop.chain, joint))
        measurements.append(
            Measurement(
                recording=recording,
                analysis=analysis,
                longest_stall_ns=longest_stall(recording),
                overruns=overruns_in(recording, own_plan, analysis, decided),
                outcomes=outcomes_in(analysis, own_plan),
                into_open_slots=into_open_slots(decided),
                dropped=dropped_in(decided),
                plan=own_plan,
                prediction=judge_prediction(own_plan, shaped)
                if own_plan and (planned_for or through_loop)
                else None,
                left_out=left_out,
                age=_judged_age(own_plan, whole, recording),
                flow=kept,
            )
        )
    return measurements


def _through_loop(plan: Plan, analysis: LatencyAnalysis) -> ChainPlan | None:
    """Return the plan of the output that a chain has before the loop it goes through, if any."""
    topics = analysis.chain.topics[:-1]
    for planned in plan.chains:
        if planned.loop is not None and planned.chain.output in topics:
            return planned
    return None


def _before_loop(analysis: LatencyAnalysis, plan: ChainPlan) -> Chain:
    """Return the part of a chain that its plan is for: up to the output that the loop reads."""
    hops = analysis.chain.topics.index(plan.chain.output or "") + 1
    return chain_until(analysis.graph, analysis.chain, hops)


def _judged_age(
    plan: ChainPlan | None, whole: LatencyAnalysis | None, recording: Recording
) -> JudgedAge | None:
    """Judge the age of the data of a plan's loop; None: there is no such loop."""
    if plan is None or plan.loop is None or whole is None or whole.data_age is None:
        return None
    return judge_age(whole.chain.spec, plan.loop, whole.data_age, recording.events)


def _refuse_other_period(plan: ChainPlan, analysis: LatencyAnalysis, recording: Recording) -> None:
    """Refuse to judge by a plan whose cycle is no multiple of the chain's period.

    Several periods in a cycle are allowed: a source may be faster than the cycle.
    """
    period = analysis.period_ns
    if period is not None and plan.cycle_ns % period:
        raise InputError(
            f"{recording.path}: {analysis.chain.spec} starts every {duration_text(period)} there,"
            f" and the plan's cycle is {duration_text(plan.cycle_ns)}: name the plan that was in"
            " force, or plan again"
        )


def _in_front(chain: str, plan: Plan | None) -> str:
    """The text of a chain that begins in front of a shaping node of its first topic.

    A chain of one callback may have such a node, and so may the first topic under LET per callback.
    """
    first, *further = chain.split("..")
    inputs = {} if plan is None else {node.output: node.input for node in plan.shaping_nodes}
    if first not in inputs:
        return chain
    return "..".join([inputs[first], *(further or [first])])


def _in_force(recording: Recording) -> tuple[tuple[int, int | None] | None, LeftOut]:
    """When the plan was in force (None: throughout), and how much is left out."""
    spell, starts = recording.info.in_force, events.table(recording.events, "callback_start")
    if spell is None or not starts.height:
        return None, LeftOut()
    first, last = int(starts["time"][0]), int(starts["time"][-1])
    before = max(0, min(spell.since_ns, last) - first)
    after = 0 if spell.until_ns is None else max(0, last - max(spell.until_ns, first))
    within = (spell.since_ns, spell.until_ns) if before or after else None
    return within, LeftOut(before, after)


def longest_stall(recording: Recording) -> int | None:
    """The longest stall of the machine in a recording (ns); None: it was not watched."""
    if recording.info.stall_meter is None:
        return None
    stalls = events.table(recording.events, "machine_stall")
    return int(stalls["duration"].max() or 0)  # type: ignore[arg-type]


def compare_recordings(
    recordings: Sequence[Recording | str | Path],
    chain: str | None = None,
    plan: Plan | None = None,
) -> Comparison:
    """Measure the same chain in several recordings; of several chains the plan's first.

    ``plan`` was in force in the last of them, if that recording does not have the plan itself.

    Raises InputError: fewer than two recordings, or a chain that one of them does not have.
    """
    return compare_chains(recordings, chain, plan)[0]


def compare_chains(
    recordings: Sequence[Recording | str | Path],
    chain: str | None = None,
    plan: Plan | None = None,
    *,
    least: int = 2,
    progress: Callable[[float, str], None] = lambda *_: None,
    with_flow: bool = False,
) -> tuple[Comparison, ...]:
    """Measure every chain of an application in ``least`` recordings or more.

    If the plan in force in the last of them has several chains, these are measured; else the chain
    that each recording names. ``chain`` selects one. ``with_flow`` keeps the recordings' data flows
    in the measurements, for what needs them too. Raises: as :func:`compare_recordings`.
    """
    if len(recordings) < least:
        raise InputError("a comparison needs two recordings, such as `compare before after`")
    opened_recordings = [opened(recording) for recording in recordings]
    joint = _plan_of(opened_recordings[-1], plan)
    chains = (
        []
        if joint is None or chain is not None
        else [planned.chain.spec for planned in joint.chains]
    )
    if len(chains) < 2:
        chains = [chain or next(iter(chains), None)]
    columns = []
    for number, recording in enumerate(opened_recordings, start=1):
        progress((number - 1) / len(opened_recordings), f"analysing {recording.path}")
        in_force = plan if number == len(opened_recordings) else None
        columns.append(_measured(recording, chains, in_force, declaring=joint, with_flow=with_flow))
    return tuple(
        Comparison(measurements[0].analysis.chain.spec, measurements)
        for measurements in zip(*columns, strict=True)
    )


PARTS = ("communication", "computation", "waiting")


def hop_breakdown(analysis: LatencyAnalysis) -> pl.DataFrame:
    """Make a frame of each hop's communication, computation and waiting, over complete traversals.

    A row per hop:

    * ``hop``: from 0.
    * ``callback_id``, ``node``; ``callback``, a short text; ``topic`` that it publishes.
    * ``count``: number of traversals.
    * ``by_sibling``: how often another callback of the node published for it.
    * ``communication_ns``, ``computation_ns``, ``waiting_ns``: structs ``{min, mean, max}`` in ns
      (null without traversals, and for the first hop's communication).
    * ``communication_share``, ``computation_share``, ``waiting_share``: of the mean latency.
    """
    path = analysis.graph.path(analysis.chain)
    complete = analysis.traversals.filter("complete")
    latency = pl.lit(complete["latency_ns"].mean(), dtype=pl.Float64)
    times = [f"{part}_ns" for part in PARTS]
    by_hop = analysis.hops.join(complete, on="traversal", how="semi").group_by("hop")
    figures = by_hop.agg(
        *(summary(pl.col(name)).alias(name) for name in times),
        count=pl.len(),
        by_sibling=(pl.col("via") == "sibling").sum(),
    )
    rows = pl.DataFrame(
        {
            "hop": range(len(path)),
            "callback_id": analysis.chain.callbacks,
            "node": [callback.node for callback in path],
            "callback": [analysis.graph.label(callback) for callback in path],
            "topic": analysis.chain.topics,
        },
        schema_overrides={"hop": pl.UInt8, "callback_id": pl.UInt32},
    )
    means = (pl.col(name).struct.field("mean") for name in times)
    return rows.join(figures, on="hop", how="left", maintain_order="left").select(
        *rows.columns,
        pl.col("count", "by_sibling").fill_null(0),
        *times,
        *((mean / latency).alias(f"{part}_share") for part, mean in zip(PARTS, means, strict=True)),
    )


def cycle_parts(analysis: LatencyAnalysis) -> pl.DataFrame:
    """Make a frame of the parts of each hop in each complete traversal; they sum to the latency.

    Sorted by traversal and hop:

    * ``traversal``, ``hop`` (from 0).
    * ``communication_ns``, ``computation_ns``, ``waiting_ns``: 0 where there is no such part.
    """
    complete = analysis.traversals.filter("complete")
    parts = analysis.hops.join(complete, on="traversal", how="semi").select(
        "traversal", "hop", *(pl.col(f"{part}_ns").fill_null(0) for part in PARTS)
    )
    return parts.sort("traversal", "hop")


def hop_names(analysis: LatencyAnalysis) -> list[str]:
    """Name each hop by its node, and its topic where the chain meets the node several times."""
    path = analysis.graph.path(analysis.chain)
    met = Counter(callback.node for callback in path)
    return [
        callback.node if met[callback.node] == 1 else f"{callback.node} → {topic}"
        for callback, topic in zip(path, analysis.chain.topics, strict=True)
    ]


def part_shares(frame: pl.DataFrame) -> dict[str, float | None]:
    """Sum the parts' shares of the mean latency over all hops; None without traversals."""
    shares = {part: frame[f"{part}_share"].drop_nulls() for part in PARTS}
    return {
        part: float(of_hops.sum()) if len(of_hops) else None for part, of_hops in shares.items()
    }
