"""Measuring a chain in a recording, and comparing the same chain in several recordings.

:func:`hop_breakdown` says where the latency goes. A hop is a callback of the chain. Its
*communication* is the time from the publication before it to its own start: transport, and waiting
for its executor. Its *computation* is the time from its start to its publication: execution and
pre-emption; without its *waiting*: for another callback of the node that publishes for it (a
synchroniser that waits for its other input, a timer that publishes what was stored for it), in a
gate for its slot, or for the thread of an asynchronous publisher. Over a complete traversal the
three add up to the latency, so mean shares add up to one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import polars as pl

from chainshaper.analysis import (
    LatencyAnalysis,
    analyse_latency,
    enumerate_chains,
    graph_of,
    recorded_flow,
)
from chainshaper.analysis.flow import DataFlow, left_when_taken
from chainshaper.analysis.latency import summary
from chainshaper.planning import ChainPlan, Plan
from chainshaper.planning.chain_plan import publisher_servers
from chainshaper.planning.plan import plan_of_chain
from chainshaper.planning.plan_file import plan_in
from chainshaper.sources import open_source
from chainshaper.values import events
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording
from chainshaper.verify.overruns import (
    Outcome,
    dropped_in,
    gate_releases,
    into_open_slots,
    outcomes_in,
    overruns_in,
)
from chainshaper.verify.predictions import JudgedPrediction, due_of, judge_prediction

MOST_PROPOSED = 3  # chains, to who names none


@dataclass(frozen=True)
class LeftOut:
    """What was recorded before the plan came into force, and after its release (ns)."""

    before_ns: int = 0
    after_ns: int = 0

    @property
    def text(self) -> str | None:
        """In words; None where it is nothing."""
        before, after = (round(lasted, -6) for lasted in (self.before_ns, self.after_ns))
        parts = [f"the first {duration_text(before)}, before the plan came into force"] * bool(
            before
        )
        parts += [f"the last {duration_text(after)}, after it was released"] * bool(after)
        return f"left out: {' and '.join(parts)}" if parts else None


@dataclass(frozen=True)
class Measurement:
    """A recording with its chain's latency analysis, of the time in which the plan was in force.

    ``longest_stall_ns`` is the machine's own (None: it was not watched), ``overruns`` counts
    outputs that came too late for their publish slot, per policy (None: nothing was gated),
    ``outcomes`` says what became of those of the chain, and of the cycles behind them,
    ``into_open_slots`` those that came in time, but too late to wait until their slot's start,
    ``dropped`` messages that were lost at a gate, per reason (None: no gate decided). ``plan`` is
    the plan in force, ``prediction`` its own beside this measurement; ``left_out`` names the rest.
    """

    recording: Recording
    analysis: LatencyAnalysis
    longest_stall_ns: int | None
    overruns: dict[str, int] | None
    outcomes: dict[str, Outcome]
    into_open_slots: int | None
    dropped: dict[str, int] | None
    plan: ChainPlan | None
    prediction: JudgedPrediction | None
    left_out: LeftOut


@dataclass(frozen=True)
class Comparison:
    """The same chain in several recordings, usually before and after shaping."""

    chain: str
    measurements: tuple[Measurement, ...]

    @property
    def remark(self) -> str | None:
        """What makes its recordings hard to compare: other periods; None: nothing does."""
        periods = {one.recording.path.name: one.analysis.period_ns for one in self.measurements}
        if len({*periods.values()} - {None}) < 2:
            return None
        found = ", ".join(
            f"every {duration_text(period)} in {name}" for name, period in periods.items() if period
        )
        return f"{self.chain} starts {found}: these are different applications"


class SeveralChainsError(InputError):
    """No chain was named, and the recording has several, or none."""


def chain_of(recording: Recording, chain: str | None, flow: DataFlow | None = None) -> str:
    """The chain that was asked for, that the recording itself names, or the only one in it.

    ``flow`` is the recording's data flow, where that has been resolved already. Raises
    SeveralChainsError: none was asked for or named, and it has several, or none.
    """
    named = chain or recording.info.chain
    if named is not None:
        return named
    flow = flow or recorded_flow(recording)
    found = enumerate_chains(graph_of(flow), limit=MOST_PROPOSED)
    if found.complete and len(found.chains) == 1:
        return found.chains[0].spec
    known = " or ".join(f"--chain {one.spec}" for one in found.chains)
    more = "" if found.complete else ", or others (`chainshaper chains`)"
    raise SeveralChainsError(
        f"{recording.path} names no chain of interest: "
        + (f"add {known}{more}" if known else "and no chain is in it, see `chainshaper graph`")
    )


def taken_chain(recording: Recording, chain: str | None, spec: str) -> tuple[str, ...]:
    """A note that ``spec`` was taken since it is the only chain; none where one was named."""
    if chain is not None or recording.info.chain is not None:
        return ()
    return (f"no --chain was given: {spec} is the only chain in {recording.path}.",)


def measure_latency(
    recording: Recording | str | Path,
    chain: str | None = None,
    plan: Plan | None = None,
    flow: DataFlow | None = None,
) -> Measurement:
    """Analyse the end-to-end latency of one chain in a recording.

    ``plan`` is the plan in force, for recordings that do not know it themselves; ``flow`` the
    recording's data flow, where that has been resolved already.
    """
    return _measured(opened(recording), (chain,), plan, flow)[0]


def opened(recording: Recording | str | Path) -> Recording:
    """A recording as it is, or opened where it lies."""
    return recording if isinstance(recording, Recording) else open_source(recording)


def _plan_of(recording: Recording, plan: Plan | None) -> Plan | None:
    """The plan in force: the given one, or that of the recording."""
    if plan is not None:
        return plan
    known = recording.info.plan
    return None if known is None else plan_in(known, f"{recording.path}, its plan in force")


def _measured(
    recording: Recording,
    chains: Sequence[str | None],
    plan: Plan | None,
    flow: DataFlow | None = None,
) -> list[Measurement]:
    """The measurements of several chains in one recording, whose events are resolved once."""
    joint, info = _plan_of(recording, plan), recording.info
    due = [] if joint is None else [due for one in joint.chains for due in due_of(one)]
    spell, left_out = _in_force(recording)
    flow = flow or recorded_flow(recording)
    if gated := [one for one in joint.chains if any(publisher_servers(one))] if joint else []:
        flow = left_when_taken(flow, [one.chain.output for one in gated])
    if spell is not None:
        recording = replace(recording, events=events.happened(recording.events, *spell))
    measurements = []
    for chain in chains:
        spec = chain_of(recording, chain, flow)
        begun = _in_front(spec, joint)
        found = analyse_latency(flow, begun, due=due, between=spell)
        notes = (*taken_chain(recording, chain, spec), *info.notes, *found.notes)
        analysis = replace(found, notes=notes)
        output = analysis.chain.topics[-1]
        own = None if joint is None else plan_of_chain(joint, output)
        planned_for = own is not None and own.chain.output in (None, output)
        if own is not None and planned_for:
            _refuse_other_period(own, analysis, recording)
        decided = gate_releases(recording, own, analysis)
        measurements.append(
            Measurement(
                recording=recording,
                analysis=analysis,
                longest_stall_ns=longest_stall(recording),
                overruns=overruns_in(recording, own, analysis, decided),
                outcomes=outcomes_in(analysis, own),
                into_open_slots=into_open_slots(decided),
                dropped=dropped_in(decided),
                plan=own,
                prediction=judge_prediction(own, analysis) if own and planned_for else None,
                left_out=left_out,
            )
        )
    return measurements


def _refuse_other_period(plan: ChainPlan, analysis: LatencyAnalysis, recording: Recording) -> None:
    """Refuse to judge by a plan whose cycle is not the chain's period, or several of them (a source
    may be faster than the cycle)."""
    period = analysis.period_ns
    if period is not None and plan.cycle_ns % period:
        raise InputError(
            f"{recording.path}: {analysis.chain.spec} starts every {duration_text(period)} there,"
            f" and the plan's cycle is {duration_text(plan.cycle_ns)}: name the plan that was in"
            " force, or plan again"
        )


def _in_front(chain: str, plan: Plan | None) -> str:
    """A chain whose first topic is shaped, from in front of that shaping node.

    So is a chain of one callback, and the first topic under LET per callback.
    """
    first, *others = chain.split("..")
    inputs = {} if plan is None else {node.output: node.input for node in plan.shaping_nodes}
    if first not in inputs:
        return chain
    return "..".join([inputs[first], *(others or [first])])


def _in_force(recording: Recording) -> tuple[tuple[int, int | None] | None, LeftOut]:
    """When the plan was in force, if not throughout, and what was recorded besides."""
    spell, starts = recording.info.in_force, events.table(recording.events, "callback_start")
    if spell is None or not starts.height:
        return None, LeftOut()
    first, last = int(starts["time"][0]), int(starts["time"][-1])
    before = max(0, min(spell.since_ns, last) - first)
    after = 0 if spell.until_ns is None else max(0, last - max(spell.until_ns, first))
    within = (spell.since_ns, spell.until_ns) if before or after else None
    return within, LeftOut(before, after)


def longest_stall(recording: Recording) -> int | None:
    """The machine's longest stall while it was recorded (ns); None: it was not watched."""
    if recording.info.stall_meter is None:
        return None
    stalls = events.table(recording.events, "machine_stall")
    return int(stalls["duration"].max() or 0)  # type: ignore[arg-type]


def compare_recordings(
    recordings: Sequence[Recording | str | Path],
    chain: str | None = None,
    plan: Plan | None = None,
) -> Comparison:
    """Measure the same chain, the first of several, in several recordings.

    ``plan`` was in force in the last of them, should that not say so itself.

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
) -> tuple[Comparison, ...]:
    """Measure every chain of an application in ``least`` recordings or more.

    They are the chains of the plan that was in force in the last of them, if it has several;
    otherwise each recording's own. ``chain`` names one. Raises: as :func:`compare_recordings`.
    """
    if len(recordings) < least:
        raise InputError("a comparison needs two recordings, such as `compare before after`")
    every = [opened(recording) for recording in recordings]
    joint = _plan_of(every[-1], plan)
    chains = [] if joint is None or chain is not None else [one.chain.spec for one in joint.chains]
    chains = chains if len(chains) > 1 else [chain or next(iter(chains), None)]
    columns = []
    for number, recording in enumerate(every, start=1):
        progress((number - 1) / len(every), f"analysing {recording.path}")
        columns.append(_measured(recording, chains, plan if number == len(every) else None))
    return tuple(Comparison(own[0].analysis.chain.spec, own) for own in zip(*columns, strict=True))


PARTS = ("communication", "computation", "waiting")


def hop_breakdown(analysis: LatencyAnalysis) -> pl.DataFrame:
    """Communication, computation and waiting of every hop of a chain, over complete traversals.

    One row per hop: ``hop`` (from 0), ``callback_id``, ``node``, ``callback`` (a short text),
    ``topic`` (that it publishes), ``count``, ``by_sibling`` (how often another callback of the
    node published for it), and for all parts ``…_ns``, a struct ``{min, mean, max}`` in ns (null
    without traversals, and for the first hop's communication), and ``…_share`` of the mean latency.
    """
    path = analysis.graph.path(analysis.chain)
    complete = analysis.traversals.filter("complete")
    latency = pl.lit(complete["latency_ns"].mean(), dtype=pl.Float64)
    times = [f"{part}_ns" for part in PARTS]
    found = analysis.hops.join(complete, on="traversal", how="semi").group_by("hop")
    figures = found.agg(
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


def part_shares(frame: pl.DataFrame) -> dict[str, float | None]:
    """The parts' shares of the mean latency, over all hops; None without traversals."""
    shares = {part: frame[f"{part}_share"].drop_nulls() for part in PARTS}
    return {part: float(one.sum()) if len(one) else None for part, one in shares.items()}
