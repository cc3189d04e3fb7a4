"""Verbs that compute plans, move them against each other, and try out what they would do."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chainshaper.cli.options import (
    APPLICATION,
    JSON,
    PLAN_WISHES,
    SEED,
    argument,
    option,
    plan_in_force,
    takes_wishes,
)
from chainshaper.cli.output import notes, print_json, progress, show, show_line
from chainshaper.values.errors import InputError

if TYPE_CHECKING:
    from chainshaper.planning import Plan, PlanRequest, Profile


@takes_wishes(*PLAN_WISHES)
def plan(
    recording: Path | None = argument(None, "[REC]", "A recording's or a trace's folder."),
    chain: list[str] | None = option(
        None,
        "--chain FIRST..LAST",
        "The chain, by topics or nodes: /t1../t5. Default: the one the recording names."
        " Give several to plan chains that share cores: their offsets are found.",
    ),
    output: Path | None = option(
        None,
        "--output -o plan.yaml",
        "File to write; for several chains a folder, which must not exist.",
    ),
    latencies: Path | None = option(
        None, "--latencies FILE", "Instead of a recording: a duration a line, or .npy in ns."
    ),
    period: int | None = option(
        None, "--period DURATION", "Period, with --latencies or a chain that no timer starts."
    ),
    *,
    request: "PlanRequest",
    curve: Path | None = option(
        None,
        "--curve FILE.png",
        "With --bands auto: draw the average over the number of bands.",
        rich_help_panel="Latency bands",
    ),
    sink: list[str] | None = option(
        None,
        "--sink FIRST..LAST",
        "A chain to a further output of the same graph, to be shaped too.",
        rich_help_panel="More of the graph",
    ),
    json: bool = JSON,
) -> None:
    """Plan the reservation servers of a chain: by default one publish slot behind its longest
    latency, or several latency bands, or one of the schedules that shaping is compared with.

    From a recording, or from bare latencies with their period.
    """
    from chainshaper.planning import plan_chain, plan_chains

    if (recording is None) == (latencies is None):
        raise InputError("give either a recording or --latencies FILE --period DURATION")
    if curve is not None and request.bands != "auto":
        raise InputError("--curve draws what --bands auto looked at: add --bands auto")
    wanted: list[str | None] = [*chain] if chain else [None]
    profiles = _profiles(recording, latencies, period, [*wanted, *(sink or [])])
    planned, sinks = profiles[: len(wanted)], profiles[len(wanted) :]
    if len(planned) == 1:
        made = plan_chain(planned[0], request, sinks)
        _print_one(made, planned[0], request, output, curve, json)
    elif sinks or curve is not None:
        raise InputError("--sink and --curve go with one chain: plan chains one by one")
    else:
        _place_and_print(plan_chains(planned, request), output, json)


def _profiles(
    recording: Path | None, latencies: Path | None, period: int | None, chains: Sequence[str | None]
) -> "tuple[Profile, ...]":
    from chainshaper.flow.plan import profile_chains
    from chainshaper.planning import Profile, read_latencies

    if recording is not None:
        return profile_chains(recording, chains, period_ns=period)
    if latencies is None or period is None:
        raise InputError("--latencies needs the chain's period: add --period, such as 100ms")
    if len(chains) > 1:
        raise InputError("--latencies are those of one chain: give a recording for several")
    return (Profile(read_latencies(latencies), period, spec=chains[0]),)


def _print_one(
    planned: "Plan",
    profile: "Profile",
    request: "PlanRequest",
    output: Path | None,
    curve: Path | None,
    json: bool,
) -> None:
    from chainshaper.planning import band_choice, plan_json, plan_warnings, publish_slots, save_plan
    from chainshaper.reporting.plans import bands_table, choice_json, choice_table, plan_table

    choice = band_choice(planned, profile, request) if request.bands == "auto" else None
    if output is not None:
        save_plan(planned, output)
    if curve is not None and choice is not None:
        from chainshaper.reporting.figures import draw_curve

        draw_curve(choice, curve)
    if json:
        values: dict[str, Any] = {**plan_json(planned), "warnings": plan_warnings(planned)}
        print_json(values if choice is None else {**values, "choice": choice_json(choice)})
        return
    bands = [bands_table(planned)] if len(publish_slots(planned)) > 1 else []
    show(plan_table(planned), *bands, *([] if choice is None else [choice_table(choice)]))
    notes(plan_warnings(planned))
    for path in (curve, output):
        if path is not None:
            show_line(str(path))


def offsets(
    plans: list[Path] = argument(..., "PLAN PLAN...", "Plans, one a chain."),
    output: Path | None = option(
        None, "--output -o DIR", "Folder to write the plans into; must not exist."
    ),
    time_limit: float = option(
        60.0, "--time-limit SECONDS", "How long to search, per group.", min=0.1
    ),
    json: bool = JSON,
) -> None:
    """Find when each chain's cycles start, so that no slots of one core collide.

    Where chains cannot take turns on a core, they run at the same time at different priorities, and
    only their publish slots are kept apart.
    """
    from chainshaper.planning import load_plan

    _place_and_print([load_plan(path) for path in plans], output, json, time_limit)


def _place_and_print(
    plans: "Sequence[Plan]", output: Path | None, json: bool, time_limit: float = 60.0
) -> None:
    from chainshaper.planning import place_chains, plan_json, plan_warnings, save_plans
    from chainshaper.reporting.plans import plan_table

    placed, remarks = place_chains(plans, time_limit_s=time_limit)
    written = [] if output is None else save_plans(placed, output)
    warnings = [warning for planned in placed for warning in plan_warnings(planned)]
    if json:
        print_json(
            {
                "plans": [plan_json(planned) for planned in placed],
                "files": [str(path) for path in written],
                "warnings": [*remarks, *warnings],
            }
        )
        return
    show(*(plan_table(planned) for planned in placed))
    notes(list(dict.fromkeys([*remarks, *warnings])))
    for path in written:
        show_line(str(path))


def sweep(
    application: Path = APPLICATION,
    vary: list[str] = option(
        ...,
        "--vary NAME=VALUES",
        "An axis (repeat it for more): a wish for the plan, such as epsilon=0ms,1ms or"
        " bands=1..5; interference=0ms,20ms; or a value of the description by its path, such"
        " as nodes.node3.core=0,1.",
    ),
    output: Path = option(..., "--output -o FILE.parquet", "File to write, a row for each point."),
    plan: Path | None = argument(
        None, "plan.yaml", "A plan that is in force at all points. Default: each is planned."
    ),
    cycles: int = option(100_000, "--cycles", "Cycles to plan from, and to judge by.", min=1),
    seed: int | None = SEED,
    workers: int | None = option(
        None, "--workers", "Threads that compute. Default: one per core.", min=1
    ),
    scheduler: str | None = option(
        None,
        "--scheduler ADDRESS",
        "Compute on the Dask cluster whose scheduler is there, such as tcp://host:8786.",
    ),
    draw: Path | None = option(
        None, "--draw FILE.png", "Draw average and jitter over the first axis."
    ),
    json: bool = JSON,
) -> None:
    """Simulate an application at every combination of some values: planned, shaped, judged.

    Ended before it is whole, it keeps the finished points beside the file that it writes; the same
    command goes on with the others.
    """
    from chainshaper.flow.sweep import parse_axis, rows_beside
    from chainshaper.flow.sweep import sweep as run_sweep
    from chainshaper.reporting.figures import draw_sweep
    from chainshaper.reporting.plans import sweep_table
    from chainshaper.values.files import new_file
    from chainshaper.workload.description import load_application

    if workers is not None and scheduler is not None:
        raise InputError("a cluster has workers of its own: leave out --workers, or --scheduler")
    if draw is not None:
        draw = new_file(draw, (".png", ".pdf", ".svg"))
    description = load_application(application)
    in_force = plan_in_force(plan)
    axes = [parse_axis(text) for text in vary]
    if len(dict(axes)) < len(axes):
        raise InputError("an axis is given twice: give all of its values in one --vary")
    try:
        with progress("sweep") as report:
            frame = run_sweep(
                description,
                dict(axes),
                output,
                in_force,
                cycles=cycles,
                seed=seed,
                workers=workers,
                scheduler=scheduler,
                progress=report,
            )
    except KeyboardInterrupt:
        if rows_beside(output).exists():
            notes([f"finished points are in {rows_beside(output)}: the same command goes on"])
        raise
    if draw is not None:
        draw_sweep(frame, draw)
    if json:
        print_json(frame.to_dicts())
        return
    show(sweep_table(frame))
    notes([f"{error}" for error in frame["error"].drop_nulls().unique(maintain_order=True)])
    for path in (draw, output):
        if path is not None:
            show_line(str(path))
