"""Budgets: what a chain, its hops, callbacks and loops may take, and which recordings keep to it.

    format: 1
    through: [/command=/motor]
    chains:
      - {chain: /t1../t5, maximum: 80ms, percentiles: {'99': 75ms}, jitter: 40ms, missing: 1%,
         control: {plant: plant.yaml, cost: 1.5},
         hops: [{topic: /t3, communication: 1ms, computation: 22ms}],
         age_at_loop: {minimum: 2ms, maximum: 14ms, percentiles: {'99': 12ms}, jitter: 10ms,
                       never: 1%, again: 55%}}
    callbacks:
      - {node: /filter, starts: /t2, response: 25ms, execution: 22ms}
    loops:
      - {node: /controller_manager, publishes: /command, shortest_period: 9ms, period: 11ms,
         start_jitter: 500us, overruns: 1%}

``through`` is what no event shows, as `--through` declares it: messages of the first topic go into
those of the second. Limits hold for all cycles, also those that the machine disturbed. A limit that
only these break is broken, and its message says so. ``missing`` is the share of outputs that were
late or never came; ``starts`` is the topic that starts a callback, or the declared period of its
timer, as `chainshaper callbacks` shows it. ``age_at_loop`` is about the data of the chain's last
loop, over all of its cycles; ``never`` and ``again`` are shares of the messages: used in no cycle,
and in several. ``control`` limits what the latencies cost a control loop per second; the path of
its description is relative to the budget file. ``overruns`` is a share of a loop's instances.
``minimum`` and ``shortest_period`` are the least that is allowed, all others the most.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal
from xml.etree import ElementTree

import polars as pl
import yaml
from pydantic import BeforeValidator, Field, PlainSerializer, SerializationInfo

from chainshaper.analysis import recorded_flow
from chainshaper.analysis.contradictions import refuse_contradicted
from chainshaper.analysis.data_age import DataAge, use_shares
from chainshaper.analysis.graph import with_possible_hand_overs
from chainshaper.analysis.latency import Longest, longest_times
from chainshaper.analysis.loop_rates import LoopRate, loop_instances, loop_label, loop_rates
from chainshaper.analysis.statistics import PERCENTILES, LatencyStatistics, latency_statistics
from chainshaper.control.plant_file import load_loop
from chainshaper.sources import open_source, with_declared
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import ChainshaperError, InputError, OperationError, shown
from chainshaper.values.files import new_file, write_whole
from chainshaper.values.handed_over import HandedOver, parse_through, through_texts
from chainshaper.values.many_tasks import computed
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import AS_YAML, Part, PositiveDuration, read_model
from chainshaper.verify.control import control_costs
from chainshaper.verify.measure import PARTS, chain_of, hop_breakdown, measure_latency
from chainshaper.verify.promises import OutputsDue, outputs_due, undisturbed_outputs_due

if TYPE_CHECKING:
    from chainshaper.monitor.watch import Seen
    from chainshaper.verify.slowdowns import Compared

ROOM = 0.1  # a proposed limit is so much above what was measured (a share of it)
GRAIN_NS = 10_000  # proposed limits are whole multiples of it
LEAST_MISSING = 0.01  # the lowest limit that is proposed for a share
SHARES = ("missing", "overruns", "never used", "used again")  # figures that are no times
COST = "control cost"
EVENTS = "its events"  # what cannot be measured of a recording that cannot be read


def _share_in(value: object) -> object:
    if isinstance(value, str) and value.endswith("%"):
        try:
            return float(value[:-1]) / 100
        except ValueError:
            raise ValueError(f"{value!r} is no share: write 1% or 0.01") from None
    return value


def _share_out(value: float, info: SerializationInfo) -> float | str:
    return f"{100 * value:g}%" if info.context == AS_YAML else value


Share = Annotated[
    float, BeforeValidator(_share_in), PlainSerializer(_share_out), Field(ge=0, le=1, strict=False)
]
Percentile = Literal["0.5", "1", "5", "25", "50", "75", "95", "99", "99.5"]
assert {f"{percentile:g}" for percentile in PERCENTILES} == set(Percentile.__args__)  # type: ignore[attr-defined]  # noqa: S101


class HopBudget(Part):
    """The longest times that one hop may take."""

    topic: str  # that it publishes
    communication_ns: PositiveDuration | None = None
    computation_ns: PositiveDuration | None = None
    waiting_ns: PositiveDuration | None = None


class AgeBudget(Part):
    """How old the data may be that a loop works with, and how often it may use them."""

    minimum_ns: PositiveDuration | None = None
    maximum_ns: PositiveDuration | None = None
    percentiles: dict[Percentile, PositiveDuration] = Field(default_factory=dict)
    jitter_ns: PositiveDuration | None = None
    never: Share | None = None  # of the messages: used in no cycle
    again: Share | None = None  # of the messages: used in several cycles


class ControlBudget(Part):
    """What the chain's latencies may cost a control loop per second."""

    plant: str  # the description of the loop
    cost: float = Field(gt=0, strict=False)


class ChainBudget(Part):
    """The limits of a chain's latency."""

    chain: str
    maximum_ns: PositiveDuration | None = None
    percentiles: dict[Percentile, PositiveDuration] = Field(default_factory=dict)
    jitter_ns: PositiveDuration | None = None
    missing: Share | None = None
    hops: tuple[HopBudget, ...] = Field(default=(), strict=False)
    age_at_loop: AgeBudget | None = None
    control: ControlBudget | None = None


class CallbackBudget(Part):
    """The longest times that one callback may take."""

    node: str
    starts: str  # the topic that starts it, or its timer's declared period
    response_ns: PositiveDuration | None = None  # from start to end
    execution_ns: PositiveDuration | None = None  # of CPU time


class LoopBudget(Part):
    """The rate that one loop has to keep."""

    node: str
    publishes: str | None = None  # one of its topics; None: any loop of the node, the worst counts
    shortest_period_ns: PositiveDuration | None = None
    period_ns: PositiveDuration | None = None  # the longest
    start_jitter_ns: PositiveDuration | None = None
    overruns: Share | None = None  # of its instances

    @property
    def label(self) -> str:
        return loop_label(self.node, () if self.publishes is None else (self.publishes,))

    def is_of(self, rate: LoopRate) -> bool:
        """Return whether a loop is the one that these limits are for."""
        return rate.node == self.node and self.publishes in (None, *rate.publishes)


class Budget(Part):
    """A budget file."""

    format: Literal[1] = 1
    # What no event shows (values/handed_over.py): /command=/motor
    through: tuple[HandedOver, ...] = Field(default=(), strict=False)
    chains: tuple[ChainBudget, ...] = Field(default=(), strict=False)
    callbacks: tuple[CallbackBudget, ...] = Field(default=(), strict=False)
    loops: tuple[LoopBudget, ...] = Field(default=(), strict=False)

    def declaring(self, through: Sequence[str]) -> "Budget":
        """Return the budget with what `--through` declares, beside its own.

        Raises InputError: a text declares nothing.
        """
        texts = dict.fromkeys((*self.through, *through_texts(parse_through(through))))
        return self.model_copy(update={"through": tuple(texts)})


@dataclass(frozen=True)
class Judged:
    """One limit, and the figure of one recording beside it.

    It is in ns, or a share (:data:`SHARES`), or a cost per second (:data:`COST`).
    """

    recording: str
    where: str  # the chain, or the callback
    figure: str  # the name of what is limited, such as "maximum"
    limit: float
    measured: float | None  # None: nothing was measured, which breaks the limit
    undisturbed: float | None = None  # of cycles that the machine did not disturb; None: unknown
    because: str | None = None  # where a broken limit comes from, or why nothing was measured
    at_least: bool = False  # whether it is broken by less, not by more

    @property
    def met(self) -> bool:
        return self._meets(self.measured)

    def _meets(self, measured: float | None) -> bool:
        if measured is None:
            return False
        return measured >= self.limit if self.at_least else measured <= self.limit

    @property
    def text(self) -> str:
        """The limit in one line: ``/t1../t5: maximum 81.2ms, budget 80ms; from …``."""
        if self.measured is None:
            return f"{self.where}: {self.figure} could not be measured; {self.because}"
        measured, limit = self._value(self.measured), self._value(self.limit)
        bound = "at least " if self.at_least else ""
        line = f"{self.where}: {self.figure} {measured}, budget {bound}{limit}"
        if not self.met and self.undisturbed is not None and self._meets(self.undisturbed):
            line += f", {self._value(self.undisturbed)} where the machine disturbed nothing"
        return line if self.because is None else f"{line}; {self.because}"

    def _value(self, value: float) -> str:
        if self.is_cost:
            return f"{value:.4g}"
        return f"{value:.2%}" if self.is_share else duration_text(round(value))

    @property
    def is_cost(self) -> bool:
        """Whether the figure is a cost per second, not a time."""
        return self.figure == COST

    @property
    def is_share(self) -> bool:
        """Whether the figure is a share, not a time."""
        return self.figure in SHARES


def load_budget(path: str | Path) -> Budget:
    """Read a budget file. Raises InputError: as :func:`.read_model`, or it has no limits."""
    budget = read_model(path, Budget, made_by="written by `chainshaper budget`")
    if not (budget.chains or budget.callbacks or budget.loops):
        raise InputError(f"{path} has no limits: `chainshaper budget REC -o FILE` proposes some")
    chains = []
    for chain in budget.chains:
        if (control := chain.control) is not None:
            plant = str(Path(path).parent / control.plant)
            load_loop(plant)  # what is wrong in it is no recording's fault
            control = control.model_copy(update={"plant": plant})
        chains.append(chain.model_copy(update={"control": control}))
    return budget.model_copy(update={"chains": tuple(chains)})


def save_budget(budget: Budget, path: str | Path) -> Path:
    """Write a budget file. Raises InputError: it exists. OperationError: it cannot be written."""
    values = budget.model_dump(
        mode="json", by_alias=True, exclude_none=True, exclude_defaults=True, context=AS_YAML
    )
    text = yaml.safe_dump({"format": 1, **values}, sort_keys=False, default_flow_style=None)
    return write_whole(new_file(path), [text.encode()])


def propose_budget(recording: Recording, chains: Sequence[str] = (), room: float = ROOM) -> Budget:
    """Propose limits for chains, hops, callbacks and loops: what was measured, and ``room`` beyond.

    Without ``chains``, for the chain that the recording names, or the only one in it. What is
    declared of the recording (`--through`) is in the budget, too.

    Raises InputError: no such chain.
    """

    def limit(ns: float | None) -> int | None:
        return _most(ns, room)

    of_chains, flow = [], recorded_flow(recording)
    for chain in chains or [chain_of(recording, None, flow)]:
        analysis = measure_latency(recording, chain, flow=flow).analysis
        refuse_contradicted(flow.contradictions, analysis.chain.callbacks, recording.path)
        figures = analysis.statistics
        wanted: tuple[Percentile, ...] = ("50", "99")
        percentiles = {
            percentile: limit(figures.percentiles_ns.get(percentile)) for percentile in wanted
        }
        hops = tuple(
            HopBudget(topic=topic, **{f"{part}_ns": limit(ns) for part, ns in parts.items()})
            for topic, parts in _longest_parts(hop_breakdown(analysis)).items()
        )
        missing = outputs_due(analysis).share or 0.0
        age = None if analysis.data_age is None else _proposed_age(analysis.data_age, room)
        of_chains.append(
            ChainBudget(
                chain=chain,
                maximum_ns=limit(figures.max_ns),
                percentiles={percentile: ns for percentile, ns in percentiles.items() if ns},
                jitter_ns=limit(figures.jitter_ns),
                missing=_most_share(missing, room),
                hops=hops,
                age_at_loop=age,
            )
        )
    callbacks = tuple(
        CallbackBudget(node=node, starts=starts, response_ns=limit(took), execution_ns=limit(used))
        for (node, starts), (took, used, _) in longest_times(flow).items()
    )
    loops = tuple(_proposed_loop(rate, room) for rate in loop_rates(loop_instances(flow)))
    through = through_texts(recording.info.through)
    return Budget(through=through, chains=tuple(of_chains), callbacks=callbacks, loops=loops)


def _most(ns: float | None, room: float) -> int | None:
    """Return a limit that lies ``room`` above what was measured."""
    # To a thousandth, since 150 times 1.1 is a little more than 165 in binary numbers.
    return None if ns is None else -int(-round(ns * (1 + room), 3) // GRAIN_NS) * GRAIN_NS or None


def _least(ns: float | None, room: float) -> int | None:
    """Return a limit that lies ``room`` below what was measured."""
    return None if ns is None else int(round(ns * (1 - room), 3) // GRAIN_NS) * GRAIN_NS or None


def _most_share(share: float, room: float) -> float:
    """Return a limit for a share, ``room`` above what was measured."""
    return min(1.0, max(LEAST_MISSING, round(share * (1 + room), 4)))


def _proposed_age(age: DataAge, room: float) -> AgeBudget:
    """Propose limits for the age of a loop's data."""
    figures = latency_statistics(age.at_loop_ns.to_numpy())
    never, again = use_shares(age.uses)
    wanted: tuple[Percentile, ...] = ("50", "99")
    limits = {name: _most(figures.percentiles_ns.get(name), room) for name in wanted}
    return AgeBudget(
        minimum_ns=_least(figures.min_ns, room),
        maximum_ns=_most(figures.max_ns, room),
        percentiles={name: ns for name, ns in limits.items() if ns},
        jitter_ns=_most(figures.jitter_ns, room),
        never=None if never is None else _most_share(never, room),
        again=None if again is None else _most_share(again, room),
    )


def _proposed_loop(rate: LoopRate, room: float) -> LoopBudget:
    """Propose limits for a loop's rate."""
    share = rate.overrun_share
    return LoopBudget(
        node=rate.node,
        publishes=rate.publishes[0] if rate.publishes else None,
        shortest_period_ns=_least(rate.period_ns, room),
        period_ns=_most(rate.period_ns, room),
        start_jitter_ns=_most(rate.start_jitter_ns, room),
        overruns=None if share is None else _most_share(share, room),
    )


def check_budget(recording: Recording, budget: Budget, name: str | None = None) -> list[Judged]:
    """Judge every limit of a budget by one recording, in the budget's order.

    A chain, hop or callback that is not in the recording breaks its limits. ``name`` is that of
    the recording in messages.
    """
    judged: list[Judged] = []
    name = name or str(recording.path)
    recording = with_declared(recording, parse_through(budget.through))
    flow, doubts = with_possible_hand_overs(recorded_flow(recording))
    for chain in budget.chains:
        try:
            analysis = measure_latency(recording, chain.chain, flow=flow).analysis
        except InputError as error:
            reason = "; ".join([str(error), *doubts])
            for figure, limit, measured in _chain_limits(chain, None, None):
                judged.append(Judged(name, chain.chain, figure, limit, measured, because=reason))
            judged += _judged_age(name, chain, None, None, reason)
            if (control := chain.control) is not None:
                judged.append(Judged(name, chain.chain, COST, control.cost, None, because=reason))
            continue
        parts = hop_breakdown(analysis)
        hops = list(_judged_hops(name, chain, _longest_parts(parts)))
        because = _from_where(hops, parts) or "no cycle was complete"
        missing_undisturbed = undisturbed_outputs_due(analysis).share
        every = _chain_limits(chain, analysis.statistics, outputs_due(analysis).share)
        undisturbed = _chain_limits(chain, analysis.undisturbed, missing_undisturbed)
        for (figure, limit, measured), (_, _, calm) in zip(every, undisturbed, strict=True):
            verdict = Judged(name, chain.chain, figure, limit, measured, calm)
            judged.append(verdict if verdict.met else replace(verdict, because=because))
        judged += hops
        judged += _judged_ages_of(name, chain, analysis.data_age)
        judged += _judged_control(name, chain, recording)
    judged += _judged_callbacks(name, budget.callbacks, longest_times(flow))
    rates = loop_rates(loop_instances(flow)) if budget.loops else []
    return [*judged, *_judged_loops(name, budget.loops, rates)]


def check_budgets(
    paths: Sequence[Path],
    budget: Budget,
    progress: Callable[[float, str], None] = lambda *_: None,
    scheduler: str | None = None,
) -> list[list[Judged]]:
    """Judge recordings and traces by a budget, several at a time; the verdicts in their order.

    They are computed on the cores of this machine, or on the cluster of a Dask ``scheduler``. A
    recording that cannot be read breaks the budget, with the reason. Raises: as
    :func:`~chainshaper.values.many_tasks.engine`.
    """
    return computed(
        _checked, paths, budget, scheduler=scheduler, purpose="a check", progress=progress
    )


def _checked(
    path: Path, budget: Budget, progress: Callable[[float, str], None] | None = None
) -> list[Judged]:
    try:
        return check_budget(open_source(path, progress=progress), budget, str(path))
    except ChainshaperError as error:
        return [Judged(str(path), str(path), EVENTS, 0, None, because=str(error))]


def broken_limits(budget: Budget, seen: "Seen") -> list[Judged]:
    """Return the limits of a budget that the last minute broke.

    A chain or callback that has never run breaks none. Of a chain that has run before, and had no
    output in the last minute, all outputs are missing.
    """
    of_chain = {chain.chain: chain for chain in seen.chains}
    judged: list[Judged] = []
    for chain in budget.chains:
        now = of_chain.get(chain.chain)
        if now is None:
            continue
        minute = now.spans["minute"]
        stopped = None if minute.count else now.problem or "no output in the last minute"
        if stopped and chain.missing is not None and now.counted["complete"]:
            judged.append(
                Judged("now", chain.chain, "missing", chain.missing, 1.0, because=stopped)
            )
            chain = chain.model_copy(update={"missing": None})  # noqa: PLW2901
        missing = OutputsDue.of(minute.count, minute.late, minute.incomplete).share
        if missing is not None:
            reason = None if minute.count else "no cycle was complete"
            for figure, limit, measured in _chain_limits(chain, minute, missing):
                judged.append(Judged("now", chain.chain, figure, limit, measured, because=reason))
            longest = {hop.topic: dict(zip(PARTS, hop.longest_ns, strict=True)) for hop in now.hops}
            judged += _judged_hops("now", chain, longest)
        if now.age is not None and now.age.at_loop.count:
            shares, reason = (now.age.never, now.age.again), "no message came in the last minute"
            judged += _judged_age("now", chain, now.age.at_loop, shares, reason)
    times = {(callback.node, callback.starts): callback.longest_ns for callback in seen.callbacks}
    running = [
        callback for callback in budget.callbacks if (callback.node, callback.starts) in times
    ]
    judged += _judged_callbacks("now", running, times)
    rates = [loop.rate for loop in seen.loops]
    looping = [loop for loop in budget.loops if any(loop.is_of(rate) for rate in rates)]
    judged += _judged_loops("now", looping, rates)
    return [verdict for verdict in judged if not verdict.met]


def not_running(budget: Budget, seen: "Seen") -> Iterator[str]:
    """Yield a sentence for each chain, callback and loop of a budget that has never run."""
    ran = {(callback.node, callback.starts) for callback in seen.callbacks}
    named = {chain.chain for chain in budget.chains}
    for chain in seen.chains:
        if chain.problem and chain.chain in named and not any(chain.counted.values()):
            yield f"the budget's chain {chain.chain} has not run yet: {chain.problem}"
    for callback in budget.callbacks:
        if (callback.node, callback.starts) not in ran:
            yield (
                f"the budget's callback {callback.node} ({callback.starts}) has not run yet:"
                " `chainshaper callbacks` shows node and start of those in a recording"
            )
    rates = [loop.rate for loop in seen.loops]
    for loop in budget.loops:
        if not any(loop.is_of(rate) for rate in rates):
            yield (
                f"the budget's {loop.label} has not run yet: {_loops_text(rates)}. A loop that"
                " publishes nothing is to be named (--loop) where the application is started"
            )


def _chain_limits(
    chain: ChainBudget, figures: LatencyStatistics | None, missing: float | None
) -> Iterator[tuple[str, float, float | None]]:
    """Yield the limits that a chain has: the figure's name, the limit, and the figure or None."""
    statistics = figures or latency_statistics([])
    if chain.maximum_ns is not None:
        yield "maximum", chain.maximum_ns, statistics.max_ns
    for percentile, limit in chain.percentiles.items():
        yield f"p{percentile}", limit, statistics.percentiles_ns.get(percentile)
    if chain.jitter_ns is not None:
        yield "jitter", chain.jitter_ns, statistics.jitter_ns
    if chain.missing is not None:
        yield "missing", chain.missing, missing


def _longest_parts(parts: pl.DataFrame) -> dict[str, dict[str, float | None]]:
    """Return the longest communication, computation and waiting of each hop, by its topic."""
    longest = (pl.col(f"{part}_ns").struct.field("max").alias(part) for part in PARTS)
    rows = parts.select("topic", *longest).iter_rows(named=True)
    return {row["topic"]: {part: row[part] for part in PARTS} for row in rows}


def _judged_hops(
    name: str, chain: ChainBudget, longest: Mapping[str, Mapping[str, float | None]]
) -> Iterator[Judged]:
    """Judge the limits of hops; ``longest`` has the longest parts of each hop, by its topic."""
    for hop in chain.hops:
        limits = {f"{part} of {hop.topic}": getattr(hop, f"{part}_ns") for part in PARTS}
        of_parts = longest.get(hop.topic)
        times = None if of_parts is None else tuple(of_parts[part] for part in PARTS)
        yield from _judged(name, chain.chain, limits, times, "the chain has no such hop here")


def _judged_callbacks(
    name: str, callbacks: Sequence[CallbackBudget], longest: Mapping[tuple[str, str], Longest]
) -> Iterator[Judged]:
    """Judge the limits of callbacks; ``longest`` has their times by node and what starts them."""
    for callback in callbacks:
        measured = longest.get((callback.node, callback.starts))
        limits = {"response": callback.response_ns, "execution": callback.execution_ns}
        if measured is None:
            where, times = f"{callback.node} ({callback.starts})", None
            reason = "the recording has no such callback"
        else:
            where, times = f"{callback.node} ({measured.shown})", measured.times
            reason = "the recording has no such time"
        yield from _judged(name, where, limits, times, reason)


def _judged_ages_of(name: str, chain: ChainBudget, age: DataAge | None) -> Iterator[Judged]:
    """Judge the limits of the age of the chain's data at its loop."""
    if age is None:
        reason = (
            "no loop reads what this chain stores: `chainshaper graph` shows loops and what they"
            " read; one that publishes nothing is recorded with --loop, and its chain ends with"
            " NODE:end"
        )
        return _judged_age(name, chain, None, None, reason)
    figures = latency_statistics(age.at_loop_ns.to_numpy())
    return _judged_age(name, chain, figures, use_shares(age.uses), "its loop used no message")


def _judged_age(
    name: str,
    chain: ChainBudget,
    figures: LatencyStatistics | None,
    shares: tuple[float | None, float | None] | None,
    reason: str,
) -> Iterator[Judged]:
    """Judge the limits of the age of data; ``reason`` says why a figure is not known.

    ``shares`` are those of messages that were never used, and used again.
    """
    limits = chain.age_at_loop
    if limits is None:
        return
    statistics, (never, again) = figures or latency_statistics([]), shares or (None, None)
    judged: list[tuple[str, float | None, float | None]] = [
        ("lowest age", limits.minimum_ns, statistics.min_ns),
        ("highest age", limits.maximum_ns, statistics.max_ns),
    ]
    for percentile, limit in limits.percentiles.items():
        judged.append((f"age p{percentile}", limit, statistics.percentiles_ns.get(percentile)))
    judged += [
        ("jitter of age", limits.jitter_ns, statistics.jitter_ns),
        ("never used", limits.never, never),
        ("used again", limits.again, again),
    ]
    for figure, most, measured in judged:
        if most is not None:
            because, where = reason if measured is None else None, f"{chain.chain} at its loop"
            at_least = figure == "lowest age"
            yield Judged(name, where, figure, most, measured, None, because, at_least)


def _judged_control(name: str, chain: ChainBudget, recording: Recording) -> Iterator[Judged]:
    """Judge the limit of what a recording's latencies cost a control loop."""
    if chain.control is None:
        return
    limit, measured, because = chain.control.cost, None, None
    try:
        costs = control_costs(chain.control.plant, [recording], chain.chain)
        cost = costs.recordings[0].sequence.cost
        if math.isfinite(cost):
            measured = cost
        else:
            because = "the control loop is unstable with these latencies"
    except (InputError, OperationError) as error:
        because = str(error)
    yield Judged(name, chain.chain, COST, limit, measured, because=because)


def _judged_loops(
    name: str, loops: Sequence[LoopBudget], rates: Sequence[LoopRate]
) -> Iterator[Judged]:
    """Judge the limits of loops; of several that a limit is for, the worst counts."""
    for loop in loops:
        here = [rate for rate in rates if loop.is_of(rate)]
        absent = (
            f"the recording has no such loop: {_loops_text(rates)}; a loop that publishes nothing"
            " is recorded with --loop, and one that is paced by data is none"
        )
        irregular = next((rate.irregular for rate in here if rate.period_ns is None), "")
        unseen = "no event shows how it sleeps: record with `--source preload`"
        limits: list[tuple[str, float | None, list[float | None], str]] = [
            ("shortest period", loop.shortest_period_ns, [r.period_ns for r in here], irregular),
            ("period", loop.period_ns, [r.period_ns for r in here], irregular),
            ("jitter of start", loop.start_jitter_ns, [r.start_jitter_ns for r in here], unseen),
            ("overruns", loop.overruns, [r.overrun_share for r in here], unseen),
        ]
        for figure, limit, figures, unknown in limits:
            if limit is None:
                continue
            known = [value for value in figures if value is not None]
            at_least = figure == "shortest period"
            measured = (min if at_least else max)(known) if known and known == figures else None
            because = None if measured is not None else unknown if here else absent
            yield Judged(name, loop.label, figure, limit, measured, None, because, at_least)


def _loops_text(rates: Sequence[LoopRate]) -> str:
    """Name the loops that there are."""
    return f"it has the {', the '.join(rate.label for rate in rates)}" if rates else "it has none"


def _judged(
    name: str,
    where: str,
    limits: Mapping[str, int | None],
    times: Sequence[float | None] | None,
    reason: str,
) -> Iterator[Judged]:
    """Judge the limits that are given (not None) by the times, in the same order.

    ``times`` is None where nothing was measured; ``reason`` says why a time is not known.
    """
    longest = times or [None] * len(limits)
    for (figure, limit), measured in zip(limits.items(), longest, strict=True):
        if limit is not None:
            because = reason if measured is None else None
            yield Judged(name, where, figure, limit, measured, because=because)


def _from_where(hops: Sequence[Judged], parts: pl.DataFrame) -> str | None:
    """Name the hop that exceeds its budget by most; without one, that with the longest mean."""
    broken = [verdict for verdict in hops if verdict.measured is not None and not verdict.met]
    if broken:
        worst = max(broken, key=lambda verdict: (verdict.measured or 0) - verdict.limit)
        return f"from {worst.text.partition(': ')[2]}"
    if not parts["count"].sum():
        return None
    means = [
        (row[f"{part}_ns"]["mean"], part, row)
        for row in parts.iter_rows(named=True)
        for part in ("computation", "waiting")
        if row[f"{part}_ns"] is not None
    ]
    mean, part, longest = max(means, key=lambda mean_part_row: mean_part_row[0])
    took = f"{duration_text(round(mean))} of {part} on average"
    return f"its longest hop is {longest['node']} ({took} to {longest['topic']})"


def junit_report(judged: "Sequence[Judged | Compared]") -> str:
    """Return JUnit XML: a suite for each recording, a test case for each limit or callback."""
    root = ElementTree.Element("testsuites", name="chainshaper check")
    for recording in dict.fromkeys(verdict.recording for verdict in judged):
        of_recording = [verdict for verdict in judged if verdict.recording == recording]
        broken = sum(not verdict.met for verdict in of_recording)
        counts = {"tests": str(len(of_recording)), "failures": str(broken)}
        suite = ElementTree.SubElement(root, "testsuite", {"name": shown(recording), **counts})
        for verdict in of_recording:
            named = {"classname": shown(verdict.where), "name": shown(verdict.figure)}
            case = ElementTree.SubElement(suite, "testcase", named)
            if not verdict.met:
                ElementTree.SubElement(case, "failure", {"message": shown(verdict.text)})
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def markdown_report(
    judged: "Sequence[Judged | Compared]", words: tuple[str, str, str] = ("limits", "broken", "met")
) -> str:
    """Return Markdown (GitHub's) for a pull request: what breaks, and how many limits are met.

    ``words`` are for what is judged, and for both verdicts.
    """
    noun, bad, good = words
    broken = [verdict for verdict in judged if not verdict.met]
    if not broken:
        return f"**All {len(judged)} {noun} are {good}**\n"
    lines = [f"**{len(broken)} of {len(judged)} {noun} are {bad}**", ""]
    lines += [f"| recording | {noun.removesuffix('s')} |", "|---|---|"]
    for verdict in broken:
        cells = (shown(text).replace("|", "\\|") for text in (verdict.recording, verdict.text))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, ""])
