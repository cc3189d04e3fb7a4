"""Several latency bands, or one long slot, in place of a shaped plan's single publish slot.

Single-band shaping gives every execution the latency of the slowest. These steps take a plan of
:func:`chainshaper.planning.shaping.plan_shaping` and trade some of its constancy for a better
average (sections 3.3 and 4.1), without touching the longest latency.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.bands import (
    BandProblem,
    Placement,
    band_problem,
    enough_bands,
    place_bands,
    placement_curve,
)
from chainshaper.planning.latency_file import check_latencies
from chainshaper.planning.plan import (
    Plan,
    Prediction,
    Slot,
    output_server,
    publish_slots,
    revised,
)
from chainshaper.planning.publisher_threads import below_executors
from chainshaper.planning.shaping import predict_bands
from chainshaper.planning.swarm import place_by_swarm, place_randomly
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Goal, Solver

__all__ = ["BandChoice", "choose_bands", "with_bands", "with_long_slot"]

MOST_BANDS = 12  # as far as `auto` looks; figure 7 is flat from the fourth on


def with_bands(
    plan: Plan,
    latencies_ns: NDArray[np.int64],
    bands: int | Literal["auto"],
    *,
    solver: Solver = "exact",
    minimise: Goal = "mean",
    mean_at_most_ns: int | None = None,
    least_gain: float = 0.02,
    seed: int | None = None,
    **limits: Any,
) -> Plan:
    """A shaped plan with ``bands`` publish slots; the last stays where the plan has it.

    The slots are as long as the plan's own (Δ). ``exact`` finds the best placement on the grid;
    ``pso`` and ``random`` are for comparison and take a ``seed``. ``auto`` takes as many bands
    as each lower the average by ``least_gain`` of it at least. With ``mean_at_most_ns`` the exact
    solver can ``minimise`` the ``jitter`` or the largest ``gap`` instead of the average.
    ``limits`` are those of :func:`~chainshaper.planning.bands.band_problem`: ``grid_ns``,
    ``max_gap_ns`` (LV) and ``max_share``.

    Raises:
        InputError: a plan without a publish slot, or values that make no sense together.
        OperationError: no such placement exists; the message names the binding constraint.
    """
    problem = _problem(plan, latencies_ns, limits)
    length = problem.publish_slot_ns
    if (bands == "auto" or solver != "exact") and (
        minimise != "mean" or mean_at_most_ns is not None
    ):
        raise InputError("another goal than the average needs the exact solver and fixed bands")
    if bands == "auto":
        if solver != "exact":
            raise InputError("only the exact solver chooses the number of bands by itself")
        placement = choose_bands(plan, latencies_ns, least_gain=least_gain, **limits).chosen
    elif solver == "pso":
        placement = place_by_swarm(problem, bands, seed)
    elif solver == "random":
        placement = place_randomly(problem, bands, seed)
    else:
        placement = place_bands(problem, bands, minimise=minimise, mean_at_most_ns=mean_at_most_ns)
    slots = tuple((end - length, end) for end in placement.slot_ends_ns)
    predicted = predict_bands(problem.latencies_ns, placement.slot_ends_ns, length)
    return _with_publish_slots(plan, slots, predicted)


@dataclass(frozen=True)
class BandChoice:
    """A curve of figure 7, the placement that ``auto`` takes from it, and why it stops there."""

    curve: tuple[Placement, ...]
    chosen: Placement
    reason: str


def choose_bands(
    plan: Plan,
    latencies_ns: NDArray[np.int64],
    *,
    least_gain: float = 0.02,
    **limits: Any,
) -> BandChoice:
    """What :func:`with_bands` takes for ``auto``, with its grounds.

    ``plan`` may have any publish slots, of which the last counts.

    Raises:
        InputError: a plan without a publish slot, or a least gain that is no share.
        OperationError: no number of bands can be placed.
    """
    if not 0 < least_gain < 1:
        raise InputError(
            f"the least gain is a share of the average, such as 0.02: not {least_gain}"
        )
    curve = placement_curve(_problem(plan, latencies_ns, limits), MOST_BANDS)
    chosen = enough_bands(curve, least_gain)
    bands, longest = len(chosen.slot_ends_ns), len(curve[-1].slot_ends_ns)
    if chosen is not curve[-1]:
        gain = 1 - curve[curve.index(chosen) + 1].mean_ns / chosen.mean_ns
        reason = (
            f"stopped at {bands}: another band would lower the average by {gain:.2%}, less than"
            f" {least_gain:.2%}"
        )
    elif longest < MOST_BANDS:
        reason = f"stopped at {bands}: no more bands can be placed"
    else:
        reason = f"stopped at {bands}: more bands are not tried"
    return BandChoice(tuple(curve), chosen, reason)


def with_long_slot(plan: Plan, latencies_ns: NDArray[np.int64], slot_start_ns: int) -> Plan:
    """A shaped plan with one long publish slot, from ``slot_start_ns`` to where it ended before.

    An execution that is done earlier waits for the slot, any other publishes at once: the
    average falls and the jitter grows as the start moves towards the shortest latency (end of
    section 4.1; the paper's example is [62, 87] ms).

    Raises:
        InputError: a start that is not before the plan's own publish slot, or negative.
    """
    start, end = _last_publish_slot(plan)
    if not 0 <= slot_start_ns <= start:
        raise InputError(
            f"a long publish slot may start from 0ms to {format_duration(start)}, where the plan's"
            f" own does; {format_duration(slot_start_ns)} does not"
        )
    published = np.maximum(check_latencies(latencies_ns), slot_start_ns)
    # Published at once, the output is late by the publication itself, which the slot's end bounds.
    predicted = Prediction(
        mean_ns=round(int(published.sum()) / published.size),
        max_ns=end,
        jitter_ns=end - slot_start_ns,
        shares=(1.0,),
    )
    slots = ((slot_start_ns, end),)
    return revised(_with_publish_slots(plan, slots, predicted), policy="one-long-slot")


def _problem(plan: Plan, latencies_ns: NDArray[np.int64], limits: dict[str, Any]) -> BandProblem:
    start, end = _last_publish_slot(plan)
    return band_problem(latencies_ns, end, publish_slot_ns=end - start, **limits)


def _last_publish_slot(plan: Plan) -> Slot:
    slots = publish_slots(plan)
    if not slots:
        raise InputError(f"a plan of policy {plan.policy} has no publish slot: plan shaping first")
    return slots[-1]


def _with_publish_slots(plan: Plan, slots: tuple[Slot, ...], predicted: Prediction) -> Plan:
    publishing = output_server(plan)
    servers = [
        server.model_copy(update={"slots": slots}) if server is publishing else server
        for server in plan.servers
    ]
    return revised(plan, servers=below_executors(servers), predicted=predicted)
