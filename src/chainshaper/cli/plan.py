"""`chainshaper plan`: from measured latencies to reservation servers and slots."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from chainshaper.cli import plan_options as options
from chainshaper.cli.options import JsonOption, duration_option
from chainshaper.gate.decision import Anchor, Late
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Goal, Policy, Publication, Solver

if TYPE_CHECKING:
    from chainshaper.planning import Plan, PlanRequest, Profile

__all__ = ["plan"]


def plan(
    recording: Annotated[
        Path | None, typer.Argument(metavar="[REC]", help="A recording's or a trace's folder.")
    ] = None,
    chain: options.ChainsOption = None,
    output: options.PlanOutput = None,
    latencies: options.LatenciesOption = None,
    period: options.PeriodOption = None,
    policy: Annotated[Policy, typer.Option(help="How it is scheduled.")] = "shaped",
    publication: Annotated[
        Publication, typer.Option(help="By a shaping node, or the publisher's own thread.")
    ] = "synchronous",
    publish_slot: Annotated[
        int, duration_option("--publish-slot", "Length of the publish slot.")
    ] = "1ms",  # type: ignore[assignment]
    slot_start: options.SlotStartOption = None,
    epsilon: options.EpsilonOption = None,
    overrun_probability: options.ProbabilityOption = None,
    ideal_machine: options.IdealMachineOption = False,
    bands: options.BandsOption = "1",
    solver: Annotated[
        Solver, typer.Option(help="What places bands.", rich_help_panel="Latency bands")
    ] = "exact",
    grid: options.GridOption = "1us",  # type: ignore[assignment]
    modes: options.ModesOption = None,
    late: Annotated[
        Late | None,
        typer.Option(
            help="With --modes, an output behind its mode's slot: at once, wait for the next"
            " cycle's, discard, or in the cycle's next slot. Default: publish.",
            rich_help_panel="Latency bands",
            show_default=False,
        ),
    ] = None,
    max_gap: options.MaxGapOption = None,
    max_share: options.MaxShareOption = None,
    minimise: Annotated[
        Goal, typer.Option(help="What to make small.", rich_help_panel="Latency bands")
    ] = "mean",
    mean_at_most: options.MeanAtMostOption = None,
    least_gain: options.LeastGainOption = "2%",  # type: ignore[assignment]
    curve: options.CurveOption = None,
    seed: options.SeedOption = 0,
    first_slot: options.FirstSlotOption = None,
    sink: options.SinksOption = None,
    anchor: Annotated[
        Anchor,
        typer.Option(help="What slots count from: the message's stamp, or the cycle."),
    ] = "stamp",
    overrun: options.OverrunOption = None,
    messages: options.MessagesOption = "all-in-order",
    depth: options.DepthOption = None,
    fallback: options.FallbackOption = None,
    spin: Annotated[
        int, duration_option("--spin", "How long the gate watches the clock before its slot.")
    ] = "1ms",  # type: ignore[assignment]
    pause: Annotated[
        int | None,
        duration_option(
            "--pause",
            "How long the gate rests after publishing. Default: 2ms, a twentieth of the cycle at"
            " most.",
        ),
    ] = None,
    receivers: options.ReceiversOption = True,
    json: JsonOption = False,
) -> None:
    """Plan the reservation servers of a chain: by default one publish slot behind its longest
    latency, or several latency bands, or one of the schedules that shaping is compared with.

    From a recording, or from bare latencies with their period.
    """
    from chainshaper.planning import PlanRequest, plan_chain

    if (recording is None) == (latencies is None):
        raise InputError("give either a recording or --latencies FILE --period DURATION")
    if curve is not None and bands != "auto":
        raise InputError("--curve draws what --bands auto looked at: add --bands auto")
    request = PlanRequest(
        policy=policy,
        publication=publication,
        epsilon_ns=epsilon,
        overrun_probability=overrun_probability,
        ideal_machine=ideal_machine,
        publish_slot_ns=publish_slot,
        bands="auto" if bands == "auto" else int(bands),
        solver=solver,
        grid_ns=grid,
        max_gap_ns=max_gap,
        max_share=max_share,
        minimise=minimise,
        mean_at_most_ns=mean_at_most,
        least_gain=least_gain,
        seed=seed,
        slot_start_ns=slot_start,
        first_slot_ns=first_slot,
        modes=options.modes_of(modes, late),
        anchor=anchor,
        overrun=overrun,
        messages=messages,
        depth=depth,
        fallback=fallback or "bypass",
        spin_ns=spin,
        pause_ns=pause,
        with_receivers=receivers,
    )
    wanted: list[str | None] = [*chain] if chain else [None]
    profiles = _profiles(recording, latencies, period, [*wanted, *(sink or [])])
    chains, sinks = profiles[: len(wanted)], profiles[len(wanted) :]
    if len(chains) > 1:
        _several(chains, sinks, request, output, curve, json)
        return
    planned = plan_chain(chains[0], request, sinks)
    _print_one(planned, chains[0], request, output, curve, json)


def _profiles(
    recording: Path | None, latencies: Path | None, period: int | None, chains: Sequence[str | None]
) -> "tuple[Profile, ...]":
    from chainshaper.flow.steps import profile_chains
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
    from chainshaper.cli.output import notes, print_json, show, show_line
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


def _several(
    profiles: "Sequence[Profile]",
    sinks: "Sequence[Profile]",
    request: "PlanRequest",
    output: Path | None,
    curve: Path | None,
    json: bool,
) -> None:
    from chainshaper.cli.offsets import place_and_print
    from chainshaper.planning import plan_chains

    if sinks or curve is not None:
        raise InputError("--sink and --curve go with one chain: plan chains one by one")
    place_and_print(plan_chains(profiles, request), output, json)
