"""Find out which folders of a trace belong together, and which have the same events.

A session that is rotated writes a folder for each chunk; a session with a snapshot of the
application's start writes two folders. In both cases the folders are one trace. Processes in
different containers may have the same numbers, so folders of containers must be kept apart. Two
sessions that recorded the same processes have every event twice, at slightly different times.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import NamedTuple, TypeAlias

import polars as pl

from chainshaper.sources.ctf import CtfTrace, read_events
from chainshaper.values import events
from chainshaper.values.errors import InputError

CARET_INIT = "caret_init"
"""An event of CARET that is read with the events of creation; it has no event table."""
Place: TypeAlias = tuple[str, str | Path]
"""A host's name, and the path that was given."""
_SAME_NS = 100_000
"""Two sessions record the same event at times that differ by no more than this."""
_REGISTERED = (
    "rclcpp_callback_register",
    "rclcpp_timer_callback_added",
    "rclcpp_subscription_callback_added",
    "rclcpp_service_callback_added",
)
_COMPARED = (
    "rcl_init",
    "rcl_node_init",
    "callback_start",
    "rmw_publish",
    "rmw_take",
    "rclcpp_publish",
    "sched_switch",
)


def table_name(event: str) -> str | None:
    """Return the table that an event belongs to: ``ros2:callback_start`` → ``callback_start``."""
    provider, _, name = event.rpartition(":")
    known = name in events.FIELDS or name == CARET_INIT
    # CARET's provider was called `ros2_hook` in its first version.
    providers = ("",) if name == "sched_switch" else ("ros2", "ros2_caret", "ros2_hook")
    return name if known and provider in providers else None


def first_of_session(trace: CtfTrace, places: Sequence[Place]) -> dict[Place, Place]:
    """Return for each place of user space the first place that belongs to the same session.

    ``places`` are those of the trace's folders. They belong together where they have a trace's UUID
    in common, none of whose streams runs in both at once, or where one runs what was created in the
    other.
    """
    folders: dict[Place, list[int]] = {}
    for number, place in enumerate(places):
        if trace.folders[number].env.get("domain") != "kernel":
            folders.setdefault(place, []).append(number)
    first = {place: place for place in folders}
    objects = cache(lambda place: _objects(trace, folders[place]))
    for left, right in combinations(folders, 2):
        if left[0] != right[0] or first[right] != right:
            continue
        if _continues(trace, folders[left], folders[right]) or _shares_creation(
            objects(left), objects(right)
        ):
            first[right] = first[left]
    return first


def _continues(trace: CtfTrace, left: Sequence[int], right: Sequence[int]) -> bool:
    """Return whether a trace is in both folders, and none of its streams runs in both at once."""
    of_left, of_right = (_spans_of_streams(trace, folders) for folders in (left, right))
    uuids = {uuid for uuid, _, _ in of_left} & {uuid for uuid, _, _ in of_right}
    if not uuids - {None}:
        return False
    common = of_left.keys() & of_right.keys()
    return not any(_overlap(of_left[stream], of_right[stream]) for stream in common)


_Span: TypeAlias = tuple[int, int]
"""From and to, in cycles of a trace's clock."""


def _overlap(left: _Span, right: _Span) -> bool:
    return max(left[0], right[0]) < min(left[1], right[1])


def _spans_of_streams(
    trace: CtfTrace, folders: Sequence[int]
) -> dict[tuple[str | None, str, int], _Span]:
    """Return (UUID of the trace, its domain, instance of the stream) → when the stream runs."""
    spans: dict[tuple[str | None, str, int], _Span] = {}
    for stream in trace.streams:
        if stream.folder in folders:
            declared, packets = trace.folders[stream.folder], stream.packets
            key = declared.uuid, str(declared.env.get("domain")), int(packets["instance"][0])
            begin, end = _span(packets)
            known = spans.get(key, (begin, end))
            spans[key] = min(begin, known[0]), max(end, known[1])
    return spans


def _span(packets: pl.DataFrame) -> _Span:
    begin, end = packets.select(pl.col("begin").min(), pl.col("end").max()).row(0)
    return begin, end


class _Objects(NamedTuple):
    """The objects of which some folders have events."""

    created: frozenset[tuple[int, int]]  # callbacks that are created: process and address
    running: frozenset[tuple[int, int]]  # callbacks that run
    nodes: frozenset[object]  # that are created: process, handle and time


def _objects(trace: CtfTrace, folders: Sequence[int]) -> _Objects:
    """Return the callbacks and nodes of which some folders have events."""
    frames = _events_of(trace, folders, (*_REGISTERED, "callback_start", "rcl_node_init"))
    created, running = set[tuple[int, int]](), set[tuple[int, int]]()
    nodes = set[object]()
    for name, frame in frames:
        if name == "rcl_node_init":
            when = "init_timestamp" if "init_timestamp" in frame.columns else "time"
            if "node_handle" in frame.columns:
                nodes.update(frame.select("pid", "node_handle", when).iter_rows())
        elif "callback" in frame.columns:
            pairs = frame.select("pid", "callback").unique().drop_nulls().iter_rows()
            (running if name == "callback_start" else created).update(pairs)
    return _Objects(frozenset(created), frozenset(running), frozenset(nodes))


def _shares_creation(left: _Objects, right: _Objects) -> bool:
    """Return whether two sets of folders are of one application.

    They are if most callbacks that run in one of them, but are not created there, are created in
    the other; or if both have the creation of the same node, since CARET writes the creation
    again in each session, with the time at which it really was.
    """
    if left.nodes & right.nodes:
        return True
    for earlier, later in ((left, right), (right, left)):
        pids = {pid for pid, _ in earlier.created}
        unknown = {pair for pair in later.running - later.created if pair[0] in pids}
        if unknown and 2 * len(unknown & earlier.created) >= len(unknown):
            return True
    return False


def refuse_same_events(trace: CtfTrace) -> None:
    """Raise InputError for a trace with two folders that have the same events; it names them."""
    times = {number: _time_of(trace, number) for number in range(len(trace.folders))}
    suspected = [
        (left, right)
        for left, right in combinations(range(len(trace.folders)), 2)
        if _of_same_system(trace, left, right) and _overlap(times[left], times[right])
    ]
    read: dict[int, dict[str, pl.DataFrame]] = {}
    threads: dict[int, frozenset[object]] = {}
    for number in {number for pair in suspected for number in pair}:
        read[number] = {
            name: _keyed(frame) for name, frame in _events_of(trace, [number], _COMPARED)
        }
        threads[number] = frozenset(
            pid for frame in read[number].values() for pid in frame["pid"].unique().drop_nulls()
        )
    for left, right in suspected:
        of_kernel = trace.folders[left].env.get("domain") == "kernel"
        if (of_kernel or threads[left] & threads[right]) and _same(read[left], read[right]):
            raise InputError(
                f"{trace.folders[left].path} and {trace.folders[right].path} hold the same events:"
                " two sessions recorded the same processes, or one is a copy of the other; give one"
                " of the two"
            )


def _of_same_system(trace: CtfTrace, left: int, right: int) -> bool:
    """Return whether two folders are of one host, and both of its kernel or of user space."""
    of_left, of_right = trace.folders[left].env, trace.folders[right].env
    return all(of_left.get(name) == of_right.get(name) for name in ("hostname", "domain"))


def _time_of(trace: CtfTrace, folder: int) -> _Span:
    """Return from when to when a folder has packets; always, if packets do not say a time."""
    packets = [stream.packets for stream in trace.streams if stream.folder == folder]
    if not packets:
        return 0, 0
    begin, end = _span(pl.concat(packets))
    return (begin, end) if min(begin, end) >= 0 else (-(1 << 63), 1 << 63)


def _events_of(
    trace: CtfTrace, folders: Sequence[int], names: Iterable[str]
) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield the tables of some folders, behind their names, of events that happened."""
    chosen = tuple(stream for stream in trace.streams if stream.folder in folders)
    full = {name: table_name(name) for name in trace.event_names}
    wanted = [name for name, table in full.items() if table in set(names)]
    for name, frame in read_events(replace(trace, streams=chosen), wanted, nameless=wanted).items():
        if frame.height and (frame.schema["pid"].is_integer() or name == "sched_switch"):
            yield str(full[name]), frame


def _keyed(frame: pl.DataFrame) -> pl.DataFrame:
    """Return times, processes and keys of events; a key is a hash of the event's fields."""
    simple = [
        name
        for name, kind in frame.schema.items()
        if name not in {"time", "cpu", "procname"} and (kind.is_integer() or kind == pl.String)
    ]
    return frame.select("time", "pid", key=pl.struct(sorted(simple) or ["time"]).hash())


def _same(left: Mapping[str, pl.DataFrame], right: Mapping[str, pl.DataFrame]) -> bool:
    """Return whether both sides have the same events.

    That is so if, for each kind of event, most events within the common time are on both sides.
    """
    shares = []
    for name in left.keys() & right.keys():
        begin = max(int(side[name]["time"][0]) for side in (left, right)) - _SAME_NS
        end = min(int(side[name]["time"][-1]) for side in (left, right)) + _SAME_NS
        within = pl.col("time").is_between(begin, end)
        in_left, in_right = left[name].filter(within), right[name].filter(within)
        if in_left.height and in_right.height:
            joined = in_left.join_asof(
                in_right.select("time", "key", there=True),
                on="time",
                by="key",
                strategy="nearest",
                tolerance=_SAME_NS,
                check_sortedness=False,
            )
            shares.append(joined["there"].count() / min(in_left.height, in_right.height))
    return bool(shares) and min(shares) >= 0.5
