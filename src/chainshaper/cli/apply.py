"""`chainshaper apply`: put a plan in force on a running application."""

import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from chainshaper.cli.options import JsonOption, UsersOption, duration_option
from chainshaper.cli.signals import stop_on_signals

if TYPE_CHECKING:
    from chainshaper.enforcement.runs.state import RunState
    from chainshaper.planning import Plan
    from chainshaper.values.recording import Recording

__all__ = ["apply"]

LINE_EVERY = 10


def apply(
    plan: Annotated[Path, typer.Argument(metavar="plan.yaml", help="The plan.")],
    command: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[-- COMMAND…]",
            help="Start this, such as `ros2 launch …`, and end when it ends. Default: attach to "
            "what runs.",
        ),
    ] = None,
    backend: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="auto (the strongest that works here), scx, litmus, freezer or fifo.",
        ),
    ] = "auto",
    phase: Annotated[
        int | None,
        duration_option(
            "--phase",
            "Where in a cycle the chain's timer expires, on CLOCK_MONOTONIC. Default: measured.",
        ),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            metavar="REC", help="A recording of these very processes: it tells executors for sure."
        ),
    ] = None,
    wait: Annotated[
        int | None,
        duration_option(
            "--wait",
            "How long the plan's nodes have to appear. Default: 30s with a COMMAND, else no time.",
        ),
    ] = None,
    user: UsersOption = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Show what would be done to which thread, and change nothing."
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Keep the threads of an application inside a plan's slots, until Ctrl-C.

    Whatever ends it, everything is as it was before.
    """
    from dataclasses import asdict

    from chainshaper.cli.output import notes, print_json, show
    from chainshaper.flow.apply import apply_plan
    from chainshaper.planning import load_plan, plan_warnings
    from chainshaper.reporting.plans import servers_table
    from chainshaper.values.errors import OperationError

    planned, recorded = load_plan(plan), None
    if recording is not None:
        from chainshaper.sources import open_source  # slow to import

        recorded = open_source(recording)
    if dry_run:
        _show_changes(planned, backend, recorded, phase, user or (), json=json)
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


def _show_changes(
    plan: "Plan",
    backend: str,
    recording: "Recording | None",
    phase_ns: int | None,
    users: Sequence[str],
    *,
    json: bool,
) -> None:
    import shlex
    from dataclasses import asdict

    from chainshaper.cli.output import notes, print_json, show, show_line
    from chainshaper.flow.dry_run import planned_changes
    from chainshaper.reporting.plans import changes_table

    changes = planned_changes(plan, backend, recording=recording, phase_ns=phase_ns, users=users)
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
    from chainshaper.cli.output import progress
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
    from chainshaper.cli.output import say

    seen = 0

    def watch(state: "RunState") -> None:
        nonlocal seen
        if seen == 0:
            say(f"in force with {state.back_end}: {state.reason}; Ctrl-C ends it")
        elif seen % LINE_EVERY == 0:
            say(text(state))
        seen += 1

    return watch
