"""What a live run's control loop cost: as a table, a sentence, and plain data."""

import math
from collections.abc import Sequence
from typing import Any

from chainshaper.reporting.tables import ABSENT, ResultTable, cost_text, figures, words
from chainshaper.values.errors import PlatformError
from chainshaper.verify.live_control import LiveCost, live_cost
from chainshaper.verify.measure import Measurement


def live_costs(measurements: Sequence[Measurement]) -> list[LiveCost | None]:
    """Return what the control loop cost in each recording; None: it had none, or no SciPy is here.

    Raises InputError, OperationError: as :func:`~chainshaper.verify.live_control.live_cost`.
    """
    try:
        return [live_cost(measurement.recording) for measurement in measurements]
    except PlatformError:
        return [None] * len(measurements)


def live_cost_table(names: Sequence[str], costs: Sequence[LiveCost | None]) -> ResultTable:
    """Make the table of recordings whose control loop was live."""
    columns = [*words("recording"), *figures("cycles", "lost", "measured", "computed", "±")]
    table = ResultTable("Cost of the control loop", [*columns, *words("")])
    table.caption = (
        "cost per second, measured by the plant, and computed for the same instants; ±: 95 % of"
        " runs measure so close to what is computed"
    )
    for name, cost in zip(names, costs, strict=True):
        if cost is None:
            continue
        table.add(
            name,
            f"{cost.cycles:,}",
            cost.lost,
            cost_text(cost.measured),
            cost_text(cost.computed),
            ABSENT if math.isnan(cost.margin) else cost_text(cost.margin),
            "" if math.isnan(cost.margin) else "agrees" if cost.agrees else "does not agree",
        )
    return table


def live_verdict(costs: Sequence[LiveCost | None]) -> str | None:
    """Return the sentence about the first and last recording; None: one of them has no loop."""
    first, last = costs[0], costs[-1]
    if len(costs) < 2 or first is None or last is None:
        return None
    change = f"{cost_text(first.measured)} → {cost_text(last.measured)}"
    computed = f"{cost_text(first.computed)} → {cost_text(last.computed)}"
    return f"the same controller: cost {change} (computed: {computed})"


def live_cost_json(cost: LiveCost | None) -> dict[str, Any] | None:
    """Return the figures as plain data: costs per second, null where they have no bound."""
    if cost is None:
        return None
    reals = {"measured": cost.measured, "computed": cost.computed, "margin": cost.margin}
    return {
        "cycles": cost.cycles,
        "lost": cost.lost,
        "copies": cost.copies,
        **{name: value if math.isfinite(value) else None for name, value in reals.items()},
    }
