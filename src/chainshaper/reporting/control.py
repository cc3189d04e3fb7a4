"""What a control loop costs: tables, plain data, and recordings in a map of costs."""

import math
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from chainshaper.control.costs import Events, events_of
from chainshaper.control.drawn import draw
from chainshaper.control.modes import ModeCosts
from chainshaper.control.steady_state import LatencyCosts, covariance_of_constant
from chainshaper.planning.chain_plan import ControlCost
from chainshaper.reporting.figures import COLOURS, ENDINGS, new_figure, save_figure, user_style
from chainshaper.reporting.tables import ABSENT, ResultTable, cost_text, figures, ms, words
from chainshaper.values.durations import duration_text
from chainshaper.values.files import new_file
from chainshaper.verify.control import ControlCosts, ControlledRecording

JSON_FORMAT = 1
SHOWN_CYCLES = 120  # of each recording's drawn run
MAP_POINTS = 33  # of the map, along each side
LATENCIES_OF_POINT = 21  # of a uniform distribution with a point's average and jitter


def _finite(cost: float | None) -> float | None:
    return cost if cost is not None and math.isfinite(cost) else None


def control_table(costs: ControlCosts) -> ResultTable:
    """Make the table of recordings: latency, jitter, cost, and costs of constant latencies."""
    constants = [f"at p{constant.percentile:g}" for constant in costs.recordings[0].constants]
    constants = [name.replace("p100", "maximum") for name in constants]
    columns = [*words("recording"), *figures("cycles", "lost", "average", "jitter", "cost", "±")]
    columns += figures(*constants)
    table = ResultTable(f"Cost of the control loop {costs.description.path.name}", columns)
    table.caption = (
        f"cost per second; at p50: with all latencies constant, there; redesigned: with the"
        f" controller for it;\n"
        f"{_margin_text(costs)}; times in ms"
    )
    for recording in costs.recordings:
        came = recording.came_ns
        table.add(
            recording.path.name,
            f"{len(recording.latencies_ns):,}",
            recording.lost,
            ms(float(came.mean())),
            ms(float(np.ptp(came))),
            cost_text(recording.sequence.cost),
            cost_text(_finite(recording.sequence.margin)),
            *(cost_text(constant.cost) for constant in recording.constants),
        )
        redesigned = [cost_text(constant.redesigned) for constant in recording.constants]
        table.add("redesigned", *[""] * 6, *redesigned)
    return table


def _margin_text(costs: ControlCosts) -> str:
    unstable = "unstable with every constant latency"
    return unstable if costs.stable is None else costs.stable.text


def verdict(costs: ControlCosts) -> str | None:
    """Return the sentence about the first and last recording; None: there is one only."""
    if len(costs.recordings) < 2:
        return None
    first, last = (costs.recordings[place].sequence.cost for place in (0, -1))
    return f"the same controller: cost {cost_text(first)} → {cost_text(last)}"


def modes_table(modes: ModeCosts) -> ResultTable:
    """Make the table of modes: the cost of each, and of a change from it to each of the others."""
    names = list(modes.latency_ns)
    columns = [*words("mode"), *figures("latency", "cost", *(f"to {name}" for name in names))]
    table = ResultTable("Modes, each with the controller for its latency", columns)
    table.caption = "cost per second; of a change, once, beyond that of the mode behind it"
    for name in names:
        changes = [
            ABSENT if name == target else cost_text(modes.switching[name, target])
            for target in names
        ]
        table.add(name, ms(modes.latency_ns[name]), cost_text(modes.cost[name]), *changes)
    return table


def choice_table(control: ControlCost) -> ResultTable:
    """Make the table of what a plan chose from for a plant."""
    table = ResultTable(
        f"Cost of the control loop {control.plant}", [*words("outputs leave"), *figures("cost")]
    )
    table.add("when they are there (unshaped)", cost_text(_or_unstable(control.unshaped)))
    for name, cost in control.alternatives.items():
        mark = "→ " if name == control.chosen else ""
        table.add(f"{mark}in {name}", cost_text(_or_unstable(cost)))
    return table


def _or_unstable(cost: float | None) -> float:
    return math.inf if cost is None else cost


def choice_notes(control: ControlCost) -> list[str]:
    """Return what a user must know about a plan for a plant."""
    notes = []
    if not control.worth:
        least, unshaped = cost_text(control.cost), cost_text(control.unshaped)
        notes.append(
            f"shaping is not worth it for this loop: it costs {least}, and {unshaped} unshaped. The"
            " added delay costs more than the jitter"
        )
    if control.delay_ns is not None:
        delay = duration_text(control.delay_ns)
        notes.append(f"this cost is that of a controller for a delay of {delay}: design it so")
    return notes


def control_json(costs: ControlCosts) -> dict[str, Any]:
    """Return all figures as plain data: costs per second, null where a loop is unstable."""
    return {
        "format": JSON_FORMAT,
        "plant": str(costs.description.path),
        "period_ns": costs.period_ns,
        "stable_latencies_ns": _range_ns(costs),
        "recordings": [_recording_json(recording) for recording in costs.recordings],
        "modes": None if costs.modes is None else modes_json(costs.modes),
        "notes": list(costs.notes),
    }


def _range_ns(costs: ControlCosts) -> list[int | None] | None:
    """Return the constant latencies with which the loop is stable: from, and until (null: all)."""
    if costs.stable is None:
        return None
    return [None if edge is None else round(edge * 1e9) for edge in costs.stable]


def _recording_json(recording: ControlledRecording) -> dict[str, Any]:
    came = recording.came_ns
    return {
        "recording": str(recording.path),
        "chain": recording.chain,
        "count": len(recording.latencies_ns),
        "lost": recording.lost,
        "mean_ns": round(float(came.mean())),
        "jitter_ns": int(np.ptp(came)),
        "cost": _finite(recording.sequence.cost),
        "margin": _finite(recording.sequence.margin),
        "unstable": recording.sequence.diverged,
        "steady_cost": _finite(recording.steady),
        "constant": [
            {
                "percentile": constant.percentile,
                "latency_ns": constant.latency_ns,
                "cost": _finite(constant.cost),
                "redesigned_cost": _finite(constant.redesigned),
            }
            for constant in recording.constants
        ],
    }


def modes_json(modes: ModeCosts) -> dict[str, Any]:
    """Return the costs of modes as plain data."""
    return {
        name: {
            "latency_ns": modes.latency_ns[name],
            "cost": modes.cost[name],
            "switching": {
                target: cost for (first, target), cost in modes.switching.items() if first == name
            },
        }
        for name in modes.latency_ns
    }


@user_style()
def draw_control(costs: ControlCosts, path: str | Path) -> Path:
    """Draw one possible run of the plant for each recording, and recordings in a map of costs.

    The runs have the same seed. The map has the steady cost of uniform distributions, by average
    and width.

    Raises InputError: the file exists already, or ends as no picture does. OperationError: it
    cannot be written.
    """
    path = new_file(path, ENDINGS)
    figure, (left, right) = new_figure(2)
    for recording, colour in zip(costs.recordings, cycle(COLOURS), strict=False):
        events, begin = _shown_events(recording), recording.constants[0].latency_ns / 1e9
        covariance = covariance_of_constant(costs.loop, begin)
        drawn = draw(costs.loop, events, seed=1, covariance=covariance)
        left.plot(
            drawn.times_s, drawn.outputs[:, 0], color=colour, linewidth=1, label=recording.path.name
        )
    left.set(xlabel="time [s]", ylabel="output of the plant (one possible run)")
    left.legend(loc="upper right")
    _draw_map(right, costs)
    return save_figure(figure, path)


def _shown_events(recording: ControlledRecording) -> Events:
    shown = slice(0, SHOWN_CYCLES)
    return events_of(recording.samples_ns[shown], recording.latencies_ns[shown])


def _draw_map(axes: Any, costs: ControlCosts) -> None:
    """Draw contours of the cost over average latency and jitter, and a point for each recording."""
    period_ns = costs.period_ns
    means = np.linspace(0, period_ns, MAP_POINTS)
    inside = (np.arange(LATENCIES_OF_POINT) + 0.5) / LATENCIES_OF_POINT - 0.5
    of_loop = LatencyCosts(costs.loop)
    field = np.full((MAP_POINTS, MAP_POINTS), np.nan)
    for row, jitter in enumerate(means):
        for column, mean in enumerate(means):
            latencies = np.round(mean + jitter * inside).astype(np.int64)
            if latencies[0] >= 0 and latencies[-1] <= period_ns:
                field[row, column] = of_loop.cost(latencies)
    stable = np.isfinite(field)
    if stable.any():
        top = float(np.quantile(field[stable], 0.9))
        levels = np.linspace(
            float(field[stable].min()), max(top, float(field[stable].min()) + 1e-12), 13
        )
        drawn = axes.contourf(
            means / 1e6,
            means / 1e6,
            np.where(stable, field, np.nan),
            levels,
            cmap="viridis_r",
            extend="max",
        )
        axes.figure.colorbar(drawn, ax=axes, label="cost per second")
    for recording, colour in zip(costs.recordings, cycle(COLOURS), strict=False):
        came = recording.came_ns
        label = f"{recording.path.name}: {cost_text(recording.sequence.cost)}"
        axes.plot(
            float(came.mean()) / 1e6,
            float(np.ptp(came)) / 1e6,
            "o",
            color=colour,
            markeredgecolor="white",
            markersize=9,
            label=label,
        )
    axes.set(xlabel="average latency [ms]", ylabel="jitter [ms]")
    axes.legend(loc="upper right")
