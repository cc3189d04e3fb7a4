"""What was recorded where and how: the part of the report that makes its figures believable."""

from collections import Counter
from collections.abc import Sequence
from datetime import datetime, timezone

import polars as pl

from chainshaper.reporting.html.markup import details, listed, table
from chainshaper.reporting.html.told import Told
from chainshaper.values.recording import Recording, ThreadInfo, event_counts, lost_text
from chainshaper.verify.measure import Measurement

__all__ = ["condition_tables", "note_lists"]

UNKNOWN = "unknown"


def condition_tables(told: Sequence[Told]) -> str:
    """One column per recording; threads, as the kernel reported them, below."""
    measurements = [one.measurement for one in told]
    recordings = [measurement.recording for measurement in measurements]
    infos = [recording.info for recording in recordings]
    every = list(range(1, len(told) + 1))
    rows = [
        ["folder", *(str(recording.path) for recording in recordings)],
        ["first cycle", *(_begun(measurement) for measurement in measurements)],
        ["source", *(info.source for info in infos)],
        ["host", *(info.host or UNKNOWN for info in infos)],
        ["kernel", *(info.kernel or UNKNOWN for info in infos)],
        ["ROS 2 distribution", *(info.distribution or UNKNOWN for info in infos)],
        ["RMW", *(info.rmw or UNKNOWN for info in infos)],
        ["command", *(" ".join(info.command) or UNKNOWN for info in infos)],
        ["real-time scheduling", *(_YES_NO[info.realtime] for info in infos)],
        ["scheduling in force", *(_scheduling(info.threads) for info in infos)],
        ["machine watched for stalls", *(_watched(recording) for recording in recordings)],
        ["events", *(f"{_events(recording):,}" for recording in recordings)],
        ["events lost", *(lost_text(info.lost).partition(": ")[2] for info in infos)],
        ["plan in force", *(_plan(measurement) for measurement in measurements)],
    ]
    threads = [
        details(f"Threads of {one.name} ({len(info.threads)})", _threads(info.threads))
        for one, info in zip(told, infos, strict=True)
        if info.threads
    ]
    return "\n".join([table(["", *(one.name for one in told)], rows, words=every), *threads])


def note_lists(told: Sequence[Told]) -> str:
    """What a reader of the figures must know, recording by recording."""
    notes = [(one.name, dict.fromkeys(one.measurement.analysis.notes)) for one in told]
    return listed([f"{name}: {note}" for name, own in notes for note in own])


_YES_NO = {True: "yes", False: "no", None: UNKNOWN}


def _begun(measurement: Measurement) -> str:
    """When the first cycle began, and for how long cycles went on beginning."""
    starts = measurement.analysis.traversals["start"]
    if not len(starts):
        return "none"
    offset = measurement.recording.info.clock_offset_ns
    first = datetime.fromtimestamp((starts[0] + offset) / 1e9, tz=timezone.utc)
    lasted = (starts[-1] - starts[0]) / 1e9
    return f"{first:%Y-%m-%d %H:%M:%S} UTC, {len(starts)} cycles in {lasted:.1f} s"


def _scheduling(threads: Sequence[ThreadInfo]) -> str:
    kinds = Counter(
        (thread.role, thread.policy, thread.priority, thread.cores) for thread in threads
    )
    return (
        "\n".join(
            f"{role}: {policy} {priority}, {_cores(cores)} ({count})"
            for (role, policy, priority, cores), count in sorted(kinds.items())
        )
        or UNKNOWN
    )


def _cores(cores: Sequence[int]) -> str:
    return f"core{'' if len(cores) == 1 else 's'} {', '.join(map(str, cores))}"


def _watched(recording: Recording) -> str:
    meter = recording.info.stall_meter
    if meter is None:
        return "no: disturbed cycles are not known"
    own = "" if meter.realtime else ", itself open to pre-emption"
    return (
        f"every {meter.period_ns / 1e6:g} ms on {_cores(meter.cores)}{own}; stalls from "
        f"{meter.threshold_ns / 1e6:g} ms"
    )


def _events(recording: Recording) -> int:
    return int(event_counts(recording).select(pl.col("count").sum()).item())


def _plan(measurement: Measurement) -> str:
    plan = measurement.plan
    return "none" if plan is None else f"{plan.policy}, for {plan.chain.spec or 'a chain'}"


def _threads(threads: Sequence[ThreadInfo]) -> str:
    rows = [
        [
            thread.node,
            thread.comm,
            thread.role,
            str(thread.pid),
            str(thread.tid),
            f"{thread.policy} {thread.priority}",
            ", ".join(map(str, thread.cores)),
        ]
        for thread in sorted(threads, key=lambda thread: (thread.node, thread.tid))
    ]
    head = ["node", "thread", "role", "pid", "tid", "scheduling", "cores"]
    return table(head, rows, words=[1, 2, 5])
