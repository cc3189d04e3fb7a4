"""Recordings of several hosts, read as one.

The first host is the reference. Each other host's clock is found from the messages between it and
those whose clocks are known already (:mod:`chainshaper.analysis.clocks`): messages carry their DDS
source timestamp, by which a publication on one host and a take on another are recognised. Where
messages went one way only, the wall clocks' own claim takes the place of the missing side, and the
recording's notes say so; where it lies outside of what messages allow, it is refused.

Numbers of processes, threads and cores are moved, host by host (:mod:`chainshaper.values.hosts`),
and all instants converted to the reference's clock. The table `host_clock` says how far instants
may truly have been from that.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.clocks import (
    ContradictingClocksError,
    Corridor,
    OffsetBounds,
    corridor,
    steps,
)
from chainshaper.analysis.messages import publications, takes
from chainshaper.analysis.objects import resolve_objects
from chainshaper.values import events
from chainshaper.values.durations import milliseconds
from chainshaper.values.errors import InputError
from chainshaper.values.event_declarations import EVENTS
from chainshaper.values.hosts import CORE_STRIDE, HOST_STRIDE, MOST_HOSTS, ClockStep, HostInfo
from chainshaper.values.recording import Recording, RecordingInfo, StallMeterInfo

Times = npt.NDArray[np.int64]

CLAIM_TOLERANCE_NS = 20_000
"""By so much may wall clocks' claim miss the corridor: it is read with an error of its own."""
_FEW = 3  # names that a message lists
_SHOWS_GAPS = ("callback_start", "callback_end", "rmw_publish", "rmw_take")


@dataclass(frozen=True)
class _Host:
    """A host's recording, and the messages in it: frames ``topic, source_timestamp, time`` (ns)."""

    recording: Recording
    published: pl.DataFrame
    taken: pl.DataFrame

    @property
    def name(self) -> str:
        return self.recording.info.host


def joint_recording(recordings: Sequence[Recording]) -> Recording:
    """Return the recordings of several hosts as one; its tables are converted when they are used.

    Raises InputError: a host is there twice, no messages between the hosts say how far their clocks
    are apart, or the clocks contradict each other.
    """
    _refuse_names(recordings)
    hosts = [_host(recording) for recording in recordings]
    _refuse_without_stamps(hosts)
    known: dict[int, Corridor | None] = {0: None}
    described = {0: HostInfo(name=hosts[0].name, kernel=hosts[0].recording.info.kernel)}
    notes = list[str]()
    published = _recognisable(hosts)
    while len(known) < len(hosts):
        number, upper, lower = _best_known(hosts, published, known)
        found, about, note = _clock(hosts, number, upper, lower)
        known[number], described[number] = found, about
        notes += note
    corridors = [known[number] for number in range(len(hosts))]
    tables = JointTables([recording.events for recording in recordings], corridors)
    about_hosts = tuple(described[number] for number in range(len(hosts)))
    info = _joint_info([recording.info for recording in recordings], corridors, about_hosts, notes)
    return Recording(recordings[0].path, info, tables)


def _refuse_names(recordings: Sequence[Recording]) -> None:
    """Refuse recordings that are not of one host each, with different names."""
    if len(recordings) > MOST_HOSTS:
        raise InputError(f"{len(recordings)} hosts are too many: read {MOST_HOSTS} at most as one")
    seen = dict[str, Recording]()
    for recording in recordings:
        info = recording.info
        if info.hosts:
            raise InputError(
                f"{recording.path} has several hosts already: give the recordings of single hosts"
            )
        first = seen.setdefault(info.host, recording)
        if first is recording:
            continue
        both = f"{first.path} and {recording.path}"
        if first.info.boot is not None and first.info.boot == info.boot:
            raise InputError(
                f"{both} are of the same host, {info.host}: give one recording of each host"
            )
        reason = f"{both} are both of a host called {info.host}"
        remedy = (
            "if they are two computers, give one another name (hostnamectl), or another `host` in"
            " its recording.json; if they are one, give one recording of it"
        )
        raise InputError(f"{reason}: {remedy}")


def _host(recording: Recording) -> _Host:
    """Find the messages in a host's recording, by its own clock."""
    tables = recording.events
    objects = resolve_objects(tables)
    no_calls = pl.DataFrame()
    columns = [pl.col("topic").cast(pl.String), "source_timestamp", "time"]
    published = publications(tables, objects, no_calls).select(columns)
    taken = takes(tables, objects, no_calls).select(columns).drop_nulls()
    return _Host(recording, published, taken.filter(pl.col("source_timestamp") > 0))


def _refuse_without_stamps(hosts: Sequence[_Host]) -> None:
    """Refuse recordings whose publications have no source timestamps."""
    for host in hosts:
        if host.published.height and not host.published["source_timestamp"].count():
            raise InputError(
                f"{host.recording.path}: its publications have no source timestamps (ROS 2 before"
                " Jazzy), so messages to other hosts cannot be recognised: record Jazzy or later"
            )


def _recognisable(hosts: Sequence[_Host]) -> list[pl.DataFrame]:
    """Return each host's publications whose topic and source timestamp no other message has."""
    parts = [
        host.published.drop_nulls().with_columns(host=pl.lit(number))
        for number, host in enumerate(hosts)
    ]
    unique = pl.concat(parts).unique(["topic", "source_timestamp"], keep="none")
    return [
        unique.filter(host=number).select("topic", "source_timestamp", sent="time")
        for number in range(len(hosts))
    ]


def _between(published: pl.DataFrame, taker: _Host) -> tuple[Times, Times]:
    """Return when messages were published, and when taken, each by its own host's clock."""
    pairs = taker.taken.join(published, on=["topic", "source_timestamp"])
    return pairs["sent"].to_numpy(), pairs["time"].to_numpy()


def _best_known(
    hosts: Sequence[_Host], published: Sequence[pl.DataFrame], known: Mapping[int, Corridor | None]
) -> tuple[int, OffsetBounds, OffsetBounds]:
    """Return the host about whose clock messages say most, and the bounds of its offset.

    A bound from a host whose own clock is known to lie in an interval counts from its far end.
    """
    ranked = list[tuple[tuple[int, int], int, OffsetBounds, OffsetBounds]]()
    for number, host in enumerate(hosts):
        if number in known:
            continue
        uppers, lowers = list[OffsetBounds](), list[OffsetBounds]()
        for partner, clock in known.items():
            sent, took = _between(published[partner], host)
            sent, earlier, _ = _by_reference(clock, sent)
            uppers.append(OffsetBounds(sent, took - sent + earlier))
            sent, took = _between(published[number], hosts[partner])
            took, _, later = _by_reference(clock, took)
            lowers.append(OffsetBounds(took, sent - took - later))
        upper, lower = _together(uppers), _together(lowers)
        counts = sorted((len(upper.times), len(lower.times)))
        ranked.append(((counts[0], counts[1]), number, upper, lower))
    _, number, upper, lower = max(ranked, key=lambda entry: entry[0])
    if not (len(upper.times) or len(lower.times)):
        _refuse_apart(hosts, number, known)
    return number, upper, lower


def _by_reference(clock: Corridor | None, times: Times) -> tuple[Times, Times, Times]:
    """Return times of a host by the reference's clock; how much earlier and later they may be."""
    if clock is None:
        nothing = np.zeros(len(times), dtype=np.int64)
        return times, nothing, nothing
    converted = clock.converted(times)
    return converted, *clock.errors(converted)


def _together(bounds: Sequence[OffsetBounds]) -> OffsetBounds:
    return OffsetBounds(
        np.concatenate([bound.times for bound in bounds]),
        np.concatenate([bound.offsets for bound in bounds]),
    )


def _refuse_apart(hosts: Sequence[_Host], number: int, known: Mapping[int, object]) -> None:
    """Refuse a host to which, and from which, no message went."""
    host, partners = hosts[number], [hosts[partner] for partner in known]
    among = " or ".join(partner.name for partner in partners)
    spans = {each.name: _wall_span(each.recording) for each in (host, *partners)}
    since, until = spans.pop(host.name)
    if spans and all(until < begun or ended < since for begun, ended in spans.values()):
        texts = [
            f"{name} from {_at(begun)} to {_at(ended)}" for name, (begun, ended) in spans.items()
        ]
        raise InputError(
            f"{host.recording.path}: {host.name} was recorded from {_at(since)} to {_at(until)},"
            f" {', '.join(texts)} (by their wall clocks): give recordings of the same time"
        )
    theirs = {topic for partner in partners for topic in partner.published["topic"].unique()}
    mine = set(host.taken["topic"].unique())
    theirs_taken = {topic for partner in partners for topic in partner.taken["topic"].unique()}
    common = sorted((theirs & mine) | (set(host.published["topic"].unique()) & theirs_taken))
    reason = f"no message went between {host.name} and {among} while they were recorded"
    if common:
        listed = ", ".join(common[:_FEW])
        reason += f" (both know {listed}, but no source timestamp is in both)"
    raise InputError(
        f"{host.recording.path}: {reason}, so how far their clocks are apart cannot be known:"
        " record all hosts at the same time, with nodes that take topics of the others"
    )


def _wall_span(recording: Recording) -> tuple[int, int]:
    """Return the first and the last instant of a recording's messages, in ns of its wall clock."""
    times = [
        table["time"]
        for name in _SHOWS_GAPS
        if (table := events.table(recording.events, name)).height
    ]
    offset = recording.info.clock_offset_ns
    if not times:
        return offset, offset
    begun, ended = min(int(time[0]) for time in times), max(int(time[-1]) for time in times)
    return begun + offset, ended + offset


def _at(wall_ns: int) -> str:
    """Text for an instant of the wall clock, in seconds since 1970 in UTC."""
    import datetime

    instant = datetime.datetime.fromtimestamp(wall_ns // 1_000_000_000, datetime.timezone.utc)
    return f"{instant:%Y-%m-%d %H:%M:%S} UTC"


def _clock(
    hosts: Sequence[_Host], number: int, upper: OffsetBounds, lower: OffsetBounds
) -> tuple[Corridor, HostInfo, list[str]]:
    """Find a host's clock from the bounds of its offset; say what is to be known about it."""
    host, reference = hosts[number], hosts[0]
    claimed = reference.recording.info.clock_offset_ns - host.recording.info.clock_offset_ns
    counts = len(upper.times), len(lower.times)
    one_way = not all(counts)
    if one_way:
        upper, lower = _with_claim(hosts, number, upper, lower, claimed)
    try:
        found = corridor(
            upper,
            lower,
            host_events=_instants(host.recording),
            reference_events=_instants(reference.recording),
        )
    except ContradictingClocksError as error:
        raise InputError(
            f"{host.recording.path}: the clocks of {host.name} and {reference.name} contradict each"
            f" other: {error}. A clock is being slewed, or set again and again, or events are"
            " wrong: let the synchronisation settle, and record again"
        ) from error
    jumps = tuple(ClockStep(since_ns=a, until_ns=b, by_ns=by) for a, b, by in steps(found))
    notes = [
        f"the clock of {host.name} jumped by {jump.by_ns / 1e6:+.3f} ms against that of"
        f" {reference.name}, {_since(found, jump)}: latencies between them are uncertain by as much"
        " just then, and on each side of it as stated."
        for jump in jumps
    ]
    claim, claim_notes = _judged_claim(hosts, number, found, claimed)
    if one_way:
        claim = "taken"
        sender, taker = (reference, host) if counts[0] else (host, reference)
        notes.append(
            f"all messages between {reference.name} and {host.name} go to {taker.name}: they"
            f" bound its clock from one side only. The wall clocks' own claim is taken for the"
            f" rest, without an error: let {sender.name} take a topic of {taker.name}"
            " (any, once a second) to have an interval that holds."
        )
    else:
        notes += claim_notes
    middle = np.array([(int(found.starts[0]) + found.ends) // 2], dtype=np.int64)
    piece = found.pieces[max(int(found.piece[found.cell(middle)][0]), 0)]
    line = int(piece.line(middle)[0])
    earlier, later = (int(side[0]) for side in found.errors(middle))
    about = HostInfo(
        name=host.name,
        kernel=host.recording.info.kernel,
        messages_there=counts[0],
        messages_back=counts[1],
        offset_ns=(line - later, line + earlier),
        width_ns=int(np.median(found.above + found.below)),
        drift_ppm=(
            round(min(each.rate for each in found.pieces) * 1e6, 3),
            round(max(each.rate for each in found.pieces) * 1e6, 3),
        ),
        steps=jumps,
        claimed_ns=claimed,
        claim_is=claim,
    )
    return found, about, notes


def _since(found: Corridor, jump: ClockStep) -> str:
    """Text for when a clock jumped, in seconds since the first message."""
    first = int(found.starts[0])
    after, before = ((at - first) / 1e9 for at in (jump.since_ns, jump.until_ns))
    return f"between {after:.3f} and {before:.3f} s after their first message"


def _with_claim(
    hosts: Sequence[_Host],
    number: int,
    upper: OffsetBounds,
    lower: OffsetBounds,
    claimed: int,
) -> tuple[OffsetBounds, OffsetBounds]:
    """Let the wall clocks' claim bound an offset from the side that no message bounds.

    Raises InputError: messages contradict the claim.
    """
    known = upper if len(upper.times) else lower
    wrong = upper.offsets.min() - claimed if len(upper.times) else claimed - lower.offsets.max()
    if wrong < -CLAIM_TOLERANCE_NS:
        names = f"{hosts[0].name} and {hosts[number].name}"
        raise InputError(
            f"{hosts[number].recording.path}: messages between {names} go one way only, and by"
            f" their wall clocks some were taken {milliseconds(-int(wrong))} ms before they were"
            " sent: the clocks are not synchronised, and nothing else says how far they are apart."
            " Synchronise them, or let one node on each host take a topic of the other, and record"
            " again"
        )
    edges = np.array([known.times.min(), known.times.max()], dtype=np.int64)
    at = claimed + min(int(wrong), 0) if len(upper.times) else claimed - min(int(wrong), 0)
    claim = OffsetBounds(edges, np.full(2, at, dtype=np.int64))
    return (known, claim) if len(upper.times) else (claim, known)


def _judged_claim(
    hosts: Sequence[_Host], number: int, found: Corridor, claimed: int
) -> tuple[str, list[str]]:
    """Compare what the wall clocks claim with the corridor; name a synchronisation that lies.

    What each wall clock was over time, the source timestamps of its host's publications show.
    """
    host, reference = hosts[number], hosts[0]
    wall = [_wall_offsets(each) for each in (reference, host)]
    if any(len(times) < 2 for times, _ in wall):
        times = found.starts
        claims = np.full(len(times), claimed, dtype=np.int64)
    else:
        (times, of_reference), (own_times, of_host) = wall
        by_reference = found.converted(own_times)
        inside = (times >= by_reference[0]) & (times <= by_reference[-1])
        times, of_reference = times[inside], of_reference[inside]
        after = np.clip(np.searchsorted(by_reference, times), 1, len(of_host) - 1)
        # Between two publications the wall clock may have been set: then it is not known.
        steady = np.abs(of_host[after] - of_host[after - 1]) <= CLAIM_TOLERANCE_NS
        times, claims = times[steady], (of_reference - of_host[after])[steady]
    if not len(times):
        return "within", []
    cell = found.cell(times)
    certain = found.piece[cell] >= 0
    times, claims = times[certain], claims[certain]
    line = np.zeros(len(times), dtype=np.int64)
    for place, piece in enumerate(found.pieces):
        here = found.piece[found.cell(times)] == place
        line[here] = piece.line(times[here])
    earlier, later = found.errors(times)
    over = claims - (line + earlier) - CLAIM_TOLERANCE_NS
    under = (line - later) - claims - CLAIM_TOLERANCE_NS
    wrong = np.maximum(over, under)
    if not len(wrong) or wrong.max() <= 0:
        return "within", []
    worst = int(np.argmax(wrong))
    share = np.count_nonzero(wrong > 0) / len(wrong)
    truth = claims[worst] - line[worst]
    return "wrong", [
        f"the wall clocks of {reference.name} and {host.name} are not synchronised as they claim:"
        f" by messages they differ by {-truth / 1e6:+.3f} ± "
        f"{milliseconds(int(earlier[worst] + later[worst]) // 2)} ms at the worst, and by more than"
        f" messages allow in {share:.0%} of the time; latencies do not depend on it."
    ]


def _wall_offsets(host: _Host) -> tuple[Times, Times]:
    """Return the wall clock less the clock of events at a host's publications, in order of time."""
    stamped = host.published.drop_nulls().sort("time")
    times = stamped["time"].to_numpy()
    return times, stamped["source_timestamp"].to_numpy() - times


def _instants(recording: Recording) -> Times:
    """Return the instants of a host's callbacks and messages, in order."""
    times = [events.table(recording.events, name)["time"].to_numpy() for name in _SHOWS_GAPS]
    return np.sort(np.concatenate(times))


class JointTables(Mapping[str, pl.DataFrame]):
    """The tables of several hosts as one, converted when they are first used."""

    def __init__(
        self, tables: Sequence[events.EventTables], clocks: Sequence[Corridor | None]
    ) -> None:
        self._tables, self._clocks = tables, clocks
        self._read: dict[str, pl.DataFrame] = {}
        names = dict.fromkeys(name for of_host in tables for name in of_host)
        self._names = (*names, "host_clock")

    def __getitem__(self, name: str) -> pl.DataFrame:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._read:
            self._read[name] = self._joint(name)
        return self._read[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def _joint(self, name: str) -> pl.DataFrame:
        if name == "host_clock":
            parts = [_clock_table(n, clock) for n, clock in enumerate(self._clocks) if clock]
        else:
            parts = [
                moved(of_host[name], name, number, clock)
                for number, (of_host, clock) in enumerate(
                    zip(self._tables, self._clocks, strict=True)
                )
                if name in of_host
            ]
        joined = pl.concat(parts, how="diagonal_relaxed")
        return joined.sort("time", maintain_order=True)


def moved(table: pl.DataFrame, name: str, number: int, clock: Corridor | None) -> pl.DataFrame:
    """Return a host's table with its instants by the reference's clock, and its numbers moved."""
    declared = () if name not in EVENTS else EVENTS[name].fields
    instants = ["time", *(field.name for field in declared if field.kind == "instant")]
    threads = ["pid", "tid"]
    idle = [field.name for field in declared if field.kind == "thread"]
    if number:
        added = number * HOST_STRIDE
        table = table.with_columns(
            *(pl.col(column) + added for column in threads if column in table.columns),
            *(
                pl.when(pl.col(column) != 0).then(pl.col(column) + added).otherwise(column)
                for column in idle
                if column in table.columns
            ),
        )
        if "cpu" in table.columns:
            table = table.with_columns(pl.col("cpu") + number * CORE_STRIDE)
    if clock is not None:
        table = table.with_columns(
            _converted(table[column], clock) for column in instants if column in table.columns
        )
    return table


def _converted(column: pl.Series, clock: Corridor) -> pl.Series:
    """Convert a column of instants; nulls, and numbers that are no instant, stay."""
    times = column.fill_null(0).to_numpy()
    is_instant = times > 0
    converted = times.copy()
    converted[is_instant] = clock.converted(times[is_instant])
    result = pl.Series(column.name, converted, pl.Int64)
    return result.set(column.is_null(), None) if column.null_count() else result


def _clock_table(number: int, clock: Corridor) -> pl.DataFrame:
    """Make the rows of `host_clock` of a host."""
    last = np.array([clock.ends], dtype=np.int64)
    starts = np.concatenate((clock.starts, last))
    cell = clock.cell(starts)
    table = pl.DataFrame(
        {
            "time": starts,
            "host": np.full(len(starts), number),
            "earlier": clock.above[cell],
            "later": clock.below[cell],
            "slack": np.ceil(clock.slack[cell] * 1e9).astype(np.int64),
            "piece": clock.piece[cell],
        }
    )
    nobody = (pl.lit(None).alias(name) for name in ("pid", "tid", "cpu"))
    return events.as_table(table.with_columns(nobody), "host_clock")


def _joint_info(
    infos: Sequence[RecordingInfo],
    clocks: Sequence[Corridor | None],
    hosts: tuple[HostInfo, ...],
    notes: Sequence[str],
) -> RecordingInfo:
    """Describe a joint recording: what single hosts said, with their numbers moved."""
    first = infos[0]
    meters = [info.stall_meter for info in infos]
    chains = {info.chain for info in infos if info.chain is not None}
    with_plan = [info for info in infos if info.plan is not None]
    all_notes = [*notes]
    if with_plan:
        of_hosts = ", ".join(info.host for info in with_plan)
        all_notes.append(
            f"a plan was in force on {of_hosts}: whether its promise was kept is not judged in a"
            " recording of several hosts, but in that of its own host."
        )
    all_notes += [f"{info.host}: {note}" for info in infos for note in info.notes]
    values: dict[str, Any] = {
        "source": _same(info.source for info in infos),
        "host": ", ".join(info.host for info in infos),
        "kernel": _same(info.kernel for info in infos),
        "hosts": hosts,
        "distribution": _same(info.distribution for info in infos),
        "rmw": _same(info.rmw for info in infos),
        "clock_offset_ns": first.clock_offset_ns,
        "processes": {
            pid + number * HOST_STRIDE: name
            for number, info in enumerate(infos)
            for pid, name in info.processes.items()
        },
        "threads": tuple(
            thread.model_copy(
                update={
                    "tid": thread.tid + number * HOST_STRIDE,
                    "pid": thread.pid + number * HOST_STRIDE,
                    "cores": tuple(core + number * CORE_STRIDE for core in thread.cores),
                }
            )
            for number, info in enumerate(infos)
            for thread in info.threads
        ),
        "endpoints": tuple(dict.fromkeys(end for info in infos for end in info.endpoints)),
        "realtime": None
        if any(info.realtime is None for info in infos)
        else all(info.realtime for info in infos),
        "notes": tuple(all_notes),
        "lost": _sum(info.lost for info in infos),
        "trace_events": _sum(info.trace_events for info in infos),
        "stall_meter": _joint_meter([meter for meter in meters if meter is not None], len(infos)),
        "chain": chains.pop() if len(chains) == 1 else None,
        "through": tuple(dict.fromkeys(pair for info in infos for pair in info.through)),
        "worst_ns": tuple(
            int(time)
            for info, clock in zip(infos, clocks, strict=True)
            for time in _by_reference(clock, np.array(info.worst_ns, dtype=np.int64))[0]
        ),
    }
    return RecordingInfo(**values)


def _sum(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    total = Counter[str]()
    for of_host in counts:
        total.update(of_host)
    return dict(total)


def _same(values: Iterator[str | None]) -> Any:
    """Return what all hosts have in common, else a list of their values as text."""
    known = list(dict.fromkeys(value for value in values if value is not None))
    return ", ".join(known) or None


def _joint_meter(meters: Sequence[StallMeterInfo], hosts: int) -> StallMeterInfo | None:
    """Return how all hosts were watched for stalls; None: not all of them were."""
    if len(meters) < hosts:
        return None
    return StallMeterInfo(
        cores=tuple(
            core + number * CORE_STRIDE
            for number, meter in enumerate(meters)
            for core in meter.cores
        ),
        period_ns=max(meter.period_ns for meter in meters),
        threshold_ns=max(meter.threshold_ns for meter in meters),
        wakeups=sum(meter.wakeups for meter in meters),
        median_lateness_ns=tuple(late for meter in meters for late in meter.median_lateness_ns),
        realtime=all(meter.realtime for meter in meters),
    )
