"""Write the script by which bpftrace prints the events of `libtracetools.so`, and read its output.

Every ROS 2 build with tracing compiled in calls `ros_trace_<event>(arguments…)` of that library;
:attr:`TracePoint.arguments` says with which arguments. bpftrace sets uprobes there, and prints
lines of numbers, separated by tabs and in no order:

    code  time  pid  tid  cpu  value 0 … value 9  [prev_comm  next_comm]

* The code says which of the trace points it is; :data:`FIRST_POINT` is the code of the first one.
* Each value stands at its argument's place. A gid stands at two places, which have its first 16
  bytes; its other bytes are zeros.
* A text is printed as the aligned words of eight bytes that it lies in, in lines of
  :data:`TEXT_CODE`. Their values are: 16 × the argument's place + the number of the line; how many
  bytes before the text the first word begins; and eight words. So a name may contain any character,
  unlike with bpftrace's `str()`.
* A `sched_switch` (:data:`SWITCH_CODE`) is printed when a thread that has emitted events starts or
  stops running. At a thread's first event such a line is printed, too: it says that the thread
  runs, and nothing of the thread before it.

The handles of `rmw_publish` and `rmw_take` are the addresses of structures that begin with the
addresses of the RMW's name, of its data and of the topic's name. Before tracetools 8 `rmw_publish`
has no handle; there it is read from the `rcl_publisher_t` of `rcl_publish`.

bpftrace runs as root, so the script contains nothing that a stranger may have written: only events,
which we know, numbers, and paths of plain characters.

Upstream: `tracetools/tracetools.h` of ros2_tracing, tags 4.1.1 to 8.10.1; bpftrace 0.17 to 0.26;
rmw, `rmw/types.h`; rcl, `publisher_impl.h` (Humble, Iron).
"""

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from chainshaper.sources.registers import table_of_registers
from chainshaper.sources.tracing_library import FUNCTION_PREFIX, TracingLibrary
from chainshaper.values import events
from chainshaper.values.errors import InputError, text_of
from chainshaper.values.event_declarations import EVENTS, EventField

CODE = ("code", "time", "pid", "tid", "cpu")
VALUES = tuple(f"value_{number}" for number in range(10))
_SCHEMA: dict[str, pl.DataType] = {
    **dict.fromkeys((*CODE, *VALUES), pl.Int64()),
    **dict.fromkeys(("prev_comm", "next_comm"), pl.String()),
}
HEADER = "\t".join(_SCHEMA) + "\n"
"""The first line of the file that bpftrace prints into: lines may have fewer columns, not more."""

TEXT_CODE, SWITCH_CODE, FIRST_POINT = 0, 1, 2
TEXT_LINES = 8
"""Lines that one text may take, of 64 bytes each."""
TEXT_BYTES = 64 * TEXT_LINES - 8
"""A text of so many bytes is printed whole; of a longer one only the beginning."""
NAME_PLACE, RMW_PLACE = 8, 9
"""Places of the topic's name and the RMW's name of a handle, beyond those of arguments."""

_PLAIN = re.compile(r"[A-Za-z0-9/._+ -]+")
_TOPIC_NAME_AT = 16  # in rmw_publisher_t and rmw_subscription_t, on 64-bit machines
_RMW_HANDLE_AT_HUMBLE, _RMW_HANDLE_AT_IRON = 240, 248  # in rcl_publisher_impl_t

_SWITCH = {  # column of `sched_switch` → the kernel's name, in the order of printing
    "prev_tid": "prev_pid",
    "prev_prio": "prev_prio",
    "prev_state": "prev_state",
    "next_tid": "next_pid",
    "next_prio": "next_prio",
}


@dataclass(frozen=True)
class TracePoint:
    """The function of an event in a library."""

    event: str
    file: Path  # by which bpftrace opens the library
    tracing_library: TracingLibrary

    @property
    def arguments(self) -> tuple[tuple[EventField, int], ...]:
        """The fields that are arguments of the function, with the number of each, from 0."""
        fields = EVENTS[self.event].fields_of_version(self.tracing_library.major)
        return tuple((field, field.argument) for field in fields if field.argument is not None)

    @property
    def handle(self) -> str | None:
        """The address of the event's `rmw_publisher_t` or `rmw_subscription_t`, as bpftrace has it.

        None: the event has none.
        """
        at_rmw = self.tracing_library.handles_at_rmw
        if self.event == "rmw_take" or (self.event == "rmw_publish" and at_rmw):
            return "arg0"
        if self.event == "rcl_publish" and not at_rmw:
            at = _RMW_HANDLE_AT_HUMBLE if self.tracing_library.major == 4 else _RMW_HANDLE_AT_IRON
            return f"*(uint64 *)(*(uint64 *)arg0 + {at})"
        return None


def trace_points(libraries: Sequence[TracingLibrary]) -> tuple[TracePoint, ...]:
    """Return the trace points that the libraries export and that have a table, in their order."""
    return tuple(
        TracePoint(event, library.path, library)
        for event in events.FIELDS
        for library in libraries
        if FUNCTION_PREFIX + event in library.functions
    )


def bpftrace_script(
    points: Sequence[TracePoint],
    traced: Iterable[int] = (),
    *,
    users: Collection[int] = (),
    attached: bool = False,
) -> str:
    """Return the script that prints the events of some trace points.

    Events are limited to the ``traced`` processes and all that they start, or, if there are none,
    to processes of ``users``, if there are any. ``attached``: the application runs already, so
    names of handles are read from its memory.
    Raises InputError: a file's path has other than plain characters.
    """
    limits = [f"@traced[{pid}] = 1;" for pid in traced]
    of_users = " || ".join(f"uid == {user}" for user in sorted(users))
    restriction = ""
    if limits:
        restriction = " /@traced[pid]/"
    elif of_users:
        restriction = f" /{of_users}/"
    maps, probes = ["@running"], dict[str, Iterable[str]]()
    if limits:
        maps.append("@traced")
        # Here `pid` is the parent's. The child may be a thread: its number is then no process's,
        # and does no harm in the map.
        fork = "tracepoint:sched:sched_process_fork /@traced[pid]/"
        probes |= {"BEGIN": limits, fork: ["@traced[args->child_pid] = 1;"]}
    for code, point in enumerate(points, FIRST_POINT):
        if not _PLAIN.fullmatch(str(point.file)):
            raise InputError(
                f"{str(point.file)!r}: a path with such characters is not written into a script "
                "that root runs: rename it, or give the file open, as /proc/PID/fd/N"
            )
        function = f'uprobe:"{point.file}":{FUNCTION_PREFIX}{point.event}{restriction}'
        probes[function] = _statements(point, code, attached)
    if attached and any(point.handle for point in points):
        maps.append("@named")
    template = "\\t%lld" * len(_SWITCH) + "\\t" * (len(VALUES) - len(_SWITCH)) + "\\t%s\\t%s"
    values = [f"args->{name}" for name in (*_SWITCH.values(), "prev_comm", "next_comm")]
    involved = "@running[args->prev_pid] || @running[args->next_pid]"
    switch = f"tracepoint:sched:sched_switch /{involved}/"
    probes[switch] = [_printf(SWITCH_CODE, values, template, now="nsecs")]
    probes["END"] = [f"clear({name});" for name in maps]
    blocks = ("\n  ".join((f"{probe}\n{{", *lines)) for probe, lines in probes.items())
    return "\n".join(f"{block}\n}}\n" for block in blocks)


def _statements(point: TracePoint, code: int, attached: bool) -> Iterator[str]:
    """Yield the statements of a trace point's probe."""
    yield "$now = nsecs;"
    first_run = _printf(SWITCH_CODE, ["tid"], "\\t" * 4 + "%d")
    yield f"if (@running[tid] == 0) {{ @running[tid] = 1; {first_run} }}"
    values: dict[int, str] = {}
    for field, place in point.arguments:
        if field.kind == "gid":
            values |= {place: f"*(uint64 *)arg{place}", place + 1: f"*(uint64 *)(arg{place} + 8)"}
        elif field.kind != "text":
            values[place] = f"arg{place}"
    yield _printf(code, [values.get(place, "0") for place in range(max(values, default=-1) + 1)])
    for field, place in point.arguments:
        if field.kind == "text":
            yield from _text(f"arg{place}", place)
    if attached and point.handle is not None:
        yield f"$handle = {point.handle};"
        yield "if (@named[pid, $handle] == 0) {"
        yield "@named[pid, $handle] = 1;"
        yield from _text(f"*(uint64 *)($handle + {_TOPIC_NAME_AT})", NAME_PLACE)
        yield from _text("*(uint64 *)$handle", RMW_PLACE)
        yield "}"


def _printf(code: int, values: Sequence[str], template: str = "", now: str = "$now") -> str:
    """Return the statement that prints a line of values.

    They are numbers unless a ``template`` says otherwise.
    """
    columns = template or "\\t%lld" * len(values)
    arguments = ", ".join((now, "pid", "tid", "cpu", *values))
    return f'printf("{code}\\t%lld\\t%d\\t%d\\t%d{columns}\\n", {arguments});'


def _text(address: str, place: int) -> Iterator[str]:
    """Yield the statements that print a text: lines of words up to one that ends in a zero byte.

    A text that does not end so within :data:`TEXT_LINES` lines is cut.
    """
    words = [f"*(uint64 *)($word + {offset})" for offset in range(0, 64, 8)]
    yield f"$text = {address};"
    yield "$word = $text & ~7;"
    yield "$line = 0;"
    yield f"while ($line < {TEXT_LINES}) {{"
    yield "  " + _printf(TEXT_CODE, [f"{16 * place} + $line", "$text & 7", *words])
    yield f"  if (*(uint8 *)($word + 63) == 0) {{ $line = {TEXT_LINES}; }}"
    yield "  $word = $word + 64;"
    yield "  $line = $line + 1;"
    yield "}"


class Printed(NamedTuple):
    """The output of a run of the script.

    ``handles`` are those that events had, if the application ran before tracing began:

    * ``pid``, ``event``, ``handle``
    * ``topic``: the name in the handle's memory
    """

    tables: dict[str, pl.DataFrame]
    handles: pl.DataFrame
    rmw: str | None  # the RMW's name, in the memory of a handle
    cut_names: int  # so many names were longer than what is printed


def read_printed(path: Path, points: Sequence[TracePoint], ahead_ns: int) -> Printed:
    """Read what the script of these trace points printed into a file that begins with HEADER.

    ``ahead_ns`` is CLOCK_BOOTTIME, which bpftrace reads, minus CLOCK_MONOTONIC.
    """
    form: dict[str, Any] = {"separator": "\t", "quote_char": None, "encoding": "utf8-lossy"}
    form |= {"schema": _SCHEMA, "truncate_ragged_lines": True, "ignore_errors": True}
    lines = pl.read_csv(path, **form)
    with path.open("rb") as stream:
        stream.seek(-1, 2)
        if stream.read() != b"\n":  # bpftrace was killed while it wrote
            lines = lines.head(-1)
    # Messages of bpftrace itself have no number in front.
    lines = lines.drop_nulls(CODE).with_columns(pl.col("time") - ahead_ns)
    texts = _texts(lines.filter(code=TEXT_CODE))
    parts: dict[str, list[pl.DataFrame]] = {}
    for code, point in enumerate(points, FIRST_POINT):
        rows = lines.filter(code=code)
        if rows.height:

            def texts_at(place: int, rows: pl.DataFrame = rows) -> pl.Series:
                at_place = texts.filter(place=place)
                key = ["time", "tid"]
                return rows.join(at_place, on=key, how="left", maintain_order="left")["text"]

            values = rows.select(VALUES).fill_null(0).to_numpy().view(np.uint64)
            table = table_of_registers(
                point.event,
                point.arguments,
                rows.select(CODE[1:]),
                values,
                texts_at,
                version=point.tracing_library.version,
            )
            parts.setdefault(point.event, []).append(table)
    switches = lines.filter(code=SWITCH_CODE)
    if switches.height:
        switches = switches.rename(dict(zip(VALUES, _SWITCH, strict=False)))
        types = events.column_types("sched_switch")
        parts["sched_switch"] = [switches.select(pl.col(n).cast(t) for n, t in types.items())]
    tables = {
        event: pl.concat(tables, how="diagonal").sort("time", maintain_order=True)
        for event, tables in parts.items()
    }
    event_of = {code: point.event for code, point in enumerate(points, FIRST_POINT)}
    named = texts.filter(place=NAME_PLACE).select("time", "tid", topic="text")
    of_points = lines.filter(pl.col("code") >= FIRST_POINT).join(named, on=["time", "tid"])
    handles = of_points.select(
        pl.col("pid").cast(pl.Int32),
        event=pl.col("code").replace_strict(event_of, return_dtype=pl.String),
        handle=pl.col(VALUES[0]).cast(pl.UInt64),
        topic="topic",
    ).unique(maintain_order=True)
    rmw = texts.filter(place=RMW_PLACE)["text"]
    return Printed(tables, handles, rmw[0] if len(rmw) else None, int(texts["cut"].sum()))


def _texts(lines: pl.DataFrame) -> pl.DataFrame:
    """Put texts together from the lines of their words; leave out those whose beginning was lost.

    Columns:

    * ``time``, ``tid``: of the event that has the text
    * ``place``: of the argument
    * ``text``
    * ``cut``: whether its end was not printed
    """
    key = ["time", "tid", "place", "line"]
    lines = lines.with_columns(place=pl.col(VALUES[0]) // 16, line=pl.col(VALUES[0]) % 16)
    lines = lines.sort(key)
    words = lines.select(VALUES[2:]).fill_null(0).to_numpy().astype("<i8")
    parts: dict[tuple[int, ...], bytes] = {}
    rows = lines.select(*key, VALUES[1]).iter_rows()
    for part, (*key_values, line, skipped) in zip(words, rows, strict=True):
        text_key = tuple(key_values)
        before = parts.get(text_key, b"")
        offset = line * part.nbytes - (skipped if line else 0)
        if b"\0" not in before and offset == len(before):  # else it has ended, or a line was lost
            parts[text_key] = before + part.tobytes()[0 if line else skipped :]
    texts = ((text_key, *part.partition(b"\0")) for text_key, part in parts.items())
    return pl.DataFrame(
        [(*text_key, text_of(text), not end) for text_key, text, end, _ in texts],
        schema={**dict.fromkeys(key[:3], pl.Int64), "text": pl.String, "cut": pl.Boolean},
        orient="row",
    )
