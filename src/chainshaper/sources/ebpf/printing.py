"""The bpftrace script that prints the events, and what it printed as event tables.

The script sets uprobes on the trace points, and `sched_switch`. Every line that it prints is
numbers separated by tabs (:data:`CODE` to :data:`VALUES`; what is further right is left out), which
costs the traced thread little and is read at the speed of CSV:

    code  time  pid  tid  cpu  value 0 … value 9  [prev_comm  next_comm]

* The code says which of the trace points it is, :data:`FIRST_POINT` being the first one.
* A number or a flag is one value, a gid two: the first 16 of its bytes, which are those that mean
  anything.
* A text is printed as the eight-byte words it lies in, in lines of its own (:data:`TEXT_CODE`) with
  the time and thread of the event: 16 × the argument's place + the line's number, how many bytes
  before the text the first word begins, and eight words. So a name may be of any length and
  contain anything, in every version of bpftrace: its `str()` cuts at 64 bytes or less than 200.
  Aligned words never reach into a page where the text is not.
* `sched_switch` (:data:`SWITCH_CODE`) is printed where a thread that has emitted events goes or
  comes. The first of these events shows a thread at work that came unseen, so a line like that
  stands before it, which says nothing of the thread that went.

Other lines are bpftrace's own: what it attaches, and how many events it lost. Every core has a
buffer of its own, so lines of different cores are in no order; the tables are sorted. Times are of
CLOCK_BOOTTIME, as bpftrace takes them.

Where the application runs already, its publishers and subscriptions were created unseen. Their
topics are read where they are used first: the handles of `rmw_publish` and `rmw_take` are the
addresses of a `rmw_publisher_t` and a `rmw_subscription_t`, which begin with the addresses of the
RMW's name, of its data and of the topic's name. Before tracetools 8 the former is found from
`rcl_publish`'s `rcl_publisher_t`.

bpftrace runs the script as root, so nothing stands in it that a stranger may have written:
events, which we know, numbers, and paths of plain characters only. Who traces a file of another
name gives it open, as `/proc/PID/fd/N`.

Upstream: bpftrace 0.17 to 0.26; rmw, `rmw/types.h`; rcl, `publisher_impl.h` (Humble, Iron).
"""

import mmap
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from chainshaper.sources.ebpf.trace_points import FUNCTION_PREFIX, Argument, TracePoint
from chainshaper.values import events
from chainshaper.values.errors import InputError

CODE = ("code", "time", "pid", "tid", "cpu")
VALUES = tuple(f"value_{number}" for number in range(10))

TEXT_CODE, SWITCH_CODE, FIRST_POINT = 0, 1, 2
TEXT_LINES = 8
"""Lines that one text may take, of 64 bytes each."""
TEXT_BYTES = 64 * TEXT_LINES - 8
"""What is printed of a text at least."""

NAME_PLACE, RMW_PLACE = 8, 9
"""Places, beyond any argument's, of the topic's and the RMW's name of a handle."""

_PLAIN = re.compile(r"[A-Za-z0-9/._+ -]+")
_WORDS = 8
_WHO = "\\t%lld\\t%d\\t%d\\t%d"
_TOPIC_NAME_AT = 16  # in rmw_publisher_t and rmw_subscription_t, on 64-bit machines
_RMW_HANDLE_AT_HUMBLE, _RMW_HANDLE_AT_IRON = 240, 248  # in rcl_publisher_impl_t


_COMMS = ("prev_comm", "next_comm")
_SCHEMA: dict[str, pl.DataType] = {
    **dict.fromkeys((*CODE, *VALUES), pl.Int64()),
    **dict.fromkeys(_COMMS, pl.String()),
}
HEADER = "\t".join(_SCHEMA) + "\n"
"""What the file begins with that bpftrace prints into: lines may have fewer columns, not more."""

_SWITCH_COLUMNS = ("prev_tid", "prev_prio", "prev_state", "next_tid", "next_prio")
_LOST = re.compile(rb"^Lost (\d+) events", re.MULTILINE)

_Texts = dict[tuple[int, int, int], str]
"""(time, tid, place) → text."""


def bpftrace_script(
    points: Sequence[TracePoint],
    traced: Iterable[int] = (),
    *,
    users: Collection[int] = (),
    attached: bool = False,
) -> str:
    """The script for some trace points.

    ``traced`` are the processes to which, with all that they start, events are limited; without
    them ``users`` are the user ids to whose processes they are, empty: to none. ``attached`` is
    whether names of handles are read that were created before.

    Raises:
        InputError: a file's path is not of plain characters.
    """
    limits = [f"@traced[{pid}] = 1;" for pid in traced]
    theirs = " || ".join(f"uid == {user}" for user in sorted(users))
    restriction = " /@traced[pid]/" if limits else f" /{theirs}/" if theirs else ""
    maps = ["@running", *(["@traced"] if limits else [])]
    if attached and any(_named_by(point) for point in points):
        maps.append("@named")
    probes = []
    if limits:
        probes.append(_block("BEGIN", limits))
        # `pid` is the parent here; a new thread's number is no process's, and does no harm.
        new = ["@traced[args->child_pid] = 1;"]
        probes.append(_block("tracepoint:sched:sched_process_fork /@traced[pid]/", new))
    probes += [
        _block(
            f"uprobe:{_quoted(point.file)}:{FUNCTION_PREFIX}{point.event}{restriction}",
            _statements(point, code, attached),
        )
        for code, point in enumerate(points, FIRST_POINT)
    ]
    probes.append(_switches())
    probes.append(_block("END", [f"clear({name});" for name in maps]))
    return "\n".join(probes)


def _block(probe: str, statements: Iterable[str]) -> str:
    body = "\n".join(f"  {statement}" for statement in statements)
    return f"{probe}\n{{\n{body}\n}}\n"


def _quoted(path: Path) -> str:
    """A path as bpftrace takes it, which separates probes' parts by colons."""
    if not _PLAIN.fullmatch(str(path)):
        raise InputError(
            f"{str(path)!r}: a path with such characters is not written into a script that root "
            "runs: rename it, or give the file open, as /proc/PID/fd/N"
        )
    return f'"{path}"'


def _statements(point: TracePoint, code: int, attached: bool) -> list[str]:
    values = [value for argument in point.arguments for value in _values(argument)]
    came = f'printf("{SWITCH_CODE}{_WHO}\\t\\t\\t\\t%d\\n", $now, pid, tid, cpu, tid);'
    first_sight = f"if (@running[tid] == 0) {{ @running[tid] = 1; {came} }}"
    statements = ["$now = nsecs;", first_sight, _printf(code, values)]
    for argument in point.arguments:
        if argument.kind == "text":
            statements += _text(f"arg{argument.place}", argument.place)
    handle = _named_by(point) if attached else None
    if handle is not None:
        statements += [
            f"$handle = {handle};",
            "if (@named[pid, $handle] == 0) {",
            "@named[pid, $handle] = 1;",
            *_text(f"*(uint64 *)($handle + {_TOPIC_NAME_AT})", NAME_PLACE),
            *_text("*(uint64 *)$handle", RMW_PLACE),
            "}",
        ]
    return statements


def _values(argument: Argument) -> tuple[str, ...]:
    given = f"arg{argument.place}"
    match argument.kind:
        case "number":
            return (given,)
        case "flag":  # the upper bytes of a register that holds a bool are undefined
            return (f"{given} & 0xff",)
        case "gid":
            return f"*(uint64 *){given}", f"*(uint64 *)({given} + 8)"
        case "text":
            return ()


def _named_by(point: TracePoint) -> str | None:
    """The address of the `rmw_publisher_t` or `rmw_subscription_t` that an event is about."""
    if point.event == "rmw_take" or (point.event == "rmw_publish" and point.handles_at_rmw):
        return "arg0"
    if point.event == "rcl_publish" and not point.handles_at_rmw:
        humble = (point.version or "").startswith("4.")
        at = _RMW_HANDLE_AT_HUMBLE if humble else _RMW_HANDLE_AT_IRON
        return f"*(uint64 *)(*(uint64 *)arg0 + {at})"
    return None


def _printf(code: int, values: Sequence[str]) -> str:
    template = f"{code}{_WHO}" + "\\t%lld" * len(values)
    arguments = ", ".join(("$now", "pid", "tid", "cpu", *values))
    return f'printf("{template}\\n", {arguments});'


def _text(address: str, place: int) -> list[str]:
    """Print the words of a text until one that ends with a null byte, or for long enough."""
    words = [f"*(uint64 *)($word + {8 * number})" for number in range(_WORDS)]
    return [
        f"$text = {address};",
        "$word = $text & ~7;",
        "$line = 0;",
        f"while ($line < {TEXT_LINES}) {{",
        "  " + _printf(TEXT_CODE, [f"{16 * place} + $line", "$text & 7", *words]),
        f"  if (*(uint8 *)($word + {8 * _WORDS - 1}) == 0) {{ $line = {TEXT_LINES}; }}",
        f"  $word = $word + {8 * _WORDS};",
        "  $line = $line + 1;",
        "}",
    ]


def _switches() -> str:
    numbers = ("prev_pid", "prev_prio", "prev_state", "next_pid", "next_prio")
    template = f"{SWITCH_CODE}{_WHO}" + "\\t%lld" * len(numbers)
    template += "\\t" * (len(VALUES) - len(numbers)) + "\\t%s\\t%s\\n"
    values = ", ".join(f"args->{name}" for name in (*numbers, "prev_comm", "next_comm"))
    return _block(
        "tracepoint:sched:sched_switch /@running[args->prev_pid] || @running[args->next_pid]/",
        [f'printf("{template}", nsecs, pid, tid, cpu, {values});'],
    )


@dataclass(frozen=True)
class Printed:
    """The output of one run; times are ns of CLOCK_MONOTONIC.

    * ``tables``: the events.
    * ``handles``: ``pid, event, handle, topic``, the names of handles that were in use when
      tracing began; the event is the one that the handle was read from.
    * ``rmw``: the RMW's name from such a handle.
    * ``cut_names``: how many names were longer than what is printed of one.
    """

    tables: dict[str, pl.DataFrame]
    handles: pl.DataFrame
    rmw: str | None
    cut_names: int


def lost_events(*paths: Path) -> int:
    """How many events bpftrace says it has lost, in what it wrote into these files."""
    count = 0
    for path in paths:
        if path.is_file() and path.stat().st_size:
            with (
                path.open("rb") as stream,
                mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as said,
            ):
                count += sum(int(found[1]) for found in _LOST.finditer(said))
    return count


def read_printed(path: Path, points: Sequence[TracePoint], ahead_ns: int) -> Printed:
    """Read the file that the script of these trace points printed into, behind :data:`HEADER`.

    ``ahead_ns`` is CLOCK_BOOTTIME, which bpftrace reads, minus CLOCK_MONOTONIC.
    """
    lines = _lines(path).with_columns(pl.col("time") - ahead_ns)
    texts, cut_names = _texts(lines.filter(code=TEXT_CODE))
    parts: dict[str, list[pl.DataFrame]] = {}
    for code, point in enumerate(points, FIRST_POINT):
        rows = lines.filter(code=code)
        if rows.height:
            parts.setdefault(point.event, []).append(_table(rows, point, texts))
    switches = lines.filter(code=SWITCH_CODE)
    if switches.height:
        named = dict(zip(_SWITCH_COLUMNS, VALUES, strict=False))
        parts["sched_switch"] = [_typed(switches, "sched_switch", named | {c: c for c in _COMMS})]
    tables = {
        event: pl.concat(tables, how="diagonal").sort("time", maintain_order=True)
        for event, tables in parts.items()
    }
    handles = _handles(lines, points, texts)
    rmw = next((text for (_, _, place), text in texts.items() if place == RMW_PLACE), None)
    return Printed(tables, handles, rmw, cut_names)


def _lines(path: Path) -> pl.DataFrame:
    """Our lines as rows; bpftrace's own have no number in front."""
    lines = pl.read_csv(
        path,
        separator="\t",
        quote_char=None,
        schema=_SCHEMA,
        truncate_ragged_lines=True,
        ignore_errors=True,
        encoding="utf8-lossy",
    )
    with path.open("rb") as stream:
        stream.seek(-1, 2)
        if stream.read() != b"\n":  # bpftrace was killed while it wrote
            lines = lines.head(-1)
    return lines.drop_nulls(CODE)


def _texts(lines: pl.DataFrame) -> tuple[_Texts, int]:
    """The texts, put together from their words, and how many of them are cut."""
    key = ["time", "tid", "place", "line"]
    lines = lines.with_columns(place=pl.col(VALUES[0]) // 16, line=pl.col(VALUES[0]) % 16)
    lines = lines.sort(key)
    words = lines.select(VALUES[2:]).fill_null(0).to_numpy().astype("<i8")
    parts: dict[tuple[int, int, int], bytes] = {}
    for row, (time, tid, place, line, skipped) in enumerate(
        lines.select(*key, VALUES[1]).iter_rows()
    ):
        before = parts.get((time, tid, place), b"")
        here = line * words[row].nbytes - (skipped if line else 0)
        if b"\0" not in before and here == len(before):  # else it has ended, or a line was lost
            part = words[row].tobytes()
            parts[time, tid, place] = before + (part if line else part[skipped:])
    ended = {key: part.partition(b"\0") for key, part in parts.items()}
    texts = {key: text.decode(errors="replace") for key, (text, _, _) in ended.items()}
    return texts, sum(not end for _, end, _ in ended.values())


def _table(rows: pl.DataFrame, point: TracePoint, texts: _Texts) -> pl.DataFrame:
    """The table of one trace point's rows."""
    sources: dict[str, str | pl.Series] = {}
    free = iter(VALUES)
    for argument in point.arguments:
        match argument.kind:
            case "text":
                keys = rows.select("time", "tid").iter_rows()
                names = [texts.get((time, tid, argument.place)) for time, tid in keys]
                sources[argument.column] = pl.Series(argument.column, names, dtype=pl.String)
            case "gid":
                sources[argument.column] = _gids(rows[next(free)], rows[next(free)])
            case _:
                sources[argument.column] = next(free)
    table = _typed(rows, point.event, sources)
    if point.event == "rcl_init":
        table = table.with_columns(version=pl.lit(point.version, dtype=pl.String))
    return table


def _typed(
    rows: pl.DataFrame, event: str, sources: dict[str, str] | dict[str, str | pl.Series]
) -> pl.DataFrame:
    """The rows' values under the columns' names and types."""
    types = {**events.COMMON_COLUMNS, **events.FIELDS[event]}
    columns = {name: name for name in events.COMMON_COLUMNS} | sources
    return rows.select(
        (pl.col(source) if isinstance(source, str) else pl.lit(source))
        .cast(types[column])
        .alias(column)
        for column, source in columns.items()
    )


def _gids(first: pl.Series, second: pl.Series) -> pl.Series:
    words = np.column_stack([first.to_numpy(), second.to_numpy()]).astype("<i8")
    return pl.Series([list(word.tobytes()) for word in words], dtype=pl.List(pl.UInt8))


def _handles(lines: pl.DataFrame, points: Sequence[TracePoint], texts: _Texts) -> pl.DataFrame:
    """Whose names were read at which event: ``pid, event, handle, topic``."""
    named = pl.DataFrame(
        [(time, tid, name) for (time, tid, place), name in texts.items() if place == NAME_PLACE],
        schema={"time": pl.Int64, "tid": pl.Int64, "topic": pl.String},
        orient="row",
    )
    event_of = {code: point.event for code, point in enumerate(points, FIRST_POINT)}
    return (
        lines.filter(pl.col("code").is_in(list(event_of)))
        .join(named, on=["time", "tid"])
        .select(
            pl.col("pid").cast(pl.Int32),
            pl.col("code").replace_strict(event_of, return_dtype=pl.String).alias("event"),
            pl.col(VALUES[0]).cast(pl.UInt64).alias("handle"),
            "topic",
        )
        .unique(maintain_order=True)
    )
