"""Loops that the user names: what the tracing library is told, and what is said of those not seen.

A loop is named by its node (`/controller_manager`), where a thread of the node's process sleeps,
or by the name of its thread (`control_loop`). `preload.c` records the sleeps of such threads also
where they publish nothing, and emits `loop_named` for each name that it meets.
"""

from collections.abc import Iterator, Sequence

import polars as pl

from chainshaper.sources.preload.in_front import in_front, installed_library
from chainshaper.values import events
from chainshaper.values.errors import InputError

VARIABLE = "CHAINSHAPER_LOOPS"
"""The variable that has the names, with a comma between two."""

_THREAD_BYTES = 15  # of a thread's name, which the kernel cuts
_MOST_BYTES = 4000  # of all names: `loops` in preload.c


def names_text(names: Sequence[str]) -> str:
    """Return the names as the library reads them.

    Raises InputError: a name is none of a node or a thread, or there are too many.
    """
    for name in names:
        is_node = name.startswith("/")
        has_space = any(sign.isspace() for sign in name if is_node)  # threads' names may have some
        if not name.strip() or "," in name or has_space:
            raise InputError(f"{name!r} names no loop: give a node (/name) or a thread's name")
        if not is_node and len(name.encode()) > _THREAD_BYTES:
            raise InputError(
                f"no thread can be called {name!r}: the kernel cuts names to {_THREAD_BYTES} bytes"
                f" (`ps -eLo comm`); to name a node, begin with a slash"
            )
    text = ",".join(names)
    if len(text.encode()) > _MOST_BYTES:
        raise InputError(f"the names of loops have more than {_MOST_BYTES} bytes: name fewer")
    return text


def variables(names: Sequence[str]) -> dict[str, str]:
    """Return the variable that names loops in what is started with it; empty: none is named.

    Raises InputError: as :func:`names_text`.
    """
    return {VARIABLE: names_text(names)} if names else {}


def in_front_of(names: Sequence[str]) -> dict[str, str]:
    """Return the variables that start a command behind the library, and name loops to it.

    Raises InputError: as :func:`names_text`. PlatformError: as :func:`.in_front`.
    """
    return {**in_front(installed_library()), **variables(names)}


def not_named(names: Sequence[str], tables: events.EventTables) -> list[str]:
    """Return the loops that no process met that runs already with the library in front.

    The library reads the names when its process starts.
    """
    met = events.table(tables, "loop_named")["name"]
    return [name for name in dict.fromkeys(names) if name not in met]


STARTED_SO = 'eval "$(chainshaper watch --environment --loop NAME)"'
"""Names a loop in all that is started behind it."""


def notes(names: Sequence[str], tables: events.EventTables) -> Iterator[str]:
    """Say which of the named loops were not seen, and why."""
    seen = events.table(tables, "loop_named")
    by_name = events.table(tables, "controller_manager_call")["pid"].unique()
    slept = events.table(tables, "thread_sleep")["pid"].append(by_name).unique()
    for name in dict.fromkeys(names):
        met = seen.filter(name=name)
        if met.is_empty():
            missing = "node of this name was created" if name.startswith("/") else "thread of this"
            missing += "" if name.startswith("/") else " name slept in a process with nodes"
            remedy = "`chainshaper graph` shows the nodes, `ps -eLo pid,comm` the threads"
            yield f"the loop {name} was not seen: no {missing}; {remedy}."
        elif met.filter(pl.col("pid").is_in(slept.implode())).is_empty():
            pids = ", ".join(map(str, met["pid"].unique().sort()))
            yield (
                f"the loop {name} was not seen: no thread of its process ({pids}) slept for a time"
                " outside callbacks. It is paced by data or by another thread, or it waits by a"
                " condition variable: then name its thread instead of the node."
            )
