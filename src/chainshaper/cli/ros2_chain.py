"""`ros2 chain VERB …` is `chainshaper VERB …`, where ROS 2's command line finds this package.

`ros2` takes its commands from the entry points ``ros2cli.command`` of all installed packages, and
parses them with argparse. Everything behind `ros2 chain` is handed on as it is, so both command
lines are the same, help and completion included. Upstream: ros2cli, `ros2cli/command/__init__.py`.
"""

import argparse
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from chainshaper.vendored_packages import CALLED, has_vendored

__all__ = ["ChainCommand"]


class ChainCommand:
    """Constant end-to-end latency for computation chains (chainshaper)."""

    # Not derived from ros2cli's CommandExtension, which would be needed to import this file; it
    # adds nothing but a check for the version of the extension point, 0.1 in all distributions.
    NAME = "chain"
    EXTENSION_POINT_VERSION = "0.1"

    def add_arguments(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        """Leave all that follows `ros2 chain` to us."""
        arguments = parser.add_argument(
            "arguments", nargs=argparse.REMAINDER, help=argparse.SUPPRESS
        )
        arguments.completer = _complete  # type: ignore[attr-defined]  # argcomplete reads it
        parser.print_help = lambda *_: _run(["--help"])  # type: ignore[assignment,method-assign]

    def main(self, *, args: argparse.Namespace, **_: Any) -> int:
        """Run the verb; return the exit code for `ros2`."""
        return _run(args.arguments or ["--help"])


def _complete(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> Sequence[str]:
    """Return the words that may stand at the cursor: verbs, options and their values, or files.

    Typer knows them, in a process of its own, as it does for the completion of `chainshaper`.
    """
    words = ["chainshaper", *parsed_args.arguments]
    asked = {
        "_CHAINSHAPER_COMPLETE": "complete_bash",
        "COMP_WORDS": shlex.join([*words, *([prefix] if prefix else [])]),
        "COMP_CWORD": str(len(words)),
    }
    answer = subprocess.run(
        [sys.executable, "-m", "chainshaper"],
        env={**os.environ, **asked},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        check=False,
    )
    if answer.stdout.split():
        return answer.stdout.splitlines()
    from argcomplete.completers import FilesCompleter

    files: Sequence[str] = FilesCompleter()(prefix)
    return files


def _run(arguments: list[str]) -> int:
    if has_vendored():  # these packages are not for the process of `ros2`
        sys.stdout.flush()
        os.environ[CALLED] = "ros2 chain"
        command = [sys.executable, "-m", "chainshaper", *arguments]
        os.execv(sys.executable, command)  # noqa: S606 - no shell is wanted
    from chainshaper.cli import main

    try:
        main(arguments, "ros2 chain")
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    return 0
