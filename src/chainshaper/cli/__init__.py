"""The command line: each verb a thin coat over a library call; results go to stdout, all else to
stderr. Exit codes: 0 done, 1 the operation failed, 2 wrong use or input, 3 the platform cannot.
"""

import codecs
import ctypes
import errno
import io
import json
import os
import resource
import signal
import sys
import textwrap
from types import FrameType
from typing import Any, NoReturn

__all__ = ["main"]

REMEDY = "raise the limit (`ulimit -v`), free memory, or give a smaller input"
OF_ANALYSIS = ("matplotlib",)
"""What the extra `analysis` brings, which a robot does without."""
_LACK_OF_MEMORY = (
    "cannot allocate memory",
    "failed to map segment",  # the loader, of a library
    "can't start new thread",
    "could not spawn threads",
    "capacity overflow",
)
_FRUGAL = {
    "POLARS_MAX_THREADS": "1",
    "POLARS_ASYNC_THREAD_COUNT": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "_RJEM_MALLOC_CONF": "background_thread:false",  # of the allocator in Polars
}
_PLAIN = {
    "→": "->",
    "←": "<-",
    "–": "-",
    "−": "-",
    "…": "...",
    "µ": "u",
    "μ": "u",
    "×": "x",
    "≤": "<=",
}
_handlers: list[Any] = []  # ctypes forgets a callback that nothing refers to


def main(arguments: list[str] | None = None, name: str = "chainshaper") -> None:
    """Run these arguments (default: the process's own); help calls the command ``name``."""
    try:
        _run(arguments, name)
    except KeyboardInterrupt:  # while it says how it has ended
        sys.exit(130)
    finally:  # while the interpreter ends, a handler of ours would end in a traceback
        for number in _ENDING:
            if signal.getsignal(number) is _end_in_order:
                signal.signal(number, signal.SIG_DFL)


def _run(arguments: list[str] | None, name: str) -> None:
    """As :func:`main`, but signals go on raising KeyboardInterrupt where they do so here."""
    from chainshaper.cli.output import say
    from chainshaper.values.errors import ChainshaperError, shown

    _prepare_output_and_memory()
    _interrupted.clear()
    words = list(sys.argv[1:] if arguments is None else arguments)
    own = words[: words.index("--")] if "--" in words else words  # behind it is a COMMAND

    def fail(message: str, code: int) -> NoReturn:
        """End with the last line of a failed command: for people, or for a script."""
        as_json = json.dumps({"format": 1, "error": message, "exit_code": code})
        say(as_json if "--json" in own else f"error: {message}")
        sys.exit(code)

    try:
        for number in _ENDING:
            # As chainshaper.__main__ has it for Ctrl-C; what is ignored under nohup stays so.
            if signal.getsignal(number) == signal.SIG_DFL:
                signal.signal(number, _end_in_order)
        from chainshaper.cli.app import USAGE_ERROR, Abort, app

        try:
            sys.exit(app(arguments, prog_name=name, standalone_mode=False))
        except USAGE_ERROR as error:
            error.message = shown(error.message, but="\n")  # it may quote a file's name
            error.show()
            sys.exit(error.exit_code)
        except Abort:  # a question without an answer
            say("Aborted.")
            sys.exit(1)
    except ChainshaperError as error:
        fail(str(error), error.exit_code)
    except PermissionError as error:
        remedy = "name a place that you may read and write, or change its permissions"
        fail(f"{error.filename}: permission denied: {remedy}", 2)
    except ModuleNotFoundError as error:
        lacks = (error.name or "").partition(".")[0]
        if lacks not in OF_ANALYSIS:
            raise
        fail(f"this needs {lacks}, which is not installed: pip install 'chainshaper[analysis]'", 3)
    except BaseException as error:  # a panic of Polars is no Exception
        # Libraries that are not Python make an error of their own of Ctrl-C.
        if isinstance(error, KeyboardInterrupt) or (
            _interrupted and not isinstance(error, SystemExit)
        ):
            sys.exit(130)
        message = _exhausted(error)
        if message is None:
            raise
        fail(message, 1)


_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_interrupted: list[int] = []
"""The signals that have asked us to end."""


def _end_in_order(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - a signal handler
    """Ctrl-C, SIGTERM and a lost terminal end us alike: through every `finally`."""
    _interrupted.append(number)
    raise KeyboardInterrupt


def _exhausted(error: BaseException | None) -> str | None:
    """The message for lack of memory, or for a panic of Polars; None for every other error."""
    if isinstance(error, KeyboardInterrupt | SystemExit):
        return None
    seen, link = set[int](), error
    while link is not None and id(link) not in seen:
        seen.add(id(link))
        reason = textwrap.shorten(str(link), 160, placeholder=" ...")  # NumPy's has fifty lines
        if (
            isinstance(link, MemoryError)
            or (isinstance(link, OSError) and link.errno == errno.ENOMEM)
            or any(words in str(link).lower() for words in _LACK_OF_MEMORY)
        ):
            return f"memory ran out ({reason or 'Python could not allocate it'}): {REMEDY}"
        if type(link).__name__ == "PanicException":  # of Polars; its module has no lasting name
            return f"Polars cannot process this data ({reason}): check the input files"
        link = link.__cause__ or link.__context__
    return None


def _readable(error: UnicodeError) -> tuple[str | bytes, int]:
    """What a terminal without some character gets instead (LC_ALL=C): one alike, or its escape."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    wrong = error.object[error.start : error.end]
    plain = (_PLAIN.get(one) or one.encode("ascii", "backslashreplace").decode() for one in wrong)
    return "".join(plain), error.end


def _prepare_output_and_memory() -> None:
    """Where memory is limited (`ulimit -v`), let a library's abort end us with a message.

    Libraries start as few threads as they can there: each one costs address space, Polars waits for
    ever for one that it cannot start, and its allocator tries to start one for ever.
    """
    codecs.register_error("readable", _readable)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="readable")
    if resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY:
        return
    for name, value in _FRUGAL.items():
        os.environ.setdefault(name, value)
    message = f"error: memory ran out in a library: {REMEDY}\n".encode()

    def ended(_: int) -> None:
        os.write(2, message)
        os._exit(1)

    handler = ctypes.CFUNCTYPE(None, ctypes.c_int)(ended)
    _handlers.append(handler)
    ctypes.CDLL(None).signal(int(signal.SIGABRT), handler)
