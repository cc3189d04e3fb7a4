"""What verbs print: tables for people, JSON for machines, progress on stderr; how they end."""

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import chainshaper as cs
from chainshaper.values.errors import OperationError, shown
from chainshaper.values.progress import Progress

if TYPE_CHECKING:
    from rich.console import RenderableType


PATIENCE_S = 2.0  # what takes longer than this shows its progress


def show(*tables: "RenderableType") -> None:
    """Tables on stdout; in a file or a pipe without colour, and not folded to no width."""
    from rich.console import Console

    console = Console() if sys.stdout.isatty() else Console(width=120)
    with _written():
        for table in tables:
            console.print(table)


def show_line(text: str | Path) -> None:
    """A line on stdout, or several, as they are: a path must not be folded."""
    with _written():
        sys.stdout.write(shown(str(text), but="\n") + "\n")


def print_json(value: Any, *, indent: int | None = 2) -> None:
    """One JSON document on stdout, out at once; without an indent it is a line."""
    text = json.dumps(value, indent=indent).replace("\x7f", "\\u007f")  # JSON leaves it alone
    with _written():
        sys.stdout.write(text + "\n")


def present(as_json: bool, value: Any, *tables: "RenderableType") -> bool:
    """A value as JSON, or the same as tables; whether it was the tables."""
    if as_json:
        print_json(value)
    elif tables:
        show(*tables)
    return not as_json


@contextmanager
def _written() -> Iterator[None]:
    """What is printed inside is out, or the command fails: a redirection to a full disk."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        raise  # `chainshaper … | head`: Typer ends us quietly
    except OSError as error:
        # What could not be written would be tried again, and complained about, at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise OperationError(
            f"standard output cannot be written ({error.strerror}): send it somewhere else"
        ) from error


def say(text: str) -> None:
    """A message on stderr."""
    sys.stderr.write(shown(text, but="\n") + "\n")


def notes(lines: Iterable[str]) -> None:
    """What a reader of the figures must know, one line each, on stderr."""
    for line in lines:
        say(f"note: {line}")


def warn(plan: "cs.Plan") -> None:
    """Say what is doubtful about a plan, before it is used."""
    from chainshaper.planning import plan_warnings

    notes(plan_warnings(*plan.chains))


@contextmanager
def progress(title: str) -> Iterator[Progress]:
    """A progress bar on stderr; without a terminal one line per stage instead."""
    if not sys.stderr.isatty():
        yield stage_lines(title)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(shown(title), total=1.0)
        yield lambda share, what: bar.update(
            task, completed=min(1.0, share), description=shown(f"{title}: {what}")
        )


@contextmanager
def late_progress(title: str) -> Iterator[Progress]:
    """As :func:`progress`, but nothing is shown of what is over in two seconds."""
    latest = (0.0, "working")
    bar: Progress | None = None

    def begin() -> None:
        nonlocal bar
        bar = stack.enter_context(progress(title))
        bar(*latest)

    def report(share: float, what: str) -> None:
        nonlocal latest
        latest = (share, what)
        if bar is not None:
            bar(share, what)

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
    """Progress as one line per stage, for where a bar would disturb what others print."""
    last = ""

    def report(_: float, what: str) -> None:
        nonlocal last
        if what != last:
            say(f"{title}: {what}")
            last = what

    return report


@contextmanager
def opened(verb: str, trace: Sequence[Path]) -> "Iterator[tuple[cs.Recording, Progress]]":
    """A trace or recording for a verb that reads it, and what reports the verb's progress."""
    with late_progress(verb) as report:
        yield cs.open_source(*trace, progress=report), report


def lost_events(recording: "cs.Recording") -> str:
    """What was lost while recording; "nothing" is said as well."""
    from chainshaper.values.recording import lost_text

    return lost_text(recording.info.lost)


def stop_on_signals() -> AbstractContextManager[threading.Event]:
    """Ctrl-C, a closed terminal and `kill` are an order to finish inside: each sets the event."""
    nohup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return set_by(signal.SIGINT, signal.SIGTERM, *(() if nohup else (signal.SIGHUP,)))


@contextmanager
def set_by(*numbers: signal.Signals) -> Iterator[threading.Event]:
    """An event that these signals set, by a thread: a handler may interrupt who has its lock."""
    event, (reading, writing) = threading.Event(), os.pipe()

    def listen() -> None:
        while os.read(reading, 1):
            event.set()
        os.close(reading)

    threading.Thread(target=listen, daemon=True).start()
    before = {one: signal.signal(one, lambda *_: os.write(writing, b"!")) for one in numbers}
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(writing)


@contextmanager
def live(*, on_stderr: bool = False) -> "Iterator[Callable[[Sequence[RenderableType]], None]]":
    """Tables that take the place of those before, on a terminal; else they follow each other."""
    if not (on_stderr or sys.stdout.isatty()):
        yield lambda tables: show(*tables)
        return
    from rich.console import Console, Group
    from rich.live import Live

    with Live(console=Console(stderr=on_stderr), transient=on_stderr, auto_refresh=False) as place:
        yield lambda tables: place.update(Group(*tables), refresh=True)
