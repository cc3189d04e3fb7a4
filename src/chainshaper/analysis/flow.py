"""From events to the data flow: callback instances, the messages they took, those they published.

Everything about chains builds on this step. It joins objects, callback instances, publications and
takes into frames that refer to each other by row number. It costs a fixed number of sorts and
joins, however many events there are.

An instance runs from `callback_start` to `callback_end` of the same callback on the same thread
(paper, section 2.4). Some callbacks have no such events, but their messages prove that they ran.
For these, instances are assumed (column ``assumed``; they have no ``end`` and no response time):

* Callbacks of rclpy that are coroutines run in pieces (:mod:`~chainshaper.analysis.coroutines`);
  they are not assumed, and neither are those that the library in front follows.
* Another Python node, or one that takes from a wait set, has no callback events. An instance of
  its subscription begins with each take, one of its timer with each `rcl_timer_call`. What the
  thread publishes for the same node until the next such beginning is that instance's output.
* The callback of a service's client, and what an action's client and server do, begin with the
  take as well. They end when the thread's executor looks for work again. Where an event shows
  that, they have an end, and are not ``assumed``.
* A loop in a thread of its own, of which events show when it sleeps, has an instance for each of
  its turns (:mod:`~chainshaper.analysis.loops`). These are not ``assumed``: they have an end.
* A driver's thread, a player of recorded data, or a Python timer without `rcl_timer_call` publishes
  outside all callbacks that events show. A topic that its node publishes only like this gets a
  callback with the handle 0 and one instance per publication. Its kind is ``loop`` where the
  publications are regular and the node is one of rclcpp, else ``unknown``.
"""

from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import polars as pl

from chainshaper.analysis import coroutines
from chainshaper.analysis.contradictions import (
    Contradiction,
    contradictions,
    with_shown_periods,
)
from chainshaper.analysis.loops import NO_TURNS, regular_period, seems_regular, with_loops
from chainshaper.analysis.lost_ends import LOOKS, without_disproved_ends
from chainshaper.analysis.matching import by_number, ends_of_starts, first_after, latest_before
from chainshaper.analysis.messages import (
    gate_decisions,
    link_takes,
    publications,
    service_calls,
    taken_by_rmw,
    takes,
    with_departures,
)
from chainshaper.analysis.objects import CALLBACK_SCHEMA, Objects, resolve_objects
from chainshaper.analysis.restarts import FOLLOWED, followed_processes
from chainshaper.analysis.unseen_takes import with_unseen_takes
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS, REQUEST, RESPONSE
from chainshaper.values.recording import Recording

_ACTION = "/_action/"
_MOST_NESTED = 8  # tasks, each created by the one before
MANY_ROWS = 1_000_000
"""Tables with more rows (tens of MB each) leave memory when the data flow has what they say."""


@dataclass(frozen=True)
class DataFlow:
    """The data flow of a recording: who exists, what ran when, which message went where.

    ``objects``
        Nodes, callbacks and endpoints (:class:`~chainshaper.analysis.objects.Objects`). A timer's
        period is the one that its starts show.
    ``instances``
        The frame of :func:`callback_instances`, and the assumed instances. A row's place is the
        instance's number. Ends that other events disprove are left out
        (:mod:`~chainshaper.analysis.lost_ends`). One column is added:
        ``until``, when an instance without an end had ended at the latest (ns, null: not known).
    ``publications``
        The frame of :func:`~chainshaper.analysis.messages.publications`, and three columns:
        ``instance`` in which it was published (null: outside callbacks);
        ``callback_id`` of that instance;
        ``sent``, when it left the process (ns, null: it never did).
    ``takes``
        The frame of :func:`~chainshaper.analysis.messages.takes`, and two columns:
        ``publication`` that was taken (null: not known);
        ``instance`` that got the message (null: none did).
    ``turns``
        Of the instances of loops, when they were due, and whether they overran
        (:class:`~chainshaper.analysis.loops.FlowWithLoops`).
    ``events``
        The tables that all this came from.
    ``notes``
        What cannot be known, in plain words, with the notes of the contradictions.
    ``contradictions``
        Events that contradict each other.
    ``without_takes``
        Ids of subscriptions' callbacks that ran although no event shows a take of theirs.
    ``followed``
        The frame of :func:`~chainshaper.analysis.restarts.followed_processes`. The callbacks of a
        node that was started again have one ``callback_id`` in all frames.
    ``through``
        What the user declared that no event shows: pairs of topics, of which the first one's
        messages go into publications on the second (:mod:`~chainshaper.values.handed_over`).
    """

    objects: Objects
    instances: pl.DataFrame
    publications: pl.DataFrame
    takes: pl.DataFrame
    events: events.EventTables
    notes: tuple[str, ...]
    contradictions: tuple[Contradiction, ...] = ()
    without_takes: frozenset[int] = frozenset()
    turns: pl.DataFrame = field(default_factory=NO_TURNS.clear)
    followed: pl.DataFrame = field(default_factory=FOLLOWED.to_frame)
    through: tuple[tuple[str, str], ...] = ()


def recorded_flow(recording: Recording) -> DataFlow:
    """Resolve the events of a recording, with its clock offset and its count of lost events."""
    info = recording.info
    flow = data_flow(recording.events, info.clock_offset_ns, complete=not any(info.lost.values()))
    return replace(flow, through=info.through) if info.through else flow


def _let_go(tables: events.EventTables, names: Collection[str]) -> None:
    """Have large tables leave memory; who wants one of them again waits until it is read again."""
    if isinstance(tables, events.ReadAgain):
        tables.let_go([name for name in names if events.table(tables, name).height > MANY_ROWS])


def data_flow(
    tables: events.EventTables,
    clock_offset_ns: int = 0,
    objects: Objects | None = None,
    *,
    ended: Collection[int] | None = None,
    complete: bool = False,
) -> DataFlow:
    """Resolve the events of some tables.

    * ``clock_offset_ns``: CLOCK_REALTIME less the clock of events; matters only before Jazzy.
    * ``objects``: those of the tables, if the caller has resolved them already.
    * ``ended``: the processes that have ended; None: events decide.
    * ``complete``: whether it is certain that no event was lost.
    """
    objects = objects or resolve_objects(tables)
    # What the frames below need of the largest tables is in them. A table goes before the next
    # frame is made: all of them together would take half as much memory again.
    instances = callback_instances(tables, objects.callbacks)
    _let_go(tables, ["callback_start", "callback_end"])
    sent, received = service_calls(tables, objects, clock_offset_ns)
    with ThreadPoolExecutor(max_workers=1) as beside:
        taking = beside.submit(takes, tables, objects, received)
        published = publications(tables, objects, sent)
        taken = taking.result()
    without_rmw = _taken_without_rmw(tables)
    _let_go(tables, ["rmw_publish", "rmw_take"])
    taken, stamped = link_takes(tables, taken, published, clock_offset_ns)
    ends = without_disproved_ends(tables, instances, taken, objects.callbacks, complete=complete)
    pieces = coroutines.coroutine_pieces(tables)
    instances = _with_coroutines(ends.instances, pieces, objects.callbacks)
    instances, taken = _with_assumed_readers(instances, taken, objects, tables)
    taken = _used(taken, instances, tables, objects)
    taken, unseen = with_unseen_takes(taken, instances, published, objects)
    published = _published_in(published, _running(instances, pieces, tables, objects), objects)
    if "rcl_timer_call" not in tables and instances["assumed"].any():
        published = _begun_outside(published, instances)
    if sent.height and received.height:
        published = _answered(published, taken)
    looping = with_loops(objects, instances, published, tables)
    objects, instances, published = _with_assumed_writers(
        looping.objects, looping.instances, looping.published, tables
    )
    published = with_departures(published, tables, objects)
    seen = contradictions(
        tables=tables,
        objects=objects,
        instances=instances,
        published=published,
        taken=taken,
        ends=ends,
        unseen=unseen,
        stamped=stamped,
    )
    notes = (
        *objects.notes,
        *_notes(tables, instances, taken, without_rmw),
        *(contradiction.note for contradiction in seen),
    )
    without_takes = frozenset(subscription.callback_id for subscription in unseen)
    followed = followed_processes(tables, objects, ended)
    flow = DataFlow(
        objects=objects,
        instances=instances,
        publications=published,
        takes=taken,
        events=tables,
        notes=notes,
        contradictions=seen,
        without_takes=without_takes,
        turns=looping.turns,
        followed=followed,
    )
    flow = _with_restarts(flow)  # which knows a timer again by its declared period
    shown = with_shown_periods(flow.objects.callbacks, flow.contradictions)
    return replace(flow, objects=replace(flow.objects, callbacks=shown))


def _notes(
    tables: events.EventTables, instances: pl.DataFrame, taken: pl.DataFrame, without_rmw: int
) -> Iterator[str]:
    """Yield what cannot be known of instances and messages, in plain words.

    ``without_rmw`` is what `_taken_without_rmw` returns.
    """
    if "sched_switch" in tables and instances.height and not instances["execution_ns"].count():
        yield (
            "sched_switch was recorded, but shows none of the application's threads (inside a "
            "container threads have other numbers): execution times cannot be known."
        )
    within = int(instances["intra_process"].sum())
    if within and not taken["intra_process"].any():
        yield (
            f"{within} callback instances got their message within their process, of which no "
            "other event tells (before Iron, or not enabled): chains cannot be followed through "
            "them."
        )
    if without_rmw:
        yield (
            f"{without_rmw} messages were taken without an event of rmw (from Lyrical on"
            " rmw_fastrtps_cpp has none for messages with a field uint8[]): chains are followed"
            " through them only where a note says so. `record --source preload` sees them."
        )


def _taken_without_rmw(tables: events.EventTables) -> int:
    """Count the messages that rcl took in processes where rmw has an event of hardly any."""
    by_rmw = taken_by_rmw(tables).group_by("pid").len("by_rmw")
    by_rcl = events.table(tables, "rcl_take").group_by("pid").len("by_rcl")
    both = by_rcl.join(by_rmw, on="pid", how="left").fill_null(0)
    return int(both.filter(pl.col("by_rcl") > 5 * pl.col("by_rmw"))["by_rcl"].sum())


def left_when_taken(flow: DataFlow, topics: Collection[str | None]) -> DataFlow:
    """Return the flow in which each message on ``topics`` left when its first reader took it.

    It is for topics that the publisher's thread of ROS 2 sends: events show only when a message was
    handed to that thread. A flow with events of the sending itself stays as it is.
    """
    taken = flow.takes.drop_nulls("publication").sort("time", descending=True)
    left = by_number(taken, "publication", "time", flow.publications.height)  # the first take
    topics_left_late = flow.publications.filter(
        left.is_not_null() & pl.col("topic").is_in([*topics])
    )["topic"]
    if events.table(flow.events, "asynchronous_send").height or not topics_left_late.len():
        return flow
    sent = pl.when(pl.col("topic").is_in(topics_left_late.implode())).then(left).otherwise("sent")
    note = "when it left no event says: it counts as published when its first reader took it"
    notes = (
        *flow.notes,
        f"a thread of its own publishes {', '.join(topics_left_late.unique())}: {note}",
    )
    return replace(flow, publications=flow.publications.with_columns(sent=sent), notes=notes)


def callback_instances(tables: events.EventTables, callbacks: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of all instances of all callbacks, sorted by start.

    ``callbacks`` is the frame of :class:`~chainshaper.analysis.objects.Objects`. Columns:

    * ``instance``: numbered from 0 in order of start.
    * ``callback_id``, ``pid``, ``tid``.
    * ``start``: ns of the event clock.
    * ``end``: ns of the event clock; null when the event was lost, or the instance was still
      running (:func:`~chainshaper.analysis.matching.ends_of_starts`).
    * ``execution_ns``: CPU time (paper: e), from the ``thread_time`` columns where the source has
      them, else from `sched_switch` (:func:`cpu_time`), else null.
    * ``intra_process``: whether its message came through a ring buffer.
    * ``assumed``: always false here.
    """
    starts = events.table(tables, "callback_start", ["is_intra_process"])
    ends = events.table(tables, "callback_end")
    row = ends_of_starts(starts, ends)
    owners = _owners(callbacks)
    started = starts.select("pid", "callback", "time")  # in order of time, and stays so
    used = pl.lit(None, dtype=pl.Int64)
    if "thread_time" in starts.columns and "thread_time" in ends.columns:
        spent = ends["thread_time"].gather(row) - starts["thread_time"]
        used = pl.lit(spent.set(spent < 0, None))
    frame = starts.select(
        latest_before(started, owners, ["pid", "callback"], "time", "registered")["callback_id"],
        *("pid", "tid"),
        start="time",
        end=ends["time"].gather(row),
        execution_ns=used,
        intra_process=pl.col("is_intra_process").fill_null(0) != 0,
        assumed=pl.lit(False),
    )
    if frame["callback_id"].null_count():
        frame = frame.drop_nulls("callback_id")
    if "sched_switch" in tables and not frame["execution_ns"].count():
        frame = _plausible(frame.with_columns(execution_ns=cpu_time(tables, frame)))
    return frame.with_row_index("instance")


def _owners(callbacks: pl.DataFrame) -> pl.DataFrame:
    """Select the registrations of callbacks that have events."""
    return callbacks.filter(pl.col("observed")).select(
        "callback_id", "pid", callback="handle", registered="valid_from"
    )


def _with_coroutines(
    instances: pl.DataFrame, pieces: pl.DataFrame, callbacks: pl.DataFrame
) -> pl.DataFrame:
    """Add the instances of callbacks that are coroutines, and number all anew."""
    if pieces.is_empty():
        return instances
    added = coroutines.coroutine_instances(pieces, _owners(callbacks))
    together = pl.concat([instances.drop("instance"), added], how="diagonal_relaxed")
    together = together.sort("start", maintain_order=True).with_row_index("instance")
    return together.select(instances.columns)


def _running(
    instances: pl.DataFrame, pieces: pl.DataFrame, tables: events.EventTables, objects: Objects
) -> pl.DataFrame:
    """Make a frame of what ran on which thread: instances; of coroutines and tasks their pieces.

    A task counts as the instance in which it was created, which may be that of another task.
    """
    columns = ["instance", "callback_id", "pid", "tid", "start", "end", "until", "assumed"]
    if pieces.is_empty():
        return instances.select(columns)
    pieces = coroutines.instances_of_pieces(pieces, instances)
    known = pieces.drop_nulls("instance")
    whole = instances.join(known, on="instance", how="anti", maintain_order="left").select(columns)

    def beside(added: pl.DataFrame) -> pl.DataFrame:
        added = added.with_columns(assumed=pl.lit(False))
        together = pl.concat([whole, added.select({*columns} - {"until"})], how="diagonal_relaxed")
        return together.select(columns).sort("start", maintain_order=True)

    running = beside(known)
    created = coroutines.created_tasks(tables).with_row_index("publication")
    created = created.with_columns(node=pl.lit(None, pl.String))
    tasks = pieces.filter(pl.col("callback") == 0).drop("instance", "callback_id")
    numbers: list[int | None] = []
    for _ in range(_MOST_NESTED if created.height else 0):
        owned = _published_in(created, running, objects, of_any_node=True)
        if (latest := owned["instance"].to_list()) == numbers:
            break
        numbers = latest
        owner = owned.drop_nulls("instance").select("pid", "call", "instance", "callback_id")
        running = beside(pl.concat([known, tasks.join(owner, on=["pid", "call"])], how="diagonal"))
    return running


def cpu_time(tables: events.EventTables, spans: pl.DataFrame) -> pl.Series:
    """Return the CPU time (ns) of each row of ``spans``: of ``tid`` between ``start`` and ``end``.

    It comes from `sched_switch`, and is exact: the time that the thread had used at its last switch
    plus, if that switched it in, the time since. A thread whose first switch takes it off its core
    counts as running since the recording began. Null without an end, and for threads that never
    appear in `sched_switch`.
    """
    curve = _running_time(tables)
    rows = spans.select("tid", "start", "end").with_row_index("row")
    for edge in ("start", "end"):
        rows = latest_before(rows, curve, ["tid"], edge, "switched")
        since = pl.when("running").then(pl.col(edge) - pl.col("switched")).otherwise(0)
        rows = rows.with_columns((pl.col("used") + since).alias(f"used_at_{edge}"))
        rows = rows.drop("switched", "used", "running")
    return rows.sort("row").select(pl.col("used_at_end") - pl.col("used_at_start")).to_series()


def _plausible(frame: pl.DataFrame) -> pl.DataFrame:
    """Return the frame without execution times of 0, which are impossible.

    Where most instances of a thread used none, `sched_switch` speaks of another thread with the
    same number (the trace was taken inside a container): all its values go. Where few used none,
    switches were lost: only these go.
    """
    used, thread = pl.col("execution_ns"), ["pid", "tid"]
    never = (used == 0) & (pl.col("end") > pl.col("start"))
    stranger = never.sum().over(thread) * 2 > used.count().over(thread)
    return frame.with_columns(pl.when(~(never | stranger)).then(used).alias("execution_ns"))


def _running_time(tables: events.EventTables) -> pl.DataFrame:
    """Make a frame of how much CPU time each thread had used at each of its switches.

    Columns: ``tid``; ``switched``, the instant (ns); ``used``, its CPU time until then (ns);
    ``running``, whether it runs since.
    """
    switches = events.table(tables, "sched_switch")
    off = switches.select(tid="prev_tid", switched="time", running=pl.lit(False))
    on = switches.select(tid="next_tid", switched="time", running=pl.lit(True))
    changes = pl.concat([off, on])
    changes = changes.filter(pl.col("tid") != 0)  # 0 is every core's idle thread
    changes = changes.sort("tid", "switched", "running", maintain_order=True)
    first = changes.unique("tid", keep="first", maintain_order=True).filter(~pl.col("running"))
    began = pl.lit(switches["time"].min(), dtype=pl.Int64)
    ran_from_start = first.with_columns(switched=began, running=pl.lit(True))
    changes = pl.concat([ran_from_start, changes]).sort("tid", "switched", maintain_order=True)
    elapsed = (pl.col("switched") - pl.col("switched").shift(1)).over("tid")
    ran = pl.when(pl.col("running").shift(1).over("tid")).then(elapsed).otherwise(0)
    return changes.with_columns(used=ran.fill_null(0).cum_sum().over("tid"))


def timer_calls(tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    """Make a frame of the calls of timers: ``callback_id, observed, pid, tid, time`` (ns).

    It is empty where the recording has no `rcl_timer_call`. The thread need not be the one that
    runs the callback: rclcpp's events executor has a thread for the calls.
    """
    added = events.table(tables, "rclcpp_timer_callback_added")
    added = added.select("pid", "timer_handle", handle="callback", valid_from="time")
    timers = objects.callbacks.filter(pl.col("kind") == "timer")
    timers = timers.join(added, on=["pid", "handle", "valid_from"], how="left").select(
        *("pid", "valid_from", "callback_id", "observed"), pl.coalesce("timer_handle", "handle")
    )
    calls = events.table(tables, "rcl_timer_call")
    calls_of_timers = latest_before(calls, timers, ["pid", "timer_handle"], "time", "valid_from")
    return calls_of_timers.drop_nulls("callback_id").select(
        "callback_id", "observed", "pid", "tid", "time"
    )


def _with_assumed_readers(
    instances: pl.DataFrame, taken: pl.DataFrame, objects: Objects, tables: events.EventTables
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Add an instance for each take, and each timer's call, of callbacks that have no events.

    Instances of services, clients and actions end when the thread's executor looks for work again.
    Return the instances, renumbered in order of start, and the takes with ``assumed_instance``.
    """
    by_executor = (pl.col("kind") != "subscription") | pl.col("topic").str.contains(
        _ACTION, literal=True
    )
    silent = objects.callbacks.filter(~pl.col("observed")).unique("callback_id")
    silent = silent.select("callback_id", by_executor=by_executor)
    assumed = taken.join(silent, on="callback_id", maintain_order="left").select(
        *("callback_id", "pid", "tid", "take", "intra_process", "by_executor"), start="time"
    )
    called = timer_calls(tables, objects).filter(~pl.col("observed")).drop("observed")
    called = called.rename({"time": "start"}).with_columns(intra_process=pl.lit(False))
    assumed = pl.concat([assumed, called], how="diagonal").with_columns(assumed=pl.lit(True))
    if assumed.is_empty():
        return instances, taken.with_columns(assumed_instance=pl.lit(None, dtype=pl.UInt32))
    if assumed["by_executor"].any():
        looks = pl.concat(
            events.table(tables, name).select("pid", "tid", end="time") for name in LOOKS
        )
        assumed = first_after(assumed, looks.sort("end"), ["pid", "tid"], "start", "end")
        end = pl.when("by_executor").then("end")
        assumed = assumed.with_columns(end=end, assumed=end.is_null())
    assumed = assumed.drop("by_executor")
    all_instances = pl.concat([instances.drop("instance"), assumed], how="diagonal_relaxed")
    all_instances = all_instances.sort("start", maintain_order=True).with_row_index("instance")
    reading = all_instances.select("take", "instance").drop_nulls("take")
    instance_of_take = by_number(reading, "take", "instance", taken.height)
    return all_instances.select(instances.columns), taken.with_columns(
        assumed_instance=instance_of_take
    )


def _used(
    taken: pl.DataFrame, instances: pl.DataFrame, tables: events.EventTables, objects: Objects
) -> pl.DataFrame:
    """Give messages the ``instance`` that used them, those that waited in a gate included."""
    taken = _consumed(taken, instances)
    if "gate_release" not in tables:
        return taken
    return _released(taken, instances, gate_decisions(tables, objects))


def _consumed(taken: pl.DataFrame, instances: pl.DataFrame) -> pl.DataFrame:
    """Add to each take the ``instance`` that got its message.

    It is the next instance of the subscription's callback on the thread of the take, if it starts
    before that thread's next take for the callback: an instance reads the latest message that was
    taken for it, and one instance reads a message.
    """
    thread_callback = ["tid", "callback_id"]
    for through_buffer in (False, True):
        same = pl.col("intra_process") == through_buffer
        starts = instances.lazy().filter(same & ~pl.col("assumed"))
        began = starts.select(*thread_callback, "instance", "start").collect()
        of_kind = taken.lazy().filter(same)
        received = of_kind.select(*thread_callback, "take", took="time").collect()
        if began.height and received.height:
            read = latest_before(began, received, thread_callback, "start", "took")
            read = read.select("take", "instance").drop_nulls("take")
            # Of several instances after one take the first read the message. Of several rows with
            # one number `by_number` takes the last, so the order of starts is reversed.
            instance_of_take = by_number(read.reverse(), "take", "instance", taken.height)
            taken = taken.with_columns(
                assumed_instance=pl.coalesce("assumed_instance", instance_of_take)
            )
    return taken.rename({"assumed_instance": "instance"})


def _released(
    taken: pl.DataFrame, instances: pl.DataFrame, decisions: pl.DataFrame
) -> pl.DataFrame:
    """Give messages that waited in a gate the ``instance`` in which they left, as its log has it.

    A gate takes further messages while it holds one, and lets each go in an instance of its own:
    the message taken last before that instance need not be the one in it. And a message that the
    executor took while others waited has an instance as well that only queued it. ``decisions`` is
    the frame of :func:`~chainshaper.analysis.messages.gate_decisions`. Where stamps of several
    messages are equal nothing is changed.
    """
    key = ["callback_id", "source_timestamp"]
    left = decisions.filter(pl.col("dropped").is_null()).drop_nulls([*key, "time"])
    left = left.filter(pl.struct(key).is_unique())
    if left.is_empty():
        return taken
    began = instances.filter(~pl.col("assumed"))
    began = began.select("callback_id", "instance", "end", began="start")
    left = latest_before(left.select(*key, "time"), began, ["callback_id"], "time", "began")
    left = left.filter(pl.col("time") <= pl.coalesce("end", "time")).drop_nulls("instance")
    left = left.filter(pl.col("instance").is_unique())  # else the log does not fit the events
    takes = taken.select(*key, "take", took="time").join(left, on=key)
    takes = takes.filter(pl.col("took") <= pl.col("began")).sort("take")
    known = takes.group_by(key).agg(pl.col("instance", "take").last())
    others = takes.join(known, on="take", how="anti")["take"]
    claimed = pl.col("instance").is_in(known["instance"].implode())
    claimed |= pl.col("take").is_in(others.implode())
    instance = by_number(known, "take", "instance", taken.height)
    return taken.with_columns(instance=pl.coalesce(instance, pl.when(~claimed).then("instance")))


def _answered(published: pl.DataFrame, taken: pl.DataFrame) -> pl.DataFrame:
    """Give responses the instance that took the request: rclcpp sends them after its end."""
    requests = taken.filter(
        pl.col("call").is_not_null(),
        pl.col("instance").is_not_null(),
        pl.col("topic").cast(pl.String).str.ends_with(REQUEST),
    )
    responses = published.filter(
        pl.col("call").is_not_null(), pl.col("topic").cast(pl.String).str.ends_with(RESPONSE)
    )
    columns, call = ["instance", "callback_id"], ["pid", "call"]
    rows = responses.drop(columns).join(requests.select(*call, *columns), on=call)
    return published.with_columns(
        pl.coalesce(by_number(rows, "publication", column, published.height), column)
        for column in columns
    )


def _published_in(
    published: pl.DataFrame, running: pl.DataFrame, objects: Objects, *, of_any_node: bool = False
) -> pl.DataFrame:
    """Add ``instance`` and ``callback_id``: the innermost instance then running on the thread.

    ``running`` is the frame of :func:`_running`. ``of_any_node``: the rows have no nodes.

    An instance without an end is taken to run until the thread's next instance, or until its thread
    looked for other work. A publication in the nanosecond in which one instance ends and the next
    begins belongs to the one that ends. A callback that spins an executor has instances of other
    callbacks inside itself, and publishes after them: so the search is repeated among the
    instances that contain others, once per level of nesting.
    """
    nodes = objects.callbacks.unique("callback_id", maintain_order=True)
    nodes = nodes.select("callback_id", owner=pl.col("node").cast(published.schema["node"]))
    running = running.join(nodes, on="callback_id", how="left", maintain_order="left")
    key, columns = ["pid", "tid"], ["publication", "instance", "callback_id"]
    over_by = pl.coalesce("end", "until")
    lies_inside = (over_by.is_null() | (pl.col("time") <= over_by)) & (
        ~pl.col("assumed") | of_any_node | (pl.col("owner") == pl.col("node"))
    )
    left_over, parts, strictly = published.select("publication", "time", *key, "node"), [], True
    while True:
        matches = latest_before(left_over, running, key, "time", "start", strictly=strictly)
        is_match = lies_inside.fill_null(False) & pl.col("instance").is_not_null()
        matches = matches.lazy().filter(is_match).select(columns).collect()
        parts.append(matches)
        instance_of = by_number(matches, "publication", "instance", published.height)
        left_over = left_over.filter(instance_of.gather(left_over["publication"]).is_null())
        # The first search is for instances that began before the publication, the second among the
        # same for those that began in the same nanosecond; each later one is a level further out.
        if not strictly:
            running = running.sort("start", maintain_order=True)
            inner_start, inner_end = (pl.col(n).shift(-1).over(key) for n in ("start", "end"))
            ends_within = (inner_end <= pl.col("end")).fill_null(True)
            contains = (inner_start < pl.col("end")) & ends_within
            running = running.filter(contains.fill_null(False))
        if not (running.height and left_over.height):
            break
        strictly = False
    all_matches = pl.concat(parts)
    return published.with_columns(
        by_number(all_matches, "publication", column, published.height) for column in columns[1:]
    )


def _with_restarts(flow: DataFlow) -> DataFlow:
    """Return the flow in which a node that was started again is one node, with a note for each.

    Its callbacks are those of its last process. A callback replaces one of an earlier process that
    has the same node, kind and trigger.
    """
    if flow.followed.is_empty():
        return flow
    alike = ["node", "kind", "period_ns", "of"]
    writes = flow.publications.group_by("callback_id").agg(wrote=pl.col("topic").first())
    known = flow.objects.callbacks.unique("callback_id", keep="first", maintain_order=True)
    known = known.join(writes, on="callback_id", how="left", maintain_order="left")
    known = known.join(flow.followed, on=["node", "pid"], how="left", maintain_order="left")
    outside = pl.col("kind").is_in(["unknown", "loop"]) & (pl.col("handle") == 0)
    # A loop's period is measured: it is not the same number in the next process.
    known = known.with_columns(period_ns=pl.when(pl.col("kind") != "loop").then("period_ns"))
    of = pl.when(outside).then(pl.col("wrote").cast(pl.String)).otherwise("topic")
    known = known.with_columns(pl.coalesce("last_pid", "pid"), of=of)
    runs_last = pl.col("pid") == pl.col("last_pid")
    known = known.sort(runs_last, "valid_from", maintain_order=True)
    known = known.with_columns(place=pl.int_range(pl.len()).over("pid", *alike))
    latest = pl.col("callback_id").last().over("last_pid", *alike, "place")
    known = known.with_columns(latest=latest)
    # Numbers stay without gaps: they are places in the graph.
    dense = pl.col("latest").rank("dense").cast(pl.UInt32) - 1
    ids = dict(known.select("callback_id", dense).iter_rows())
    renumbered = pl.col("callback_id").replace_strict(ids, return_dtype=pl.UInt32)
    # Of a callback's registrations those of its last process come first: they describe it.
    replaced = known.filter(pl.col("callback_id") != pl.col("latest"))["callback_id"]
    superseded = pl.col("callback_id").is_in(replaced.implode())
    callbacks = flow.objects.callbacks.sort(superseded, maintain_order=True).with_columns(
        renumbered
    )
    buffers = flow.objects.buffers.with_columns(renumbered)
    names = flow.followed.group_by("node", "last_pid", maintain_order=True).agg("pid")
    notes = (
        f"{node} was started again (processes {', '.join(map(str, pids))}): it counts as one node."
        for node, _, pids in names.sort("node", "last_pid").iter_rows()
    )
    return replace(
        flow,
        objects=replace(flow.objects, callbacks=callbacks, buffers=buffers),
        instances=flow.instances.with_columns(renumbered),
        publications=flow.publications.with_columns(renumbered),
        takes=flow.takes.with_columns(renumbered),
        contradictions=tuple(
            replace(
                contradiction,
                callbacks=frozenset(ids[number] for number in contradiction.callbacks),
            )
            for contradiction in flow.contradictions
        ),
        without_takes=frozenset(ids[number] for number in flow.without_takes),
        notes=(*flow.notes, *notes),
    )


def _begun_outside(published: pl.DataFrame, instances: pl.DataFrame) -> pl.DataFrame:
    """Take the publications of rclpy's timers out of the instances of subscriptions.

    For recordings without `rcl_timer_call`. A publisher that published before its thread took any
    message publishes for a timer, also where its later publications come after a take.
    """
    inside = pl.lit(instances["assumed"]).gather("instance")
    published = published.with_columns(assumed=inside)
    first = pl.col("instance").first().is_null()
    of_timer = (first & pl.col("assumed").fill_null(True).all()).over("publisher")
    columns = (
        pl.when(~of_timer).then(column).alias(column) for column in ("instance", "callback_id")
    )
    return published.with_columns(columns).drop("assumed")


def _with_assumed_writers(
    objects: Objects,
    instances: pl.DataFrame,
    published: pl.DataFrame,
    tables: events.EventTables,
) -> tuple[Objects, pl.DataFrame, pl.DataFrame]:
    """Add a callback, and instances, for each topic that is published only outside callbacks.

    The new instances come last.
    """
    key, columns = ["pid", "node", "topic"], ["instance", "callback_id"]
    # First by publisher, which is a single number a row instead of three columns.
    of_publisher = published.group_by("publisher").agg(
        pl.col(key).first(), inside=pl.col("instance").count(), valid_from=pl.col("time").min()
    )
    writers = of_publisher.group_by(key).agg(pl.col("inside").sum(), pl.col("valid_from").min())
    internal = pl.col("topic").cast(pl.String).is_in(sorted(INTERNAL_TOPICS))
    outside = writers.filter((pl.col("inside") == 0) & ~internal & pl.col("node").is_not_null())
    if outside.is_empty():
        return objects, instances, published
    last: int | None = objects.callbacks.select(pl.col("callback_id").max()).item()
    first = 0 if last is None else last + 1
    outside = outside.sort("valid_from", "topic").with_row_index("callback_id", offset=first)
    callback_of_topic = outside.select(*key, "callback_id")
    outside_publications = published.drop(columns).join(
        callback_of_topic, on=key, maintain_order="left"
    )
    outside_publications = outside_publications.with_row_index("instance", offset=instances.height)
    assumed_instances = outside_publications.select(
        *(*columns, "pid", "tid"), start="time", intra_process=pl.lit(False), assumed=pl.lit(True)
    )
    published = published.with_columns(
        pl.coalesce(
            column, by_number(outside_publications, "publication", column, published.height)
        )
        for column in columns
    )
    periods = _periods_of_writers(outside_publications, objects, tables)
    period = pl.col("callback_id").replace_strict(periods, default=None, return_dtype=pl.Int64)
    new = outside.select(
        *("pid", "valid_from", "callback_id"),
        node=pl.col("node").cast(pl.String),
        kind=pl.when(period.is_null()).then(pl.lit("unknown")).otherwise(pl.lit("loop")),
        period_ns=period,
        handle=pl.lit(0, dtype=pl.UInt64),
        observed=pl.lit(False),
    )
    callbacks = pl.concat([objects.callbacks, new], how="diagonal_relaxed").cast(CALLBACK_SCHEMA)  # type: ignore[arg-type]
    notes = _notes_of_writers(outside, outside_publications, periods, tables)
    objects = replace(objects, callbacks=callbacks, notes=(*objects.notes, *notes))
    all_instances = pl.concat([instances, assumed_instances], how="diagonal").select(
        instances.columns
    )
    return objects, all_instances, published


def _periods_of_writers(
    written: pl.DataFrame, objects: Objects, tables: events.EventTables
) -> dict[int, int]:
    """Map the callbacks of threads that publish regularly, as a loop does, to their periods (ns).

    Nodes of rclpy are left out, whose timers publish outside callbacks as well; and threads of
    which events of sleeps show that they are no loops.
    """
    in_cpp = objects.callbacks.filter("observed").select("pid", "node").unique()
    sleeping = events.table(tables, "thread_wake").select("pid", "tid").unique()
    written = written.with_columns(pl.col("node").cast(pl.String))
    written = written.join(in_cpp, on=["pid", "node"], how="semi", maintain_order="left")
    written = written.join(sleeping, on=["pid", "tid"], how="anti", maintain_order="left")
    periods = {}
    for (number,), rows in written.group_by("callback_id", maintain_order=True):
        times = rows["time"].sort().to_numpy()
        if rows["tid"].n_unique() == 1 and seems_regular(times):
            periods[int(str(number))] = regular_period(times) or 0
    return periods


def _notes_of_writers(
    writers: pl.DataFrame,
    written: pl.DataFrame,
    periods: Collection[int],
    tables: events.EventTables,
) -> Iterator[str]:
    """Say of topics that are published only outside callbacks what is known of who does it.

    ``writers`` has their callbacks, ``written`` the publications; ``periods`` are those that count
    as loops.
    """
    sleeping = events.table(tables, "thread_wake").select("pid", "tid").unique()
    followed = written.join(sleeping, on=["pid", "tid"]).group_by("callback_id")
    threads = dict(followed.agg(pl.col("tid").first()).iter_rows())
    for node, topic, number in writers.select("node", "topic", "callback_id").iter_rows():
        if number in periods:
            text = (
                "regularly from a thread of its own, which counts as a loop. No event shows its"
                " sleep (`record --source preload` sees it): each of its instances is known by its"
                " publication alone, so its response time, its overruns, and what it read while it"
                " computed are not known"
            )
        elif number in threads:
            text = (
                f"from a thread of its own (thread {threads[number]}) that does not sleep for a"
                " time, mostly wakes up before it is over, or waits for something else: it is paced"
                " by data or by another thread, and has no period of its own. A chain that begins"
                " there is measured from the publication"
            )
        else:
            text = (
                "outside its callbacks (from a thread of its own, from Python, or from a service"
                " client's callback): a chain that begins there is measured from the publication"
            )
        yield f"{node} publishes {topic} {text}."
