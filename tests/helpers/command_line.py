"""The command line as a person or a script runs it.

Starting an interpreter and loading what a verb needs takes a second. What is about processes
(exit codes, pipes, signals) runs in a process of its own; what is about one verb's words and
figures calls the same entry point here.
"""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

from processes import marked_processes, wait_for

from chainshaper.cli import main


@dataclass(frozen=True)
class Finished:
    """What a command left: its exit code and what it printed."""

    code: int
    out: str
    err: str


def chainshaper(*arguments: str | Path, prefix: tuple[str, ...] = ()) -> Finished:
    """Run a command to its end; ``prefix`` is a program that runs it, such as `setpriv`."""
    run = subprocess.run(
        [*prefix, *_command(arguments)], capture_output=True, text=True, check=False, timeout=100
    )
    return Finished(run.returncode, run.stdout, run.stderr)


def called(*arguments: str | Path) -> Finished:
    """The same, by a call of the entry point in this process."""
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["chainshaper", *map(str, arguments)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        _signal_handlers_kept(),
    ):
        code = 0
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return Finished(code, out.getvalue(), err.getvalue())


@contextlib.contextmanager
def _signal_handlers_kept() -> Iterator[None]:
    numbers = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def message_of(finished: Finished, code: int) -> str:
    """The message of a command that had to fail with this exit code.

    One clear message, and nothing else: no traceback, and no result that a script could take.
    """
    assert finished.code == code, finished
    assert finished.out == ""
    assert "Traceback" not in finished.err
    messages = [line for line in finished.err.splitlines() if line.startswith("error: ")]
    assert len(messages) == 1, finished.err
    return finished.err[finished.err.index(messages[0]) :]


def refused(code: int, *arguments: str | Path) -> str:
    """The message of a command that must fail with this exit code."""
    return message_of(called(*arguments), code)


def json_of(*arguments: str | Path) -> Any:
    """The one JSON document that a successful command prints."""
    finished = called(*arguments, "--json")
    assert finished.code == 0, finished
    return json.loads(finished.out)


@dataclass
class Running:
    """A command under way, known by a mark in the environment of all its descendants."""

    process: "subprocess.Popen[str]"
    mark: str
    said: list[str] = field(default_factory=list)

    @classmethod
    def start(cls, *arguments: str | Path) -> "Running":
        mark = f"MARK_{uuid.uuid4().hex}=1"
        name, _, value = mark.partition("=")
        # Who runs tests in the background, or under nohup, has them ignore these signals.
        process = subprocess.Popen(
            ["env", "--default-signal=INT,HUP", *_command(arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, name: value},
        )
        return cls(process, mark)

    def wait_until_it_says(self, words: str) -> None:
        """Read its messages until one has these words."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.said.append(line)
            if words in line:
                return
        raise AssertionError(f"it ended without saying {words!r}: {self.said}")

    def nodes(self) -> dict[str, int]:
        """Its living descendants, by name."""
        marked = marked_processes(self.mark)
        return {name: pid for pid, name in marked.items() if pid != self.process.pid}

    def end(self) -> Finished:
        """Wait for its end, and for that of its descendants."""
        out, err = self.process.communicate(timeout=60)
        wait_for(lambda: not self.nodes(), f"the end of its processes {self.nodes()}")
        return Finished(self.process.returncode, out, "".join(self.said) + err)


def _command(arguments: tuple[str | Path, ...]) -> list[str]:
    return [sys.executable, "-m", "chainshaper", *map(str, arguments)]
