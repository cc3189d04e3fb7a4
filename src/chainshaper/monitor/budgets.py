"""Budgets: what a chain, its hops and callbacks may take, and which recordings keep to it.

    format: 1
    chains:
      - {chain: /t1../t5, maximum: 80ms, percentiles: {'99': 75ms}, jitter: 40ms, missing: 1%,
         hops: [{topic: /t3, communication: 1ms, computation: 22ms}]}
    callbacks:
      - {node: /filter, starts: /t2, response: 25ms, execution: 22ms}

Limits are of all cycles, those that the machine disturbed included: a limit that is broken by these
alone is broken, and says so. ``missing`` is the share of outputs that were late or never came;
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

ROOM = 0.1
"""A proposal leaves as much room beyond what was measured."""
GRAIN_NS = 10_000
"""Proposed limits are whole multiples of it."""
LEAST_MISSING = 0.01
EVENTS = "its events"  # what a recording lacks that cannot be read


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
assert {f"{one:g}" for one in PERCENTILES} == set(Percentile.__args__)  # type: ignore[attr-defined]  # noqa: S101


class HopBudget(Part):
    """The longest that one hop may take; ``topic`` is what it publishes."""

    topic: str
    communication_ns: PositiveDuration | None = None
    computation_ns: PositiveDuration | None = None
    waiting_ns: PositiveDuration | None = None


class ChainBudget(Part):
    """What the latency of a chain may be."""

    chain: str
    maximum_ns: PositiveDuration | None = None
    percentiles: dict[Percentile, PositiveDuration] = Field(default_factory=dict)
    jitter_ns: PositiveDuration | None = None
    missing: Share | None = None
    hops: tuple[HopBudget, ...] = Field(default=(), strict=False)


class CallbackBudget(Part):
    """The longest that one callback may take, from start to end, and of CPU time."""

    node: str
    starts: str
    response_ns: PositiveDuration | None = None
    execution_ns: PositiveDuration | None = None


class Budget(Part):
    """A budget file."""

    format: Literal[1] = 1
    chains: tuple[ChainBudget, ...] = Field(default=(), strict=False)
    callbacks: tuple[CallbackBudget, ...] = Field(default=(), strict=False)


@dataclass(frozen=True)
class Judged:
    """One limit and what was found in one recording: ns, or a share for ``missing``.

    ``found`` is None where nothing was measured, which breaks the limit; ``undisturbed`` is the
    figure of cycles that the machine did not disturb (None: not known). ``because`` says where a
    broken limit of a chain comes from, or why nothing was measured.
    """

    recording: str
    where: str
    what: str
    limit: float
    found: float | None
    undisturbed: float | None = None
    because: str | None = None

    @property
    def met(self) -> bool:
        return self.found is not None and self.found <= self.limit

    @property
    def text(self) -> str:
        """In one line: ``/t1../t5: maximum 81.2ms, budget 80ms (only in disturbed cycles)``."""
        if self.found is None:
            return f"{self.where}: {self.what} could not be measured; {self.because}"
        found, limit = self._value(self.found), self._value(self.limit)
        line = f"{self.where}: {self.what} {found}, budget {limit}"
        if not self.met and self.undisturbed is not None and self.undisturbed <= self.limit:
            line += f", {self._value(self.undisturbed)} where the machine disturbed nothing"
        return line if self.because is None else f"{line}; {self.because}"

    def _value(self, value: float) -> str:
        return f"{value:.2%}" if self.what == "missing" else duration_text(round(value))


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
    """What was measured, and ``room`` beyond it, as limits for chains, hops and callbacks.

    Without ``chains``, of the chain that it names, or the only one in it. Raises InputError: no
    such chain.
    """

    def limit(ns: float | None) -> int | None:
        return None if ns is None else -int(-ns * (1 + room) // GRAIN_NS) * GRAIN_NS or None

    of_chains, flow = [], recorded_flow(recording)
    for chain in chains or [chain_of(recording, None, flow)]:
        analysis = measure_latency(recording, chain, flow=flow).analysis
        refuse_contradicted(flow.contradictions, analysis.chain.callbacks, recording.path)
        figures = analysis.statistics
        wanted: tuple[Percentile, ...] = ("50", "99")
        percentiles = {which: limit(figures.percentiles_ns.get(which)) for which in wanted}
        hops = tuple(
            HopBudget(topic=topic, **{f"{part}_ns": limit(most) for part, most in parts.items()})
            for topic, parts in _longest_parts(hop_breakdown(analysis)).items()
        )
        missing = outputs_due(analysis).share or 0.0
        of_chains.append(
            ChainBudget(
                chain=chain,
                maximum_ns=limit(figures.max_ns),
                percentiles={which: ns for which, ns in percentiles.items() if ns},
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
    """Every limit of a budget beside what one recording has, in the budget's order.

    What is not in the recording breaks its limits. ``name`` stands for the recording.
    """
    found: list[Judged] = []
    name = name or str(recording.path)
    flow = recorded_flow(recording)
    for chain in budget.chains:
        try:
            analysis = measure_latency(recording, chain.chain, flow=flow).analysis
        except InputError as error:
            limits = _chain_limits(chain, None, None)
            found += [Judged(name, chain.chain, *one, because=str(error)) for one in limits]
            continue
        parts = hop_breakdown(analysis)
        hops = list(_judged_hops(name, chain, _longest_parts(parts)))
        because = _from_where(hops, parts) or "no cycle was complete"
        calm = undisturbed_outputs_due(analysis).share
        every = _chain_limits(chain, analysis.statistics, outputs_due(analysis).share)
        undisturbed = _chain_limits(chain, analysis.undisturbed, calm)
        for limit, (_, _, at_rest) in zip(every, undisturbed, strict=True):
            one = Judged(name, chain.chain, *limit, at_rest)
            found.append(one if one.met else replace(one, because=because))
        found += hops
    return [*found, *_judged_callbacks(name, budget.callbacks, longest_times(flow))]


def check_budgets(
    paths: Sequence[Path],
    budget: Budget,
    progress: Callable[[float, str], None] = lambda *_: None,
    scheduler: str | None = None,
) -> list[list[Judged]]:
    """Recordings and traces against a budget, in their order, as many at a time as there are cores,
    or as the cluster of a Dask ``scheduler`` computes.

    What cannot be read breaks the budget as well, with the reason. Raises: as
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
    """What is broken of a budget's limits in the last minute; what has never run breaks none.

    All outputs are missing of a chain that has run, and had none in the last minute.
    """
    of_chain = {one.chain: one for one in seen.chains}
    found: list[Judged] = []
    for chain in budget.chains:
        now = of_chain.get(chain.chain)
        if now is None:
            continue
        minute = now.spans["minute"]
        stopped = None if minute.count else now.problem or "no output in the last minute"
        if stopped and chain.missing is not None and now.counted["complete"]:
            found.append(Judged("now", chain.chain, "missing", chain.missing, 1.0, because=stopped))
            chain = chain.model_copy(update={"missing": None})  # noqa: PLW2901
        missing = OutputsDue.of(minute.count, minute.late, minute.incomplete).share
        if missing is not None:
            why = None if minute.count else "no cycle was complete"
            limits = _chain_limits(chain, minute, missing)
            found += [Judged("now", chain.chain, *one, because=why) for one in limits]
            longest = {one.topic: dict(zip(PARTS, one.longest_ns, strict=True)) for one in now.hops}
            found += _judged_hops("now", chain, longest)
    times = {(one.node, one.starts): one.longest_ns for one in seen.callbacks}
    running = [one for one in budget.callbacks if (one.node, one.starts) in times]
    found += _judged_callbacks("now", running, times)
    return [one for one in found if not one.met]


def not_running(budget: Budget, seen: "Seen") -> Iterator[str]:
    """What a budget names and has never run, each in words."""
    ran, named = {(c.node, c.starts) for c in seen.callbacks}, {c.chain for c in budget.chains}
    for chain in seen.chains:
        if chain.problem and chain.chain in named and not any(chain.counted.values()):
            yield f"the budget's chain {chain.chain} has not run yet: {chain.problem}"
    for one in budget.callbacks:
        if (one.node, one.starts) not in ran:
            yield (
                f"the budget's callback {one.node} ({one.starts}) has not run yet: `chainshaper "
                "callbacks` shows node and start of those in a recording"
            )


def _chain_limits(
    chain: ChainBudget, figures: LatencyStatistics | None, missing: float | None
) -> Iterator[tuple[str, float, float | None]]:
    """The limits that a chain has, each with what was found."""
    found = figures or latency_statistics([])
    if chain.maximum_ns is not None:
        yield "maximum", chain.maximum_ns, found.max_ns
    for which, limit in chain.percentiles.items():
        yield f"p{which}", limit, found.percentiles_ns.get(which)
    if chain.jitter_ns is not None:
        yield "jitter", chain.jitter_ns, found.jitter_ns
    if chain.missing is not None:
        yield "missing", chain.missing, missing


def _longest_parts(parts: pl.DataFrame) -> dict[str, dict[str, float | None]]:
    """The longest communication, computation and waiting of each hop, by its topic."""
    most = (pl.col(f"{part}_ns").struct.field("max").alias(part) for part in PARTS)
    rows = parts.select("topic", *most).iter_rows(named=True)
    return {row["topic"]: {part: row[part] for part in PARTS} for row in rows}


def _judged_hops(
    name: str, chain: ChainBudget, longest: Mapping[str, Mapping[str, float | None]]
) -> Iterator[Judged]:
    """The limits of hops; ``longest`` are the parts of each by its topic."""
    for hop in chain.hops:
        named = {f"{part} of {hop.topic}": getattr(hop, f"{part}_ns") for part in PARTS}
        times = longest.get(hop.topic)
        found = None if times is None else tuple(times[part] for part in PARTS)
        yield from _judged(name, chain.chain, named, found, "the chain has no such hop here")


def _judged_callbacks(
    name: str, callbacks: Sequence[CallbackBudget], longest: Mapping[tuple[str, str], Longest]
) -> Iterator[Judged]:
    """Their limits; ``longest`` are response and execution times by node and what starts it."""
    for one in callbacks:
        found = longest.get((one.node, one.starts))
        limits = {"response": one.response_ns, "execution": one.execution_ns}
        starts, times = (found.shown, found.times) if found else (one.starts, None)
        why = f"the recording has no such {'time' if times else 'callback'}"
        yield from _judged(name, f"{one.node} ({starts})", limits, times, why)


def _judged(
    name: str,
    where: str,
    limits: Mapping[str, int | None],
    times: Sequence[float | None] | None,
    why: str,
) -> Iterator[Judged]:
    """Those of the limits that there are, beside the times; ``why`` one of these is not known."""
    for (what, limit), most in zip(limits.items(), times or [None] * len(limits), strict=True):
        if limit is not None:
            yield Judged(name, where, what, limit, most, because=why if most is None else None)


def _from_where(hops: Sequence[Judged], parts: pl.DataFrame) -> str | None:
    """The hop that exceeds its budget by most; without one, that with the longest mean."""
    broken = [one for one in hops if one.found is not None and not one.met]
    if broken:
        worst = max(broken, key=lambda one: (one.found or 0) - one.limit)
        return f"from {worst.text.partition(': ')[2]}"
    if not parts["count"].sum():
        return None
    means = [
        (row[f"{part}_ns"]["mean"], part, row)
        for row in parts.iter_rows(named=True)
        for part in ("computation", "waiting")
        if row[f"{part}_ns"] is not None
    ]
    mean, part, longest = max(means, key=lambda one: one[0])
    took = f"{duration_text(round(mean))} of {part} on average"
    return f"its longest hop is {longest['node']} ({took} to {longest['topic']})"


def junit_report(judged: "Sequence[Judged | Compared]") -> str:
    """JUnit XML: a suite for each recording, a test case for each limit or callback."""
    root = ElementTree.Element("testsuites", name="chainshaper check")
    for recording in dict.fromkeys(one.recording for one in judged):
        own = [one for one in judged if one.recording == recording]
        broken = sum(not one.met for one in own)
        counts = {"tests": str(len(own)), "failures": str(broken)}
        suite = ElementTree.SubElement(root, "testsuite", {"name": shown(recording), **counts})
        for one in own:
            named = {"classname": shown(one.where), "name": shown(one.what)}
            case = ElementTree.SubElement(suite, "testcase", named)
            if not one.met:
                ElementTree.SubElement(case, "failure", {"message": shown(one.text)})
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def markdown_report(
    judged: "Sequence[Judged | Compared]", words: tuple[str, str, str] = ("limits", "broken", "met")
) -> str:
    """GitHub-flavoured Markdown for a pull request: what breaks, and how many limits are met.

    ``words`` are for what is judged, and for both verdicts.
    """
    noun, bad, good = words
    broken = [one for one in judged if not one.met]
    if not broken:
        return f"**All {len(judged)} {noun} are {good}**\n"
    lines = [f"**{len(broken)} of {len(judged)} {noun} are {bad}**", ""]
    lines += [f"| recording | {noun.removesuffix('s')} |", "|---|---|"]
    cells = ((shown(t).replace("|", "\\|") for t in (o.recording, o.text)) for o in broken)
    return "\n".join([*lines, *(f"| {' | '.join(own)} |" for own in cells), ""])
