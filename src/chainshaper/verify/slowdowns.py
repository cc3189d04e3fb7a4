"""Slowdowns: callbacks that take longer than in recordings of before, by more than noise.

CPU times are compared if all recordings have them, else the times from start to end, without
instances that met a stall of the machine. Each recording is compared with the first one of before:

* **The same work.** A program that gets the same input again computes as long for the same message.
  Stretches of WINDOW instances are laid beside stretches of the first recording that go up and down
  alike (rank correlation), so that the variation of the input cancels out, also after messages were
  lost. If inputs differ, instances are compared in their order.
* **A run's figure** is the median of the logarithms of these ratios. Its error is that of the means
  of BLOCKS consecutive medians, since neighbours are alike (batch means: Schmeiser, 1982).
* **The same machine.** Clock rate, caches and stolen time change all callbacks of a run. The change
  that the other callbacks have in common (a weighted median, at most COMMON) is subtracted.
* **The same program** still differs from run to run, because memory lies elsewhere as long as its
  processes live. How much is estimated from the recordings of both sides. If these are few, it is
  estimated from how much single instances vary, which counts as much as PRIOR recordings (a
  moderated t-test: Smyth, 2004). Single runs far from the others are drawn in (Winsor).

A callback is slower if the change is above LEAST, with a probability of error below LEVEL over all
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
from chainshaper.analysis.graph import with_possible_hand_overs
from chainshaper.analysis.latency import named_callbacks
from chainshaper.sources import open_source
from chainshaper.values.errors import InputError
from chainshaper.values.many_tasks import computed
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import measure_latency
from chainshaper.verify.student import t_quantile, t_tail

LEVEL = 1 / 200  # probability of error over all callbacks
LEAST = log1p(0.005)
"""Less is no slowdown: another build of the same program differs by as much."""
COMMON = log1p(0.1)  # the largest change that callbacks have in common and that is subtracted
PRIOR = 12  # how many recordings the expected deviation counts for
RUN_SHARE, RUN_LEAST, RUN_MOST = 0.25, 0.001, 0.015
"""Expected standard deviation from run to run: a share of that of ratios of instances, and its
limits."""
WINDOW = 32  # instances in a stretch
ALIKE = 0.8  # correlation from which two stretches are the same work
SHIFT = 128  # instances, by which a stretch may lie elsewhere than the one before
BLOCKS = 20  # of consecutive instances, for the error of a run's figure
FEWEST = 40  # undisturbed instances that a callback needs
NORMAL_QUARTILE = 0.6744897501960817  # of a normal distribution, in standard deviations
SEVERAL = 3  # recordings of each side from which chance is unlikely
MUCH = 0.03  # a resolution above this is worth a note

Times: TypeAlias = npt.NDArray[np.float64]
Places: TypeAlias = npt.NDArray[np.intp]
Name: TypeAlias = tuple[str, str]


class Taken(NamedTuple):
    """Times of a callback's instances, in their order (ns; NaN: a stall hit it, or not known)."""

    response: Times
    execution: Times


@dataclass(frozen=True)
class Sample:
    """The data of a recording that are compared. Callbacks are named by node and trigger."""

    recording: str
    callbacks: Mapping[Name, Taken]
    chains: Mapping[str, tuple[float, frozenset[Name]]]
    """Chain → its median undisturbed latency (ns), and the callbacks on the way."""
    shown: Mapping[Name, str] = field(default_factory=dict)
    """Text of each trigger, with the period that a timer's starts show."""
    doubts: tuple[str, ...] = ()  # why what the user declared cannot be in it


@dataclass(frozen=True)
class Compared:
    """A callback in some recordings, compared with recordings of before."""

    recording: str
    node: str
    starts: str  # its trigger
    time: str  # that was compared: "execution" or "response"
    before_ns: float  # median of that time before
    change: float  # by which share it is longer (0.03: by 3 %)
    p: float  # probability of so much by chance, in any of all callbacks
    resolution: float  # a change of so much would be found in 95 % of comparisons
    chains: Mapping[str, float] = field(default_factory=dict)
    """Chain through the callback → by how much its median latency changed (ns)."""

    @property
    def met(self) -> bool:
        """Whether it is no slowdown."""
        return not self.p < LEVEL

    @property
    def where(self) -> str:
        """Text: node and trigger."""
        return f"{self.node} ({self.starts})"

    @property
    def figure(self) -> str:
        """Text: the time that was compared, and with what."""
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
    *,
    through: Sequence[str] = (),
) -> tuple[list[Compared], list[str]]:
    """Read recordings and traces in parallel, and find slowdowns (:func:`find_slowdowns`).

    ``chains`` are those whose latencies are compared; (): those that recordings name. ``through``
    is what the user declares that no event shows (:mod:`~chainshaper.values.handed_over`). A
    recording in which that cannot be is compared without it. Raises: as
    :func:`find_slowdowns` and :func:`~chainshaper.values.many_tasks.engine`. InputError: a
    recording cannot be read.
    """
    all_paths, purpose = [*paths, *before], "a comparison"
    samples = computed(
        _read,
        all_paths,
        (tuple(chains), tuple(through)),
        scheduler=scheduler,
        purpose=purpose,
        progress=progress,
    )
    compared, notes = find_slowdowns(samples[: len(paths)], samples[len(paths) :])
    missing = {
        (chain, sample.recording)
        for chain in chains
        for sample in samples
        if chain not in sample.chains
    }
    notes += [f"{chain} is not in {name}" for chain, name in sorted(missing)]
    notes += [f"{sample.recording}: {doubt}" for sample in samples for doubt in sample.doubts]
    return compared, notes


def _read(
    path: Path,
    asked: tuple[tuple[str, ...], tuple[str, ...]],
    progress: Callable[[float, str], None] | None = None,
) -> Sample:
    """Read the sample of a recording, by chains and declarations; one of many tasks."""
    chains, through = asked
    return sample_of(open_source(path, progress=progress, through=through), chains, str(path))


def sample_of(recording: Recording, chains: Sequence[str] = (), name: str | None = None) -> Sample:
    """Collect the data of a recording to compare, with ``chains`` that it has ((): its own)."""
    flow, doubts = with_possible_hand_overs(recorded_flow(recording))
    named = named_callbacks(flow).select("callback_id", "node", "starts", "shown")
    names = {number: (node, starts) for number, node, starts, _ in named.iter_rows()}
    shown = {(node, starts): text for _, node, starts, text in named.iter_rows()}
    ended = flow.instances.filter(pl.col("callback_id").is_in([*names]) & ~pl.col("assumed"))
    ended = ended.drop_nulls("end").with_columns(response=pl.col("end") - pl.col("start"))
    stalled = pl.Series(stalled_after(flow, ended["start"].to_numpy(), ended["end"].to_numpy()))
    taken = pl.col("response", "execution_ns").cast(pl.Float64).clip(1)
    ended = ended.with_columns(pl.when(~stalled).then(taken).fill_null(np.nan))
    calm = ended.join(named, on="callback_id", maintain_order="left")
    callbacks = {
        (node, starts): Taken(
            instances["response"].to_numpy(), instances["execution_ns"].to_numpy()
        )
        for (node, starts), instances in calm.group_by("node", "starts", maintain_order=True)
    }
    measured_chains = {}
    for chain in chains or (None,):
        with contextlib.suppress(InputError):  # the recording names no chain, or does not have it
            analysis = measure_latency(recording, chain, flow=flow).analysis
            median = analysis.undisturbed.percentiles_ns.get("50", np.nan)
            on_the_way = frozenset(
                names[number] for number in analysis.chain.callbacks if number in names
            )
            measured_chains[analysis.chain.spec] = (float(median), on_the_way)
    return Sample(name or str(recording.path), callbacks, measured_chains, shown, doubts)


def find_slowdowns(
    samples: Sequence[Sample], before: Sequence[Sample]
) -> tuple[list[Compared], list[str]]:
    """Compare each callback, over all samples together, with those of before.

    The second value has notes on what was not compared, and on doubts. Raises InputError: the
    samples have no callback in common, or too few instances of each.
    """
    all_samples, notes = [*before, *samples], list[str]()
    named = [frozenset(sample.callbacks) for sample in all_samples]
    times: dict[Name, tuple[str, list[Times]]] = {}
    beside: dict[Name, list[Times]] = {}
    for name in sorted(frozenset.intersection(*named)):
        for time in reversed(Taken._fields):
            times_of_name = [getattr(sample.callbacks[name], time) for sample in all_samples]
            if min(np.count_nonzero(~np.isnan(of_sample)) for of_sample in times_of_name) < FEWEST:
                continue
            ratios = [_ratios(times_of_name[0], of_sample) for of_sample in times_of_name]
            if min(of_sample.size for of_sample in ratios) >= BLOCKS:
                times[name], beside[name] = (time, times_of_name), ratios
            break
    if not times:
        raise InputError(
            f"{all_samples[-1].recording} and {all_samples[0].recording} have no callback with"
            f" {FEWEST} undisturbed instances or more in common: compare recordings of the same"
            " application, and record longer"
        )
    if left_out := sorted(frozenset.union(*named) - frozenset(times)):
        listed = ", ".join(f"{node} ({starts})" for node, starts in left_out)
        notes.append(
            f"not compared, since not all recordings have {FEWEST} undisturbed instances: {listed}"
        )
    figures = np.array(
        [
            [_beside(ratios_of_sample) for ratios_of_sample in ratios_of_name]
            for ratios_of_name in beside.values()
        ]
    )
    shifts, errors, noise = np.moveaxis(figures, 2, 0)  # [callback, recording]
    common, tested = _tested(shifts, errors[:, 1:], noise[:, 1:], len(before))
    if abs(common) > LEAST:
        notes.append(
            f"all callbacks took {expm1(common):+.1%}: the machine, or all of the program;"
            " taken out of each"
        )
    more = f" and {len(samples) - 1} more" if len(samples) > 1 else ""
    compared = []
    for (name, (time, times_of_name)), *figure in zip(times.items(), *tested, strict=True):
        medians = [np.nanmedian(of_sample) for of_sample in times_of_name[: len(before)]]
        change, p, resolution = map(float, figure)
        compared.append(
            Compared(
                recording=samples[0].recording + more,
                node=name[0],
                starts=samples[-1].shown.get(name, name[1]),
                time=time,
                before_ns=float(np.median(medians)),
                change=expm1(change),
                p=p,
                resolution=expm1(resolution),
                chains=_chains(samples, before, name),
            )
        )
    compared.sort(key=lambda callback: callback.p)
    return compared, [*notes, *_doubts(compared, min(len(samples), len(before)))]


def _doubts(compared: Sequence[Compared], fewest: int) -> Iterator[str]:
    """Yield notes on what makes verdicts doubtful; a side has ``fewest`` recordings or more."""
    if fewest < SEVERAL and not all(callback.met for callback in compared):
        yield (
            "now and then a process runs slower from its start to its end, by chance: see whether"
            f" {SEVERAL} recordings of each side say the same"
        )
    worst = max(compared, key=lambda callback: callback.resolution)
    if worst.resolution > MUCH:
        least = min(callback.resolution for callback in compared)
        yield (
            f"detects slowdowns above {least:.1%}, at {worst.where} above {worst.resolution:.1%}:"
            " record more, or longer, to detect smaller ones"
        )


def _chains(samples: Sequence[Sample], before: Sequence[Sample], name: Name) -> dict[str, float]:
    """Map chains through a callback to how much their median latency changed (ns)."""
    changes = {}
    for chain, (_, on_the_way) in before[0].chains.items():
        if name in on_the_way and all(chain in sample.chains for sample in (*samples, *before)):
            sides = [[sample.chains[chain][0] for sample in side] for side in (samples, before)]
            changes[chain] = float(np.median(sides[0]) - np.median(sides[1]))
    return changes


def _beside(ratios: Times) -> tuple[float, float, float]:
    """Sum up how much longer instances took than those of the first recording.

    Return the median of the logarithms of ratios, its standard error, and their robust standard
    deviation.
    """
    medians = [np.median(block) for block in np.array_split(ratios, BLOCKS)]
    error = float(np.std(medians, ddof=1)) / np.sqrt(len(medians))
    return float(np.median(ratios)), error, float(_robust_deviation(ratios))


def _robust_deviation(values: Times) -> Times:
    """Standard deviations along the last axis, from the median distance from the median."""
    apart = np.abs(values - np.median(values, axis=-1, keepdims=True))
    return np.asarray(np.median(apart, axis=-1) / NORMAL_QUARTILE)


def _ranks(values: Times) -> Times:
    """Ranks of values, from 1; equal values have the mean of their ranks."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts - 1) / 2)[places])


def _ratios(first: Times, second: Times) -> Times:
    """Logarithms of how much longer instances took, of those undisturbed in both recordings."""
    if second is first:
        return np.zeros(np.count_nonzero(~np.isnan(second)))
    places, beside = _alike(first, second)
    ratios = np.log(second[beside] / first[places])
    return np.asarray(ratios[~np.isnan(ratios)])


def _alike(first: Times, second: Times) -> tuple[Places, Places]:
    """Pair the instances of two recordings that did the same work; if none did, by their order."""
    ranks, second_ranks = (
        _ranks(np.nan_to_num(times, nan=np.nanmedian(times))) for times in (first, second)
    )
    shift, pairs, likeness = 0, list[tuple[int, int]](), list[float]()
    for start in range(0, len(second) - WINDOW + 1, WINDOW):
        low, high = max(0, start + shift - SHIFT), start + shift + SHIFT + WINDOW
        if len(nearby := ranks[low:high]) < WINDOW:
            break
        windows, stretch = sliding_window_view(nearby, WINDOW), second_ranks[start : start + WINDOW]
        scale = windows.std(axis=1) * stretch.std() * WINDOW + 1e-9  # ranks may be all the same
        alike = (windows @ (stretch - stretch.mean())) / scale
        best = int(alike.argmax())
        likeness.append(alike[best])
        if alike[best] > ALIKE:
            shift = low + best - start
            pairs.append((low + best, start))
    if not pairs or np.median(likeness) < ALIKE:
        in_order = np.arange(min(len(first), len(second)))
        return in_order, in_order
    places = np.add.outer(np.array(pairs), np.arange(WINDOW))
    return places[:, 0].ravel(), places[:, 1].ravel()


def _tested(
    shifts: Times, errors: Times, noise: Times, before: int
) -> tuple[float, tuple[Times, Times, Times]]:
    """Test each row of ``shifts``: those of a callback in every recording, those of before first.

    ``errors`` and ``noise`` are those of :func:`_beside`, ``before`` is how many recordings are of
    before. Return the change that callbacks have in common, and for each callback its change, its
    ``p`` and its resolution. Changes are logarithms.
    """
    count, runs = shifts.shape
    shifts = shifts - np.median(shifts[:, :before], axis=1, keepdims=True)
    per_run = np.clip(RUN_SHARE * noise.mean(axis=1), RUN_LEAST, RUN_MOST)
    prior = np.hypot(errors.mean(axis=1) / np.sqrt(2), per_run)
    common, unsure = np.zeros_like(shifts), np.zeros(count)
    for place in range(count if count > 2 else 0):  # of two callbacks, either may have changed
        rest = np.arange(count) != place
        common[place] = _weighted_median(shifts[rest], 1 / prior[rest])
        unsure[place] = np.pi / 2 * (count - 1) / np.sum(1 / prior[rest]) ** 2
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
    """The weighted median of each column, interpolated between the two rows beside it."""
    order = np.argsort(rows, axis=0)
    heights = np.cumsum(weights[order], axis=0) - weights[order] / 2
    half = weights.sum() / 2
    columns = zip(np.take_along_axis(rows, order, axis=0).T, heights.T, strict=True)
    return np.array([np.interp(half, height, row) for row, height in columns])
