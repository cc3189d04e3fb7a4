"""Verbs about what runs on this machine: its threads, plans in force, and what it can do."""

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import chainshaper as cs
from chainshaper.cli import options as opt
from chainshaper.cli import output as out
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.progress import Progress

if TYPE_CHECKING:
    from chainshaper.enforcement.undoing import RunState

LINE_EVERY = 10  # states of a run, without a terminal


def threads(
    where: str | None = opt.argument(
        "[PID|PLAN]",
        "A process, which stands for its descendants too, or a plan.yaml for the nodes "
        "of its servers. Default: all that looks like ROS 2 or DDS.",
    ),
    recording: Path | None = opt.option(
        "--recording REC",
        "A recording or trace of the processes while they ran: it tells nodes and "
        "executors for sure. Default: the plan's own, where it exists.",
    ),
    user: list[str] | None = opt.USERS,
    callback_groups: Path | None = opt.option(
        "--callback-groups FILE.yaml",
        "A configuration of callback_isolated_executor: show what it gives to each thread, and"
        " whether the thread has it.",
    ),
    json: bool = opt.JSON,
) -> None:
    """Show the threads of running nodes: executors, DDS threads, publishers; class and cores."""
    from chainshaper.reporting.overviews import threads_json, threads_table
    from chainshaper.values.callback_groups import read_group_configuration

    given = None if callback_groups is None else read_group_configuration(callback_groups)
    pid = int(where) if where is not None and where.isdecimal() else None
    plan = None if where is None or pid is not None else cs.load_plan(where)
    with out.late_progress("threads") as report:
        report(0.0, "looking for nodes and their threads")
        known = opt.recording_of(recording)
        running = cs.find_threads(plan if pid is None else pid, known, users=user or ())
    if out.present(json, threads_json(running, given), threads_table(running, given)):
        out.notes(running.notes)
        if plan is not None:
            out.next_step("chainshaper", "apply", str(where), "--dry-run")


def apply(
    plan: Path = opt.argument("plan.yaml", "The plan.", ...),
    command: list[str] | None = opt.argument(
        "[-- COMMAND…]",
        "Start this, such as `ros2 launch …`, and end when it ends. Default: attach to what runs.",
    ),
    backend: str = opt.option(
        "--backend NAME",
        "auto (the strongest that works here), scx, litmus, freezer or fifo.",
        "auto",
    ),
    phase: int | None = opt.option(
        "--phase DURATION",
        "Where in a cycle the chain's timer expires, on CLOCK_MONOTONIC: slots then stay there."
        " Default: measured, and followed where it drifts.",
        rich_help_panel=opt.IN_FORCE,
    ),
    recording: Path | None = opt.option(
        "--recording REC",
        "Of these very processes, or of an earlier run: it tells which threads execute what. "
        "Default: the plan's own, where it exists.",
        rich_help_panel=opt.THREADS,
    ),
    wait: int | None = opt.option(
        "--wait DURATION",
        "How long the plan's nodes have to appear. Default: 30s with a COMMAND, else no time.",
    ),
    adapt: bool = opt.ADAPT,
    max_latency: int | None = opt.MAX_LATENCY,
    user: list[str] | None = opt.USERS,
    dry_run: bool = opt.option(
        "--dry-run", "Show what would be done to which thread, and change nothing.", False
    ),
    json: bool = opt.JSON,
) -> None:
    """Keep the threads of an application inside a plan's slots, until Ctrl-C.

    Whatever ends it, everything is as it was before.
    """
    from chainshaper.linux.child_processes import end_in_words
    from chainshaper.reporting.overviews import changes_table, servers_table

    planned = cs.load_plan(plan)
    opt.refuse_bound_alone(max_latency, adapt)
    known = opt.recording_of(recording)
    if dry_run:
        with out.late_progress("apply") as report:
            report(0.0, "looking for nodes and their threads")
            changes = cs.planned_changes(
                planned, backend, recording=known, phase_ns=phase, users=user or ()
            )
        if out.present(json, asdict(changes)):
            for words in changes.commands:
                out.show_line(shlex.join(words))
            if not changes.commands:
                out.show(changes_table(changes.threads))
            out.notes((f"back end {changes.back_end}: {changes.reason}", *changes.notes))
            out.next_step("chainshaper", "apply", plan)
        return
    out.warn(planned)
    with out.stop_on_signals() as stop, _watching() as (watch, report):
        done = cs.apply_plan(
            planned,
            command or (),
            command_stdout=sys.stderr.fileno() if json else None,  # standard output is ours
            back_end=backend,
            recording=known,
            phase_ns=phase,
            users=user or (),
            wait_ns=wait,
            adapt=adapt,
            max_latency_ns=max_latency,
            plan_path=str(plan),
            stop=stop,
            watch=watch,
            progress=report,
        )
    out.present(json, asdict(done.state) | {"exit_code": done.exit_code}, servers_table(done.state))
    out.notes(done.state.notes)
    if done.exit_code and not stop.is_set():
        raise OperationError(f"the command {end_in_words(done.exit_code)}")


@contextmanager
def _watching() -> "Iterator[tuple[Callable[[RunState], None], Progress]]":
    """Yield what shows each state of a run, and the progress before there is one.

    It shows a live table, or without a terminal a line now and then.
    """
    from chainshaper.reporting.overviews import run_line, servers_table

    states: int = 0
    show: Any = None

    def watch(state: "RunState") -> None:
        nonlocal states, show
        is_first, states = states == 0, states + 1
        if is_first and sys.stderr.isatty():
            stack.pop_all().close()  # the bar makes room for the table
            show = stack.enter_context(out.live(on_stderr=True))
        if show is not None:
            show([servers_table(state)])
        elif is_first:
            out.say(f"in force with {state.back_end}: {state.reason}; Ctrl-C ends it")
        elif states % LINE_EVERY == 1:
            out.say(run_line(state))

    with ExitStack() as stack:
        report = stack.enter_context(out.progress("applying"))
        yield watch, report


def status(
    outputs: bool = opt.option(
        "--outputs", "Only the outputs that are shaped, bypassed or silent.", False
    ),
    json: bool = opt.JSON,
) -> None:
    """Show the plans in force: back end, servers, counters, and what crashed runs have left.

    And the outputs that have a shaping node: which of them go around it, or are silent.
    """
    from chainshaper.enforcement.freezer import stray_groups
    from chainshaper.enforcement.undoing import runs_as_json, strange_lines
    from chainshaper.reporting.overviews import runs_table, servers_table
    from chainshaper.splicing.shaped_outputs import find_outputs, output_text

    shaped = find_outputs()
    if json:
        out.print_json([asdict(output) for output in shaped] if outputs else runs_as_json())
        return
    for output in shaped:
        out.show_line(output_text(output))
    if outputs:
        if not shaped:
            out.show_line("no output has a shaping node")
        return
    runs = list(cs.find_runs())
    strays = stray_groups(journal for journal, _ in runs)
    if runs:
        states = (state for _, state in runs if state is not None)
        out.show(runs_table(runs), *map(servers_table, states))
        out.next_step("chainshaper", "release", runs[0][0].name)
    elif not strays:
        out.show_line("no plan is in force")
    out.notes(line for journal, _ in runs for line in strange_lines(journal))
    out.notes(
        f"{folder} was left by a run whose journal is gone: `chainshaper release` lets its "
        "threads run"
        for folder in strays
    )


def release(
    run: str | None = opt.argument(
        "[RUN]", "The run, as `chainshaper status` names it. Default: all of them."
    ),
    crashed: bool = opt.option(
        "--crashed", "Only of runs that have crashed: plans in force stay so.", False
    ),
) -> None:
    """End plans in force, and put back what crashed runs have left changed.

    What was being written into the current folder when its run was killed is removed as well, and
    what it had among temporary files and in the cache; and what outputs have left in memory that no
    process shapes any more.
    """
    from chainshaper.enforcement.freezer import groups_of, run_of
    from chainshaper.enforcement.journal import find_journals
    from chainshaper.enforcement.scheduling_memory import look_alikes
    from chainshaper.enforcement.undoing import release_strays
    from chainshaper.splicing.shaped_outputs import remove_abandoned_pages
    from chainshaper.values.files import clear_killed_runs

    runs = find_journals()
    chosen = [journal for journal in runs if run in (None, journal.name)]
    if run is not None and not chosen:
        known = ", ".join(journal.name for journal in runs) or "there are none"
        raise InputError(f"no run {run!r}: {known}")
    chosen = [journal for journal in chosen if not crashed or journal.owner is None]
    problems, strangers = list[str](), list[str]()
    for journal in chosen:
        try:
            strangers += look_alikes(journal, groups_of(run_of(journal)))
            left = cs.end_run(journal)
        except OperationError as error:  # the others are ended all the same
            left = (str(error),)
        problems += left
        if not left:
            out.show_line(f"{journal.name}: everything is as it was before")
    strays, left = release_strays(runs) if run is None else ((), ())
    for folder in strays:
        out.show_line(f"{folder}, of a run whose journal is gone: its threads run again")
    problems += left
    removed, stays = clear_killed_runs(Path.cwd()) if run is None else ([], [])
    for line in removed:
        out.show_line(line)
    notes = [*strangers, *stays]
    pages = remove_abandoned_pages() if run is None else []
    if pages:
        notes.append(f"{len(pages)} pages of outputs that no process shapes any more are removed")
    out.notes(notes)
    if problems:
        raise OperationError("; ".join(problems))
    if not chosen and not strays and not removed and not stays:
        out.show_line("no plan is in force, and nothing was left behind")


def doctor(
    watch: int = opt.option(
        "--watch DURATION", "How long to watch for stalls of the machine.", 5_000_000_000
    ),
    json: bool = opt.JSON,
) -> None:
    """Examine this machine: scheduling, privileges, tracing, DDS, and its own stalls."""
    from chainshaper.reporting.overviews import machine_json, machine_line, machine_tables

    with (
        out.progress("examining this machine") as report,
        out.lasting(report, watch / 1e9, "watching for stalls"),
    ):
        machine = cs.examine_machine(watch)
    if out.present(json, machine_json(machine), *machine_tables(machine)):
        out.show_line(machine_line(machine))
