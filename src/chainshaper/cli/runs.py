"""Verbs that run an application: live, simulated, recorded, profiled, shaped; and the demo."""

import shlex
import signal
import sys
import time
from contextlib import ExitStack, suppress
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import chainshaper as cs
from chainshaper.cli import options as opt
from chainshaper.cli import output as out
from chainshaper.cli.plans import throttled_inputs
from chainshaper.cli.traces import comparison_tables, judge
from chainshaper.values.errors import ChainshaperError, InputError, OperationError
from chainshaper.values.plan_choices import NodeChoice

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from chainshaper.analysis import ChainEnumeration
    from chainshaper.flow.demonstration import Demonstration
    from chainshaper.monitor.budgets import Budget, Judged
    from chainshaper.monitor.watch import Seen, Watch
    from chainshaper.values.application import ApplicationGraph

STDERR = 2
PATIENCE_NS = 10_000_000_000  # after nodes are there `watch` names what of a budget has not run
MOST_JUDGED = 100_000  # simulated cycles: they are read again to be judged, which takes memory
MOST_RECORDED = 100  # by `watch --budget` itself: a limit that breaks for weeks fills no disk

COMMAND: list[str] | None = opt.argument(
    "[-- COMMAND…]", "Starts the application, such as `ros2 launch …`; ended with the recording."
)
DURATION: int | None = opt.option(
    "--duration DURATION", "How long to record. Default: until the application ends, or Ctrl-C."
)
BUFFER: int | None = opt.option(
    "--buffer MIB",
    "LTTng's buffer of each core, in MiB, for when events were lost. Default: 4.",
    min=1,
    rich_help_panel=opt.TRACING,
)


@opt.takes_wishes("ideal_machine")
def demo(
    output: Path | None = opt.option(
        "--output -o DIR", "Folder for everything. Default: chainshaper-demo-DATE-TIME here."
    ),
    application: Path | None = opt.option(
        "--application APP.yaml", "Another application than the paper's synthetic chain."
    ),
    cycles: int = opt.CYCLES,
    realtime: bool | None = opt.REALTIME,
    *,
    request: "cs.PlanRequest",
    ros: bool = opt.option(
        "--ros",
        "As nodes of the ROS 2 that is sourced, shaped in the publisher's process and by a node.",
        False,
    ),
    verbose: bool = opt.option("--verbose", "Print all tables, too, and every note.", False),
    json: bool = opt.JSON,
) -> None:
    """Measure a live chain, plan, splice the shaping node, measure again, show the gain.

    Runs the paper's synthetic chain as real processes over real DDS topics, for about two minutes.
    Needs no ROS 2. Runs without and with the plan take turns, so that both meet the same machine.
    """
    from chainshaper.flow.demonstration import run_demo
    from chainshaper.reporting.latency import comparison_json

    kind = "demo-ros" if ros else "demo"
    folder = output or Path(f"chainshaper-{kind}-{datetime.now():%Y%m%d-%H%M%S}")
    with out.progress("demo") as report:
        shown = run_demo(
            folder,
            application=application,
            cycles=cycles,
            request=request,
            realtime=realtime,
            in_ros=ros,
            command=sys.argv,
            progress=report,
        )
    if shown.comparison is None:
        values: dict[str, Any] = {"folder": str(folder), "unplanned": shown.unplanned}
    else:
        values = comparison_json(shown.comparison) | {"folder": str(folder)}
    if json:
        out.print_json(values | {"longer": shown.longer, "percentile": shown.percentile})
        return
    _show_demonstration(shown, verbose=verbose)


def _show_demonstration(shown: "Demonstration", *, verbose: bool) -> None:
    """Show what a demonstration has shown on one screen; ``verbose`` shows all tables."""
    from chainshaper.reporting.overviews import callback_table, plan_table
    from chainshaper.reporting.screen import compared_before, comparison_lines, unplanned_lines

    before, folder = shown.before.recording, shown.folder
    if verbose:
        flow = cs.data_flow(before.events, before.info.clock_offset_ns)
        out.show(callback_table(cs.callback_statistics(flow)))
        for plan in shown.plans:
            out.show(*map(plan_table, plan.chains))
            out.warn(plan)
        if shown.comparison is not None:
            out.show(*comparison_tables(shown.comparison))
        out.notes(before.info.notes)
    if shown.comparison is None:
        out.show(*unplanned_lines(shown.before, shown.unplanned or ""))
    for number, (title, comparison) in enumerate(shown.shaped.items()):
        if len(shown.shaped) > 1:
            out.show_line(f"{'' if number == 0 else chr(10)}  ROS 2 nodes, {title}")
        out.show(*comparison_lines(comparison))
    if shown.retried:
        out.show_line("  ! No plan fitted the first cycles: it measured for longer.")
    elif shown.longer:
        out.show_line("  ! Stalls hit more than a third of the cycles: it measured for longer.")
    if shown.percentile is not None:
        most = f"{shown.percentile:g} % of the cycles"
        out.show_line(f"  ! Planned for {most}: the longest ones do not fit into a period.")
    out.show_line("")
    earlier = sorted(Path().glob("chainshaper-demo-2*/comparison.json"))[-1:]
    if len(shown.shaped) > 1 and earlier:
        out.show(*compared_before(earlier[0]))
    look = "report.html" if shown.comparison is not None else "before"
    out.show_line(f"  Look        {folder / look}")
    out.show_line(
        "  Your robot  chainshaper shape -o shaped -- ros2 launch my_robot robot.launch.py"
    )


def init(
    output: Path = opt.option(
        "--output -o app.yaml", "File to write; must not exist.", Path("app.yaml")
    ),
) -> None:
    """Write the description of an application to start from: the paper's synthetic chain.

    Edit its nodes, callbacks and execution times; `chainshaper run` and `simulate` take it.
    """
    from chainshaper.flow.demonstration import synthetic_chain
    from chainshaper.values.files import new_file, write_whole

    write_whole(new_file(output, opt.DESCRIPTIONS), [synthetic_chain().read_bytes()])
    out.show_line(output)
    out.next_step("chainshaper", "run", output, "-o", "before")


def run(
    application: Path = opt.APPLICATION,
    output: Path = opt.RECORDING_OUTPUT,
    cycles: int = opt.CYCLES,
    realtime: bool | None = opt.REALTIME,
) -> None:
    """Run an application live over DDS and record its events.

    Every node is a process of its own, scheduled as the description says (SCHED_FIFO where it is
    permitted). The recording is a folder of Parquet tables.
    """
    from chainshaper.workload.timing import WARM_UP_CYCLES

    described = cs.load_application(application)
    with out.progress(f"running {described.name}") as report:
        recording = cs.run_application(
            described, output, cycles=cycles, realtime=realtime, command=sys.argv, progress=report
        )
    out.notes((f"skipped {WARM_UP_CYCLES} warm-up cycles", *recording.info.notes))
    out.show_line(recording.path)
    out.next_step("chainshaper", "plan", recording.path, "-o", "plan.yaml")


def simulate(
    application: Path = opt.APPLICATION,
    output: Path = opt.RECORDING_OUTPUT,
    plan: Path | None = opt.argument("plan.yaml", "The plan in force."),
    cycles: int = opt.CYCLES,
    seed: int | None = opt.SEED,
    switches: bool = opt.option("--switches", "Record what ran on which core, too.", False),
    execution_times: Path | None = opt.option(
        "--execution-times REC", "Draw execution times from those recorded there."
    ),
    block: int = opt.option(
        "--block", "Draw execution times in stretches of N consecutive cycles.", 1, min=1, max=1024
    ),
) -> None:
    """Simulate an application, with a plan in force or without, and record its events.

    The recording is like that of a live run: every other verb takes it. With a plan, a note says
    whether its promise was met.
    """
    from chainshaper.reporting.latency import verdict

    described = cs.load_application(application)
    with out.late_progress(f"simulating {described.name}") as report:
        if execution_times is not None:
            from chainshaper.simulation.simulating import with_recorded_times

            report(0.0, f"reading execution times from {execution_times}")
            described = with_recorded_times(described, execution_times, block=block)
        recording = cs.simulate(
            described,
            output,
            opt.plan_in_force(plan),
            cycles=cycles,
            seed=seed,
            switches=switches,
            command=sys.argv,
            progress=report,
        )
        judged = plan is not None and cycles <= MOST_JUDGED
        comparisons = cs.compare_chains([recording], least=1) if judged else ()
    for comparison in comparisons:
        for measurement in comparison.measurements:
            out.notes([f"{comparison.chain}: {verdict(measurement)[1]}"])
    out.show_line(recording.path)
    out.next_step("chainshaper", "latency", recording.path)


def generate(
    application: Path | None = opt.argument("[APP.yaml]", "The application's description."),
    output: Path = opt.option(
        "--output -o PATH",
        "Folder of the package, named like it, or with --nodes the description's file; must not"
        " exist.",
        ...,
    ),
    nodes: int | None = opt.option(
        "--nodes N", "Instead of a package, describe a made-up application of so many nodes.", min=1
    ),
    containers: int = opt.option(
        "--containers N", "With --nodes: processes they share.", 20, min=1
    ),
    chains: int = opt.option("--chains N", "With --nodes: chains through them.", 12, min=1),
    cores: int = opt.option("--cores N", "With --nodes: cores that they run on.", 8, min=1),
    seed: int = opt.option("--seed N", "With --nodes: random seed.", 1, min=0),
    json: bool = opt.option("--json", "Print what was written as JSON.", False),
) -> None:
    """Write a colcon package with the application as ROS 2 nodes in C++.

    Build it with `colcon build`, then `ros2 launch NAME NAME.launch.py`; `chainshaper shape` shapes
    that as any other application. With --nodes, write the description of a large application
    instead, to try things on.
    """
    if nodes is not None:
        if application is not None:
            raise InputError("give either APP.yaml, to write its package, or --nodes")
        _describe_large(output, nodes, containers, chains, cores, seed, json=json)
        return
    if application is None:
        raise InputError("what to generate is missing: name APP.yaml, or say --nodes N")
    files = cs.generate_package(cs.load_application(application), output)
    value = {"package": output.name, "folder": str(output), "files": list(map(str, files))}
    if out.present(json, value):
        out.show_line(output)
        out.next_step("colcon", "build", "--base-paths", output)


def _describe_large(
    output: Path, nodes: int, containers: int, chains: int, cores: int, seed: int, *, json: bool
) -> None:
    """Write the description of a large application, and show its chains."""
    import yaml

    from chainshaper.values.files import new_file, write_whole
    from chainshaper.workload.description import application_as_written
    from chainshaper.workload.large_application import large_application

    new_file(output, opt.DESCRIPTIONS)
    made = large_application(nodes, containers, chains, cores, seed)
    text = yaml.safe_dump(application_as_written(made.application), sort_keys=False)
    write_whole(output, [text.encode()])
    if out.present(json, {"description": str(output), "chains": list(made.chains)}):
        for line in (str(output), *made.chains):
            out.show_line(line)
        out.next_step("chainshaper", "simulate", output, "-o", "simulated")


def record(
    output: Path = opt.RECORDING_OUTPUT,
    command: list[str] | None = COMMAND,
    source: opt.Source | None = opt.SOURCE,
    duration: int | None = DURATION,
    pid: list[int] | None = opt.option(
        "--pid",
        "Attach to this process and what it has started (ebpf, preload; may be repeated). "
        "Default, without a COMMAND: everything of the users that looks like ROS 2.",
        rich_help_panel=opt.TRACING,
    ),
    user: list[str] | None = opt.USERS,
    buffer: int | None = BUFFER,
    loop: list[str] | None = opt.LOOPS,
    watch_stalls: bool = opt.option(
        "--watch-stalls",
        "Have a sleeper on every core notice when the machine itself stands still.",
        False,
    ),
    json: bool = opt.JSON,
) -> None:
    """Record a ROS 2 application: its events, nodes, threads and QoS.

    Starts tracing, then the COMMAND, and ends both with Ctrl-C, after --duration, or when the
    application ends by itself. The application is neither changed nor recompiled.
    """
    if command and pid:
        raise InputError("a COMMAND is started, --pid attaches to what runs: give one of them")
    if not command and source not in ("ebpf", "preload"):
        raise InputError("no command given: add `-- ros2 launch …`, or to attach --source ebpf")
    with out.stop_on_signals() as stop:
        recorded = cs.record_command(
            output,
            command or [],
            source=source,
            duration_ns=duration,
            pids=pid or [],
            users=user or [],
            buffer=buffer and buffer << 20,
            loops=loop or [],
            watch_stalls=watch_stalls,
            command_stdout=STDERR if json else None,  # standard output is ours
            stop=stop,
            progress=out.stage_lines("record"),
        )
    _show_recorded(recorded, "chains", json=json)


def _show_recorded(recorded: "cs.Recorded", *then: str, json: bool) -> None:
    """Show what was recorded, and the command for it that comes ``then``.

    Raises OperationError: the command ended with an error.
    """
    from chainshaper.linux.child_processes import end_in_words

    recording = recorded.recording
    events = int(cs.event_counts(recording)["count"].sum())
    values = {
        "recording": str(recording.path),
        "events": events,
        "lost": recording.info.lost,
        "exit_code": recorded.exit_code,
        "notes": list(recording.info.notes),
    }
    if out.present(json, values):
        out.show_line(recording.path)
    out.notes((*recording.info.notes, f"{events} events; {out.lost_events(recording)}"))
    if recorded.exit_code:
        ended = f"the command {end_in_words(recorded.exit_code)}"
        raise OperationError(f"{ended}; what was recorded until then is in {recording.path}")
    if not json:
        verb, *options = then
        out.next_step("chainshaper", verb, recording.path, *options)


def watch(
    command: list[str] | None = opt.argument(
        "[-- COMMAND…]",
        "Starts the application with the library in front, and ends it with Ctrl-C. Default: "
        "what runs already with the library is watched, and left running.",
    ),
    chain: list[str] | None = opt.option(
        "--chain FIRST..LAST", "A chain, by topics or nodes: /t1../t5 (may be repeated)."
    ),
    through: list[str] | None = opt.THROUGH,
    plan: Path | None = opt.option(
        "--plan plan.yaml", "The plan in force: its chains, slots, and which outputs are late."
    ),
    longest: int = opt.option(
        "--longest DURATION>0", "What takes longer counts as incomplete.", 2_000_000_000
    ),
    every: int = opt.option("--every DURATION>0", "How often to look.", 1_000_000_000),
    budget: Path | None = opt.option(
        "--budget FILE",
        "What chains, hops and callbacks may take in the last minute: a limit that breaks is said,"
        " and the last ten seconds are written.",
        rich_help_panel="Budgets",
    ),
    recorder: Path = opt.option(
        "--recorder DIR",
        "Where these are written, also by Ctrl-\\: recordings in folders named by their time.",
        Path(),
        rich_help_panel="Budgets",
    ),
    metrics: int | None = opt.option(
        "--metrics PORT",
        "Serve OpenMetrics (Prometheus) on this port of this machine.",
        min=1,
        max=65535,
        rich_help_panel="Other programs",
    ),
    otlp: str | None = opt.option(
        "--otlp URL",
        "Send metrics there every ten seconds, by OTLP over HTTP (OpenTelemetry).",
        rich_help_panel="Other programs",
    ),
    diagnostics: bool = opt.option(
        "--diagnostics",
        "Publish the chains on /diagnostics, with the ROS 2 of the nodes.",
        False,
        rich_help_panel="Other programs",
    ),
    user: list[str] | None = opt.USERS,
    loop: list[str] | None = opt.LOOPS,
    environment: bool = opt.option(
        "--environment",
        "Print the export line that enables watching, and exit.",
        False,
    ),
    json: bool = opt.option("--json", "Print a JSON object a line at each look.", False),
) -> None:
    """Watch the chains and loops of a running application: now, over a minute, over an hour.

    The application needs the library in front of ROS 2: `eval "$(chainshaper watch --environment)"`
    before it is started, or start it here, as COMMAND. Watching needs no root and changes nothing.
    """
    from chainshaper.linux import child_processes
    from chainshaper.linux.processes import run_users
    from chainshaper.monitor.budgets import Budget, load_budget
    from chainshaper.monitor.watch import Watch, exporting
    from chainshaper.reporting.overviews import watch_tables
    from chainshaper.sources.preload import named_loops
    from chainshaper.values.handed_over import parse_through
    from chainshaper.values.recording import refuse_existing

    named_loops.names_text(loop or [])
    if environment:
        for name, value in named_loops.in_front_of(loop or []).items():
            out.show_line(f"export {name}={shlex.quote(value)}")
        return
    known = opt.plan_in_force(plan)
    limits = Budget() if budget is None else load_budget(budget)
    limits = limits.declaring(through or ())
    chains = _chains_to_watch(chain or [], known, limits, loop or [])
    if budget is not None or recorder != Path():
        refuse_existing(recorder / "watch-DATE-TIME")
    if command:
        child_processes.check_command(command)
    with out.stop_on_signals() as stop, ExitStack() as until:
        started = None
        if command:
            variables = named_loops.in_front_of(loop or [])
            started = child_processes.start_command(command, variables, STDERR)
            until.callback(child_processes.end_command, started)
        show = until.enter_context(out.live())
        export = until.enter_context(exporting(metrics, otlp))
        asked = until.enter_context(out.set_by(signal.SIGQUIT))
        watched = Watch(
            chains,
            users=run_users(user or []),
            plan=known,
            longest_ns=longest,
            callbacks=bool(limits.callbacks),
            loops=loop or [],
            through=parse_through(limits.through),
        )
        publish = _publisher(watched, until) if diagnostics else lambda _: None
        next_look, judged = time.monotonic_ns() + every, _judging(limits, watched, recorder)
        while not stop.wait(0.1) and (started is None or started.poll() is None):
            watched.read()
            if asked.is_set():
                asked.clear()
                _save(watched, recorder)
            if (late := time.monotonic_ns() - next_look) >= 0:
                next_look += (1 + late // every) * every  # looks that were missed are left out
                out.notes(export(seen := watched.look()))
                publish(seen)
                for missed in seen.missed:
                    out.say(missed)
                broken = [limit.text for limit in judged(seen)]
                if json:
                    out.print_json(seen.as_json() | {"broken": broken}, indent=None)
                else:
                    show(watch_tables(seen))
    if started is not None and started.returncode and not stop.is_set():
        raise OperationError(f"the command {child_processes.end_in_words(started.returncode)}")


def _chains_to_watch(
    chains: "Sequence[str]", plan: "cs.Plan | None", limits: "Budget", loops: "Sequence[str]"
) -> list[str]:
    """Return the chains that are named, or else those of the plan; and those that have limits.

    There may be none where loops are named, or have limits. Raises InputError: nothing is named.
    """
    specs = [*chains]
    if not specs and plan is not None:
        specs = [spec for chain_plan in plan.chains if (spec := chain_plan.chain.spec)]
    specs += [of_chain.chain for of_chain in limits.chains]
    if not (specs or loops or limits.loops):
        raise InputError(
            "no chain is named: give --chain FIRST..LAST, such as /t1../t5, or --plan or --budget,"
            " or --loop for a loop alone"
        )
    return list(dict.fromkeys(specs))


def _judging(
    limits: "Budget", watched: "Watch", recorder: Path
) -> "Callable[[Seen], list[Judged]]":
    """Return what finds the broken limits at a look; it reports and records those newly broken."""
    from chainshaper.monitor.budgets import broken_limits, not_running

    breaks, named_at, left = set[tuple[str, str]](), 0, MOST_RECORDED

    def judged(seen: "Seen") -> "list[Judged]":
        nonlocal breaks, named_at, left
        broken = broken_limits(limits, seen)
        new = [limit.text for limit in broken if (limit.where, limit.figure) not in breaks]
        breaks = {(limit.where, limit.figure) for limit in broken}
        if new:
            out.say("; ".join(new))
            if left > 0:
                left -= 1
                _save(watched, recorder, new)
                if not left:
                    out.notes([f"{MOST_RECORDED} recordings are there: no more but with Ctrl-\\"])
        if not named_at and any(seen.processes.values()):
            named_at = seen.at_ns + PATIENCE_NS
        if 0 < named_at <= seen.at_ns:
            out.notes([*not_running(limits, seen), *watched.unseen_loops()])
            named_at = -1
        return broken

    return judged


def _save(watched: "Watch", recorder: Path, reasons: "Sequence[str]" = ()) -> None:
    """Have the flight recorder write; if it cannot, say so, and go on watching."""
    name = f"watch-{datetime.now():%Y%m%d-%H%M%S}"
    try:
        for number in count(1):  # another watch may have taken the name
            folder = recorder / (name if number == 1 else f"{name}-{number}")
            with suppress(FileExistsError):
                folder.mkdir()
                break
        try:
            out.say(f"the last ten seconds are in {watched.save(folder, reasons=reasons).path}")
        finally:
            with suppress(OSError):
                folder.rmdir()  # it is empty: nothing was written
    except (ChainshaperError, OSError) as error:
        out.say(f"the flight recorder has not written: {error}")


def _publisher(watched: "Watch", until: ExitStack) -> "Callable[[Seen], None]":
    """Return what publishes a look on `/diagnostics`, with the ROS 2 of the first node seen."""
    from chainshaper.sources.ros import environment_of, publishing_diagnostics

    publish: Callable[[Sequence[Mapping[str, Any]]], str | None] | None = None

    def take(seen: "Seen") -> None:
        nonlocal publish
        try:
            if publish is None and watched.processes:
                environment = environment_of(next(iter(watched.processes)))
                publish = until.enter_context(publishing_diagnostics(environment))
            problem = None if publish is None else publish(seen.as_diagnostics())
        except OperationError as error:
            problem, publish = str(error), lambda _: None
        if problem is not None:
            out.say(f"/diagnostics is not published: {problem}")

    return take


@opt.takes_wishes("cores", "policy", "best_effort")
def profile(
    output: Path = opt.RECORDING_OUTPUT,
    command: list[str] | None = COMMAND,
    *,
    chain: list[str] | None = opt.option(
        "--chain FIRST..LAST",
        "The chain whose nodes, and those that it waits for, get the priority (may be repeated);"
        " --like tells which those are.",
    ),
    like: Path | None = opt.option(
        "--like REC",
        "An earlier recording of the application: it knows the chain's nodes, components "
        "of containers, and executors with several threads.",
        rich_help_panel=opt.THREADS,
    ),
    through: list[str] | None = opt.THROUGH,
    node: list[str] | None = opt.option(
        "--node NAME",
        "A node that gets the priority (may be repeated, the most urgent first). Default: the "
        "chain's, or all, at one priority.",
        rich_help_panel=opt.THREADS,
    ),
    core: int | None = opt.option(
        "--core",
        "Where executors run. Default: the last core; with --chain and --like, others as well where"
        " branches run at the same time. DDS threads run on the others.",
        min=0,
        rich_help_panel=opt.THREADS,
    ),
    request: "cs.PlanRequest",
    source: opt.Source | None = opt.SOURCE,
    duration: int | None = DURATION,
    buffer: int | None = BUFFER,
    loop: list[str] | None = opt.LOOPS,
    json: bool = opt.JSON,
) -> None:
    """Record with the chain's threads under SCHED_FIFO, DDS threads on another core.

    This is how the latencies are measured that a plan is computed from. Whatever ends it, all
    threads are as before. What happened before the priorities were in force is left out, and is no
    part of --duration.
    """
    from chainshaper.flow.profiling_condition import check_profiling, profiled_cores, undelayed
    from chainshaper.linux.child_processes import check_command
    from chainshaper.planning.request import best_effort_cores
    from chainshaper.values.handed_over import parse_through
    from chainshaper.values.recording import refuse_existing

    if not command:
        raise InputError("no command given: `chainshaper profile -o REC -- ros2 launch …`")
    chains = chain or []
    if chains and like is None and not node:
        raise InputError(f"which nodes has {chains[0]}? Add --like REC, or name them (--node)")
    refuse_existing(output)
    check_command(command)
    if core is not None and request.cores is not None:
        raise InputError("--core is for one core, --cores for several: give one of them")
    if core is not None:
        request = cs.PlanRequest(cores=(core,))
    cores, earlier = check_profiling(request.cores), opt.recording_of(like, through=through or ())
    if len(cores) > 1 and not (earlier and chains):
        raise InputError("--cores are distributed by what chains do: add --chain and --like")
    core_of = {f"/{name.strip('/')}": cores[0] for name in node or ()}
    profiles = tuple["cs.Profile", ...]()
    if earlier is not None and chains:
        profiles, of_chains = profiled_cores(earlier, chains, request)
        core_of |= of_chains
        if len(undelayed(profiles, of_chains)) > 1:
            out.notes(["chains that share a core delay each other here: profile them one by one"])
    if request.best_effort and not core_of:
        raise InputError("--best-effort is beside a chain: add --chain and --like, or --node")
    with out.stop_on_signals() as stop:
        recorded = cs.record_command(
            output,
            command,
            source=source,
            duration_ns=duration,
            buffer=buffer and buffer << 20,
            loops=loop or [],
            chain=chains[0] if chains else None,
            through=parse_through(through or ()),
            scheduling=cs.profiling_condition(
                core_of,
                core_of or cores[0],
                like=earlier,
                best_effort=best_effort_cores(profiles, request, core_of),
                policy=request.policy,
            ),
            watch_stalls=True,
            command_stdout=STDERR if json else None,  # standard output is ours
            stop=stop,
            progress=out.stage_lines("record"),
        )
    _show_recorded(recorded, "plan", "-o", "plan.yaml", json=json)


@opt.takes_wishes(*opt.PLAN_WISHES)
def shape(
    words: list[str] = opt.argument(
        "APP.yaml plan.yaml | -- ros2 launch ...",
        "A described application and the plan in force; or what launches a real one, "
        "which is then measured and planned first.",
        ...,
    ),
    output: Path = opt.option(
        "--output -o REC",
        "Folder for the recording; of a launched application, for everything.",
        ...,
    ),
    cycles: int = opt.option(
        "--cycles", "Cycles to record.", 320, min=1, rich_help_panel="A described application"
    ),
    realtime: bool | None = opt.option(
        "--realtime/--no-realtime",
        "Use SCHED_FIFO. Default: where it is permitted.",
        rich_help_panel="A described application",
    ),
    chain: list[str] | None = opt.option(
        "--chain FIRST..LAST",
        "The chain, by topics or nodes: /t1../t5. Several are shaped together. Default: you are"
        " asked.",
    ),
    sink: list[str] | None = opt.SINK,
    throttle: list[str] | None = opt.option(
        "--throttle NODE:TOPIC=PERIOD",
        "A throttler before an input of NODE that is not quite periodic, from the first recording"
        " on (may be repeated).",
        rich_help_panel=opt.EVIDENCE,
    ),
    period: int | None = opt.option(
        "--period DURATION>0",
        "Period of a chain that no timer starts.",
        rich_help_panel=opt.EVIDENCE,
    ),
    duration: int = opt.option(
        "--duration DURATION>0",
        "How long to measure, before and after. Default: 60s.",
        60_000_000_000,
    ),
    since: int = opt.SINCE,
    until: int | None = opt.UNTIL,
    source: opt.Source | None = opt.SOURCE,
    loop: list[str] | None = opt.LOOPS,
    node: NodeChoice = opt.NODE,
    backend: str = opt.option(
        "--backend NAME",
        "As for `chainshaper apply`.",
        "auto",
        rich_help_panel=opt.IN_FORCE,
    ),
    adapt: bool = opt.ADAPT,
    max_latency: int | None = opt.MAX_LATENCY,
    *,
    request: "cs.PlanRequest",
    mode_profile: list[str] | None = opt.MODE_PROFILE,
    user: list[str] | None = opt.USERS,
    strict: bool = opt.STRICT,
    verbose: bool = opt.option("--verbose", "Print all tables, too, and every note.", False),
    json: bool = opt.JSON,
) -> None:
    """Run an application with its output shaped as planned, and record it.

    The publisher's output topic is remapped, and the shaping node republishes it in its slots.
    Behind `--`, `ros2 launch` does the whole flow: record, choose a chain, profile, plan, splice,
    apply, record again, compare. Every file in between stays. All options but --cycles, --realtime
    and --adapt are for this, and mean what they mean for `chainshaper plan` and `apply`.
    """
    opt.refuse_bound_alone(max_latency, adapt)
    if len(words) == 2 and words[0].endswith(opt.DESCRIPTIONS):
        if chain or sink or throttle or mode_profile or request != cs.PlanRequest():
            raise InputError("a described application is shaped as plan.yaml says: plan it so")
        if loop:
            raise InputError(
                "the loops of a described application are those of its description (`loop:`):"
                " leave out --loop"
            )
        application, planned = cs.load_application(words[0]), cs.load_plan(words[1])
        out.warn(planned)
        with out.progress(f"shaping {application.name}") as report:
            recording = cs.shape_application(
                application,
                planned,
                output,
                cycles=cycles,
                realtime=realtime,
                adapt=adapt,
                max_latency_ns=max_latency,
                command=sys.argv,
                progress=report,
            )
        _show_shaped_recording(recording, strict=strict)
        return
    if Path(words[0]).suffix in opt.DESCRIPTIONS:
        raise InputError("a described application has its plan: `shape APP.yaml plan.yaml -o REC`")
    with out.stop_on_signals() as stop:
        shaped = cs.shape_launch(
            words,
            output,
            chain=chain,
            sinks=sink or (),
            throttled=throttled_inputs(throttle or []),
            choose=_ask if sys.stdin.isatty() and not json else None,
            request=request,
            period_ns=period,
            mode_recordings=opt.mode_profiles(mode_profile, request),
            since_ns=since,
            until_ns=until,
            duration_ns=duration,
            source=source,
            loops=loop or (),
            node=node,
            back_end=backend,
            adapt=adapt,
            max_latency_ns=max_latency,
            users=user or (),
            stop=stop,
            planned=out.warn,
            progress=out.stage_lines("shape"),
        )
    _show_shaped_launch(shaped, strict=strict, verbose=verbose, json=json)


def _show_shaped_recording(recording: "cs.Recording", *, strict: bool) -> None:
    """Show what gates did in a recording of a described application, and judge it."""
    from chainshaper.verify.overruns import dropped_text, overruns_text

    with out.late_progress("shape") as report:
        comparisons = cs.compare_chains([recording], least=1, progress=report)
    for comparison in comparisons:
        about = f"{comparison.chain}: " if len(comparisons) > 1 else ""
        (measured,) = comparison.measurements
        if measured.overruns:
            out.notes([about + overruns_text(measured.overruns)])
        if measured.dropped:
            out.notes([about + dropped_text(measured.dropped)])
    out.notes(recording.info.notes)
    out.show_line(recording.path)
    judge(comparisons, strict=strict, json=False)
    out.next_step("chainshaper", "report", recording.path, "-o", "report.html")


def _show_shaped_launch(
    shaped: "cs.ShapedLaunch", *, strict: bool, verbose: bool, json: bool
) -> None:
    """Show the comparison of a launched application's chains, and judge it."""
    from chainshaper.reporting.latency import comparison_json
    from chainshaper.reporting.screen import comparison_lines

    values = comparison_json(shaped.comparison) | {
        "folder": str(shaped.folder),
        "chains": [comparison_json(comparison) for comparison in shaped.comparisons],
        "cores": dict(shaped.cores),
    }
    if json:
        out.print_json(values)
    else:
        if verbose:
            out.show(*comparison_tables(*shaped.comparisons))
            out.notes(shaped.notes)
        for number, comparison in enumerate(shaped.comparisons, start=1):
            results = shaped.folder if number == 1 else shaped.folder / f"chain_{number}"
            out.show_line(f"  {comparison.chain}")
            out.show(*comparison_lines(comparison))
            out.show_line(f"\n  Look        {results / 'report.html'}")
        if shaped.splicing is not None:
            launch = next(iter(shaped.splicing.launch.values()))
            plan = shaped.folder / "plan.yaml"
            sourced = "" if shaped.setup is None else f"source {shaped.setup}; "
            applied = f"chainshaper apply {plan} -- ros2 launch {launch}"
            out.show_line(f"  Keep it so  {sourced}{applied}")
    judge(shaped.comparisons, strict=strict, json=True)


def _ask(graph: "ApplicationGraph", listed: "ChainEnumeration") -> str:
    """Ask the user which of the listed chains to shape."""
    from chainshaper.reporting.overviews import chain_table
    from chainshaper.values.errors import shown

    out.show(chain_table(graph, listed))
    default = (listed.heaviest or listed.chains[0]).spec
    question = f"Which chain, FIRST..LAST? [{shown(default)}]"
    return str(typer.prompt(question, default=default, show_default=False, err=True))
