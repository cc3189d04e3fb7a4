"""The bpftrace script that prints the events: uprobes on the trace points, and `sched_switch`.

Every line that it prints is numbers separated by tabs (:data:`CODE` to :data:`VALUES`; what is
further right is left out), which costs the traced thread little and is read at the speed of CSV:

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

Where the application runs already, nobody saw its publishers and subscriptions being created. Their
topics are read where they are used first: the handles of `rmw_publish` and `rmw_take` are the
addresses of a `rmw_publisher_t` and a `rmw_subscription_t`, which begin with the addresses of the
RMW's name, of its data and of the topic's name. Before tracetools 8 the former is found from
`rcl_publish`'s `rcl_publisher_t`.

Times are of CLOCK_BOOTTIME, as bpftrace takes them.

bpftrace runs the script as root, so nothing stands in it that somebody else may have written:
events, which we know, numbers, and paths of plain characters only. Who traces a file of another
name gives it open, as `/proc/PID/fd/N`.

Upstream: bpftrace 0.17 to 0.26; rmw, `rmw/types.h`; rcl, `publisher_impl.h` (Humble, Iron).
"""

import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from chainshaper.sources.ebpf.trace_points import FUNCTION_PREFIX, Argument, TracePoint
from chainshaper.values.errors import InputError

__all__ = [
    "CODE",
    "FIRST_POINT",
    "NAME_PLACE",
    "RMW_PLACE",
    "SWITCH_CODE",
    "TEXT_BYTES",
    "TEXT_CODE",
    "VALUES",
    "bpftrace_script",
]

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
    statements = ["$now = nsecs;", *_first_sight(), _printf(code, values)]
    for argument in point.arguments:
        if argument.kind == "text":
            statements += _text(f"arg{argument.place}", argument.place)
    handle = _named_by(point) if attached else None
    if handle is not None:
        statements.append(f"$handle = {handle};")
        statements.append("if (@named[pid, $handle] == 0) {")
        statements.append("@named[pid, $handle] = 1;")
        statements += _text(f"*(uint64 *)($handle + {_TOPIC_NAME_AT})", NAME_PLACE)
        statements += _text("*(uint64 *)$handle", RMW_PLACE)
        statements.append("}")
    return statements


def _first_sight() -> list[str]:
    line = f'printf("{SWITCH_CODE}{_WHO}\\t\\t\\t\\t%d\\n", $now, pid, tid, cpu, tid);'
    return [f"if (@running[tid] == 0) {{ @running[tid] = 1; {line} }}"]


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
