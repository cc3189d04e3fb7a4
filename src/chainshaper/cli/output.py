"""What verbs print: tables for people, JSON for machines, progress on stderr; how they end."""

import json
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import chainshaper as cs
from chainshaper.values.errors import OperationError, shown
from chainshaper.values.progress import Progress

if TYPE_CHECKING:
    from rich.console import RenderableType


SPEAK_EVERY_S = 2.0  # about a stage, where there is no bar: nothing is silent for longer
PATIENCE_S = 2.0  # work that takes longer than this shows its progress


def show(*tables: "RenderableType") -> None:
    """Print tables on stdout; into a file or a pipe without colour, 120 columns wide."""
    from rich.console import Console

    console = Console() if sys.stdout.isatty() else Console(width=120)
    with _written():
        for table in tables:
            console.print(table)


def show_line(text: str | Path) -> None:
    """Print a line on stdout, or several, as they are: a path must not be folded."""
    with _written():
        sys.stdout.write(shown(str(text), but="\n") + "\n")


def print_json(value: Any, *, indent: int | None = 2) -> None:
    """Print one JSON document on stdout, and flush it; without an indent it is one line."""
    text = json.dumps(value, indent=indent).replace("\x7f", "\\u007f")  # `json` does not escape it
    with _written():
        sys.stdout.write(text + "\n")


def present(as_json: bool, value: Any, *tables: "RenderableType") -> bool:
    """Print a value as JSON, or the same as tables; return whether as tables."""
    if as_json:
        print_json(value)
    elif tables:
        show(*tables)
    return not as_json


@contextmanager
def _written() -> Iterator[None]:
    """Flush what is printed inside, or fail: the output may go to a file on a full disk."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        raise  # `chainshaper … | head`: Typer ends the command quietly
    except OSError as error:
        # Else Python would try to write the rest again at exit, and complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise OperationError(
            f"standard output cannot be written ({error.strerror}): send it somewhere else"
        ) from error


def say(text: str) -> None:
    """Print a message on stderr."""
    sys.stderr.write(shown(text, but="\n") + "\n")


def notes(lines: Iterable[str]) -> None:
    """Print what a reader of the figures must know on stderr, a line each."""
    for line in lines:
        say(f"note: {line}")


def next_step(*words: str | Path) -> None:
    """Say on stderr which command a user mostly wants behind this one."""
    say(f"next: {shlex.join(map(str, words))}")


def warn(plan: "cs.Plan") -> None:
    """Say what is doubtful about a plan, before it is used."""
    from chainshaper.planning import plan_warnings

    notes(plan_warnings(*plan.chains))


@contextmanager
def progress(title: str) -> Iterator[Progress]:
    """Show a progress bar on stderr; without a terminal one line per stage instead."""
    if not sys.stderr.isatty():
        yield stage_lines(title)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

    columns = (
        SpinnerColumn(),  # it also turns where the share of what is done stays the same for long
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(shown(title), total=1.0)
        yield lambda share, stage: bar.update(
            task, completed=min(1.0, share), description=shown(f"{title}: {stage}")
        )


@contextmanager
def late_progress(title: str) -> Iterator[Progress]:
    """Show progress as :func:`progress` does, unless the work is over in two seconds."""
    latest = (0.0, "working")
    bar: Progress | None = None

    def begin() -> None:
        nonlocal bar
        bar = stack.enter_context(progress(title))
        bar(*latest)

    def report(share: float, stage: str) -> None:
        nonlocal latest
        latest = (share, stage)
        if bar is not None:
            bar(share, stage)

    timer = threading.Timer(PATIENCE_S, begin)
    timer.daemon = True
    with ExitStack() as stack:
        timer.start()
        try:
            yield report
        finally:
            timer.cancel()
            timer.join()


def stage_lines(title: str) -> Progress:
    """Show progress as one line per stage, where a bar would disturb what others print.

    A stage that takes long has a line with percent and time left every two seconds.
    """
    last, began, spoke = "", 0.0, 0.0

    def report(share: float, stage: str) -> None:
        nonlocal last, began, spoke
        now = time.monotonic()
        if stage != last:
            say(f"{title}: {stage}")
            last, began, spoke = stage, now, now
        elif now - spoke >= SPEAK_EVERY_S and 0 < share < 1:
            left_s = (now - began) / share * (1 - share)
            say(f"{title}: {share:.0%}, about {left_s:.0f} s left")
            spoke = now

    return report


@contextmanager
def lasting(report: Progress, seconds: float, stage: str) -> Iterator[None]:
    """Report work that takes a known time, which cannot say itself how much of it is done."""
    began, over = time.monotonic(), threading.Event()

    def advance() -> None:
        while not over.wait(0.2):
            report(min(0.99, (time.monotonic() - began) / seconds), stage)

    report(0.0, stage)
    thread = threading.Thread(target=advance, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def opened(
    verb: str, trace: Sequence[Path], through: Sequence[str] | None = None
) -> "Iterator[tuple[cs.Recording, Progress]]":
    """Open a trace or recording for a verb; yield it with what reports the verb's progress.

    ``through`` is what the user declares that no event shows.
    """
    with late_progress(verb) as report:
        yield cs.open_source(*trace, progress=report, through=through or ()), report


def with_callback_groups(recording: "cs.Recording", path: Path | None) -> "cs.Recording":
    """Return a recording with what a configuration of callback_isolated_executor gave its threads.

    Prints notes about it.
    """
    from chainshaper.values.callback_groups import read_group_configuration

    if path is None:
        return recording
    known, remarks = cs.with_callback_groups(recording, read_group_configuration(path))
    notes(remarks)
    return known


def lost_events(recording: "cs.Recording") -> str:
    """Return a text about the events that were lost while recording, also if none was."""
    from chainshaper.values.recording import lost_text

    return lost_text(recording.info.lost)


def stop_on_signals() -> AbstractContextManager[threading.Event]:
    """Yield an event that Ctrl-C, a closed terminal or `kill` sets: an order to finish."""
    orders = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as it is under nohup
        orders.append(signal.SIGHUP)
    return set_by(*orders)


@contextmanager
def set_by(*numbers: signal.Signals) -> Iterator[threading.Event]:
    """Yield an event that these signals set.

    A thread sets it: the handler itself may interrupt a function that has the event's lock.
    """
    event, (reading, writing) = threading.Event(), os.pipe()

    def listen() -> None:
        while os.read(reading, 1):
            event.set()
        os.close(reading)

    threading.Thread(target=listen, daemon=True).start()
    handlers = {
        number: signal.signal(number, lambda *_: os.write(writing, b"!")) for number in numbers
    }
    try:
        yield event
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        os.close(writing)


@contextmanager
def live(*, on_stderr: bool = False) -> "Iterator[Callable[[Sequence[RenderableType]], None]]":
    """Yield what shows tables: on a terminal in place of those before, else behind them."""
    if not (on_stderr or sys.stdout.isatty()):
        yield lambda tables: show(*tables)
        return
    from rich.console import Console, Group
    from rich.live import Live

    with Live(console=Console(stderr=on_stderr), transient=on_stderr, auto_refresh=False) as place:
        yield lambda tables: place.update(Group(*tables), refresh=True)
