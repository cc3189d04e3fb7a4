"""How often a plan's promise holds: known distributions, samples of several sizes, many plans.

    python experiments/promises.py [--repeats 200] [--seed 39] [--only DISTRIBUTION]

From each sample a plan is made, by default and for a share of late outputs that is asked for. Its
promise holds if that share of all cycles to come, at most, is late: the distribution is known, so
what lies behind the slot's start is computed, not sampled. The way to the shaping node takes 0.2 ms
of it. The longest 5 % of the cycles count as disturbed by the machine. A plan that the sample does
not allow is refused, and counted apart. Cells: plans whose promise holds, of all that were made,
and how many samples were refused.
"""

import argparse
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from scipy import stats

from chainshaper.planning import PlanRequest, Profile, plan_chain, publish_slots
from chainshaper.planning.margins import HOP_NS
from chainshaper.values.errors import OperationError

MS, CYCLE_MS = 1_000_000, 10_000  # so long that it refuses no plan
SIZES = (300, 1_000, 3_000, 10_000)
SHARES = (None, 1e-3, 1e-4)
"""Late outputs that are asked for; None: the default, whose promise is what the plan says."""
CALM = 0.95  # so far the latencies are of cycles that the machine did not disturb
CORRELATION = 0.7  # of one cycle with the next
SLOW, SLOW_CYCLES, SLOWER_MS = 0.1, 4, 25.0  # share of slow cycles, how many follow each other
Floats = npt.NDArray[np.float64]


class Distribution(NamedTuple):
    """Latencies in ms: how they are drawn, in the order of time, and who takes longer than that."""

    draw: Callable[[np.random.Generator, int], Floats]
    longer: Callable[[float], float]


def following(random: np.random.Generator, count: int) -> Floats:
    """A normal variable of which each value depends on the one before."""
    noise, values = random.standard_normal(count), np.empty(count)
    values[0] = noise[0]
    for number in range(1, count):
        fresh = math.sqrt(1 - CORRELATION**2) * noise[number]
        values[number] = CORRELATION * values[number - 1] + fresh
    return values


def slow_stretches(random: np.random.Generator, count: int) -> Floats:
    """Gamma distributed latencies; stretches of cycles take 25 ms longer."""
    slow, now = np.zeros(count), bool(random.random() < SLOW)
    leaves, enters = 1 / SLOW_CYCLES, SLOW / (1 - SLOW) / SLOW_CYCLES
    for number, chance in enumerate(random.random(count)):
        slow[number] = now
        now = bool(chance >= leaves) if now else bool(chance < enters)
    drawn: Floats = random.gamma(9, 2, count)
    return drawn + SLOWER_MS * slow


def _mixed(share: float, slow: float, usual: float) -> float:
    return share * slow + (1 - share) * usual


DISTRIBUTIONS = {
    "uniform": Distribution(
        lambda random, count: random.uniform(20, 60, count),
        lambda ms: float(np.clip((60 - ms) / 40, 0, 1)),
    ),
    "beta (2, 5)": Distribution(
        lambda random, count: 20 + 40 * random.beta(2, 5, count),
        lambda ms: float(stats.beta.sf((ms - 20) / 40, 2, 5)),
    ),
    "exponential": Distribution(
        lambda random, count: 20 + random.exponential(8, count),
        lambda ms: math.exp(-max(0, ms - 20) / 8),
    ),
    "exponential, in whole ms": Distribution(
        lambda random, count: np.round(20 + random.exponential(8, count)),
        lambda ms: math.exp(-max(0, math.floor(ms) + 0.5 - 20) / 8),
    ),
    "lognormal (σ 0.4)": Distribution(
        lambda random, count: 20 * np.exp(0.4 * random.standard_normal(count)),
        lambda ms: float(stats.norm.sf(math.log(ms / 20) / 0.4)),
    ),
    "Pareto (α 3)": Distribution(
        lambda random, count: 20 + 8 * random.pareto(3, count),
        lambda ms: (1 + max(0, ms - 20) / 8) ** -3.0,
    ),
    "two modes (5 % slow)": Distribution(
        lambda random, count: random.normal(
            np.where(random.random(count) < 0.05, 60.0, 30.0), 3, count
        ),
        lambda ms: float(_mixed(0.05, stats.norm.sf((ms - 60) / 3), stats.norm.sf((ms - 30) / 3))),
    ),
    "autoregressive (0.7)": Distribution(
        lambda random, count: 40 + 5 * following(random, count),
        lambda ms: float(stats.norm.sf((ms - 40) / 5)),
    ),
    "slow stretches (4 cycles)": Distribution(
        slow_stretches,
        lambda ms: float(
            _mixed(SLOW, stats.gamma.sf(ms - SLOWER_MS, 9, scale=2), stats.gamma.sf(ms, 9, scale=2))
        ),
    ),
}


def held_of(
    name: str, size: int, share: float | None, repeats: int, seed: int = 0
) -> tuple[int, int]:
    """Of so many samples: the plans whose promise holds, and how many plans were made."""
    distribution, held, made = DISTRIBUTIONS[name], 0, 0
    for number in range(repeats):
        random = np.random.default_rng([seed, number, size, list(DISTRIBUTIONS).index(name)])
        sample = (distribution.draw(random, size) * MS).astype(np.int64)
        try:
            request = PlanRequest(overrun_probability=share)
            calm = sample[sample <= np.quantile(sample, CALM)]
            profile = Profile(
                calm, CYCLE_MS * MS, every_latency_ns=sample, disturbed=size - calm.size
            )
            plan = plan_chain(profile, request)
        except OperationError:
            continue
        start = publish_slots(plan)[-1][0] - HOP_NS
        promised = plan.margin.overrun_probability or 0.0
        made += 1
        held += distribution.longer(start / MS) <= promised
    return held, made


def table_of(share: float | None, names: Sequence[str], repeats: int, seed: int) -> Table:
    """Of one promise: a row for each distribution, a column for each size of the sample."""
    asked = "by default" if share is None else f"at most {share:.2%} late"
    table = Table(title=f"{asked}: plans whose promise holds, of those made (samples refused)")
    for title in ("latencies", *(f"{size:,} cycles" for size in SIZES)):
        table.add_column(title)
    for name in names:
        cells = []
        for size in SIZES:
            held, made = held_of(name, size, share, repeats, seed)
            cells.append(f"{held} of {made} ({repeats - made})" if made else "refused")
        table.add_row(name, *cells)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--seed", type=int, default=39)
    parser.add_argument("--only", choices=DISTRIBUTIONS)
    given = parser.parse_args()
    names = [given.only] if given.only else list(DISTRIBUTIONS)
    for share in SHARES:
        Console(width=140).print(table_of(share, names, given.repeats, given.seed))


if __name__ == "__main__":
    main()
