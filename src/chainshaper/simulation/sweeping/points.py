"""One point of a sweep: profile the chain, plan it, simulate it shaped, and say how it went.

The run that is planned from and the run that is judged are two runs, as on a machine: their
execution times are drawn with different seeds. So a margin is tried against latencies that the
plan has not seen, and all points of one seed are judged by the same ones.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from chainshaper.analysis import latency_statistics
from chainshaper.analysis.latency import PERCENTILES
from chainshaper.flow.steps import profile_chains
from chainshaper.planning import Plan, Profile, plan_chain, publish_slots
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.simulation import simulate, simulate_latencies
from chainshaper.simulation.layout import Int64s
from chainshaper.simulation.sweeping.grid import Grid, Values, application_at, plan_at, request_at
from chainshaper.simulation.system import build_system
from chainshaper.values.errors import ChainshaperError
from chainshaper.workload.description import Application

__all__ = ["FIGURES", "profile_at", "row_at"]

OTHER_RUN = 1 << 32
"""Added to a seed for the run that is judged; seeds that people count up never meet it."""

STRUCTURE_CYCLES = 100
"""Enough of a recording to see who publishes what where."""

MOST_RECORDED = 100_000

URGENT = 90
"""A chain is profiled at this priority where it is not more urgent than all others anyway."""

_BAND = pl.Struct(
    {
        "start_ns": pl.Int64,
        "end_ns": pl.Int64,
        "predicted_share": pl.Float64,
        "share": pl.Float64,
        "jitter_ns": pl.Int64,
    }
)

FIGURES: dict[str, Any] = {
    "profile_min_ns": pl.Int64,
    "profile_mean_ns": pl.Int64,
    "profile_max_ns": pl.Int64,
    "predicted_mean_ns": pl.Int64,
    "predicted_max_ns": pl.Int64,
    "predicted_jitter_ns": pl.Int64,
    "count": pl.Int64,
    "incomplete": pl.Int64,
    "late": pl.Int64,
    "min_ns": pl.Int64,
    "mean_ns": pl.Int64,
    "max_ns": pl.Int64,
    "jitter_ns": pl.Int64,
    "spread_ns": pl.Int64,
    **{f"p{percentile:g}_ns": pl.Int64 for percentile in PERCENTILES},
    "band_jitter_ns": pl.Int64,
    "per_band": pl.List(_BAND),
    "error": pl.String,
    "seconds": pl.Float64,
}
"""The columns of a row behind those of the axes.

``profile_…`` are L̲, the average and L̄ that the plan rests on, ``predicted_…`` the plan's own
(eq. 5). All others are of the judged run, in which ``incomplete`` instances of the chain gave no
output, and ``late`` ones gave it behind the last slot it was due in (or later than the plan says,
where there are no slots). ``per_band`` has the bands, with the outputs that left in their slots;
``band_jitter_ns`` is the widest of their jitters. ``error`` says why there is nothing else.
``seconds`` is the computing time, without that of the profile, which points share.
"""


def profile_at(grid: Grid, values: Values) -> Profile | str:
    """The measurements that a point is planned from, or why there are none.

    They depend on the application, and on whether callbacks are planned one by one: then response
    times of as many cycles are needed, 100,000 at most, which takes events.
    """
    try:
        application = _urgent(application_at(grid, values))
        per_callback = values.get("policy") == "server-per-callback"
        recorded = min(grid.cycles, MOST_RECORDED if per_callback else STRUCTURE_CYCLES)
        with tempfile.TemporaryDirectory(prefix="chainshaper-sweep-") as folder:
            recording = simulate(application, Path(folder) / "profile", cycles=recorded)
            (profile,) = profile_chains(recording)
        latencies = simulate_latencies(application, cycles=grid.cycles)
    except ChainshaperError as error:
        return str(error)
    complete = latencies[latencies >= 0]
    return replace(
        profile,
        latencies_ns=complete,
        incomplete=int(latencies.size - complete.size),
        recording=None,
    )


def _urgent(application: Application) -> Application:
    """The profiling condition (section 3.1): the chain's executors before all others."""
    system = build_system(application, follow_chain=True)
    places = [system.entities[callback].process for callback in system.chain.callbacks]
    chain = {system.processes[place].key for place in places}
    priority = {name: application.scheduling_of(name).priority for name in application.nodes}
    others = [priority[name] for name in application.nodes if name not in chain]
    if min(priority[name] for name in chain) > max(others, default=0):
        return application
    nodes = {
        name: node.model_copy(
            update={"priority": URGENT if name in chain else min(priority[name], URGENT - 1)}
        )
        for name, node in application.nodes.items()
    }
    return application.model_copy(update={"nodes": nodes})


def row_at(grid: Grid, values: Values, profile: Profile | str | None) -> dict[str, Any]:
    """The figures of one point, under the names of :data:`FIGURES`.

    ``profile`` is that of :func:`profile_at`; None where no plan is made. What is impossible is
    no error here: the row says so.
    """
    began = time.perf_counter()
    figures: dict[str, Any] = dict.fromkeys(FIGURES)
    if isinstance(profile, str):
        figures["error"] = profile
    else:
        try:
            figures |= _judged(grid, values, profile)
        except ChainshaperError as error:
            figures["error"] = str(error)
    return {**figures, "seconds": round(time.perf_counter() - began, 6)}


def _judged(grid: Grid, values: Values, profile: Profile | None) -> dict[str, Any]:
    application, plan = application_at(grid, values), plan_at(grid, values)
    request = request_at(grid, values)
    if profile is not None and request is not None:
        plan = plan_chain(profile, request)
    latencies = simulate_latencies(
        application, plan, cycles=grid.cycles, seed=application.seed + OTHER_RUN
    )
    complete = latencies[latencies >= 0]
    measured = latency_statistics(complete, incomplete=latencies.size - complete.size)
    figures: dict[str, Any] = {
        name: getattr(measured, name)
        for name in ("count", "incomplete", "min_ns", "mean_ns", "max_ns", "jitter_ns", "spread_ns")
    }
    figures |= {f"p{name}_ns": value for name, value in measured.percentiles_ns.items()}
    return figures if plan is None else {**figures, **_beside(plan, complete)}


def _beside(plan: Plan, latencies: Int64s) -> dict[str, Any]:
    """What the plan says, and what became of its bands."""
    evidence, predicted = plan.evidence, plan.predicted
    delay = cycles_until_output(plan) * plan.cycle_ns
    slots = publish_slots(plan)
    latest = delay + slots[-1][1] - 1 if slots else predicted.max_ns
    shares = predicted.shares if len(predicted.shares) == len(slots) else [None] * len(slots)
    # An output belongs to the last slot that had started when it left, if it is not late.
    until = [*(start for start, _ in slots[1:]), *(end for _, end in slots[-1:])]
    bands = [
        _band(latencies, (start, end), last, delay, share)
        for (start, end), last, share in zip(slots, until, shares, strict=True)
    ]
    jitters = [band["jitter_ns"] for band in bands if band["jitter_ns"] is not None]
    return {
        "profile_min_ns": evidence.min_latency_ns,
        "profile_mean_ns": evidence.mean_latency_ns,
        "profile_max_ns": evidence.max_latency_ns,
        "predicted_mean_ns": predicted.mean_ns,
        "predicted_max_ns": predicted.max_ns,
        "predicted_jitter_ns": predicted.jitter_ns,
        "late": int(np.count_nonzero(latencies > latest)),
        "band_jitter_ns": max(jitters, default=None),
        "per_band": bands,
    }


def _band(
    latencies: Int64s, slot: tuple[int, int], until: int, delay: int, predicted: float | None
) -> dict[str, Any]:
    start, end = slot[0] + delay, slot[1] + delay
    inside = latencies[(latencies >= start) & (latencies < until + delay)]
    return {
        "start_ns": start,
        "end_ns": end,
        "predicted_share": predicted,
        "share": inside.size / latencies.size if latencies.size else None,
        "jitter_ns": int(inside.max() - inside.min()) if inside.size else None,
    }
