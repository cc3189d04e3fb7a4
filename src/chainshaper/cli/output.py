"""What verbs print: tables for people, JSON for machines, progress on stderr; how they end."""

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

from chainshaper.values.errors import OperationError
from chainshaper.values.safe_text import shown

if TYPE_CHECKING:
    from rich.console import RenderableType

PATIENCE_S = 2.0
"""What takes longer than this shows its progress."""


def show(*tables: "RenderableType") -> None:
    """Tables on stdout; colour only on a terminal."""
    from rich.console import Console

    # A table in a file or a pipe must not be folded to the width of nothing.
    console = Console() if sys.stdout.isatty() else Console(width=120)
    with _written():
        for table in tables:
            console.print(table)


def show_line(text: str) -> None:
    """A line on stdout, or several, as they are: a path must not be folded."""
    _write(shown(text, but="\n"))


def _write(text: str) -> None:
    with _written():
        sys.stdout.write(text + "\n")


def print_json(value: Any) -> None:
    """One JSON document on stdout; the one control character that JSON leaves alone is escaped."""
    _write(json.dumps(value, indent=2).replace("\x7f", "\\u007f"))


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


@contextmanager
def progress(title: str) -> Iterator[Callable[[float, str], None]]:
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

        def report(share: float, what: str) -> None:
            bar.update(task, completed=min(1.0, share), description=shown(f"{title}: {what}"))

        yield report


@contextmanager
def late_progress(title: str) -> Iterator[Callable[[float, str], None]]:
    """As :func:`progress`, but nothing is shown of what is over in two seconds."""
    with ExitStack() as shown:
        lock = threading.Lock()
        latest = (0.0, "working")
        bar: Callable[[float, str], None] | None = None
        over = False

        def begin() -> None:
            nonlocal bar
            with lock:
                if not over:
                    bar = shown.enter_context(progress(title))
                    bar(*latest)

        def report(share: float, what: str) -> None:
            nonlocal latest
            with lock:
                latest = (share, what)
                if bar is not None:
                    bar(share, what)

        timer = threading.Timer(PATIENCE_S, begin)
        timer.daemon = True
        timer.start()
        try:
            yield report
        finally:
            timer.cancel()
            with lock:
                over = True


def stage_lines(title: str) -> Callable[[float, str], None]:
    """Progress as one line per stage, for where a bar would disturb what others print."""
    last = ""

    def report(share: float, what: str) -> None:  # noqa: ARG001 - the signature of progress
        nonlocal last
        if what != last:
            say(f"{title}: {what}")
            last = what

    return report


@contextmanager
def stop_on_signals(stop: threading.Event) -> Iterator[None]:
    """Inside, Ctrl-C, a closed terminal and `kill` are an order to finish: each sets ``stop``."""

    def end(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {
        number: signal.signal(number, end)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
