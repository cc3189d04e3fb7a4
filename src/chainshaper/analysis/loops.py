"""Loops: threads that sleep, wake up, compute, and sleep again, outside all callbacks.

ros2_control's update thread, a `rclcpp::Rate`, a `while` loop in Python: the last stage of most
robots is no callback. The tracing library in front of ROS 2 records when such a thread goes to
sleep and wakes up (`thread_sleep`, `thread_wake`).

* **A turn** is what lies between two sleeps of a thread. It is an instance of the loop. A wait
  without a time (`pthread_cond_wait`) counts only in a thread that hardly sleeps otherwise.
* **A loop** is a thread that publishes outside callbacks, or that the user named. One that
  publishes for several nodes is a loop of each. Topics that are never published in the same turn
  belong to different loops of one thread: each has the turns in which it published.
* **In Python** no event shows where a callback ends. What is published again, turns after the
  message that its thread took last, is not that callback's: a loop publishes it.
* **A loop that is paced by data** mostly wakes up before the time for which it wanted to sleep,
  waits without one, or neither sleeps nor computes for most of its period. Its publications count
  as those of a thread that no sleep explains; a note says so.
* **A named loop** (`loop_named`) may publish nothing, as one that writes to hardware. The end of
  each of its turns counts as a publication on ``NODE:end``, so that a chain can end there.
* **The loop of ros2_control** is known without being named
  (:mod:`~chainshaper.analysis.manager_loops`).

Without events of sleeps (LTTng, eBPF, older recordings) a thread that publishes regularly counts as
a loop whose turn begins with its publication (:func:`seems_regular`).
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.manager_loops import manager_turns
from chainshaper.analysis.matching import by_number, latest_before
from chainshaper.analysis.objects import CALLBACK_SCHEMA, Objects, named_loops
from chainshaper.analysis.periods import FEWEST, MOSTLY, REGULAR, roundest_period
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS, LOOP_END, MANAGER_WRITE
from chainshaper.values.durations import duration_text
from chainshaper.values.event_declarations import SLEEPING_CALLS

_THREAD = ["pid", "tid"]
_TIMED_SHARE = 0.5  # of a loop's turns: so many must begin when the time to sleep was over
_BLOCKED = 0.5  # share of its period that a loop waits at most, awake and without computing
_EARLY = 0.05  # share of a sleep by which it may end early: not every middleware's clock is ours
_EXACT = 0.01  # share of its period by which the instants until which a loop sleeps are off it
_CHOSEN = 0.5  # of these instants, more must be so exactly a period apart
_FOR_A_TIME = [SLEEPING_CALLS.index(name) for name in ("clock_nanosleep", "nanosleep", "timerfd")]
"""Calls by which a thread can only sleep, not wait for something."""
_UNTIMED = SLEEPING_CALLS.index("pthread_cond_wait")
_LOOK_NS = 100_000  # a wait until an instant that is over, by no more than this, is a look
_ALONE = 0.1  # other sleeps of a thread, for each of its waits without a time


@dataclass(frozen=True)
class _Loop:
    """A loop that was found: of which node, in which threads, and what it publishes."""

    pid: int
    node: str
    topics: tuple[str, ...]
    tids: tuple[int, ...]
    named: bool = False
    is_manager: bool = False  # of ros2_control


@dataclass(frozen=True)
class FlowWithLoops:
    """The frames of a data flow to which loops were added, and ``turns``.

    ``turns`` has a row for each instance of a loop: ``instance``, ``due`` (ns: until when the
    thread had wanted to sleep before it; null: not known), ``overran`` (whether it ended when the
    next one should have begun; null: not known), ``reads`` (ns: when it read what was stored; null:
    at its start).
    """

    objects: Objects
    instances: pl.DataFrame
    published: pl.DataFrame
    turns: pl.DataFrame


NO_TURNS = pl.DataFrame(
    schema={"instance": pl.UInt32, "due": pl.Int64, "overran": pl.Boolean, "reads": pl.Int64},
)


def thread_turns(tables: events.EventTables) -> pl.DataFrame:
    """Make a frame of what lies between two sleeps of a thread, sorted by start. Columns:

    * ``turn``: numbered from 0.
    * ``pid``, ``tid``.
    * ``start``, ``end``: when the thread woke up, and went to sleep again (ns; ``end`` is null
      where it did not, or the event was lost).
    * ``due``: until when it had wanted to sleep (ns; null: not known).
    * ``wanted_ns``: for how long it had wanted to sleep.
    * ``left_ns``: how long it wanted to sleep behind ``end``; 0 or less: the time was over already.
    * ``call``: by which function it had slept, a place in SLEEPING_CALLS.
    * ``execution_ns``: its CPU time between the two.
    """
    columns = ["time", *_THREAD, "call", "thread_time"]
    sleeps = events.table(tables, "thread_sleep", ["thread_time"]).select(
        *columns, pl.when(pl.col("until") > 0).then("until").alias("until"), wakes=pl.lit(False)
    )
    wakes = events.table(tables, "thread_wake", ["thread_time"]).filter(pl.col("call") != 0)
    wakes = wakes.select(*columns, until=pl.lit(None, pl.Int64), wakes=pl.lit(True))
    rows = pl.concat([sleeps, wakes]).sort(*_THREAD, "time", "wakes", maintain_order=True)
    # Middlewares wait without a time inside a publication, too. So such waits are between turns
    # only in a thread that hardly sleeps otherwise.
    untimed = (pl.col("call") == _UNTIMED).fill_null(False)
    others = (~untimed & ~pl.col("wakes")).sum().over(_THREAD)
    rows = rows.filter(~untimed | (others <= _ALONE * untimed.sum().over(_THREAD)))
    # A thread that looks whether there is work (`spin_some`) waits until now: it does not sleep.
    over_by = pl.col("time") - pl.col("until")
    looks = over_by.is_between(0, _LOOK_NS) & ~pl.col("call").is_in(_FOR_A_TIME)
    rows = rows.with_columns(looks=looks.fill_null(False))
    rows = rows.filter(~pl.col("looks") & ~pl.col("looks").shift(1, fill_value=False).over(_THREAD))

    def beside(column: str, places: int) -> pl.Expr:
        """Return the column of the thread's sleep before (1) or after (-1) a row."""
        is_sleep = ~pl.col("wakes").shift(places).over(_THREAD).fill_null(True)
        return pl.when(is_sleep).then(pl.col(column).shift(places).over(_THREAD))

    turns = rows.select(
        *("wakes", *_THREAD, "call"),
        start="time",
        end=beside("time", -1),
        due=beside("until", 1),
        wanted_ns=beside("until", 1) - beside("time", 1),
        left_ns=beside("until", -1) - beside("time", -1),
        execution_ns=beside("thread_time", -1) - pl.col("thread_time"),
    )
    turns = turns.filter("wakes").drop("wakes").sort("start", maintain_order=True)
    return turns.with_row_index("turn")


def _all_turns(tables: events.EventTables, nodes: pl.DataFrame) -> pl.DataFrame:
    """Return :func:`thread_turns`, where those of managers are theirs: with columns for these.

    They are ``reads``, ``waits_in`` and ``manager`` (the node) of
    :func:`~chainshaper.analysis.manager_loops.manager_turns`.
    """
    turns, of_managers = thread_turns(tables), manager_turns(tables, nodes)
    turns = turns.join(of_managers.select(_THREAD).unique(), on=_THREAD, how="anti")
    both = pl.concat([turns.drop("turn"), of_managers], how="diagonal_relaxed")
    return both.sort("start", maintain_order=True).with_row_index("turn")


def with_loops(
    objects: Objects, instances: pl.DataFrame, published: pl.DataFrame, tables: events.EventTables
) -> FlowWithLoops:
    """Add a callback for each loop, an instance for each of its turns, and the ends of named ones.

    The new instances and publications come last.
    """
    turns = _all_turns(tables, objects.nodes)
    if turns.is_empty():
        return FlowWithLoops(objects, instances, published, NO_TURNS)
    published = _without_repeats(published, turns, instances)
    outside = _outside(published, turns)
    loops, notes = _loops(outside, turns, tables, objects)
    last: int | None = objects.callbacks.select(pl.col("callback_id").max()).item()
    number = 0 if last is None else last + 1
    callbacks, about_turns = [objects.callbacks], [NO_TURNS]
    for callback_id, loop in enumerate(loops, number):
        of_loop = _turns_of(loop, loops, turns, outside)
        of_loop = of_loop.with_row_index("instance", offset=instances.height)
        callbacks.append(_callback(callback_id, loop, of_loop))
        notes += _notes(loop, of_loop)
        instances = pl.concat([instances, _as_instances(callback_id, of_loop)], how="diagonal")
        published = _given(published, outside, loop, of_loop, callback_id)
        instances, published = _with_first_publications(instances, published, loop, callback_id)
        if loop.named:
            published = _with_ends(published, objects, loop, of_loop, callback_id)
        about_turns.append(of_loop.select("instance", "due", "reads", overran=_overran(of_loop)))
    return FlowWithLoops(
        replace(
            objects,
            callbacks=pl.concat(callbacks, how="diagonal_relaxed"),
            notes=(*objects.notes, *notes),
        ),
        instances,
        published,
        pl.concat(about_turns, how="diagonal_relaxed"),
    )


def _placed(published: pl.DataFrame, turns: pl.DataFrame) -> pl.DataFrame:
    """Return the publications that lie in a turn of their thread, with its number ``turn``."""
    began = turns.select(*_THREAD, "turn", "start", over="end")
    rows = latest_before(published, began, _THREAD, "time", "start")
    is_inside = pl.col("over").is_null() | (pl.col("time") <= pl.col("over"))
    return rows.filter(pl.col("turn").is_not_null() & is_inside).drop("start", "over")


def _without_repeats(
    published: pl.DataFrame, turns: pl.DataFrame, instances: pl.DataFrame
) -> pl.DataFrame:
    """Take what a loop publishes again out of the assumed instances of callbacks (Python).

    That such an instance publishes the same topic in several turns shows that a loop does it, if
    the thread sleeps for a time in between. Then none of the publisher's messages are the
    callback's.
    """
    assumed = pl.lit(instances["assumed"]).gather("instance").fill_null(False)
    placed = _placed(published, turns).filter(assumed)
    in_turns = placed.group_by("instance", "publisher").agg(count=pl.col("turn").n_unique())
    of_loops = [
        publisher
        for publisher in in_turns.filter(pl.col("count") > 1)["publisher"].unique().sort()
        if _is_paced_by_time(_turns_in(turns, placed.filter(publisher=publisher)))
    ]
    by_loop = pl.col("publisher").is_in(of_loops) & assumed
    columns = ("instance", "callback_id")
    return published.with_columns(
        pl.when(~by_loop).then(column).alias(column) for column in columns
    )


def _outside(published: pl.DataFrame, turns: pl.DataFrame) -> pl.DataFrame:
    """Select the publications in turns that no callback made, with the number of their turn.

    That a lifecycle node or the goal of an action changes its state is none: ros2_control's loop
    activates controllers, and the thread of an action, as Nav2's controller has it, ends with its
    goal.
    """
    topic = pl.col("topic").cast(pl.String)
    internal = topic.is_in(sorted(INTERNAL_TOPICS))
    for state in ("/transition_event", "/_action/status"):
        internal |= topic.str.ends_with(state)
    outside = pl.col("instance").is_null() & ~internal & pl.col("node").is_not_null()
    return _placed(published.filter(outside), turns)


def _turns_in(turns: pl.DataFrame, placed: pl.DataFrame) -> pl.DataFrame:
    """Select the turns in which publications lie."""
    return turns.filter(pl.col("turn").is_in(placed["turn"].implode()))


def _loops(
    outside: pl.DataFrame, turns: pl.DataFrame, tables: events.EventTables, objects: Objects
) -> tuple[list[_Loop], list[str]]:
    """Find the loops, and say where one thread, or one node, has several of them."""
    loops, notes = _named_loops(outside, turns, tables, objects)
    taken_over = {(loop.pid, loop.node, tid) for loop in loops for tid in loop.tids}
    for pid, node, topics in _published_together(outside, taken_over):
        written = outside.filter(pl.col("topic").is_in(topics), pid=pid, node=node)
        tids = tuple(written["tid"].unique().sort())
        if _is_paced_by_time(_turns_in(turns, written)):
            loops.append(_Loop(pid, node, topics, tids))
    for tid, together in _of_thread(loops).items():
        if len(together) > 1:
            texts = "; ".join(", ".join(loop.topics) for loop in together)
            notes.append(
                f"thread {tid} of {together[0].node} has {len(together)} loops, which never publish"
                f" between the same two sleeps: {texts}."
            )
    return loops, notes


def _named_loops(
    outside: pl.DataFrame, turns: pl.DataFrame, tables: events.EventTables, objects: Objects
) -> tuple[list[_Loop], list[str]]:
    """Find the loops that the user named, one for each thread, and say where a node has several."""
    loops, notes = list[_Loop](), list[str]()
    of_managers = turns.drop_nulls("manager").unique(["pid", "manager", "tid"])
    of_managers = (
        of_managers.group_by("pid", "manager").agg(pl.col("tid").sort()).sort("pid", "tid")
    )
    for pid, node, tids in of_managers.iter_rows():
        topics = outside.filter(pl.col("tid").is_in(tids), pid=pid, node=node)["topic"]
        names = tuple(topics.cast(pl.String).unique().sort())
        loops.append(_Loop(pid, node, names, tuple(tids), named=True, is_manager=True))
    known = {(loop.pid, name) for loop in loops for name in (loop.node, *loop.tids)}
    named = named_loops(tables, objects.nodes).drop("valid_from").unique(maintain_order=True)
    for pid, tid, node, is_thread in named.iter_rows():
        if (pid, tid if is_thread else node) in known:
            continue
        of_process = turns.filter(pl.col("manager").is_null(), pid=pid)
        if is_thread:
            tids = [tid] if tid in of_process["tid"] else []
        else:
            tids = of_process.filter(pl.col("call").is_in(_FOR_A_TIME))["tid"].unique().sort()
        for thread in tids:
            topics = outside.filter(pid=pid, tid=thread, node=node)["topic"].cast(pl.String)
            loops.append(_Loop(pid, node, tuple(topics.unique().sort()), (thread,), named=True))
        if len(tids) > 1:
            notes.append(
                f"the loop of {node} was named by its node, and {len(tids)} threads of its process"
                f" sleep for a time ({', '.join(map(str, tids))}): each counts as a loop of it."
                " Name the thread instead."
            )
    return list(dict.fromkeys(loops)), notes


_Topics: TypeAlias = tuple[int, str, tuple[str, ...]]


def _published_together(
    outside: pl.DataFrame, taken_over: Collection[tuple[int, str, int]]
) -> Iterator[_Topics]:
    """Yield groups of topics that a node publishes in the same turns: process, node and topics.

    Threads of named loops, ``taken_over``, are left out.
    """
    names = {name: pl.col(name).cast(pl.String) for name in ("node", "topic")}
    rows = outside.with_columns(**names).group_by("pid", "node", "tid", "turn", maintain_order=True)
    sets = rows.agg(topics=pl.col("topic").unique().sort()).unique(["pid", "node", "tid", "topics"])
    groups: dict[tuple[int, str], list[set[str]]] = {}
    for pid, node, tid, topics in sets.select("pid", "node", "tid", "topics").iter_rows():
        if (pid, node, tid) in taken_over:
            continue
        known = groups.setdefault((pid, node), [])
        touching = [group for group in known if not group.isdisjoint(topics)]
        apart = [group for group in known if group.isdisjoint(topics)]
        groups[pid, node] = [*apart, set(topics).union(*touching)]
    for (pid, node), sets_of_topics in sorted(groups.items()):
        for topics in sorted(tuple(sorted(topics)) for topics in sets_of_topics):
            yield pid, node, topics


def _is_paced_by_time(turns: pl.DataFrame) -> bool:
    """Return whether turns begin when the time to sleep is over, and mostly compute.

    A driver may sleep for a moment and block on its device for the rest of the time: then it
    neither computes nor sleeps during most of its period. What is known by name needs no evidence.
    """
    if turns["manager"].count():
        return True
    waited = turns.sort("start").select(
        blocked=(pl.col("end") - pl.col("start") - pl.col("execution_ns")).median(),
        period=pl.col("start").diff().median(),
    )
    is_blocked = waited.select(pl.col("blocked") > _BLOCKED * pl.col("period")).item()
    return not is_blocked and _timed_share(turns) >= _TIMED_SHARE


def _timed_share(turns: pl.DataFrame) -> float:
    """Return the share of turns that began when the time to sleep was over, not before."""
    timer = SLEEPING_CALLS.index("timerfd")  # it says no time, but cannot be woken earlier
    early = (pl.col("due") - pl.col("start")).clip(lower_bound=0)
    is_timed = (early <= _EARLY * pl.col("wanted_ns")) | (early == 0)
    is_timed = is_timed.fill_null(pl.col("call") == timer)
    return float(turns.select(is_timed.mean()).item() or 0.0)


def _of_thread(loops: Iterable[_Loop]) -> dict[int, list[_Loop]]:
    """Map each thread to the loops of one node that it runs: the first node's that has several."""
    of_thread: dict[tuple[int, int, str], list[_Loop]] = {}
    for loop in loops:
        for tid in loop.tids:
            of_thread.setdefault((loop.pid, tid, loop.node), []).append(loop)
    return {tid: together for (_, tid, _), together in of_thread.items() if len(together) > 1}


def _turns_of(
    loop: _Loop, loops: Iterable[_Loop], turns: pl.DataFrame, outside: pl.DataFrame
) -> pl.DataFrame:
    """Select the turns of a loop: all of its threads, unless the node has several loops there."""
    chosen = turns.filter(pl.col("tid").is_in(loop.tids), pid=loop.pid)
    if loop.is_manager:
        return chosen.filter(manager=loop.node)
    shared = [
        sibling
        for sibling in loops
        if (sibling.pid, sibling.node) == (loop.pid, loop.node)
        and not {*sibling.tids}.isdisjoint(loop.tids)
    ]
    if len(shared) == 1 or loop.named:
        return chosen
    wrote = outside.filter(pl.col("topic").is_in(loop.topics), pid=loop.pid, node=loop.node)
    return _turns_in(chosen, wrote)


def _callback(callback_id: int, loop: _Loop, turns: pl.DataFrame) -> pl.DataFrame:
    """Make the row of a loop among callbacks."""
    row = {
        "callback_id": callback_id,
        "pid": loop.pid,
        "handle": 0,
        "valid_from": turns["start"].min(),
        "kind": "loop",
        "node": loop.node,
        "period_ns": _period(turns),
        "observed": False,
    }
    return pl.DataFrame([row | dict.fromkeys(CALLBACK_SCHEMA.keys() - row)], CALLBACK_SCHEMA)


def _as_instances(callback_id: int, turns: pl.DataFrame) -> pl.DataFrame:
    """Return turns as instances of a loop's callback."""
    return turns.select(
        *("instance", *_THREAD, "start", "end", "execution_ns"),
        callback_id=pl.lit(callback_id, pl.UInt32),
        intra_process=pl.lit(False),
        assumed=pl.lit(False),
    )


def _given(
    published: pl.DataFrame,
    outside: pl.DataFrame,
    loop: _Loop,
    turns: pl.DataFrame,
    callback_id: int,
) -> pl.DataFrame:
    """Give a loop's publications to its instances."""
    wrote = outside.filter(pl.col("topic").is_in(loop.topics), pid=loop.pid, node=loop.node)
    wrote = wrote.drop("instance", "callback_id").join(turns.select("turn", "instance"), on="turn")
    wrote = wrote.with_columns(callback_id=pl.lit(callback_id, pl.UInt32))
    return published.with_columns(
        pl.coalesce(by_number(wrote, "publication", column, published.height), column)
        for column in ("instance", "callback_id")
    )


def _with_first_publications(
    instances: pl.DataFrame, published: pl.DataFrame, loop: _Loop, callback_id: int
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Add an assumed instance for each publication of a loop that lies in no turn.

    As the one before its thread's first sleep, from which on its sleeps are recorded.
    """
    of_loop = pl.col("topic").is_in(loop.topics) & (pl.col("pid") == loop.pid)
    left = published.filter(of_loop, pl.col("instance").is_null(), node=loop.node)
    left = left.drop("instance", "callback_id").with_row_index("instance", instances.height)
    left = left.with_columns(callback_id=pl.lit(callback_id, pl.UInt32))
    columns = ("instance", "callback_id")
    added = left.select(
        *columns, *_THREAD, start="time", intra_process=pl.lit(False), assumed=pl.lit(True)
    )
    published = published.with_columns(
        pl.coalesce(column, by_number(left, "publication", column, published.height))
        for column in columns
    )
    return pl.concat([instances, added], how="diagonal"), published


def _with_ends(
    published: pl.DataFrame, objects: Objects, loop: _Loop, turns: pl.DataFrame, callback_id: int
) -> pl.DataFrame:
    """Add a publication on ``NODE:end`` at the end of each of a named loop's turns."""
    topic = loop.node + (MANAGER_WRITE if loop.is_manager else LOOP_END)
    ends = objects.publishers.filter(pl.col("topic") == topic, pl.col("pid") == loop.pid)
    ends = ends.select("publisher", "node", "topic")
    rows = turns.drop_nulls("end").select(
        *("instance", *_THREAD), time="end", callback_id=pl.lit(callback_id, pl.UInt32)
    )
    rows = rows.join(ends.head(1), how="cross").with_row_index("publication", published.height)
    return pl.concat([published, rows], how="diagonal")


def _overran(turns: pl.DataFrame) -> pl.Expr:
    """Whether a turn ended when the next one should have begun; null: its device paces the loop.

    A controller manager that was late moves the time to which it sleeps behind its end.
    """
    overran = (pl.col("left_ns") <= 0).fill_null(False) | _overlong(turns)
    if not turns["manager"].count():
        return overran
    period = _period(turns)
    too_late = pl.lit(False) if period is None else pl.col("end") >= pl.col("due") + period
    return pl.when(pl.col("waits_in").is_null()).then(overran | too_late.fill_null(False))


def _period(turns: pl.DataFrame) -> int | None:
    """Return the period of a loop (ns); None: it has none."""
    if turns["manager"].count():
        grid = _grid(turns["due"].drop_nulls().sort().to_numpy())
        if grid is not None:
            return grid
    return loop_period(turns["start"], turns["due"])


def _grid(due: npt.NDArray[np.int64]) -> int | None:
    """Return the period (ns) of which times to sleep are a multiple apart; None: of none.

    A controller manager that is late leaves periods out.
    """
    apart = np.diff(due)
    if len(apart) < 2:
        return None
    unit = float(np.percentile(apart, 10))
    usual = apart[np.abs(apart - unit) <= REGULAR * unit]
    multiples = apart / max(unit, 1.0)
    on_grid = (np.abs(multiples - np.round(multiples)) <= REGULAR) & (multiples > 0.5)
    if not len(usual) or float(np.mean(on_grid)) < MOSTLY:
        return None
    return roundest_period(usual, float(np.median(usual)))


def _overlong(turns: pl.DataFrame) -> pl.Expr:
    """Whether a turn lasts as long as the loop's usual distance of starts.

    A rate loop that is late does not sleep at all: two of its iterations lie in one turn.
    """
    if _period(turns) is None:
        return pl.lit(False)
    usual = float(np.median(np.diff(turns["start"].sort().to_numpy())))
    return (pl.col("end") - pl.col("start") >= usual).fill_null(False)


def _is_regular(starts: npt.NDArray[np.int64]) -> bool:
    """Return whether most starts have the usual distance from the one before."""
    apart = np.diff(starts)
    usual = float(np.median(apart)) if len(apart) else 0.0
    return usual > 0 and float(np.mean(np.abs(apart - usual) <= REGULAR * usual)) >= MOSTLY


def regular_period(starts: npt.NDArray[np.int64]) -> int | None:
    """Return the period (ns) of starts in order; None: they are irregular, or fewer than three."""
    if len(starts) < 3 or not _is_regular(starts):
        return None
    apart = np.diff(starts)
    return roundest_period(apart, float(np.median(apart)))


def loop_period(starts: pl.Series, due: pl.Series) -> int | None:
    """Return the period (ns) of a loop; None: it sleeps irregularly, or started less than thrice.

    ``starts`` are those of its instances, ``due`` until when it slept before each of them (ns;
    null: not known). A machine that stands still, or is busy, makes starts irregular. The program
    itself chooses until when it sleeps, so these instants count first: more than half of them are
    a period apart, to a hundredth, by no chance. Where the program sleeps for a duration they are
    as irregular as its computation, and the starts count.
    """
    chosen = due.drop_nulls().sort().to_numpy()
    if 3 <= chosen.size >= _TIMED_SHARE * starts.len():
        apart = np.diff(chosen)
        usual = float(np.median(apart))
        exact = np.abs(apart - usual) <= _EXACT * usual
        if usual > 0 and float(np.mean(exact)) > _CHOSEN:
            return roundest_period(apart[exact], usual)
    return regular_period(starts.sort().to_numpy())


def seems_regular(times: npt.NDArray[np.int64]) -> bool:
    """Return whether publications alone show that a loop makes them: enough, and regular."""
    return len(times) > FEWEST and _is_regular(times)


def _notes(loop: _Loop, turns: pl.DataFrame) -> Iterator[str]:
    """Say where a loop has no period, and where its device paces it."""
    if isinstance(waits_in := turns["waits_in"].first(), str):
        yield (
            f"the loop of {loop.node} waits for its device in {waits_in}(), so its period is the"
            " device's, and no event says when a turn was due: overruns and jitter of start are not"
            f" known{'; a turn begins when read() returns' if waits_in == 'read' else ''}."
        )
    starts = turns["start"].sort().to_numpy()
    if len(starts) < 3 or _period(turns) is not None:
        return
    low, usual, high = (
        duration_text(round(v)) for v in np.percentile(np.diff(starts), (5, 50, 95))
    )
    yield (
        f"the loop of {loop.node} (thread {', '.join(map(str, loop.tids))}) sleeps irregularly:"
        f" usually {usual} lie between its starts, from {low} (p5) to {high} (p95). It has no"
        " period, and nothing is to be planned on it."
    )


def loop_figures(
    callbacks: pl.DataFrame, instances: pl.DataFrame, turns: pl.DataFrame
) -> pl.DataFrame:
    """Compute what is known of loops beside the figures of all callbacks, a row for each. Columns:

    * ``callback_id``.
    * ``phase_ns``: how long after a multiple of its period, on the clock of events, it usually
      starts (null: it has no period).
    * ``start_jitter_ns``: of its starts behind the end of its time to sleep, the latest less the
      earliest (null: not known).
    * ``overruns``: instances that ended when the next one should have begun (null: not known).
    """
    period = pl.col("period_ns")
    loops = callbacks.filter(pl.col("kind") == "loop").select("callback_id", "period_ns")
    rows = instances.join(loops, on="callback_id").join(turns, on="instance", how="left")
    from_last = pl.col("start") - pl.col("start").last()
    within = (from_last + period // 2) % period - period // 2
    late = pl.col("start") - pl.col("due")
    figures = rows.sort("start").group_by("callback_id")
    return figures.agg(
        phase_ns=(
            (pl.col("start").last() + within.median()).round().cast(pl.Int64) % period.last()
        ),
        start_jitter_ns=late.max() - late.min(),
        overruns=pl.when(pl.col("overran").count() > 0).then(pl.col("overran").sum()),
    )
