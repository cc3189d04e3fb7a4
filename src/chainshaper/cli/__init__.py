"""The command line: each verb calls a function of the library and prints what it returns.

Results go to stdout, all else to stderr. Exit codes: 0 done, 1 the operation failed, 2 wrong use or
bad input, 3 the platform cannot do it.
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
OF_ANALYSIS = ("matplotlib", "resvg_py")
"""The packages of the extra `analysis`, which robots do not have."""
_LACK_OF_MEMORY = (
    "cannot allocate memory",
    "failed to map segment",  # the loader, of a library
    "can't start new thread",
    "could not spawn threads",
    "can't spawn worker thread",
    "capacity overflow",
)
# Environment variables with which libraries start as few threads as they can.
_FEW_THREADS = {
    "POLARS_MAX_THREADS": "1",
    "POLARS_ASYNC_THREAD_COUNT": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "_RJEM_MALLOC_CONF": "background_thread:false",  # of the allocator in Polars
}
# What a terminal without some characters gets in their place.
_PLAIN = {
    "→": "->",
    "←": "<-",
    "–": "-",
    "−": "-",
    "±": "+-",
    "…": "...",
    "µ": "u",
    "μ": "u",
    "×": "x",
    "≤": "<=",
    "✓": "+",
    "✗": "x",
}
_LEAST_FOR_TABLES = 400_000_000
"""Bytes of address space below which Polars, as it loads, hangs or dies where it should say so."""
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
        if sys.unraisablehook is _ask_again:
            sys.unraisablehook = sys.__unraisablehook__


def _run(arguments: list[str] | None, name: str) -> None:
    """As :func:`main`, but signals go on raising KeyboardInterrupt where they do so here."""
    from chainshaper.cli.output import say
    from chainshaper.values.errors import ChainshaperError, installing

    _prepare_output_and_memory()
    _interrupted.clear()
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = words[: words.index("--")] if "--" in words else words  # a COMMAND comes behind it

    def fail(message: str, code: int) -> NoReturn:
        """End with the last line of a failed command: for people, or for a script."""
        as_json = json.dumps({"format": 1, "error": message, "exit_code": code})
        say(as_json if "--json" in options else f"error: {message}")
        sys.exit(code)

    try:
        for number in _ENDING:
            # As chainshaper.__main__ does for Ctrl-C; a signal that nohup ignores stays ignored.
            if signal.getsignal(number) == signal.SIG_DFL:
                signal.signal(number, _end_in_order)
                sys.unraisablehook = _ask_again
        from chainshaper.cli.app import USAGE_ERROR, Abort, app

        try:
            sys.exit(app(arguments, prog_name=name, standalone_mode=False))
        except USAGE_ERROR as error:
            fail(_misuse_text(error, words, name), error.exit_code)
        except Abort:  # a question without an answer
            say("Aborted.")
            sys.exit(1)
    except ChainshaperError as error:
        message = _exhausted(error)  # a file that no memory is left for is no damaged one
        if message is not None:
            fail(message, 1)
        fail(str(error), error.exit_code)
    except PermissionError as error:
        remedy = "name a place that you may read and write, or change its permissions"
        fail(f"{error.filename}: permission denied: {remedy}", 2)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in OF_ANALYSIS:
            raise
        remedy = installing("'chainshaper[analysis]'")
        fail(f"this needs {package}, which is not installed: {remedy}", 3)
    except BaseException as error:  # a panic of Polars is no Exception
        # Libraries that are not written in Python raise errors of their own on Ctrl-C.
        if isinstance(error, KeyboardInterrupt) or (
            _interrupted and not isinstance(error, SystemExit)
        ):
            sys.exit(130)
        message = _exhausted(error)
        if message is None:
            raise
        fail(message, 1)


def _misuse_text(error: Any, words: list[str], name: str) -> str:
    """Say what is wrong with a command line, in the style of our own errors."""
    if not words:
        error.show()  # the help
        sys.exit(error.exit_code)
    help_of = name if error.ctx is None else error.ctx.command_path
    message = error.format_message().rstrip(".")
    message = f"{message[:1].lower()}{message[1:]}"
    if type(error).__name__ == "NoSuchOption" and error.option_name == "--loop":
        return (
            f"{message}: loops are named where their sleeps are recorded, by `record`, `profile`,"
            " `shape -- ros2 launch …` and `watch`; a recording knows its own (`chainshaper"
            " callbacks REC`)"
        )
    return f"{message}: see `{help_of} --help`"


_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_interrupted: list[int] = []
"""The signals that have asked this process to end."""


def _end_in_order(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - a signal handler
    """End the process on Ctrl-C, SIGTERM or a lost terminal alike: through every `finally`."""
    _interrupted.append(number)
    raise KeyboardInterrupt


def _ask_again(ignored: "sys.UnraisableHookArgs") -> None:
    """Repeat a signal that came in a callback from which Python lets nothing be raised.

    There are such in imports and in libraries: Python would print the KeyboardInterrupt, and go on.
    """
    if not (_interrupted and issubclass(ignored.exc_type, KeyboardInterrupt)):
        sys.__unraisablehook__(ignored)
        return
    import threading

    main_thread = threading.main_thread().ident
    soon = threading.Timer(0.01, signal.pthread_kill, (main_thread, _interrupted[-1]))
    soon.daemon = True
    soon.start()


def _exhausted(error: BaseException | None) -> str | None:
    """Return the message for lack of memory or a panic of Polars; None: it is another error."""
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
    """Replace characters that a terminal has not (LC_ALL=C) by similar ones, or their escapes.

    It is an error handler of `codecs`: it returns the replacement, and where encoding goes on.
    """
    if not isinstance(error, UnicodeEncodeError):
        raise error
    plain = ""
    for character in error.object[error.start : error.end]:
        escape = character.encode("ascii", "backslashreplace").decode()
        plain += _PLAIN.get(character) or escape
    return plain, error.end


class _NoRoomForTables:
    """Refuses to load Polars where memory is limited to less than it takes to load."""

    def __init__(self, limit: int) -> None:
        self.limit = limit

    def find_spec(self, fullname: str, path: object, target: object = None) -> None:  # noqa: ARG002 - as Python calls it
        if fullname == "polars":
            raise MemoryError(
                f"it is limited to {self.limit // 10**6} MB, and loading tables takes "
                f"{_LEAST_FOR_TABLES // 10**6} MB of address space"
            )


def _prepare_output_and_memory() -> None:
    """Let output be shown by any terminal; where memory is limited (`ulimit -v`), spare it.

    There a library that aborts ends the process with a message, and libraries start as few threads
    as they can: each thread costs address space. Polars waits for ever for a thread that it cannot
    start, and its allocator tries to start one for ever.
    """
    codecs.register_error("readable", _readable)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="readable")
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return
    if limit < _LEAST_FOR_TABLES:
        sys.meta_path.insert(0, _NoRoomForTables(limit))
    for name, value in _FEW_THREADS.items():
        os.environ.setdefault(name, value)
    message = f"error: memory ran out in a library: {REMEDY}\n".encode()

    def end(_: int) -> None:
        os.write(2, message)
        os._exit(1)

    handler = ctypes.CFUNCTYPE(None, ctypes.c_int)(end)
    _handlers.append(handler)
    ctypes.CDLL(None).signal(int(signal.SIGABRT), handler)
