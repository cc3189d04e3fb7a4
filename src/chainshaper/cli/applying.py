"""Verbs about what runs on this machine: its threads, plans in force, and what it can do."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chainshaper.cli.options import JSON, USERS, argument, option
from chainshaper.cli.output import (
    notes,
    print_json,
    progress,
    say,
    show,
    show_line,
    stop_on_signals,
)
from chainshaper.values.errors import InputError, OperationError

if TYPE_CHECKING:
    from chainshaper.enforcement.undoing import RunState
    from chainshaper.planning import Plan

LINE_EVERY = 10


def threads(
    where: str | None = argument(
        None,
        "[PID|PLAN]",
        "A process, which stands for its descendants too, or a plan.yaml for the nodes "
        "of its servers. Default: all that looks like ROS 2 or DDS.",
    ),
    recording: Path | None = option(
        None,
        "--recording REC",
        "A recording or trace of the processes while they ran: it tells nodes and "
        "executors for sure. Default: the plan's own, where it exists.",
    ),
    user: list[str] | None = USERS,
    json: bool = JSON,
) -> None:
    """Show the threads of running nodes: executors, DDS threads, publishers; class and cores."""
    from chainshaper.flow.threads import find_threads
    from chainshaper.planning import load_plan
    from chainshaper.reporting.recordings import threads_json, threads_table
    from chainshaper.sources import open_source

    place: int | Plan | None = None
    if where is not None and where.isdecimal():
        place = int(where)
    elif where is not None:
        place = load_plan(where)
        own = place.evidence.recording
        if recording is None and own and Path(own).is_dir():
            recording = Path(own)
    recorded = None if recording is None else open_source(recording)
    found = find_threads(place, recorded, users=user or ())
    if json:
        print_json(threads_json(found))
        return
    show(threads_table(found))
    notes(found.notes)


def apply(
    plan: Path = argument(..., "plan.yaml", "The plan."),
    command: list[str] | None = argument(
        None,
        "[-- COMMAND…]",
        "Start this, such as `ros2 launch …`, and end when it ends. Default: attach to what runs.",
    ),
    backend: str = option(
        "auto",
        "--backend NAME",
        "auto (the strongest that works here), scx, litmus, freezer or fifo.",
    ),
    phase: int | None = option(
        None,
        "--phase DURATION",
        "Where in a cycle the chain's timer expires, on CLOCK_MONOTONIC. Default: measured.",
    ),
    recording: Path | None = option(
        None, "--recording REC", "A recording of these very processes: it tells executors for sure."
    ),
    wait: int | None = option(
        None,
        "--wait DURATION",
        "How long the plan's nodes have to appear. Default: 30s with a COMMAND, else no time.",
    ),
    user: list[str] | None = USERS,
    dry_run: bool = option(
        False, "--dry-run", "Show what would be done to which thread, and change nothing."
    ),
    json: bool = JSON,
) -> None:
    """Keep the threads of an application inside a plan's slots, until Ctrl-C.

    Whatever ends it, everything is as it was before.
    """
    from chainshaper.flow.apply import apply_plan
    from chainshaper.planning import load_plan, plan_warnings
    from chainshaper.reporting.plans import servers_table

    planned, recorded = load_plan(plan), None
    if recording is not None:
        from chainshaper.sources import open_source  # slow to import

        recorded = open_source(recording)
    if dry_run:
        where = {"recording": recorded, "phase_ns": phase, "users": user or ()}
        _show_changes(planned, backend, json, **where)
        return
    notes(plan_warnings(planned))
    stop = threading.Event()
    with stop_on_signals(stop), _watching() as (watch, report):
        done = apply_plan(
            planned,
            command or (),
            command_stdout=sys.stderr.fileno() if json else None,  # standard output is ours
            back_end=backend,
            recording=recorded,
            phase_ns=phase,
            wait_ns=wait,
            users=user or (),
            plan_path=str(plan),
            stop=stop,
            watch=watch,
            progress=report,
        )
    if json:
        print_json(asdict(done.state) | {"exit_code": done.exit_code})
    else:
        show(servers_table(done.state))
    notes(done.state.notes)
    if done.exit_code and not stop.is_set():
        raise OperationError(f"the command ended with code {done.exit_code}")


def _show_changes(plan: "Plan", backend: str, json: bool, **where: Any) -> None:
    import shlex

    from chainshaper.flow.threads import planned_changes
    from chainshaper.reporting.plans import changes_table

    changes = planned_changes(plan, backend, **where)
    if json:
        print_json(asdict(changes))
        return
    if changes.commands:
        for command in changes.commands:
            show_line(shlex.join(command))
    else:
        show(changes_table(changes.threads))
    notes((f"back end {changes.back_end}: {changes.reason}", *changes.notes))


@contextmanager
def _watching() -> "Iterator[tuple[Callable[[RunState], None], Callable[[float, str], None]]]":
    """What shows the state of a run, and progress before: a live table, or a line now and then."""
    from chainshaper.reporting.plans import run_line, servers_table

    with ExitStack() as shown:
        report = shown.enter_context(progress("applying"))
        if not sys.stderr.isatty():
            yield _lines(run_line), report
            return
        from rich.console import Console
        from rich.live import Live

        live: Live | None = None

        def watch(state: "RunState") -> None:
            nonlocal live
            if live is None:
                shown.pop_all().close()  # the bar makes room for the table
                live = Live(console=Console(stderr=True), transient=True, auto_refresh=False)
                shown.enter_context(live)
            live.update(servers_table(state), refresh=True)

        yield watch, report


def _lines(text: "Callable[[RunState], str]") -> "Callable[[RunState], None]":

    seen = 0

    def watch(state: "RunState") -> None:
        nonlocal seen
        if seen == 0:
            say(f"in force with {state.back_end}: {state.reason}; Ctrl-C ends it")
        elif seen % LINE_EVERY == 0:
            say(text(state))
        seen += 1

    return watch


def status(
    outputs: bool = option(
        False, "--outputs", "Only the outputs that are shaped, bypassed or silent."
    ),
    json: bool = JSON,
) -> None:
    """Show the plans in force: back end, servers, counters, and what crashed runs have left.

    And the outputs that have a shaping node: which of them go around it, or are silent.
    """
    from chainshaper.enforcement.freezer import stray_groups
    from chainshaper.enforcement.undoing import find_runs, runs_as_json, strange_lines
    from chainshaper.reporting.plans import runs_table, servers_table
    from chainshaper.splicing.shaped_outputs import find_outputs, output_text

    found = find_outputs()
    if outputs and json:
        print_json([asdict(output) for output in found])
        return
    if json:
        print_json(runs_as_json())
        return
    for output in found:
        show_line(output_text(output))
    if outputs:
        if not found:
            show_line("no output has a shaping node")
        return
    runs = list(find_runs())
    strays = stray_groups(journal for journal, _ in runs)
    if runs:
        show(runs_table(runs), *(servers_table(state) for _, state in runs if state is not None))
    elif not strays:
        show_line("no plan is in force")
    notes(
        (
            *(line for journal, _ in runs for line in strange_lines(journal)),
            *(
                f"{folder} was left by a run whose journal is gone: `chainshaper release` lets its "
                "threads run"
                for folder in strays
            ),
        )
    )


def release(
    run: str | None = argument(
        None, "[RUN]", "The run, as `chainshaper status` names it. Default: all of them."
    ),
) -> None:
    """End plans in force, and put back what crashed runs have left changed."""
    from chainshaper.enforcement.freezer import groups_of, run_of
    from chainshaper.enforcement.scheduling_memory import look_alikes
    from chainshaper.enforcement.undoing import end_run, release_strays
    from chainshaper.linux.runs import find_journals

    runs = find_journals()
    chosen = [journal for journal in runs if run in (None, journal.path.parent.name)]
    if run is not None and not chosen:
        known = ", ".join(journal.path.parent.name for journal in runs) or "there are none"
        raise InputError(f"no run {run!r}: {known}")
    problems: list[str] = []
    strangers: list[str] = []
    for journal in chosen:
        try:
            strangers += look_alikes(journal, groups_of(run_of(journal)))
            left = end_run(journal)
        except OperationError as error:  # the others are ended all the same
            left = (str(error),)
        problems += left
        if not left:
            show_line(f"{journal.path.parent.name}: everything is as it was before")
    strays, left = release_strays(runs) if run is None else ((), ())
    for folder in strays:
        show_line(f"{folder}, of a run whose journal is gone: its threads run again")
    problems += left
    notes(strangers)
    if problems:
        raise OperationError("; ".join(problems))
    if not chosen and not strays:
        show_line("no plan is in force, and nothing was left behind")


def doctor(
    watch: int = option(
        5_000_000_000, "--watch DURATION", "How long to watch for stalls of the machine."
    ),
    json: bool = JSON,
) -> None:
    """Examine this machine: scheduling, privileges, tracing, DDS, and its own stalls."""
    from chainshaper.flow.doctor import examine_machine
    from chainshaper.reporting.recordings import machine_json, machine_tables

    with progress("examining this machine") as report:
        report(0.0, "watching for stalls")
        found = examine_machine(watch)
    if json:
        print_json(machine_json(found))
        return
    show(*machine_tables(found))
