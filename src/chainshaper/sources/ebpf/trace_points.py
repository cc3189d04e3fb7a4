"""The trace points of `libtracetools.so` as C functions, and what their arguments are.

Every ROS 2 build with tracing compiled in calls `ros_trace_<event>(arguments…)` of that library,
whether or not LTTng is there. The arguments are the fields of the event's table
(:mod:`chainshaper.values.events`) in the same order, with these exceptions:

* `rcl_init` has no version among them: that is the library's own, from its `package.xml`;
* `rclcpp_publish` has the publisher's address before the message's, mostly null, and no column;
* `rmw_publish` had the message only, before tracetools 8 (Humble and Iron).

`rclcpp_callback_register` is not called from Iron on, except under an LTTng session.

Upstream: ros2_tracing, `tracetools/include/tracetools/tracetools.h`, tags 4.1.1 to 8.10.1.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import polars as pl

from chainshaper.sources.ebpf.tracing_libraries import TracingLibrary
from chainshaper.values import events

__all__ = ["FUNCTION_PREFIX", "Argument", "TracePoint", "trace_points"]

FUNCTION_PREFIX = "ros_trace_"

Kind: TypeAlias = Literal["number", "flag", "text", "gid"]


@dataclass(frozen=True)
class Argument:
    """A function's argument that becomes a column; ``place`` counts from 0."""

    column: str
    place: int
    kind: Kind


@dataclass(frozen=True)
class TracePoint:
    """One event's function in one library, which is ``file``.

    ``handles_at_rmw`` is whether `rmw_publish` of this version names its publisher;
    ``version`` is that of the library, None if unknown.
    """

    event: str
    file: Path
    arguments: tuple[Argument, ...]
    version: str | None
    handles_at_rmw: bool


def trace_points(libraries: Sequence[TracingLibrary]) -> tuple[TracePoint, ...]:
    """All trace points that the libraries export and a table is for, in the tables' order."""
    return tuple(
        TracePoint(
            event=event,
            file=library.path,
            arguments=_arguments(event, library),
            version=library.version,
            handles_at_rmw=_handles_at_rmw(library),
        )
        for event in events.FIELDS
        for library in libraries
        if FUNCTION_PREFIX + event in library.functions
    )


def _handles_at_rmw(library: TracingLibrary) -> bool:
    return library.major is None or library.major >= 8


def _arguments(event: str, library: TracingLibrary) -> tuple[Argument, ...]:
    columns: tuple[str | None, ...] = tuple(events.FIELDS[event])
    if event == "rcl_init":
        columns = ("context_handle",)
    elif event == "rclcpp_publish":
        columns = (None, "message")
    elif event == "rmw_publish" and not _handles_at_rmw(library):
        columns = ("message",)
    return tuple(
        Argument(column, place, _kind(events.FIELDS[event][column]))
        for place, column in enumerate(columns)
        if column is not None
    )


def _kind(dtype: pl.DataType) -> Kind:
    if isinstance(dtype, pl.String):
        return "text"
    if isinstance(dtype, pl.List):
        return "gid"
    return "flag" if isinstance(dtype, pl.Int32) else "number"
