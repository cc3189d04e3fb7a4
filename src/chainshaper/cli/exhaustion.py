"""Memory that runs out, said in one line, whoever wanted it: Python, NumPy, Polars or the loader.

Most of them raise something. Some abort the process instead, which can only happen where memory is
limited (``ulimit -v``): Linux hands out what it does not have. There the abort is caught as well.
"""

import ctypes
import errno
import os
import resource
import signal
import textwrap
from typing import Any

__all__ = ["catch_aborts", "exhausted"]

REMEDY = "raise the limit (`ulimit -v`), free memory, or give a smaller input"
_SAID_SO = (
    "cannot allocate memory",
    "failed to map segment",  # the loader, of a library
    "could not find/load shared object file",  # llvmlite, of its own
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
_handlers: list[Any] = []  # ctypes forgets a callback that nothing refers to


def exhausted(error: BaseException) -> str | None:
    """What to say of an error that means that memory ran out, or that Polars gave up.

    None for every other error.
    """
    if isinstance(error, KeyboardInterrupt | SystemExit):
        return None
    seen: set[int] = set()
    link: BaseException | None = error
    while link is not None and id(link) not in seen:
        seen.add(id(link))
        if _is_lack_of_memory(link):
            reason = _short(link) or "Python could not allocate it"
            return f"memory ran out ({reason}): {REMEDY}"
        if type(link).__name__ == "PanicException":  # of Polars; its module has no lasting name
            return f"Polars cannot process this data ({_short(link)}): check the input files"
        link = link.__cause__ or link.__context__
    return None


def _short(error: BaseException) -> str:
    """An error's text on one line; NumPy's about its own import has fifty."""
    return textwrap.shorten(str(error), 160, placeholder=" ...")


def _is_lack_of_memory(error: BaseException) -> bool:
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    text = str(error).lower()
    return any(words in text for words in _SAID_SO)


def catch_aborts() -> None:
    """Where memory is limited, let an abort end the process as every other failure does.

    Libraries start as few threads as they can there: each one costs address space, Polars waits for
    ever for one that it cannot start, and its allocator tries to start one for ever.
    """
    if resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY:
        return
    for name, value in _FRUGAL.items():
        os.environ.setdefault(name, value)
    said = f"error: memory ran out in a library: {REMEDY}\n".encode()

    def ended(_: int) -> None:
        os.write(2, said)
        os._exit(1)

    handler = ctypes.CFUNCTYPE(None, ctypes.c_int)(ended)
    _handlers.append(handler)
    ctypes.CDLL(None).signal(int(signal.SIGABRT), handler)
