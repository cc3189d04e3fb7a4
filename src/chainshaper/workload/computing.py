"""What a callback does between being called and publishing: spend time, or compute something.

Most descriptions only say how long a callback computes. One that ``computes: MODULE:FUNCTION``
does real work instead: the function is called with the serialized messages that it is for (none
for a timer, the whole set for a synchronising callback, in the order of ``synchronises``) and
returns the serialized message to publish on every topic of the callback, or None: nothing then.
:func:`~chainshaper.workload.dds.data_of` and :func:`~chainshaper.workload.dds.data_message` open
and make messages; the stamp of the header, from which gates count, is the function's to pass on.
"""

import importlib
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from itertools import cycle
from pathlib import Path

from chainshaper.gate.decision import origin_of
from chainshaper.linux.own_processes import named_folders
from chainshaper.values.trusted_files import why_distrusted
from chainshaper.workload import dds
from chainshaper.workload.execution import ExecutionTimes, spend

__all__ = ["Work", "computing", "load_function", "spending"]

Work = Callable[[Sequence[dds.Message], int, int], Iterable[bytes]]
"""Called with the messages, and the wall clock and the thread's CPU clock (ns) at the callback's
start; gives what is published on each topic, in their order. Nothing: nothing is published."""


def spending(times: ExecutionTimes, templates: Sequence[bytearray], announced: list[bytes]) -> Work:
    """Spend the next execution time; the first message's stamp is passed on to all topics.

    ``templates`` has a message per topic. What is ``announced`` is published in turn instead.
    All that a callback does before it publishes is part of its execution time, so messages are
    made first.
    """
    announcements = cycle(announced)

    def work(messages: Sequence[dds.Message], wall_ns: int, cpu_ns: int) -> Sequence[bytes]:
        stamp = (origin_of(messages[0].payload) or 0) if messages else wall_ns
        made = [
            next(announcements, None) or dds.stamp_message(template, stamp)
            for template in templates
        ]
        spend(times.next(), cpu_ns)
        return made

    return work


def computing(name: str, function: Callable[..., object], topics: int) -> Work:
    """Call a loaded function; what it raises ends the process with one line that says where."""

    def work(messages: Sequence[dds.Message], _wall_ns: int, _cpu_ns: int) -> Sequence[bytes]:
        try:
            made = function(*(message.payload for message in messages))
        except Exception as error:
            at = traceback.extract_tb(error.__traceback__)[-1]
            sys.exit(f"{name} failed at {at.filename}:{at.lineno}: {_in_words(error)}")
        if made is None:
            return ()
        if not isinstance(made, bytes):
            sys.exit(
                f"{name} returned {type(made).__name__}: return the message to publish as bytes, "
                "or None"
            )
        return (made,) * topics

    return work


def load_function(name: str) -> Callable[..., object]:
    """The function that ``MODULE:FUNCTION`` names; ends the process if there is none.

    Modules are found where Python finds them, on PYTHONPATH, or in the working directory, unless
    others may change what is there.
    """
    module, _, attribute = name.partition(":")
    places = {folder: why_distrusted(folder) for folder in (*named_folders(), str(Path.cwd()))}
    sys.path += [folder for folder, reason in places.items() if reason is None]
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except Exception as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        where = "" if at.filename.startswith("<frozen") else f" ({at.filename}:{at.lineno})"
        sys.exit(
            f"{name} cannot be loaded: {_in_words(error)}{where}; its module has to be installed, "
            f"on PYTHONPATH, or in the working directory {Path.cwd()}"
            + "".join(f"; not {place}: {reason}" for place, reason in places.items() if reason)
        )
    if found is None:
        sys.exit(f"{name} cannot be loaded: {_file(module)} has no {attribute}")
    if not callable(found):
        sys.exit(f"{name} cannot be called: name a function")
    return found  # type: ignore[no-any-return]


def _in_words(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _file(module: str) -> str:
    return getattr(sys.modules[module], "__file__", None) or module
