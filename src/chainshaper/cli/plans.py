"""Verbs that compute plans, move them against each other, try them out, and splice them in."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import chainshaper as cs
from chainshaper.cli import options as opt
from chainshaper.cli import output as out
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Fallback, NodeChoice

if TYPE_CHECKING:
    from chainshaper.planning import BandChoice


@opt.takes_wishes(*opt.PLAN_WISHES)
def plan(
    recording: Path | None = opt.argument("[REC]", "A recording's or a trace's folder."),
    chain: list[str] | None = opt.option(
        "--chain FIRST..LAST",
        "The chain, by topics or nodes: /t1../t5. Default: the one the recording names, or the"
        " only one in it. Give several to plan them together: what they share, and when each one's"
        " cycles start.",
    ),
    through: list[str] | None = opt.THROUGH,
    output: Path | None = opt.option(
        "--output -o plan.yaml",
        "File to write; of several chains also a folder, for a plan each. Must not exist.",
    ),
    latencies: Path | None = opt.option(
        "--latencies FILE",
        "Instead of a recording: a duration a line, or .npy in ns.",
        rich_help_panel=opt.EVIDENCE,
    ),
    period: int | None = opt.option(
        "--period DURATION>0",
        "Period, with --latencies or a chain that no timer starts.",
        rich_help_panel=opt.EVIDENCE,
    ),
    *,
    since: int = opt.SINCE,
    until: int | None = opt.UNTIL,
    request: "cs.PlanRequest",
    curve: Path | None = opt.option(
        "--curve FILE.png",
        "With --bands auto: draw the average over the number of bands.",
        rich_help_panel="Latency bands",
    ),
    mode_profile: list[str] | None = opt.MODE_PROFILE,
    sink: list[str] | None = opt.SINK,
    callback_groups: Path | None = opt.CALLBACK_GROUPS,
    convert: Path | None = opt.option(
        "--convert OLD.yaml",
        "Plan nothing: write the plan of an earlier version anew, to --output.",
        rich_help_panel=opt.EVIDENCE,
    ),
    json: bool = opt.JSON,
) -> None:
    """Plan the reservation servers of a chain: by default one publish slot behind its longest
    latency, or several latency bands, or one of the schedules that shaping is compared with.

    From a recording, or from bare latencies with their period.
    """
    from chainshaper import planning
    from chainshaper.planning.request import on_cores
    from chainshaper.reporting import figures
    from chainshaper.verify.measure import taken_chain

    if convert is not None:
        _convert(convert, output, json, alone=recording is None and latencies is None)
        return
    if (recording is None) == (latencies is None):
        raise InputError("give either a recording or --latencies FILE --period DURATION")
    _check_curve(curve, request)
    wanted: list[str | None] = [*chain] if chain else [None]
    mode_recordings = opt.mode_profiles(mode_profile, request)
    source = None
    if recording is None:
        profiles = _profile_of_latencies(latencies, period, [*wanted, *(sink or [])], since, until)
    else:
        with out.opened("plan", [recording], through) as (read, report):
            source = out.with_callback_groups(read, callback_groups)
            report(0.5, "measuring the chains")
            profiles = cs.profile_chains(
                source,
                [*wanted, *(sink or [])],
                period_ns=period,
                modes=request.modes,
                mode_recordings=mode_recordings,
                since_ns=since,
                until_ns=until,
            )
    planned, sinks = profiles[: len(wanted)], profiles[len(wanted) :]
    taken = () if source is None else taken_chain(source, wanted[0], planned[0].spec or "")
    doubts = _doubts_about(profiles, taken, request)
    if len(planned) > 1:
        if sinks:
            raise InputError("--sink goes with one chain: name the other output with --chain, too")
        if curve is not None:
            raise InputError("--curve goes with one chain: plan it alone")
        with out.late_progress("plan") as report:
            report(0.5, "planning the chains together")
            joint, remarks = planning.plan_application(planned, request)
        _print_several(joint.chains, remarks + doubts, output, json)
        return
    choice = None
    with out.late_progress("plan") as report:
        report(0.5, "planning")
        chain_plan = cs.plan_chain(planned[0], request, sinks)
        if request.bands == "auto" and request.plant is None:
            report(0.8, "choosing the number of bands")
            choice = planning.band_choice(chain_plan, planned[0], request, sinks)
    if output is not None:
        cs.save_plan(cs.Plan.of(chain_plan), output)
    warnings = [*on_cores(profiles, request)[1], *doubts, *planning.plan_warnings(chain_plan)]
    if choice is not None and curve is not None:
        figures.draw_curve(choice, curve)
    if _print_plan(chain_plan, choice, warnings, json):
        for path in filter(None, (curve, output)):
            out.show_line(path)
        _next_with(output)


def _doubts_about(
    profiles: "Sequence[cs.Profile]", taken: Sequence[str], request: "cs.PlanRequest"
) -> list[str]:
    """Return what is doubtful about plans from these profiles, a sentence each.

    ``taken`` are the notes about the chain that was taken since none was named.
    """
    from chainshaper.linux.scheduling import available_cores
    from chainshaper.planning.profile import deciding_cycles, doubts_about

    doubts: list[str] = []
    if not request.percentile:
        doubts += filter(None, map(deciding_cycles, profiles))
    doubts += taken
    doubts += dict.fromkeys(doubt for profile in profiles for doubt in doubts_about(profile))
    doubts += [
        f"this machine has no core {core}, as --cores wants it: the plan is for another machine"
        for core in sorted({*(request.cores or ())} - {*available_cores()})
    ]
    return doubts


def _print_plan(
    chain_plan: "cs.ChainPlan", choice: "BandChoice | None", warnings: Sequence[str], json: bool
) -> bool:
    """Print the plan of a chain, and how its bands were chosen; return whether as tables."""
    from chainshaper import planning
    from chainshaper.reporting import overviews

    values: dict[str, Any] = {**planning.plan_json(chain_plan), "warnings": [*warnings]}
    tables = [overviews.plan_table(chain_plan)]
    if len(planning.publish_slots(chain_plan)) > 1 or chain_plan.modes is not None:
        tables.append(overviews.bands_table(chain_plan))
    if choice is not None:
        values["choice"] = overviews.choice_json(choice)
        tables.append(overviews.choice_table(choice))
    if chain_plan.control is not None:
        from chainshaper.reporting import control as of_control

        tables.append(of_control.choice_table(chain_plan.control))
        warnings = [*of_control.choice_notes(chain_plan.control), *warnings]
        values["warnings"] = [*warnings]
    as_tables = out.present(json, values, *tables)
    if as_tables:
        out.notes(warnings)
    return as_tables


def _check_curve(curve: Path | None, request: "cs.PlanRequest") -> None:
    """Refuse a curve that cannot be drawn, before a plan is written."""
    from chainshaper.reporting.figures import ENDINGS
    from chainshaper.values.files import new_file

    if curve is None:
        return
    if request.bands != "auto":
        raise InputError("--curve draws what --bands auto looked at: add --bands auto")
    new_file(curve, ENDINGS)


def _convert(earlier: Path, output: Path | None, json: bool, *, alone: bool) -> None:
    """Write the plan of an earlier version as plans are written now."""
    if output is None or not alone:
        raise InputError("--convert OLD.yaml goes with --output NEW.yaml, and nothing else")
    cs.save_plan(cs.convert_plan(earlier), output)
    if out.present(json, {"files": [str(output)]}):
        out.show_line(output)
        _next_with(output)


def _profile_of_latencies(
    latencies: Path | None,
    period: int | None,
    chains: Sequence[str | None],
    since_ns: int,
    until_ns: int | None,
) -> "tuple[cs.Profile, ...]":
    """Return the profile of one chain from a file of its latencies, a period apart."""
    from chainshaper.planning import read_latencies

    if latencies is None or period is None:
        raise InputError("--latencies needs the chain's period: add --period, such as 100ms")
    if len(chains) > 1:
        raise InputError("--latencies are those of one chain: give a recording for several")
    # In periods, rounded up.
    first, last = -(-since_ns // period), until_ns and -(-until_ns // period)
    return (cs.Profile(read_latencies(latencies)[first:last], period, spec=chains[0]),)


def offsets(
    plans: list[Path] = opt.argument("PLAN PLAN...", "Plans, one a chain.", ...),
    output: Path | None = opt.option(
        "--output -o plan.yaml",
        "One plan of all chains; or a folder, for a plan each. Must not exist.",
    ),
    time_limit: float = opt.option(
        "--time-limit SECONDS", "How long to search, per group.", 60.0, min=0.1
    ),
    json: bool = opt.JSON,
) -> None:
    """Find when each chain's cycles start, so that no slots of one core collide.

    Plans do not say by how much chains that cannot take turns on a core would delay each other:
    `plan` with a `--chain` for each measures that.
    """
    chains = [chain for path in plans for chain in cs.load_plan(path).chains]
    with (
        out.late_progress("offsets") as report,
        out.lasting(report, time_limit, f"searching, {time_limit:g} s per group at most"),
    ):
        placed, remarks = cs.place_chains(chains, time_limit_s=time_limit)
    _print_several(placed, remarks, output, json)


def _print_several(
    placed: "Sequence[cs.ChainPlan]", remarks: Sequence[str], output: Path | None, json: bool
) -> None:
    """Write the plans of several chains, as one plan or a folder with a plan each; print them."""
    from chainshaper import planning
    from chainshaper.planning.plan import Plan
    from chainshaper.planning.several_chains import with_own_names
    from chainshaper.reporting.overviews import plan_table

    written = [output] if output is not None else []
    if output is not None and output.suffix not in opt.DESCRIPTIONS:
        written = planning.save_plans(placed, output)
    else:
        joint = Plan.of(*with_own_names(placed))
        placed = joint.chains
        if output is not None:
            cs.save_plan(joint, output)
    warnings = [*remarks, *planning.plan_warnings(*placed)]
    values = {"plans": [*map(planning.plan_json, placed)], "files": [*map(str, written)]}
    if out.present(json, values | {"warnings": warnings}, *map(plan_table, placed)):
        out.notes(warnings)
        for path in written:
            out.show_line(path)
        _next_with(output)


def _next_with(plan: Path | None) -> None:
    """Say what comes behind planning: the plan is put in force, or first of all kept."""
    if plan is None:
        out.say("next: the same with `-o plan.yaml` keeps the plan")
    else:
        out.next_step("chainshaper", "apply", plan, "--dry-run")


def sweep(
    application: Path = opt.APPLICATION,
    vary: list[str] = opt.option(
        "--vary NAME=VALUES",
        "An axis (repeat it for more): a wish for the plan, such as epsilon=0ms,1ms or"
        " bands=1..5; interference=0ms,20ms; or a value of the description by its path, such"
        " as nodes.node3.core=0,1.",
        ...,
    ),
    output: Path = opt.option(
        "--output -o FILE.parquet", "File to write, a row for each point.", ...
    ),
    plan: Path | None = opt.argument(
        "plan.yaml", "A plan that is in force at all points. Default: each is planned."
    ),
    plant: Path | None = opt.option(
        "--plant PLANT.yaml", "Also compute what the latencies cost this control loop."
    ),
    cycles: int = opt.option("--cycles", "Cycles to plan from, and to judge by.", 100_000, min=1),
    seed: int | None = opt.SEED,
    workers: int | None = opt.option(
        "--workers", "Threads that compute. Default: one per core.", min=1
    ),
    scheduler: str | None = opt.SCHEDULER,
    draw: Path | None = opt.option(
        "--draw FILE.png", "Draw average and jitter over the first axis."
    ),
    json: bool = opt.JSON,
) -> None:
    """Simulate an application at every combination of some values: planned, shaped, judged.

    Interrupted? Run the same command again: finished points are kept beside the file.
    """
    from chainshaper.flow.sweep import changing_nothing, parse_axis, rows_beside
    from chainshaper.reporting.figures import ENDINGS, draw_sweep
    from chainshaper.reporting.overviews import sweep_axes, sweep_table
    from chainshaper.values.files import new_file

    if workers is not None and scheduler is not None:
        raise InputError("a cluster has workers of its own: leave out --workers, or --scheduler")
    if draw is not None:
        new_file(draw, ENDINGS)
    axes = [parse_axis(text) for text in vary]
    if len(dict(axes)) < len(axes):
        raise InputError("an axis is given twice: give all of its values in one --vary")
    try:
        with out.progress("sweep") as report:
            frame = cs.sweep(
                cs.load_application(application),
                dict(axes),
                output,
                None if plan is None else cs.load_plan(plan),
                cycles=cycles,
                seed=seed,
                workers=workers,
                scheduler=scheduler,
                plant=plant,
                progress=report,
            )
    except KeyboardInterrupt:
        if rows_beside(output).exists():
            out.notes([f"finished points are in {rows_beside(output)}: the same command goes on"])
        raise
    if draw is not None:
        draw_sweep(frame, draw)
    if out.present(json, frame.to_dicts(), sweep_table(frame)):
        out.notes(frame["error"].drop_nulls().unique(maintain_order=True))
        out.notes(changing_nothing(frame, sweep_axes(frame)))
        for path in filter(None, (draw, output)):
            out.show_line(path)
        out.next_step("chainshaper", "simulate", application, "-o", "simulated")


def splice(
    plan: Path | None = opt.argument("plan.yaml", "The plan; none with --throttle."),
    launch: list[str] | None = opt.argument(
        "LAUNCH...",
        "The launch files (.py, .xml, .yaml) and, for --dry-run, launch arguments; or, behind --, "
        "a `ros2 run …`. None: the new launch file is to be included first in yours.",
    ),
    *,
    output: Path = opt.option("--output -o DIR", "Folder for the launch file.", ...),
    throttle: list[str] | None = opt.option(
        "--throttle [NODE:]TOPIC=PERIOD[,RULE]",
        "Instead of a plan: a throttler before an input that is not quite periodic, for "
        "NODE or whoever subscribes in the recording (may be repeated). RULE: newest, at fixed "
        "instants (default), or first, as it comes.",
    ),
    node: NodeChoice = opt.NODE,
    message_type: str | None = opt.option(
        "--type PKG/msg/TYPE",
        "Type of the output, for a node in C++. Default: what the recording says.",
        rich_help_panel=opt.NODE_PANEL,
    ),
    recording: Path | None = opt.option(
        "--recording REC",
        "A recording of the application: it tells publishers, subscribers and types. "
        "Default: the plan's own, where it exists.",
        rich_help_panel=opt.NODE_PANEL,
    ),
    fallback: Fallback | None = opt.wish("fallback", default=None, rich_help_panel=opt.NODE_PANEL),
    build: bool = opt.option(
        "--build",
        "Build the shaping node's package with colcon.",
        False,
        rich_help_panel=opt.NODE_PANEL,
    ),
    dry_run: bool = opt.option(
        "--dry-run",
        "Write nothing, and show what would be redirected: the launch files are carried out in "
        "this ROS 2 environment, but no process is started.",
        False,
    ),
    undo: bool = opt.option("--undo", "Remove DIR again, unless it was changed since.", False),
    json: bool = opt.JSON,
) -> None:
    """Write a launch file that includes yours, starts a shaping node, and redirects the output.

    With --throttle an input is redirected, and a throttler republishes it once a period; do this
    first, then record and plan, and splice the plan into its launch file. Launch the file that it
    names, with your launch arguments; your launch files stay as they are.
    """
    from chainshaper.splicing.node_kinds import language_of
    from chainshaper.splicing.node_packages import build_package, check_build_tools
    from chainshaper.splicing.spliced_launch import NODES

    if undo:
        cs.undo_splice(output)
        if out.present(json, {"removed": str(output)}):
            out.show_line(f"{output} is removed")
        return
    if build and node == "python":
        raise InputError("--node python needs no building: leave out --build, or choose another")
    if build and language_of(node, builds=True)[0] == "cpp":
        check_build_tools()  # before anything is written
    words = launch or []
    # With --throttle there is no plan: the first word is a launch file, too.
    words = [str(plan), *words] if throttle and plan is not None else words
    ran = words[:2] == ["ros2", "run"]
    arguments = {} if ran else dict(word.split(":=", 1) for word in words if ":=" in word)
    files = words if ran else [word for word in words if ":=" not in word]
    if throttle:
        _refuse_for_throttlers(fallback, message_type, files)
    elif plan is None:
        raise InputError("give a plan, and the launch files: `splice plan.yaml LAUNCH... -o DIR`")
    with out.late_progress("splice") as report:
        report(0.0, "looking into the launch files")
        if throttle:
            splicing = cs.splice_throttlers(
                throttled_inputs(throttle),
                files,
                output,
                node=node,
                builds=build,
                arguments=arguments,
                recording=opt.recording_of(recording),
                dry_run=dry_run,
            )
        else:
            planned = cs.load_plan(str(plan))
            out.warn(planned)
            splicing = cs.splice_launch_files(
                planned,
                files,
                output,
                node=node,
                builds=build,
                arguments=arguments,
                message_type=message_type,
                recording=opt.recording_of(recording, planned),
                fallback=fallback,
                dry_run=dry_run,
            )
    has_packages = any(process.package is not None for process in splicing.processes)
    setup = None
    if build and not dry_run and has_packages:
        with out.progress("splice") as report:
            report(0.0, "building the shaping node, which takes a minute or more")
            setup = build_package(splicing.folder / NODES)
    if out.present(json, _splicing_json(splicing, setup)):
        _show_splicing(splicing, arguments, setup, dry_run=dry_run)


def _refuse_for_throttlers(
    fallback: Fallback | None, message_type: str | None, files: Sequence[str]
) -> None:
    """Refuse what belongs to a plan where there is none. Raises InputError."""
    if fallback is not None:
        raise InputError("a throttler has no fallback: --fallback goes with a plan")
    if message_type is not None:
        raise InputError("a throttler is for all types: leave out --type")
    if not files:
        usage = "`splice --throttle TOPIC=PERIOD LAUNCH... -o DIR`"
        raise InputError(f"give the launch files: {usage}")


def throttled_inputs(inputs: Sequence[str]) -> "list[cs.ThrottledInput]":
    """Parse inputs to be throttled: ``/fusion:/points_raw=100ms``, ``/points_raw=100ms,first``.

    Raises InputError: a text is not of this form.
    """
    from chainshaper.values.durations import parse_duration
    from chainshaper.values.yaml_file import wrong_values_refused

    parsed = []
    for text in inputs:
        where, equals, rhythm = text.rpartition("=")
        period, comma, rule = rhythm.partition(",")
        if not equals:
            raise InputError(f"--throttle {text}: write a topic and a period: /points_raw=100ms")
        node, _, topic = where.rpartition(":")
        values = {"topic": topic, "period_ns": parse_duration(period), "subscriber": node or None}
        if comma:
            values["rule"] = rule
        with wrong_values_refused(cs.ThrottledInput):
            parsed.append(cs.ThrottledInput.model_validate(values))
    return parsed


def _show_splicing(
    splicing: "cs.Splicing", arguments: dict[str, str], setup: Path | None, *, dry_run: bool
) -> None:
    for redirect in splicing.redirects:
        verb = "publishes" if redirect.kind == "publisher" else "subscribes to"
        instead = f"{redirect.target} in place of {redirect.topic}, for {redirect.added[0]}"
        for node in redirect.nodes:
            out.show_line(f"{node} {verb} {instead}")
    if splicing.environment and dry_run:
        out.show_line("what is launched would get the gate")
    elif splicing.environment:
        loads = [f"{key}={value}" for key, value in splicing.environment.items()]
        out.show_line("what is launched gets the gate; what starts otherwise, as a service, by:")
        out.show_line(shlex.join(["env", *loads, "COMMAND"]))
    for looked_at in splicing.redirected:
        for started in looked_at["redirected"]:
            rules = " ".join(started["rules"]) or "nothing"
            out.show_line(f"would add to {started['as']}: {rules}")
    out.notes(splicing.notes)
    if dry_run:
        return
    if setup is not None:
        out.show_line(f"source {setup}")
    words = [f"{name}:={value}" for name, value in arguments.items()]
    for file in dict.fromkeys(splicing.launch.values()):
        if file in splicing.launch:  # it includes no launch file
            out.show_line(f"include {file} in your launch file, before all else")
        else:
            out.show_line(shlex.join(["ros2", "launch", str(file), *words]))


def _splicing_json(splicing: "cs.Splicing", setup: Path | None) -> dict[str, Any]:
    return {
        "folder": str(splicing.folder),
        "launch": {str(file): str(copy) for file, copy in splicing.launch.items()},
        "originals": {str(copy): str(file) for copy, file in splicing.originals.items()},
        "nodes": [process.name for process in splicing.processes],
        "standbys": [
            process.standby.name for process in splicing.processes if process.standby is not None
        ],
        "logs": [str(log) for log in splicing.logs],
        "setup": None if setup is None else str(setup),
        "environment": dict(splicing.environment),
        "redirected": [dict(looked_at) for looked_at in splicing.redirected],
        "diff": splicing.diff,
        "notes": list(splicing.notes),
    }
