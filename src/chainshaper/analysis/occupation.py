"""Which thread had which core when: cores of threads, who pre-empted whom, who kept whom waiting.

Without `sched_switch` a callback's events are all that is known of its thread. They are enough
where threads stay on one core each: a callback that begins and ends inside another one on the same
core has pre-empted it, and one that ends while a message waits there has kept it waiting.
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

SETTLING = 0.1  # of a thread's time, at the start, in which it may be given its core
BOUND = 0.99  # the share of the others that ran on one core, if the thread is bound to it
_SHARES = (("execution_ns",), ("before_ns", "after_ns"))
CONTESTS = 3  # so often a callback must have pre-empted another for its thread to be more urgent


@dataclass(frozen=True)
class Occupation:
    """What callback instances say about threads and cores.

    * ``instances``: those of the flow, in their order, with ``published`` (the first publication
      that counts, null: none), ``before_ns`` and ``after_ns``: from the start to it (else to the
      end) and behind it, without callbacks that pre-empted it; null where the end is not known.
    * ``cores``: of each thread, None: bound to none.
    * ``urgency``: of each thread on a core with others, by who pre-empted whom: from 0 upwards,
      larger is more urgent.
    * ``places``: the numbers of the instances on each core to which threads are bound, and of each
      thread elsewhere, in order of start.
    * ``settled_ns``: from when on threads that are bound to a core ran on it only.
    * ``others``: the share of these times in which the callbacks' threads did not run: interrupts,
      threads without callbacks, the machine. None: no CPU times are in the recording.
    """

    instances: pl.DataFrame
    cores: dict[ThreadKey, int | None]
    urgency: dict[ThreadKey, int]
    places: dict[tuple[int, ...], list[int]]
    settled_ns: int
    others: float | None


def occupation(flow: DataFlow, info: RecordingInfo, published: pl.Series) -> Occupation:
    """See :class:`Occupation`. ``published`` is, by instance, the publication that counts (ns)."""
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
    used, had = (int(known.select(pl.sum_horizontal(*part).sum()).item() or 0) for part in _SHARES)
    share = max(0.0, 1 - used / had) if had else None
    return Occupation(frame, cores, _urgency(contests), places, settled_ns, share)


def thread_cores(flow: DataFlow, info: RecordingInfo) -> dict[ThreadKey, int | None]:
    """The core that each thread which runs callbacks is bound to; None: it is bound to none."""
    starts = events.table(flow.events, "callback_start").select("time", "pid", "tid", "cpu")
    starts = starts.drop_nulls()
    found: dict[ThreadKey, int | None] = {}
    threads = flow.instances.select("pid", "tid").unique(maintain_order=True)
    found = dict.fromkeys(((pid, tid) for pid, tid in threads.iter_rows()), None)
    for (pid, tid), own in starts.group_by("pid", "tid", maintain_order=True):
        begun, over = int(own["time"][0]), int(own["time"][-1])
        settled = own.filter(pl.col("time") >= begun + SETTLING * (over - begun))["cpu"]
        core, count = Counter(settled.to_list()).most_common(1)[0]
        if count >= BOUND * len(settled):
            found[int(str(pid)), int(str(tid))] = int(core)
    for thread in info.threads:
        if (thread.pid, thread.tid) in found:
            single = thread.cores[0] if len(thread.cores) == 1 else None
            found[thread.pid, thread.tid] = single
    return found


def _places(
    flow: DataFlow, cores: dict[ThreadKey, int | None]
) -> tuple[dict[tuple[int, ...], list[int]], int]:
    """The ``places`` and ``settled_ns`` of an :class:`Occupation`."""
    starts = events.table(flow.events, "callback_start").select("pid", "tid", "cpu", start="time")
    starts = starts.unique(["pid", "tid", "start"], keep="first")
    ran = flow.instances.select("pid", "tid", "start")
    ran = ran.join(starts, on=["pid", "tid", "start"], how="left", maintain_order="left")
    found: dict[tuple[int, ...], list[int]] = {}
    settled_ns = 0
    for row, (pid, tid, start, cpu) in enumerate(ran.iter_rows()):
        core = cores.get((pid, tid))
        elsewhere = core is None or cpu not in (None, core)
        found.setdefault((pid, tid) if core is None or elsewhere else (core,), []).append(row)
        if core is not None and elsewhere:
            settled_ns = start + 1
    return found, settled_ns


def _add_preemptions(
    frame: pl.DataFrame,
    rows: list[int],
    inner: dict[str, np.ndarray[tuple[int], np.dtype[np.int64]]],
    contests: Counter[tuple[ThreadKey, ThreadKey]],
) -> None:
    """Add how long others ran inside of each instance of a place, and whose threads they were."""
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
    """Ranks in which every thread is above those that it pre-empted, but for single cases."""
    above = {
        (winner, loser)
        for (winner, loser), count in contests.items()
        if count >= CONTESTS and count > 10 * contests[loser, winner]
    }
    ranks = dict.fromkeys((thread for pair in contests for thread in pair), 0)
    for _ in ranks:  # longest paths, and no longer ones where it goes round in a circle
        for winner, loser in above:
            ranks[winner] = min(len(ranks), max(ranks[winner], ranks[loser] + 1))
    return ranks


def deliveries(flow: DataFlow, found: Occupation) -> pl.DataFrame:
    """How long each message took to its callback: ``publication, instance, callback_id, delay_ns,
    before_ns, kept_ns, by_thread``.

    ``delay_ns`` is from its sending to the callback's start. Where another callback had the core or
    the thread meanwhile, ``before_ns`` and ``kept_ns`` are the parts until the last of these began
    (0: before the sending) and ended (null: none had), and ``by_thread`` whether that was one of
    the same thread.
    """
    sent = flow.publications.select("publication", "sent", by="instance")
    starts = found.instances.select("instance", "callback_id", "pid", "tid", "start")
    hops = flow.takes.select("publication", "instance").drop_nulls()
    hops = hops.join(sent, on="publication").join(starts, on="instance").drop_nulls("sent")
    kept, before = np.full((2, len(hops)), -1, np.int64)
    same = np.zeros(len(hops), bool)
    begins, ends = found.instances["start"], found.instances["end"]
    threads = found.instances.select("pid", "tid").rows()
    place_of = {row: place for place, own in found.places.items() for row in own}
    hop_rows: dict[tuple[int, ...], list[int]] = {}
    for row, instance in enumerate(hops["instance"]):
        hop_rows.setdefault(place_of[instance], []).append(row)
    for place, rows in hop_rows.items():
        ended = [(ends[one], one) for one in found.places[place] if ends[one] is not None]
        ended.sort()
        times = np.array([time for time, _ in ended], np.int64)
        for row in rows:
            _, _, left, by, _, pid, tid, start = hops.row(row)
            last = int(np.searchsorted(times, start, "right")) - 1
            if last < 0 or ended[last][0] <= left or ended[last][1] == by:
                continue
            kept[row], same[row] = ended[last][0] - left, threads[ended[last][1]] == (pid, tid)
            before[row] = max(0, begins[ended[last][1]] - left)
    known = pl.Series(kept)
    return hops.select(
        *("publication", "instance", "callback_id"),
        delay_ns=pl.col("start") - pl.col("sent"),
        before_ns=pl.Series(before).set(known < 0, None),
        kept_ns=known.set(known < 0, None),
        by_thread=pl.Series(same),
    )


def taken_first(flow: DataFlow, found: Occupation) -> Counter[tuple[int, int]]:
    """How often a callback got its message before another one, to which an older message went.

    Both waited then, and the executor looks at that callback first.
    """
    hops = deliveries(flow, found)
    starts = found.instances.select("instance", "pid", "tid", "start")
    hops = hops.join(starts, on="instance").sort("pid", "tid", "start")
    hops = hops.with_columns(sent=pl.col("start") - pl.col("delay_ns"))
    after = hops.select("pid", "tid", "callback_id", "sent").shift(-1)
    same = (hops["pid"] == after["pid"]) & (hops["tid"] == after["tid"])
    older = same & (after["sent"] < hops["sent"]) & (after["callback_id"] != hops["callback_id"])
    pairs = zip(hops["callback_id"], after["callback_id"], older.fill_null(False), strict=True)
    return Counter((one, other) for one, other, overtook in pairs if overtook)


def publication_that_counts(flow: DataFlow, topics: frozenset[str]) -> pl.Series:
    """By instance, when it first published on one of ``topics``, else on any (ns; null: never)."""
    own = flow.publications.drop_nulls("instance")
    chosen = own.with_columns(off=~pl.col("topic").cast(pl.String).is_in([*topics]))
    first = chosen.sort("off", "time").unique("instance", keep="first", maintain_order=True)
    return by_number(first, "instance", "time", flow.instances.height)
