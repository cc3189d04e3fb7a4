"""Which thread had which core when, which pre-empted which, and which made messages wait.

Without `sched_switch`, the events of its callbacks are all that is known of a thread. They suffice
where each thread stays on one core: a callback that begins and ends inside another one on the same
core has pre-empted it, and one that ends while a message waits there has made it wait.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.matching import by_number
from chainshaper.values import events
from chainshaper.values.recording import RecordingInfo

ThreadKey = tuple[int, int]
"""A thread: its process's id and its own."""

SETTLING = 0.1  # share of a thread's time, at its start, in which it may be given its core
BOUND = 0.99  # share of the starts after that on one core from which the thread is bound to it
CONTESTS = 3  # how often a thread must have pre-empted another one to be more urgent


@dataclass(frozen=True)
class Occupation:
    """What callback instances show about threads and cores.

    * ``instances``: the frame of the flow, in its order, with three more columns. ``published``:
      when the instance first published what counts (ns, null: never). ``before_ns``: from its start
      until then, or else until its end; ``after_ns``: from then until its end; both without
      callbacks that pre-empted it, null where the end is not known.
    * ``cores``: the core that each thread is bound to (None: to none).
    * ``urgency``: for each thread that shares a core, how urgent it is: from 0 upwards, by which
      thread pre-empted which.
    * ``places``: the numbers of the instances on each core to which threads are bound (``(core,)``)
      and of each thread elsewhere (``(pid, tid)``), in order of start.
    * ``settled_ns``: the instant since which bound threads ran on their core only.
    * ``others``: the share of the instances' time in which their threads did not run, because of
      interrupts, threads without callbacks, or the machine. None: the recording has no CPU times.
    """

    instances: pl.DataFrame
    cores: dict[ThreadKey, int | None]
    urgency: dict[ThreadKey, int]
    places: dict[tuple[int, ...], list[int]]
    settled_ns: int
    others: float | None


def occupation(flow: DataFlow, info: RecordingInfo, published: pl.Series) -> Occupation:
    """Find out which thread had which core when.

    ``published`` is, by instance, when it first published what counts (ns, null: never).
    """
    cores = thread_cores(flow, info)
    frame = flow.instances.with_columns(published=published)
    places, settled_ns = _places(flow, cores)
    inner = {key: np.zeros(len(frame), np.int64) for key in ("before", "after")}
    contests = Counter[tuple[ThreadKey, ThreadKey]]()
    for rows in places.values():
        _add_preemptions(frame, rows, inner, contests)
    until = pl.coalesce("published", "end")
    response = (until - pl.col("start")) - pl.Series(inner["before"])
    behind = (pl.col("end") - pl.col("published")).fill_null(0) - pl.Series(inner["after"])
    frame = frame.with_columns(before_ns=response.clip(0), after_ns=behind.clip(0))
    known = frame.drop_nulls(["execution_ns", "before_ns"])
    used_ns = int(known["execution_ns"].sum())
    had_ns = int(known.select(pl.sum_horizontal("before_ns", "after_ns").sum()).item() or 0)
    return Occupation(
        instances=frame,
        cores=cores,
        urgency=_urgency(contests),
        places=places,
        settled_ns=settled_ns,
        others=max(0.0, 1 - used_ns / had_ns) if had_ns else None,
    )


def _starts(tables: events.EventTables) -> pl.DataFrame:
    """Return when callbacks and instances of loops started, in which thread and on which core."""
    columns = ("time", "pid", "tid", "cpu")
    started = events.table(tables, "callback_start", ["cpu"]).select(columns)
    woke = events.table(tables, "thread_wake", ["cpu"]).filter(pl.col("call") != 0).select(columns)
    return pl.concat([started, woke]).sort("time", maintain_order=True) if len(woke) else started


def thread_cores(flow: DataFlow, info: RecordingInfo) -> dict[ThreadKey, int | None]:
    """Map each thread that runs callbacks to the core that it is bound to; None: to none."""
    starts = _starts(flow.events).drop_nulls()
    threads = flow.instances.select("pid", "tid").unique(maintain_order=True)
    cores: dict[ThreadKey, int | None]
    cores = dict.fromkeys(((pid, tid) for pid, tid in threads.iter_rows()), None)
    for (pid, tid), of_thread in starts.group_by("pid", "tid", maintain_order=True):
        begun, over = int(of_thread["time"][0]), int(of_thread["time"][-1])
        settled = of_thread.filter(pl.col("time") >= begun + SETTLING * (over - begun))["cpu"]
        core, count = Counter(settled.to_list()).most_common(1)[0]
        if count >= BOUND * len(settled):
            cores[int(str(pid)), int(str(tid))] = int(core)
    for thread in info.threads:
        if (thread.pid, thread.tid) in cores:
            single = thread.cores[0] if len(thread.cores) == 1 else None
            cores[thread.pid, thread.tid] = single
    return cores


def _places(
    flow: DataFlow, cores: dict[ThreadKey, int | None]
) -> tuple[dict[tuple[int, ...], list[int]], int]:
    """Return the ``places`` and ``settled_ns`` of an :class:`Occupation`."""
    starts = _starts(flow.events).rename({"time": "start"})
    starts = starts.unique(["pid", "tid", "start"], keep="first")
    ran = flow.instances.select("pid", "tid", "start")
    ran = ran.join(starts, on=["pid", "tid", "start"], how="left", maintain_order="left")
    places: dict[tuple[int, ...], list[int]] = {}
    settled_ns = 0
    for row, (pid, tid, start, cpu) in enumerate(ran.iter_rows()):
        core = cores.get((pid, tid))
        elsewhere = core is None or cpu not in (None, core)
        places.setdefault((pid, tid) if core is None or elsewhere else (core,), []).append(row)
        if core is not None and elsewhere:
            settled_ns = start + 1
    return places, settled_ns


def _add_preemptions(
    frame: pl.DataFrame,
    rows: list[int],
    inner: dict[str, np.ndarray[tuple[int], np.dtype[np.int64]]],
    contests: Counter[tuple[ThreadKey, ThreadKey]],
) -> None:
    """Add how long callbacks of other threads ran inside each instance of a place.

    ``rows`` are the instances there, in order of start. ``inner`` gets these times (ns), before and
    after the instance published; ``contests`` how often which thread pre-empted which.
    """
    columns = frame.select("pid", "tid", "start", "end", "published")
    open_rows: list[tuple[int, int, ThreadKey, int | None]] = []
    for row in rows:
        pid, tid, start, end, published = columns.row(row)
        if end is None:
            continue
        while open_rows and open_rows[-1][0] <= start:
            open_rows.pop()
        if open_rows and open_rows[-1][0] >= end and open_rows[-1][2] != (pid, tid):
            _, outer, thread, left = open_rows[-1]
            part = "before" if left is None or start < left else "after"
            inner[part][outer] += end - start
            contests[(pid, tid), thread] += 1
        open_rows.append((end, row, (pid, tid), published))


def _urgency(contests: Counter[tuple[ThreadKey, ThreadKey]]) -> dict[ThreadKey, int]:
    """Rank threads so that each is above those that it pre-empted, but for rare cases."""
    above = {
        (winner, loser)
        for (winner, loser), count in contests.items()
        if count >= CONTESTS and count > 10 * contests[loser, winner]
    }
    ranks = dict.fromkeys((thread for pair in contests for thread in pair), 0)
    for _ in ranks:  # the longest path below each thread; a circle ends with the loop
        for winner, loser in above:
            ranks[winner] = min(len(ranks), max(ranks[winner], ranks[loser] + 1))
    return ranks


def deliveries(flow: DataFlow, occupied: Occupation) -> pl.DataFrame:
    """Make a frame of how long each message took to its callback. Columns:

    * ``publication``, ``instance``, ``callback_id``.
    * ``delay_ns``: from its sending to the callback's start.

    Of the last callback that had the core, or the thread, during this time (null: none had):

    * ``before_ns``: from the sending until it began (0: it began before).
    * ``kept_ns``: from the sending until it ended.
    * ``by_thread``: whether it ran on the same thread as the message's callback.
    """
    sent = flow.publications.select("publication", "sent", by="instance")
    starts = occupied.instances.select("instance", "callback_id", "pid", "tid", "start")
    hops = flow.takes.select("publication", "instance").drop_nulls()
    hops = hops.join(sent, on="publication").join(starts, on="instance").drop_nulls("sent")
    kept_ns, before = np.full((2, len(hops)), -1, np.int64)
    by_same_thread = np.zeros(len(hops), bool)
    begins, ends = occupied.instances["start"], occupied.instances["end"]
    threads = occupied.instances.select("pid", "tid").rows()
    place_of = {row: place for place, of_place in occupied.places.items() for row in of_place}
    hop_rows: dict[tuple[int, ...], list[int]] = {}
    for row, instance in enumerate(hops["instance"]):
        hop_rows.setdefault(place_of[instance], []).append(row)
    for place, rows in hop_rows.items():
        instances = occupied.places[place]
        ended = sorted((ends[number], number) for number in instances if ends[number] is not None)
        times = np.array([time for time, _ in ended], np.int64)
        for row in rows:
            _, _, sent_ns, publishing, _, pid, tid, start = hops.row(row)
            place_of_last = int(np.searchsorted(times, start, "right")) - 1
            if place_of_last < 0:
                continue
            last_end_ns, last = ended[place_of_last]
            if last_end_ns <= sent_ns or last == publishing:
                continue
            before[row] = max(0, begins[last] - sent_ns)
            kept_ns[row] = last_end_ns - sent_ns
            by_same_thread[row] = threads[last] == (pid, tid)
    known = pl.Series(kept_ns)
    return hops.select(
        *("publication", "instance", "callback_id"),
        delay_ns=pl.col("start") - pl.col("sent"),
        before_ns=pl.Series(before).set(known < 0, None),
        kept_ns=known.set(known < 0, None),
        by_thread=pl.Series(by_same_thread),
    )


def taken_first(flow: DataFlow, occupied: Occupation) -> Counter[tuple[int, int]]:
    """Count how often a callback got its message before another one with an older message.

    Both messages waited, so the executor looks at the first of the two callbacks first.
    """
    hops = deliveries(flow, occupied)
    starts = occupied.instances.select("instance", "pid", "tid", "start")
    hops = hops.join(starts, on="instance").sort("pid", "tid", "start")
    hops = hops.with_columns(sent=pl.col("start") - pl.col("delay_ns"))
    after = hops.select("pid", "tid", "callback_id", "sent").shift(-1)
    same = (hops["pid"] == after["pid"]) & (hops["tid"] == after["tid"])
    older = same & (after["sent"] < hops["sent"]) & (after["callback_id"] != hops["callback_id"])
    pairs = zip(hops["callback_id"], after["callback_id"], older.fill_null(False), strict=True)
    return Counter((callback, passed_over) for callback, passed_over, overtook in pairs if overtook)


def publication_that_counts(flow: DataFlow, topics: frozenset[str]) -> pl.Series:
    """When each instance first published on one of ``topics``, else on any (ns; null: never)."""
    inside = flow.publications.drop_nulls("instance")
    chosen = inside.with_columns(off=~pl.col("topic").cast(pl.String).is_in([*topics]))
    first = chosen.sort("off", "time").unique("instance", keep="first", maintain_order=True)
    return by_number(first, "instance", "time", flow.instances.height)
