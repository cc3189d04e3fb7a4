"""The command line: each verb a thin coat over a library call.

Results go to stdout, errors and progress to stderr. Exit codes: 0 done, 1 the operation failed, 2
wrong use or bad input, 3 the platform cannot do it.
"""

import io
import signal
import sys
from types import FrameType
from typing import Any

__all__ = ["main"]


def main(arguments: list[str] | None = None, name: str = "chainshaper") -> None:
    """Entry point of `chainshaper`: run these arguments (default: the process's own).

    ``name`` is what the command is called in its help.
    """
    from chainshaper.cli.exhaustion import catch_aborts, exhausted
    from chainshaper.cli.output import say
    from chainshaper.values.errors import ChainshaperError

    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:  # under nohup it stays ignored
            signal.signal(number, _end_in_order)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # an ASCII terminal gets "?" for µ
    catch_aborts()
    try:
        sys.exit(_run(arguments, name))
    except ChainshaperError as error:
        say(f"error: {error}")  # the last line of a failed command
        sys.exit(error.exit_code)
    except BaseException as error:  # a panic of Polars is no Exception
        said = exhausted(error)
        if said is None:
            raise
        say(f"error: {said}")
        sys.exit(1)


def _run(arguments: list[str] | None, name: str) -> Any:
    """The verb's exit code, None for 0."""
    from chainshaper.cli.app import USAGE_ERROR, Abort, app
    from chainshaper.cli.output import say

    try:
        return app(arguments, prog_name=name, standalone_mode=False)
    except USAGE_ERROR as error:
        _show_usage(error)
        return error.exit_code
    except Abort:  # a question without an answer
        say("Aborted.")
        return 1


def _show_usage(error: Any) -> None:
    """As Typer does it, but with what the user, or a file's name, has written made safe."""
    from chainshaper.values.safe_text import shown

    error.message = shown(error.message, but="\n")
    error.show()


def _end_in_order(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - a signal handler
    """SIGTERM, or a lost terminal, ends us as Ctrl-C does: through every `finally`."""
    raise KeyboardInterrupt
