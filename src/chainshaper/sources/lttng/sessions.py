"""Which folders of a trace belong together, and which hold the same events.

A session that is rotated writes a folder for each chunk, and one with a snapshot for the start of
the application beside it writes two: they are one trace. Containers number their processes alike,
and their folders have to stay apart. Two sessions that recorded the same processes have every event
twice, at slightly different times.
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
"""An event of CARET's that is read with the creation, but is no table of ours."""
Place: TypeAlias = tuple[str, str | Path]
"""A host's name, and the path that was given."""
_SAME_NS = 100_000
"""So far apart two sessions note the same event, at most."""
_REGISTERED = (
    "rclcpp_callback_register",
    "rclcpp_timer_callback_added",
    "rclcpp_subscription_callback_added",
    "rclcpp_service_callback_added",
)
_COMPARED = (
    *("rcl_init", "rcl_node_init", "callback_start", "rmw_publish", "rmw_take"),
    *("rclcpp_publish", "sched_switch"),
)


def table_name(event: str) -> str | None:
    """The table that an event belongs to: ``ros2:callback_start`` → ``callback_start``."""
    provider, _, name = event.rpartition(":")
    known = name in events.FIELDS or name == CARET_INIT
    # CARET's provider was called `ros2_hook` in its first version.
    providers = ("",) if name == "sched_switch" else ("ros2", "ros2_caret", "ros2_hook")
    return name if known and provider in providers else None


def one_session(trace: CtfTrace, places: Sequence[Place]) -> dict[Place, Place]:
    """For each place of user space the first one that belongs to the same session as it.

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
    for one, another in combinations(folders, 2):
        if one[0] != another[0] or first[another] != another:
            continue
        if _continues(trace, folders[one], folders[another]) or _shares_creation(
            objects(one), objects(another)
        ):
            first[another] = first[one]
    return first


def _continues(trace: CtfTrace, one: Sequence[int], another: Sequence[int]) -> bool:
    """Whether some trace is in both, and none of its streams runs in both at once."""
    spans = [_spans_of_streams(trace, numbers) for numbers in (one, another)]
    traces = [{uuid for uuid, _, _ in each} for each in spans]
    if not traces[0] & traces[1] - {None}:
        return False
    common = spans[0].keys() & spans[1].keys()
    return not any(_overlap(spans[0][stream], spans[1][stream]) for stream in common)


_Span: TypeAlias = tuple[int, int]
"""From and to, in cycles of a trace's clock."""


def _overlap(one: _Span, another: _Span) -> bool:
    return max(one[0], another[0]) < min(one[1], another[1])


def _spans_of_streams(
    trace: CtfTrace, folders: Sequence[int]
) -> dict[tuple[str | None, str, int], _Span]:
    """Trace's UUID, domain and stream's instance → when it runs."""
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
    """Callbacks (process, address) that are created, those that run, and nodes with their time."""

    created: frozenset[tuple[int, int]]
    running: frozenset[tuple[int, int]]
    nodes: frozenset[object]


def _objects(trace: CtfTrace, folders: Sequence[int]) -> _Objects:
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


def _shares_creation(one: _Objects, another: _Objects) -> bool:
    """Whether most of what runs without a creation of its own was created in the other one.

    CARET writes the creation again in each session, with the time at which it was.
    """
    if one.nodes & another.nodes:
        return True
    for earlier, later in ((one, another), (another, one)):
        pids = {pid for pid, _ in earlier.created}
        unknown = {pair for pair in later.running - later.created if pair[0] in pids}
        if unknown and 2 * len(unknown & earlier.created) >= len(unknown):
            return True
    return False


def refuse_same_events(trace: CtfTrace) -> None:
    """Refuse a trace that has two folders with the same events. Raises InputError: names them."""
    times = {number: _time_of(trace, number) for number in range(len(trace.folders))}
    suspected = [
        (one, another)
        for one, another in combinations(range(len(trace.folders)), 2)
        if _alike(trace, one, another) and _overlap(times[one], times[another])
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
    for one, another in suspected:
        kernel = trace.folders[one].env.get("domain") == "kernel"
        if (kernel or threads[one] & threads[another]) and _same(read[one], read[another]):
            paths = f"{trace.folders[one].path} and {trace.folders[another].path}"
            raise InputError(
                f"{paths} hold the same events: two sessions recorded the same processes, or one is"
                " a copy of the other; give one of the two"
            )


def _alike(trace: CtfTrace, one: int, another: int) -> bool:
    facts = [
        tuple(trace.folders[number].env.get(name) for name in ("hostname", "domain"))
        for number in (one, another)
    ]
    return facts[0] == facts[1]


def _time_of(trace: CtfTrace, folder: int) -> _Span:
    """From when to when a folder has packets; for ever, where they do not say so."""
    packets = [stream.packets for stream in trace.streams if stream.folder == folder]
    if not packets:
        return 0, 0
    begin, end = _span(pl.concat(packets))
    return (begin, end) if min(begin, end) >= 0 else (-(1 << 63), 1 << 63)


def _events_of(
    trace: CtfTrace, folders: Sequence[int], names: Iterable[str]
) -> Iterator[tuple[str, pl.DataFrame]]:
    """The tables of some folders, by their names, of events that happened."""
    chosen = tuple(stream for stream in trace.streams if stream.folder in folders)
    full = {name: table_name(name) for name in trace.event_names}
    wanted = [name for name, table in full.items() if table in set(names)]
    for name, frame in read_events(replace(trace, streams=chosen), wanted, nameless=wanted).items():
        if frame.height and (frame.schema["pid"].is_integer() or name == "sched_switch"):
            yield str(full[name]), frame


def _keyed(frame: pl.DataFrame) -> pl.DataFrame:
    """An event's times, and a number that tells it from the others of its name."""
    simple = [
        name
        for name, kind in frame.schema.items()
        if name not in {"time", "cpu", "procname"} and (kind.is_integer() or kind == pl.String)
    ]
    return frame.select("time", "pid", key=pl.struct(sorted(simple) or ["time"]).hash())


def _same(one: Mapping[str, pl.DataFrame], another: Mapping[str, pl.DataFrame]) -> bool:
    """Whether of each kind of event most of those in the common time are in both."""
    shares = []
    for name in one.keys() & another.keys():
        begin = max(int(side[name]["time"][0]) for side in (one, another)) - _SAME_NS
        end = min(int(side[name]["time"][-1]) for side in (one, another)) + _SAME_NS
        left, right = (
            side[name].filter(pl.col("time").is_between(begin, end)) for side in (one, another)
        )
        if left.height and right.height:
            joined = left.join_asof(
                right.select("time", "key", there=True),
                on="time",
                by="key",
                strategy="nearest",
                tolerance=_SAME_NS,
                check_sortedness=False,
            )
            shares.append(joined["there"].count() / min(left.height, right.height))
    return bool(shares) and min(shares) >= 0.5
