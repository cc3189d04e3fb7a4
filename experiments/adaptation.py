"""Slots that follow the latencies: a step of +20 % and a drift of +1 % a minute in execution times.

    python experiments/adaptation.py [--cycles 1000000] [--live MINUTES] [--keep FOLDER]

Simulated, cycle by cycle with the estimator that `apply --adapt` uses, for 600 cycles a minute:
nothing changes; times are 20 % longer in every other stretch of a tenth of the cycles; they grow by
1 % a minute for 20 minutes, and shrink again, and so on. A move is in force two cycles after it was
decided. Live, over DDS with a cycle of 20 ms: a step behind the first third, and the drift.

Late is what comes behind the beginning of its slot, as a multiple of what was promised; 50 cycles
after a step are left out. The average is that of the slot, against a planner that knew the future:
in every cycle its slot begins exactly where the promised share is late. The plan from the first
2,000 cycles (live: from a run before), unadapted, stands beside it.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import yaml
from rich.console import Console
from rich.table import Table

import chainshaper as cs
from chainshaper.planning import Plan, PlanRequest, publish_slots
from chainshaper.planning.adaptation import Tail
from chainshaper.planning.chain_plan import Adaptation, revised
from chainshaper.planning.late_shares import covered_latency
from chainshaper.planning.margins import HOP_NS
from chainshaper.workload.description import Application

MS, PROMISED, PER_MINUTE, AFTER_STEP, DELAY = 1_000_000, 0.01, 600, 50, 2
CYCLE_MS, WORK_MS, SPREAD = 20, 10.0, 0.03
Floats = npt.NDArray[np.float64]


def normal(random: np.random.Generator, count: int) -> Floats:
    """50 ms, 4 % of it the standard deviation."""
    return 50 * MS * (1 + 0.04 * random.standard_normal(count))


def callbacks(random: np.random.Generator, count: int) -> Floats:
    """Five callbacks of 10 ms, each of gamma distributed times that vary by 6 %."""
    total: Floats = random.gamma(280, 10 / 280 * MS, (5, count)).sum(axis=0)
    return total


def bimodal(random: np.random.Generator, count: int) -> Floats:
    """A tenth of the cycles takes 60 ms, the others 48 ms, and 1 ms more or less."""
    usual = np.where(random.random(count) < 0.1, 60.0, 48.0)
    return np.asarray((usual + random.standard_normal(count)) * MS)


def long_tailed(random: np.random.Generator, count: int) -> Floats:
    """40 ms, and an exponentially distributed 2.5 ms."""
    return 40 * MS + random.exponential(2.5 * MS, count)


def steady(cycle: npt.NDArray[np.int64], _: int) -> Floats:
    return np.ones(cycle.size)


def step(cycle: npt.NDArray[np.int64], count: int) -> Floats:
    return np.asarray(1 + 0.2 * (cycle // (count // 10) % 2), dtype=np.float64)


def drift(cycle: npt.NDArray[np.int64], _: int) -> Floats:
    place = cycle / (20 * PER_MINUTE) % 2
    return np.asarray(1 + 0.2 * np.minimum(place, 2 - place), dtype=np.float64)


def outside_steps(scale: Floats) -> npt.NDArray[np.bool_]:
    """All cycles but those behind a step."""
    counted = np.ones(scale.size, dtype=bool)
    for at in np.flatnonzero(np.abs(np.diff(scale)) > 0.1) + 1:
        counted[at : at + AFTER_STEP] = False
    return counted


def followed(latencies: Floats, planned: int) -> tuple[Floats, list[int]]:
    """Where the slot begins in every cycle, and the moves."""
    tail = Tail(Adaptation(), PROMISED, planned, float(np.median(latencies[:2_000])), 10**9)
    starts, moves = np.full(latencies.size, float(planned)), []
    for number, latency in enumerate(latencies.tolist()):
        if (start := tail.add(latency)) is not None:
            moves.append(start)
            starts[number + 1 + DELAY :] = start
    return starts, moves


def row(
    table: Table,
    names: tuple[str, str],
    latencies: Floats,
    starts: Floats,
    *,
    planned: float,
    known: Floats,
    counted: npt.NDArray[np.bool_],
    moves: int,
) -> None:
    def figures(where: Floats | float) -> tuple[str, str]:
        late = float(np.mean((latencies > where)[counted])) / PROMISED
        return f"{late:.2f}", f"{np.mean(where) / known.mean() - 1:+.2%}"

    table.add_row(*names, *figures(starts), str(moves), *figures(planned))


def new_table(title: str) -> Table:
    table = Table(title=title)
    for name in ("latencies", "change", "late", "average", "moves", "unadapted: late", "average"):
        table.add_column(name)
    return table


def simulated(count: int) -> Table:
    table = new_table(f"{count:,} simulated cycles, {PROMISED:.0%} promised")
    for kind in (callbacks, normal, bimodal, long_tailed):
        random = np.random.default_rng(7)
        drawn = kind(random, count)
        beyond = float(np.quantile(kind(random, 4_000_000), 1 - PROMISED))
        for change in (steady, step, drift):
            scale = change(np.arange(count), count)
            latencies = drawn * scale
            planned = covered_latency(kind(random, 2_000).astype(np.int64), PROMISED)
            starts, moves = followed(latencies, planned)
            row(
                *(table, (kind.__name__, change.__name__), latencies, starts),
                planned=float(planned),
                known=beyond * scale,
                counted=outside_steps(scale),
                moves=len(moves),
            )
    return table


# Live -------------------------------------------------------------------------------------------

_calls = 0


def work(message: bytes) -> bytes:
    """A callback of the live workload: compute for as long as it does in this cycle."""
    global _calls  # noqa: PLW0603 - a node's process has one such callback
    begun = time.thread_time_ns()
    scale = live_scale(np.array([_calls]), os.environ["CHANGE"], int(os.environ["CYCLES"]))[0]
    drawn = np.random.default_rng(_calls).normal(1, SPREAD)
    _calls += 1
    until = begun + round(WORK_MS * MS * scale * drawn)
    while time.thread_time_ns() < until:
        pass
    return message


def live_scale(cycle: npt.NDArray[np.int64], change: str, count: int) -> Floats:
    if change == "step":
        return np.where(cycle < count // 3, 1.0, 1.2)
    a_cycle = CYCLE_MS / 60_000 / 100 if change == "drift" else 0.0
    return np.asarray(1 + cycle * a_cycle, dtype=np.float64)


def application() -> Application:
    described = {
        "name": "slots that follow",
        "chain": "/t1../t3",
        "scheduling": {
            "executors": {"core": 1, "priority": 80},
            "dds": {"core": 0, "priority": 90},
        },
        "nodes": {
            "t1": _node(timer=f"{CYCLE_MS}ms", execution={"constant": "500us"}, publishes=["/t1"]),
            "t2": _node(subscription="/t1", computes="adaptation:work", publishes=["/t2"]),
            "t3": _node(subscription="/t2", execution={"constant": "500us"}, publishes=["/t3"]),
            "sink": {"core": 0, "priority": 70, **_node(subscription="/t3")},
        },
    }
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        yaml.safe_dump(described, file)
        file.flush()
        return cs.load_application(file.name)


def _node(**callback: object) -> dict[str, object]:
    return {"callbacks": [callback]}


def live(minutes: float, folder: Path) -> Table:
    os.environ["PYTHONPATH"] = f"{Path(__file__).parent}:{os.environ.get('PYTHONPATH', '')}"
    os.environ |= {"CHANGE": "steady", "CYCLES": "1000"}
    app, count = application(), round(minutes * 60_000 / CYCLE_MS)
    before = cs.run_application(app, folder / "before", cycles=1_000)
    # As simulated, no room but for what latencies do not contain: the way to the shaping node.
    plan = cs.plan_recording(before, request=PlanRequest(epsilon_ns=HOP_NS)).chains[0]
    # What 1,000 cycles show is less, for which a window of 4,000 is hardly long enough.
    margin = plan.margin.model_copy(update={"overrun_probability": PROMISED})
    plan = revised(plan, margin=margin)
    planned = publish_slots(plan)[-1][0]
    table = new_table(f"{count:,} cycles of {CYCLE_MS} ms, live, {PROMISED:.0%} promised")
    for change in ("step", "drift"):
        os.environ |= {"CHANGE": change, "CYCLES": str(count)}
        shaped = cs.shape_application(app, Plan.of(plan), folder / change, cycles=count, adapt=True)
        rows = shaped.events["gate_release"].sort("arrival")
        latencies = (rows["arrival"] - rows["origin"]).to_numpy().astype(float)
        starts = planned + rows["moved"].to_numpy().astype(float)
        # Warm-up cycles are not recorded.
        scale = live_scale(np.arange(5, 5 + latencies.size), change, count)
        usual = WORK_MS * MS * scale
        row(
            *(table, ("over DDS", change), latencies, starts),
            planned=float(planned),
            known=usual + float(np.quantile(latencies - usual, 1 - PROMISED)),
            counted=outside_steps(scale),
            moves=int(np.count_nonzero(np.diff(starts))),
        )
        table.caption = f"{rows['dropped'].count()} messages dropped; see {folder}"
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description="Slots that follow the latencies.")
    parser.add_argument("--cycles", type=int, default=1_000_000)
    parser.add_argument("--live", type=float, metavar="MINUTES", help="run live as well")
    parser.add_argument("--keep", type=Path, help="a new folder for the recordings")
    given = parser.parse_args()
    tables: list[Callable[[], Table]] = []
    if given.cycles:
        tables.append(lambda: simulated(given.cycles))
    if given.live:
        folder = given.keep or Path(tempfile.mkdtemp())
        folder.mkdir(exist_ok=True)
        tables.append(lambda: live(given.live, folder))
    for made in tables:
        Console().print(made())


if __name__ == "__main__":
    main()
