"""How old is what an actuator has? Every way to treat an output that missed its slot, compared.

    python benchmarks/age_of_output.py [RECORDING --chain FIRST..LAST]

Takes the latencies of all cycles of a recording (without one: 20,000 drawn ones, with stalls of
the machine in 2 % of the cycles), lets them pass the gate (:func:`chainshaper.robot.decision.
release_of`) behind two margins, and prints what arrives: the age of the newest output that the
actuator has, averaged over time, its 99th percentile and maximum, the jitter of the latency, the
longest gap between two outputs, and the share of outputs that come more than 1 ms behind their
slot's start. Nothing is asserted.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from chainshaper.flow.plan import profile_chains
from chainshaper.planning.late_shares import covered_latency
from chainshaper.planning.margins import EPSILON_NS, OVERRUN_PROBABILITY
from chainshaper.robot.decision import release_of
from chainshaper.robot.gate import OVERRUNS, Gate
from chainshaper.values.durations import milliseconds

Times = NDArray[np.int64]
MS = 1_000_000
PUBLISH_SLOT_NS = MS


def main() -> None:
    parser = argparse.ArgumentParser(description="The age of an actuator's newest output.")
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("--chain")
    chosen = parser.parse_args()
    if chosen.recording is None:
        undisturbed, every, period = _drawn()
    else:
        (profile,) = profile_chains(chosen.recording, [chosen.chain])
        undisturbed, period = profile.latencies_ns, profile.period_ns
        every = undisturbed if profile.every_latency_ns is None else profile.every_latency_ns
    longest = int(undisturbed.max())
    covered = max(longest, covered_latency(every, OVERRUN_PROBABILITY))
    figures = ("mean age", "p99", "maximum", "jitter", "longest gap", "late > 1 ms", "outputs")
    table = Table(title=f"{every.size} cycles of {milliseconds(period)} ms [ms]")
    table.add_column("slot starts at, missed outputs", no_wrap=True)
    for name in figures:
        table.add_column(name, justify="right")
    table.add_row("unshaped", *_row(_origins(every, period), every, longest))
    for start in (longest + EPSILON_NS, covered + EPSILON_NS):
        for overrun in OVERRUNS:
            gate = Gate(((start, start + PUBLISH_SLOT_NS),), period, overrun=overrun)
            origins, latencies = _passed(gate, every)
            table.add_row(f"{milliseconds(start)}, {overrun}", *_row(origins, latencies, start))
        table.add_section()
    Console(width=110).print(table)


def _drawn() -> tuple[Times, Times, int]:
    """Latencies of 40 to 65 ms in cycles of 100 ms; in one of 50 the machine stalls for 1–50 ms."""
    random = np.random.default_rng(0)
    undisturbed = (random.triangular(40, 52, 65, 20_000) * MS).astype(np.int64)
    stalls = (random.uniform(1, 50, undisturbed.size) * MS).astype(np.int64)
    return undisturbed, undisturbed + stalls * (random.random(undisturbed.size) < 0.02), 100 * MS


def _origins(latencies: Times, period: int) -> Times:
    return np.arange(latencies.size, dtype=np.int64) * period


def _passed(gate: Gate, latencies: Times) -> tuple[Times, Times]:
    """Origin and latency of every message that the gate lets through."""
    passed = []
    for origin, latency in zip(_origins(latencies, gate.cycle_ns), latencies, strict=True):
        at = release_of(gate, int(origin + latency), int(origin)).at_ns
        if at is not None:
            passed.append((origin, at - origin))
    origins, shaped = np.array(passed, dtype=np.int64).T
    return origins, shaped


def _row(origins: Times, latencies: Times, start: int) -> list[str]:
    """The table's figures; the age is sampled every 0.1 ms."""
    order = np.argsort(origins + latencies, kind="stable")
    came, newest = (origins + latencies)[order], np.maximum.accumulate(origins[order])
    instants = np.arange(came[0], came[-1], MS // 10)
    age = instants - newest[np.searchsorted(came, instants, side="right") - 1]
    late = np.mean(latencies > start + MS)
    return [
        *(
            milliseconds(float(figure))
            for figure in (age.mean(), np.quantile(age, 0.99), age.max())
        ),
        milliseconds(int(latencies.max() - latencies.min())),
        milliseconds(int(np.diff(came).max())),
        f"{late:.2%}",
        str(latencies.size),
    ]


if __name__ == "__main__":
    main()
