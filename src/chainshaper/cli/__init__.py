"""The command line: one small module per verb, each a thin coat over a library call.

Results go to stdout, errors and progress to stderr. Exit codes: 0 done, 1 the operation failed,
2 wrong use or bad input, 3 the platform cannot do it.
"""

import io
import signal
import sys
from types import FrameType

__all__ = ["main"]


def main(arguments: list[str] | None = None, name: str = "chainshaper") -> None:
    """Entry point of `chainshaper`: run these arguments (default: the process's own).

    ``name`` is what the command is called in its help.
    """
    from chainshaper.cli.app import app
    from chainshaper.errors import ChainshaperError

    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:  # under nohup it stays ignored
            signal.signal(number, _end_in_order)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # an ASCII terminal gets "?" for µ
    try:
        app(arguments, prog_name=name)
    except ChainshaperError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201 - the last line of a failed command
        sys.exit(error.exit_code)


def _end_in_order(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - a signal handler
    """SIGTERM, or a lost terminal, ends us as Ctrl-C does: through every `finally`."""
    raise KeyboardInterrupt
