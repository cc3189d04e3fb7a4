"""LTTng traces (Common Trace Format 1.8) as data frames.

    trace = open_trace("~/lttng-traces/session")
    count_events(trace)                       # {"ros2:callback_start": 4711, …}
    read_events(trace, {"ros2:callback_start"})["ros2:callback_start"]

The format is that of the CTF 1.8 specification (https://diamon.org/ctf/v1.8.3/).  Numba is
imported when the first trace is opened, not with this package.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING

from chainshaper.sources.ctf.errors import CtfError
from chainshaper.sources.ctf.trace import CtfFolder, CtfStream, CtfTrace, open_trace

if TYPE_CHECKING:
    from chainshaper.sources.ctf.read import Events

__all__ = [
    "CtfError",
    "CtfFolder",
    "CtfStream",
    "CtfTrace",
    "count_events",
    "open_trace",
    "read_events",
]


def count_events(trace: CtfTrace, threads: int | None = None) -> dict[str, int]:
    """Events per name, zeros included, ordered by name; nothing is built.

    Raises `CtfError` where a file is gone.
    """
    from chainshaper.sources.ctf.read import count

    return count(trace, threads)[0]


def read_events(
    trace: CtfTrace,
    names: Collection[str] | None = None,
    *,
    context: bool = False,
    nameless: Collection[str] = (),
    threads: int | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Events:
    """Read events into one frame per name, ordered by name of event.

    Every name of ``names`` (None: all) that the metadata declares is in the result, without
    rows where it never happened.  Rows are sorted by ``time``; equal times stand in the order
    of the stream files, and in one file as recorded.  Columns:

    * ``time``: Int64, ns on the trace's own clock (CLOCK_MONOTONIC for LTTng), its offset not
      added; ``cpu``: Int32; ``pid``, ``tid``: integers as recorded (``vpid``, ``vtid`` in user
      space, ``pid``, ``tid`` in the kernel); null where the trace has none.
    * ``procname``: Categorical, where recorded; not for the events that are ``nameless``, since
      reading it is most of the work for an event without other texts.
    * the payload under its own names without LTTng's leading underscore; a field called like
      one of the above is ``payload.<name>``.  Integers and floats keep their width and sign,
      enumerations their integer; strings and text arrays are String (bytes that are not UTF-8
      as ``\\xNN``); arrays are Array, sequences List, structures Struct, variants Struct with
      all but the chosen option null.
    * with ``context``, the other context fields as ``context.<name>``.

    Events that cannot be read end their packet; the result's ``warnings`` say which and why.
    ``progress`` is told the share that is done, from 0 to 1.
    Raises `CtfError` where a file is gone or changes while it is read.
    """
    from chainshaper.sources.ctf.assembly import Wanted
    from chainshaper.sources.ctf.read import read

    asked = frozenset(trace.event_names if names is None else names)
    return read(trace, Wanted(asked, frozenset(nameless), context), threads, progress)
