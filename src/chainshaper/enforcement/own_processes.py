"""Processes of ours: how they are started, and how they ended."""

import contextlib
import signal
import sys

__all__ = ["end_in_words", "module_command"]


def module_command(module: str) -> list[str]:
    """How a module is run as a process that does not import from the user's current folder."""
    safe_path = ["-P"] if sys.version_info >= (3, 11) else []
    return [sys.executable, *safe_path, "-m", module]


def end_in_words(code: int) -> str:
    """A return code of `subprocess`: ``ended with code 3``, ``was killed by SIGSEGV``."""
    if code >= 0:
        return f"ended with code {code}"
    with contextlib.suppress(ValueError):
        return f"was killed by {signal.Signals(-code).name}"
    return f"was killed by signal {-code}"  # most real-time signals have no name of their own
