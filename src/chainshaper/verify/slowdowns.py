"""Slowdowns: callbacks that take longer than in recordings of before, by more than noise.

What is compared is CPU time where all recordings have it, else the time from start to end, without
instances that met a stall of the machine. Each recording is set against the first one of before:

* **The same work.** A program that gets the same input again computes as long for the same message.
  Stretches of WINDOW instances are laid beside those of the first recording that go up and down
  alike (rank correlation), so that what input varies cancels out, also behind messages that were
  lost. Where inputs differ, instances stand beside each other in their order.
* **A run's figure** is the median of the logarithms of these ratios. Its error is that of the means
  of BLOCKS consecutive medians, since neighbours are alike (batch means: Schmeiser, 1982).
* **The same machine.** Clock rate, caches and stolen time change all callbacks of a run: what the
  others have in common (a weighted median, at most COMMON) is taken out of each.
* **The same program** still differs from run to run, for as long as its processes live: memory lies
  elsewhere. How much is estimated from the recordings of both sides, and where these are few from
  how much single instances vary, which counts as much as PRIOR recordings (a moderated t-test:
  Smyth, 2004). Single runs far from the others are drawn in (Winsor).

A callback is slower when it is by more than LEAST, with a probability of error below LEVEL over all
callbacks together (Bonferroni). ``benchmarks/slowdowns.py`` shows how often that is wrong.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import expm1, log1p
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import polars as pl
from numpy.lib.stride_tricks import sliding_window_view

from chainshaper.analysis import recorded_flow
from chainshaper.analysis.disturbance import stalled_after
from chainshaper.analysis.latency import named_callbacks
from chainshaper.sources import open_source
from chainshaper.values.errors import InputError
from chainshaper.values.many_tasks import computed
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import measure_latency
from chainshaper.verify.student import t_quantile, t_tail

LEVEL = 1 / 200
LEAST = log1p(0.005)
"""Less is no slowdown: another build of the same program differs by as much."""
COMMON = log1p(0.1)
PRIOR = 12
RUN_SHARE, RUN_LEAST, RUN_MOST = 0.25, 0.001, 0.015
"""Standard deviation from run to run: this share of that of ratios of instances, and limits."""
WINDOW, ALIKE, SHIFT = 32, 0.8, 128
BLOCKS, FEWEST = 20, 40
NORMAL_QUARTILE = 0.6744897501960817  # of a normal distribution, in standard deviations
SEVERAL, MUCH = 3, 0.03

Times: TypeAlias = npt.NDArray[np.float64]
Places: TypeAlias = npt.NDArray[np.intp]
Name: TypeAlias = tuple[str, str]


class Taken(NamedTuple):
    """What the instances of a callback took, in their order (ns; NaN: a stall, or not known)."""

    response: Times
    execution: Times


@dataclass(frozen=True)
class Sample:
    """What a recording has for a comparison: callbacks by node and trigger, of ``chains`` the
    median undisturbed latency (ns) and the callbacks on the way. ``shown`` is what starts callbacks
    in words, with the periods that starts of timers show.
    """

    recording: str
    callbacks: Mapping[Name, Taken]
    chains: Mapping[str, tuple[float, frozenset[Name]]]
    shown: Mapping[Name, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Compared:
    """A callback in some recordings, beside those of before.

    ``time`` is what was compared, execution or response; ``before_ns`` its median before,
    ``change`` how much longer it is (0.03: by 3 %), ``p`` the probability of as much by chance in
    any of all callbacks. A change of ``resolution`` would have been found in 95 % of comparisons.
    ``chains`` are those through the callback, and by how much their median latency changed (ns).
    """

    recording: str
    node: str
    starts: str
    time: str
    before_ns: float
    change: float
    p: float
    resolution: float
    chains: Mapping[str, float] = field(default_factory=dict)

    @property
    def met(self) -> bool:
        return not self.p < LEVEL

    @property
    def where(self) -> str:
        return f"{self.node} ({self.starts})"

    @property
    def what(self) -> str:
        return f"{self.time} beside the baseline"

    @property
    def text(self) -> str:
        """``+1.8 ms on /t1../t5, from /filter (execution 19.9 → 21.6 ms, p = 0.001)``"""
        after = self.before_ns * (1 + self.change)
        digits = 1 if after >= 10e6 else 2 if after >= 1e6 else 3
        p = "p < 0.001" if self.p < 0.001 else f"p = {self.p:.1g}"
        took = f"{self.time} {self.before_ns / 1e6:.{digits}f} → {after / 1e6:.{digits}f} ms, {p}"
        if not self.chains:
            return f"{self.where}: {took}"
        on = ", ".join(f"{ns / 1e6:+.{digits}f} ms on {chain}" for chain, ns in self.chains.items())
        return f"{on}, from {self.node} ({took})"


def slowdowns_in(
    paths: Sequence[Path],
    before: Sequence[Path],
    chains: Sequence[str] = (),
    progress: Callable[[float, str], None] = lambda *_: None,
    scheduler: str | None = None,
) -> tuple[list[Compared], list[str]]:
    """:func:`find_slowdowns` in recordings and traces, which are read in parallel.

    ``chains`` are those to speak of; without, those that recordings name. Raises: as
    :func:`find_slowdowns` and :func:`~chainshaper.values.many_tasks.engine`. InputError: a
    recording cannot be read.
    """
    every, purpose = [*paths, *before], "a comparison"
    samples = computed(
        _read, every, tuple(chains), scheduler=scheduler, purpose=purpose, progress=progress
    )
    compared, notes = find_slowdowns(samples[: len(paths)], samples[len(paths) :])
    missing = {(c, one.recording) for c in chains for one in samples if c not in one.chains}
    return compared, [*notes, *(f"{chain} is not in {name}" for chain, name in sorted(missing))]


def _read(
    path: Path, chains: Sequence[str], progress: Callable[[float, str], None] | None = None
) -> Sample:
    return sample_of(open_source(path, progress=progress), chains, str(path))


def sample_of(recording: Recording, chains: Sequence[str] = (), name: str | None = None) -> Sample:
    """What counts of a recording, and of the ``chains`` that it has (none: its own)."""
    flow = recorded_flow(recording)
    named = named_callbacks(flow).select("callback_id", "node", "starts", "shown")
    names = {number: (node, starts) for number, node, starts, _ in named.iter_rows()}
    shown = {(node, starts): text for _, node, starts, text in named.iter_rows()}
    ended = flow.instances.filter(pl.col("callback_id").is_in([*names]) & ~pl.col("assumed"))
    ended = ended.drop_nulls("end").with_columns(response=pl.col("end") - pl.col("start"))
    hit = pl.Series(stalled_after(flow, ended["start"].to_numpy(), ended["end"].to_numpy()))
    taken = pl.col("response", "execution_ns").cast(pl.Float64).clip(1)
    ended = ended.with_columns(pl.when(~hit).then(taken).fill_null(np.nan))
    calm = ended.join(named, on="callback_id", maintain_order="left")
    callbacks = {
        (node, starts): Taken(own["response"].to_numpy(), own["execution_ns"].to_numpy())
        for (node, starts), own in calm.group_by("node", "starts", maintain_order=True)
    }
    found = {}
    for chain in chains or (None,):
        with contextlib.suppress(InputError):  # it names none, or the chain is not in it
            analysis = measure_latency(recording, chain, flow=flow).analysis
            median = analysis.undisturbed.percentiles_ns.get("50", np.nan)
            on_the_way = frozenset(names[n] for n in analysis.chain.callbacks if n in names)
            found[analysis.chain.spec] = (float(median), on_the_way)
    return Sample(name or str(recording.path), callbacks, found, shown)


def find_slowdowns(
    samples: Sequence[Sample], before: Sequence[Sample]
) -> tuple[list[Compared], list[str]]:
    """Every callback of all samples together beside those of before, and what was not compared.

    Raises InputError: they have no callback in common, or too few instances of each.
    """
    every, notes = [*before, *samples], list[str]()
    named = [frozenset(one.callbacks) for one in every]
    times: dict[Name, tuple[str, list[Times]]] = {}
    beside: dict[Name, list[Times]] = {}
    for name in sorted(frozenset.intersection(*named)):
        for time in reversed(Taken._fields):
            own = [getattr(one.callbacks[name], time) for one in every]
            if min(np.count_nonzero(~np.isnan(one)) for one in own) < FEWEST:
                continue
            ratios = [_ratios(own[0], one) for one in own]
            if min(one.size for one in ratios) >= BLOCKS:
                times[name], beside[name] = (time, own), ratios
            break
    if not times:
        raise InputError(
            f"{every[-1].recording} and {every[0].recording} have no callback with {FEWEST}"
            " undisturbed instances or more in common: compare recordings of the same application,"
            " and record longer"
        )
    if left_out := sorted(frozenset.union(*named) - frozenset(times)):
        listed = ", ".join(f"{node} ({starts})" for node, starts in left_out)
        notes.append(
            f"not compared, since not all recordings have {FEWEST} undisturbed instances: {listed}"
        )
    figures = np.array([[_beside(one) for one in own] for own in beside.values()])
    shifts, errors, noise = np.moveaxis(figures, 2, 0)  # [callback, recording]
    common, tested = _tested(shifts, errors[:, 1:], noise[:, 1:], len(before))
    if abs(common) > LEAST:
        notes.append(
            f"all callbacks took {expm1(common):+.1%}: the machine, or all of the program;"
            " taken out of each"
        )
    more = f" and {len(samples) - 1} more" if len(samples) > 1 else ""
    compared = []
    for (name, (time, own)), *figure in zip(times.items(), *tested, strict=True):
        change, p, resolution = map(float, figure)
        compared.append(
            Compared(
                recording=samples[0].recording + more,
                node=name[0],
                starts=samples[-1].shown.get(name, name[1]),
                time=time,
                before_ns=float(np.median([np.nanmedian(one) for one in own[: len(before)]])),
                change=expm1(change),
                p=p,
                resolution=expm1(resolution),
                chains=_chains(samples, before, name),
            )
        )
    compared.sort(key=lambda one: one.p)
    return compared, [*notes, *_doubts(compared, min(len(samples), len(before)))]


def _doubts(compared: Sequence[Compared], fewest: int) -> Iterator[str]:
    """What speaks against the verdicts, by how many recordings a side has."""
    if fewest < SEVERAL and not all(one.met for one in compared):
        yield (
            "now and then a process runs slower from its start to its end, by chance: see whether"
            f" {SEVERAL} recordings of each side say the same"
        )
    worst = max(compared, key=lambda one: one.resolution)
    if worst.resolution > MUCH:
        least = min(one.resolution for one in compared)
        yield (
            f"detects slowdowns above {least:.1%}, at {worst.where} above {worst.resolution:.1%}:"
            " record more, or longer, to detect smaller ones"
        )


def _chains(samples: Sequence[Sample], before: Sequence[Sample], name: Name) -> dict[str, float]:
    """By how much the chains through a callback changed (ns)."""
    changes = {}
    for chain, (_, on_the_way) in before[0].chains.items():
        if name in on_the_way and all(chain in one.chains for one in (*samples, *before)):
            sides = [[one.chains[chain][0] for one in side] for side in (samples, before)]
            changes[chain] = float(np.median(sides[0]) - np.median(sides[1]))
    return changes


def _beside(ratios: Times) -> tuple[float, float, float]:
    """How much longer instances took than those of the first recording: median of log ratios, its
    standard error, and their robust standard deviation."""
    medians = [np.median(block) for block in np.array_split(ratios, BLOCKS)]
    error = float(np.std(medians, ddof=1)) / np.sqrt(len(medians))
    return float(np.median(ratios)), error, float(_robust_deviation(ratios))


def _robust_deviation(values: Times) -> Times:
    """The standard deviation along the last axis, from the median distance from the median."""
    apart = np.abs(values - np.median(values, axis=-1, keepdims=True))
    return np.asarray(np.median(apart, axis=-1) / NORMAL_QUARTILE)


def _ranks(values: Times) -> Times:
    """The rank of each value, from 1; the same values have the mean of theirs."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts - 1) / 2)[places])


def _ratios(first: Times, own: Times) -> Times:
    """The logarithms of how much longer instances took, of those undisturbed in both."""
    if own is first:
        return np.zeros(np.count_nonzero(~np.isnan(own)))
    places, beside = _alike(first, own)
    ratios = np.log(own[beside] / first[places])
    return np.asarray(ratios[~np.isnan(ratios)])


def _alike(first: Times, own: Times) -> tuple[Places, Places]:
    """Which instances of two recordings did the same work; in their order, if none seem to."""
    ranks, others = (_ranks(np.nan_to_num(one, nan=np.nanmedian(one))) for one in (first, own))
    shift, found, likeness = 0, list[tuple[int, int]](), list[float]()
    for start in range(0, len(own) - WINDOW + 1, WINDOW):
        low, high = max(0, start + shift - SHIFT), start + shift + SHIFT + WINDOW
        if len(near := ranks[low:high]) < WINDOW:
            break
        windows, other = sliding_window_view(near, WINDOW), others[start : start + WINDOW]
        scale = windows.std(axis=1) * other.std() * WINDOW + 1e-9  # ranks may be all the same
        alike = (windows @ (other - other.mean())) / scale
        best = int(alike.argmax())
        likeness.append(alike[best])
        if alike[best] > ALIKE:
            shift = low + best - start
            found.append((low + best, start))
    if not found or np.median(likeness) < ALIKE:
        every = np.arange(min(len(first), len(own)))
        return every, every
    places = np.add.outer(np.array(found), np.arange(WINDOW))
    return places[:, 0].ravel(), places[:, 1].ravel()


def _tested(
    shifts: Times, errors: Times, noise: Times, before: int
) -> tuple[float, tuple[Times, Times, Times]]:
    """The test of each row of ``shifts`` (a callback's in every recording, those of before first).

    ``errors`` and ``noise`` are those of :func:`_beside`. Returns what the callbacks have in common
    and of each the change, ``p`` and the resolution; changes are logarithms.
    """
    count, runs = shifts.shape
    shifts = shifts - np.median(shifts[:, :before], axis=1, keepdims=True)
    per_run = np.clip(RUN_SHARE * noise.mean(axis=1), RUN_LEAST, RUN_MOST)
    prior = np.hypot(errors.mean(axis=1) / np.sqrt(2), per_run)
    common, unsure = np.zeros_like(shifts), np.zeros(count)
    for place in range(count if count > 2 else 0):  # of two nothing says which one changed
        others = np.arange(count) != place
        common[place] = _weighted_median(shifts[others], 1 / prior[others])
        unsure[place] = np.pi / 2 * (count - 1) / np.sum(1 / prior[others]) ** 2
    shifts = shifts - np.clip(common, -COMMON, COMMON)
    variance = prior**2 + unsure
    sides = np.split(shifts, [before], axis=1)
    centres = [np.median(side, axis=1, keepdims=True) for side in sides]
    apart = np.hstack([side - centre for side, centre in zip(sides, centres, strict=True)])
    far = 3 * np.maximum(np.sqrt(variance), _robust_deviation(apart))
    before_, after = (
        np.clip(side, centre - far[:, None], centre + far[:, None])
        for side, centre in zip(sides, centres, strict=True)
    )
    squares = sum(side.var(axis=1) * side.shape[1] for side in (before_, after))
    freedom = PRIOR + runs - 2
    error = np.sqrt((PRIOR * variance + squares) / freedom * (1 / before + 1 / (runs - before)))
    change = after.mean(axis=1) - before_.mean(axis=1)
    tails = np.array([t_tail(t, freedom) for t in ((change - LEAST) / error).tolist()])
    p = np.minimum(1.0, count * tails)
    quantiles = t_quantile(LEVEL / count, freedom) + t_quantile(0.05, freedom)
    taken_out = np.median(common[:, before:]) - np.median(common[:, :before])
    return float(taken_out), (change, p, LEAST + quantiles * error)


def _weighted_median(rows: Times, weights: Times) -> Times:
    """Of each column; between two rows where the weights are halved there."""
    order = np.argsort(rows, axis=0)
    heights = np.cumsum(weights[order], axis=0) - weights[order] / 2
    half = weights.sum() / 2
    columns = zip(np.take_along_axis(rows, order, axis=0).T, heights.T, strict=True)
    return np.array([np.interp(half, height, row) for row, height in columns])
