"""Budgets: what a chain, its hops and callbacks may take, and which recordings keep to it.

    format: 1
    chains:
      - {chain: /t1../t5, maximum: 80ms, percentiles: {'99': 75ms}, jitter: 40ms, missing: 1%,
         hops: [{topic: /t3, communication: 1ms, computation: 22ms}]}
    callbacks:
      - {node: /filter, starts: /t2, response: 25ms, execution: 22ms}

Limits hold for all cycles, also those that the machine disturbed. A limit that only these break is
broken, and its message says so. ``missing`` is the share of outputs that were late or never came;
``starts`` is the topic that starts a callback, or the declared period of its timer, as
`chainshaper callbacks` shows it.
"""

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
from chainshaper.analysis.latency import (
    PERCENTILES,
    LatencyStatistics,
    Longest,
    latency_statistics,
    longest_times,
)
from chainshaper.sources import open_source
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import ChainshaperError, InputError, shown
from chainshaper.values.files import new_file, write_whole
from chainshaper.values.many_tasks import computed
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import AS_YAML, Part, PositiveDuration, read_model
from chainshaper.verify.measure import PARTS, chain_of, hop_breakdown, measure_latency
from chainshaper.verify.promises import OutputsDue, outputs_due, undisturbed_outputs_due

if TYPE_CHECKING:
    from chainshaper.monitor.watch import Seen
    from chainshaper.verify.slowdowns import Compared

ROOM = 0.1  # a proposed limit is so much above what was measured (a share of it)
GRAIN_NS = 10_000  # proposed limits are whole multiples of it
LEAST_MISSING = 0.01  # the lowest limit that is proposed for `missing`
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


class ChainBudget(Part):
    """The limits of a chain's latency."""

    chain: str
    maximum_ns: PositiveDuration | None = None
    percentiles: dict[Percentile, PositiveDuration] = Field(default_factory=dict)
    jitter_ns: PositiveDuration | None = None
    missing: Share | None = None
    hops: tuple[HopBudget, ...] = Field(default=(), strict=False)


class CallbackBudget(Part):
    """The longest times that one callback may take."""

    node: str
    starts: str  # the topic that starts it, or its timer's declared period
    response_ns: PositiveDuration | None = None  # from start to end
    execution_ns: PositiveDuration | None = None  # of CPU time


class Budget(Part):
    """A budget file."""

    format: Literal[1] = 1
    chains: tuple[ChainBudget, ...] = Field(default=(), strict=False)
    callbacks: tuple[CallbackBudget, ...] = Field(default=(), strict=False)


@dataclass(frozen=True)
class Judged:
    """One limit, and the figure of one recording beside it: ns, or a share for ``missing``."""

    recording: str
    where: str  # the chain, or the callback
    figure: str  # the name of what is limited, such as "maximum"
    limit: float
    measured: float | None  # None: nothing was measured, which breaks the limit
    undisturbed: float | None = None  # of cycles that the machine did not disturb; None: unknown
    because: str | None = None  # where a broken limit comes from, or why nothing was measured

    @property
    def met(self) -> bool:
        return self.measured is not None and self.measured <= self.limit

    @property
    def text(self) -> str:
        """The limit in one line: ``/t1../t5: maximum 81.2ms, budget 80ms; from …``."""
        if self.measured is None:
            return f"{self.where}: {self.figure} could not be measured; {self.because}"
        measured, limit = self._value(self.measured), self._value(self.limit)
        line = f"{self.where}: {self.figure} {measured}, budget {limit}"
        if not self.met and self.undisturbed is not None and self.undisturbed <= self.limit:
            line += f", {self._value(self.undisturbed)} where the machine disturbed nothing"
        return line if self.because is None else f"{line}; {self.because}"

    def _value(self, value: float) -> str:
        return f"{value:.2%}" if self.figure == "missing" else duration_text(round(value))


def load_budget(path: str | Path) -> Budget:
    """Read a budget file. Raises InputError: as :func:`.read_model`, or it has no limits."""
    budget = read_model(path, Budget, made_by="written by `chainshaper budget`")
    if not (budget.chains or budget.callbacks):
        raise InputError(f"{path} has no limits: `chainshaper budget REC -o FILE` proposes some")
    return budget


def save_budget(budget: Budget, path: str | Path) -> Path:
    """Write a budget file. Raises InputError: it exists. OperationError: it cannot be written."""
    values = budget.model_dump(
        mode="json", by_alias=True, exclude_none=True, exclude_defaults=True, context=AS_YAML
    )
    text = yaml.safe_dump({"format": 1, **values}, sort_keys=False, default_flow_style=None)
    return write_whole(new_file(path), [text.encode()])


def propose_budget(recording: Recording, chains: Sequence[str] = (), room: float = ROOM) -> Budget:
    """Propose limits for chains, hops and callbacks: what was measured, and ``room`` above it.

    Without ``chains``, for the chain that the recording names, or the only one in it.

    Raises InputError: no such chain.
    """

    def limit(ns: float | None) -> int | None:
        return None if ns is None else -int(-ns * (1 + room) // GRAIN_NS) * GRAIN_NS or None

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
        of_chains.append(
            ChainBudget(
                chain=chain,
                maximum_ns=limit(figures.max_ns),
                percentiles={percentile: ns for percentile, ns in percentiles.items() if ns},
                jitter_ns=limit(figures.jitter_ns),
                missing=min(1.0, max(LEAST_MISSING, round(missing * (1 + room), 4))),
                hops=hops,
            )
        )
    callbacks = tuple(
        CallbackBudget(node=node, starts=starts, response_ns=limit(took), execution_ns=limit(used))
        for (node, starts), (took, used, _) in longest_times(flow).items()
    )
    return Budget(chains=tuple(of_chains), callbacks=callbacks)


def check_budget(recording: Recording, budget: Budget, name: str | None = None) -> list[Judged]:
    """Judge every limit of a budget by one recording, in the budget's order.

    A chain, hop or callback that is not in the recording breaks its limits. ``name`` is that of
    the recording in messages.
    """
    judged: list[Judged] = []
    name = name or str(recording.path)
    flow = recorded_flow(recording)
    for chain in budget.chains:
        try:
            analysis = measure_latency(recording, chain.chain, flow=flow).analysis
        except InputError as error:
            for figure, limit, measured in _chain_limits(chain, None, None):
                judged.append(
                    Judged(name, chain.chain, figure, limit, measured, because=str(error))
                )
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
    return [*judged, *_judged_callbacks(name, budget.callbacks, longest_times(flow))]


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
    times = {(callback.node, callback.starts): callback.longest_ns for callback in seen.callbacks}
    running = [
        callback for callback in budget.callbacks if (callback.node, callback.starts) in times
    ]
    judged += _judged_callbacks("now", running, times)
    return [verdict for verdict in judged if not verdict.met]


def not_running(budget: Budget, seen: "Seen") -> Iterator[str]:
    """Yield a sentence for each chain and callback of a budget that has never run."""
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
