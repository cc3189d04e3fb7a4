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

SETTLING = 0.1  # of a thread's instances, at the start, in which it may be given its core
BOUND = 0.99  # the share of the others that ran on one core, if the thread is bound to it
CONTESTS = 3  # so often a callback must have pre-empted another for its thread to be more urgent


@dataclass(frozen=True)
class Occupation:
    """What callback instances say about threads and cores.

    * ``instances``: those of the flow, in their order, with ``published`` (the first publication
      that counts, null: none), ``before_ns`` and ``after_ns``: CPU time to that publication (else
      to the end) and behind it, null where neither is known. Without CPU times in the recording
      they are response times without those of callbacks that pre-empted it.
    * ``cores``: of each thread, None: bound to none.
    * ``urgency``: of each thread on a core with others, by who pre-empted whom: from 0 upwards,
      larger is more urgent.
    * ``measured``: whether CPU times are in the recording.
    """

    instances: pl.DataFrame
    cores: dict[ThreadKey, int | None]
    urgency: dict[ThreadKey, int]
    measured: bool

    def place(self, thread: ThreadKey) -> tuple[int, ...]:
        """What a thread shares with others, or has for itself: its core, or the thread."""
        core = self.cores.get(thread)
        return thread if core is None else (core,)


def occupation(flow: DataFlow, info: RecordingInfo, published: pl.Series) -> Occupation:
    """See :class:`Occupation`. ``published`` is, by instance, the publication that counts (ns)."""
    cores = thread_cores(flow, info)
    frame = flow.instances.with_columns(published=published)
    inner = {key: np.zeros(len(frame), np.int64) for key in ("before", "after")}
    contests = Counter[tuple[ThreadKey, ThreadKey]]()
    for rows in _by_place(frame, cores).values():
        _add_preemptions(frame, rows, inner, contests)
    until = pl.coalesce("published", "end")
    response = (until - pl.col("start")) - pl.Series(inner["before"])
    behind = (pl.col("end") - pl.col("published")).fill_null(0) - pl.Series(inner["after"])
    frame = frame.with_columns(after_ns=behind.clip(0), response_ns=response.clip(0))
    used = (pl.col("execution_ns") - pl.col("after_ns")).clip(0)
    frame = frame.with_columns(before_ns=pl.coalesce(used, "response_ns")).drop("response_ns")
    measured = bool(flow.instances["execution_ns"].count())
    return Occupation(frame, cores, _urgency(contests), measured)


def thread_cores(flow: DataFlow, info: RecordingInfo) -> dict[ThreadKey, int | None]:
    """The core that each thread which runs callbacks is bound to; None: it is bound to none."""
    starts = events.table(flow.events, "callback_start").select("pid", "tid", "cpu")
    starts = starts.drop_nulls()
    found: dict[ThreadKey, int | None] = {}
    threads = flow.instances.select("pid", "tid").unique(maintain_order=True)
    found = dict.fromkeys(((pid, tid) for pid, tid in threads.iter_rows()), None)
    for (pid, tid), own in starts.group_by("pid", "tid", maintain_order=True):
        settled = own["cpu"][int(SETTLING * len(own)) :]
        core, count = Counter(settled.to_list()).most_common(1)[0]
        if count >= BOUND * len(settled):
            found[int(str(pid)), int(str(tid))] = int(core)
    for thread in info.threads:
        if (thread.pid, thread.tid) in found:
            single = thread.cores[0] if len(thread.cores) == 1 else None
            found[thread.pid, thread.tid] = single
    return found


def _by_place(
    frame: pl.DataFrame, cores: dict[ThreadKey, int | None]
) -> dict[tuple[int, ...], list[int]]:
    """The instances on each core, or of each thread that is bound to none: in order of start."""
    found: dict[tuple[int, ...], list[int]] = {}
    for row, thread in enumerate(frame.select("pid", "tid").iter_rows()):
        core = cores.get(thread)
        found.setdefault(thread if core is None else (core,), []).append(row)
    return found


def _add_preemptions(
    frame: pl.DataFrame,
    rows: list[int],
    inner: dict[str, np.ndarray[tuple[int], np.dtype[np.int64]]],
    contests: Counter[tuple[ThreadKey, ThreadKey]],
) -> None:
    """Add, for the instances of a place, how long others ran inside of each, and whose they were."""
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
    """How long each message took to its callback: ``publication, instance, delay_ns, kept_ns,
    by_thread``.

    ``delay_ns`` is from its sending to the callback's start. Where another callback had the core or
    the thread meanwhile, ``kept_ns`` is the part until the last of these ended (null: none had),
    and ``by_thread`` whether that was one of the same thread.
    """
    sent = flow.publications.select("publication", "sent", by="instance")
    starts = found.instances.select("instance", "callback_id", "pid", "tid", "start")
    hops = flow.takes.select("publication", "instance").drop_nulls()
    hops = hops.join(sent, on="publication").join(starts, on="instance").drop_nulls("sent")
    kept = np.full(len(hops), -1, np.int64)
    same = np.zeros(len(hops), bool)
    ends = found.instances["end"]
    threads = found.instances.select("pid", "tid").rows()
    places = _by_place(found.instances, found.cores)
    hop_rows: dict[tuple[int, ...], list[int]] = {}
    for row, thread in enumerate(hops.select("pid", "tid").iter_rows()):
        hop_rows.setdefault(found.place(thread), []).append(row)
    for place, rows in hop_rows.items():
        ended = [(ends[one], one) for one in places[place] if ends[one] is not None]
        ended.sort()
        times = np.array([time for time, _ in ended], np.int64)
        for row in rows:
            _, _, left, by, _, pid, tid, start = hops.row(row)
            last = int(np.searchsorted(times, start, "right")) - 1
            if last < 0 or ended[last][0] <= left or ended[last][1] == by:
                continue
            kept[row], same[row] = ended[last][0] - left, threads[ended[last][1]] == (pid, tid)
    known = pl.Series(kept)
    return hops.select(
        *("publication", "instance", "callback_id"),
        delay_ns=pl.col("start") - pl.col("sent"),
        kept_ns=known.set(known < 0, None),
        by_thread=pl.Series(same),
    )


def publication_that_counts(flow: DataFlow, topics: frozenset[str]) -> pl.Series:
    """By instance, when it first published on one of ``topics``, else on any (ns; null: never)."""
    own = flow.publications.drop_nulls("instance")
    chosen = own.with_columns(off=~pl.col("topic").cast(pl.String).is_in([*topics]))
    first = chosen.sort("off", "time").unique("instance", keep="first", maintain_order=True)
    return by_number(first, "instance", "time", flow.instances.height)
