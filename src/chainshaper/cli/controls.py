"""The verb that computes what latencies cost a controller."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import chainshaper as cs
from chainshaper.cli import options as opt
from chainshaper.cli import output as out
from chainshaper.values.errors import InputError

if TYPE_CHECKING:
    from chainshaper.verify.control import ControlCosts


def control(
    plant: Path = opt.argument("PLANT.yaml", "The description of the control loop.", ...),
    recordings: list[Path] | None = opt.argument(
        "[REC...]", "Recordings' or traces' folders, usually before and after shaping."
    ),
    chain: str | None = opt.CHAIN,
    through: list[str] | None = opt.THROUGH,
    plan: Path | None = opt.PLAN_IN_FORCE,
    latencies: Path | None = opt.option(
        "--latencies FILE",
        "Instead of recordings: a duration a line, or .npy in ns, a period apart.",
    ),
    at: Literal["output", "receiver"] = opt.option(
        "--at",
        "The actuator moves when the output leaves, or when its subscriber's callback starts.",
        "output",
    ),
    delay: int | None = opt.option(
        "--delay DURATION",
        "Design the LQG controller for this delay. Default: the file's controller.",
    ),
    figure: Path | None = opt.option(
        "--figure FILE.png", "Draw the plant's output, and the recordings in a map of costs."
    ),
    json: bool = opt.JSON,
) -> None:
    """Compute what latency and jitter cost a controller, by its own quadratic cost.

    The plant is sampled when the chain starts, and its input changes when the output leaves. The
    cost over the measured cycles is exact; beside it stands that of the same loop with constant
    latencies, and with the controller designed for these.
    """
    from chainshaper.reporting import control as reporting

    if (latencies is None) == (not recordings):
        raise InputError("give either recordings or --latencies FILE")
    if figure is not None:
        from chainshaper.reporting.figures import ENDINGS
        from chainshaper.values.files import new_file

        new_file(figure, ENDINGS)
    in_force = opt.plan_in_force(plan)
    with out.late_progress("control") as progress:
        if latencies is not None:
            costs = cs.control_costs_of_latencies(plant, latencies, delay_ns=delay)
        else:
            opened = [cs.open_source(path, through=through or ()) for path in recordings or ()]
            costs = cs.control_costs(
                plant, opened, chain, in_force, instant=at, delay_ns=delay, progress=progress
            )
        if figure is not None:
            progress(0.9, "drawing")
            reporting.draw_control(costs, figure)
    _show(costs, figure, json=json)


def _show(costs: "ControlCosts", figure: Path | None, *, json: bool) -> None:
    from chainshaper.reporting import control as reporting

    tables = [reporting.control_table(costs)]
    if costs.modes is not None:
        tables.append(reporting.modes_table(costs.modes))
    if out.present(json, reporting.control_json(costs), *tables):
        if (verdict := reporting.verdict(costs)) is not None:
            out.show_line(verdict)
        if figure is not None:
            out.show_line(figure)
        out.notes(note for recording in costs.recordings for note in recording.notes)
        out.notes(costs.notes)
