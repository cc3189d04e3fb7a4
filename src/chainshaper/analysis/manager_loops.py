"""The loop of ros2_control: what its controller manager does in each turn.

`ros2_control_node` calls `read`, `update` and `write` of `controller_manager::ControllerManager` in
each turn. The tracing library stands in front of the three, and records each call
(`controller_manager_call`), so that the loop is known without being named:

* **A turn** begins with `read()`, and ends when `write()` returns: then the commands are with the
  hardware. That instant counts as a message on ``NODE:write``. Of several calls of `write()` in a
  turn (Gazebo writes at each step of its simulation) the first counts.
* **What the turn used** is what was stored before `update()` began: in it the controllers read.
* **A loop that is paced by its device** waits in `read()` for most of its period (the parameter
  ``hardware_synchronization.expect_blocking_read_write``). Then its turn begins when `read()`
  returns. Where it waits in `write()`, its turn lasts until then. No event says when it was due.
"""

import polars as pl

from chainshaper.analysis.matching import first_after, latest_before
from chainshaper.values import events
from chainshaper.values.application import MANAGER_WRITE
from chainshaper.values.event_declarations import MANAGER_FUNCTIONS

_THREAD = ["pid", "tid"]
_WAITS = 0.5  # share of its period from which on a loop counts as paced by its device
_READ, _UPDATE, _WRITE = (MANAGER_FUNCTIONS.index(name) for name in ("read", "update", "write"))


def managers(tables: events.EventTables, nodes: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of the controller managers that were called: ``pid, manager, node, valid_from``.

    ``nodes`` is the frame of :class:`~chainshaper.analysis.objects.Objects`. One whose name is not
    known counts as the node that its process created first.
    """
    found = events.table(tables, "controller_manager_found")
    first = nodes.unique("pid", keep="first", maintain_order=True).select("pid", first="node")
    found = found.join(first, on="pid", how="left", maintain_order="left")
    name = pl.when(pl.col("name") != "").then("name")
    found = found.select("pid", "manager", "time", node=pl.coalesce(name, "first"))
    created = nodes.select("pid", "node", created="valid_from")
    created = created.unique(["pid", "node"], keep="first", maintain_order=True)
    found = found.join(created, on=["pid", "node"], how="left", maintain_order="left")
    found = found.with_columns(valid_from=pl.coalesce("created", "time")).drop_nulls("node")
    found = found.unique(["pid", "manager"], keep="first", maintain_order=True)
    return found.select("pid", "manager", "node", "valid_from")


def manager_ends(tables: events.EventTables, nodes: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of the ends of managers' turns as publishers.

    Columns: ``pid, node, valid_from, topic``.
    """
    found = managers(tables, nodes).select("pid", "node", "valid_from")
    found = found.unique(["pid", "node"], keep="first", maintain_order=True)
    return found.with_columns(topic=pl.col("node") + MANAGER_WRITE)


def manager_turns(tables: events.EventTables, nodes: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of the turns of controller managers, sorted by start. Columns:

    * ``pid``, ``tid``; ``manager``: the node.
    * ``start``, ``end`` (ns; ``end`` is null where `write` was not seen to return).
    * ``reads``: when `update` began (ns; null: it was not seen).
    * ``due``, ``wanted_ns``, ``call``: of the sleep before it, as in
      :func:`~chainshaper.analysis.loops.thread_turns` (null: it did not sleep, or its device paces
      it).
    * ``left_ns``: how long it wanted to sleep behind ``end``; 0: it did not sleep before its next
      turn (null: there is none, or its device paces it).
    * ``execution_ns``: its CPU time between the two.
    * ``waits_in``: the function in which it waits for its device; null: in none.
    """
    key = ["pid", "tid", "manager"]
    calls = events.table(tables, "controller_manager_call").sort("began", maintain_order=True)
    is_read = pl.col("function") == _READ
    calls = calls.with_columns(place=is_read.cum_sum().over(key)).filter(pl.col("place") > 0)

    def first(column: str, function: int) -> pl.Expr:
        return pl.col(column).filter(pl.col("function") == function).first()

    turns = calls.group_by(*key, "place", maintain_order=True).agg(
        began=first("began", _READ),
        used_before=first("thread_time_began", _READ),
        read=first("time", _READ),
        used_reading=first("thread_time", _READ),
        reads=first("began", _UPDATE),
        writes=first("began", _WRITE),
        used_writing=first("thread_time_began", _WRITE),
        end=first("time", _WRITE),
        used=first("thread_time", _WRITE),
    )
    turns = turns.with_columns(waits_in=_waits_in(key))
    waits_in_read = (pl.col("waits_in") == "read").fill_null(False)
    turns = turns.with_columns(
        start=pl.when(waits_in_read).then("read").otherwise("began"),
        execution_ns=pl.col("used")
        - pl.when(waits_in_read).then("used_reading").otherwise("used_before"),
    )
    turns = _with_sleeps(turns.sort("began", maintain_order=True), tables)
    found = managers(tables, nodes).select("pid", "manager", "node")
    turns = turns.join(found, on=["pid", "manager"], maintain_order="left")
    columns = ("start", "end", "reads", "due", "wanted_ns", "left_ns", "call", "execution_ns")
    turns = turns.select(*_THREAD, *columns, "waits_in", manager="node")
    return turns.sort("start", maintain_order=True)


def _waits_in(key: list[str]) -> pl.Expr:
    """The function in which a manager waits for most of its period; null: in none."""
    period = pl.col("began").diff().median()
    reading = pl.col("read") - pl.col("began") - (pl.col("used_reading") - pl.col("used_before"))
    writing = pl.col("end") - pl.col("writes") - (pl.col("used") - pl.col("used_writing"))
    return (
        pl.when((reading.median() > _WAITS * period).over(key))
        .then(pl.lit("read"))
        .when((writing.median() > _WAITS * period).over(key))
        .then(pl.lit("write"))
    )


def _with_sleeps(turns: pl.DataFrame, tables: events.EventTables) -> pl.DataFrame:
    """Add what is known of the sleeps before and behind turns, which are sorted by ``began``.

    Columns: ``due``, ``wanted_ns``, ``left_ns``, ``call``.
    """
    slept = events.table(tables, "thread_sleep").select(
        *_THREAD, "call", slept="time", until=pl.when(pl.col("until") > 0).then("until")
    )
    over_before = pl.col("end").shift(1).over(_THREAD)
    begins_next = pl.col("began").shift(-1).over(_THREAD)
    turns = turns.with_columns(over_before=over_before, begins_next=begins_next)
    turns = latest_before(turns, slept, _THREAD, "began", "slept")
    is_between = (pl.col("slept") >= pl.col("over_before")).fill_null(True)
    by_time = is_between & pl.col("waits_in").is_null()
    turns = turns.with_columns(
        due=pl.when(by_time).then("until"),
        wanted_ns=pl.when(by_time).then(pl.col("until") - pl.col("slept")),
        call=pl.when(by_time).then("call"),
    ).drop("slept", "until")
    later = slept.rename({"call": "call_behind"})
    turns = first_after(turns, later, _THREAD, "end", "slept")
    sleeps_behind = (pl.col("slept") < pl.col("begins_next")).fill_null(
        pl.col("slept").is_not_null()
    )
    left = (
        pl.when(sleeps_behind)
        .then(pl.col("until") - pl.col("slept"))
        .when(pl.col("begins_next").is_not_null() & pl.col("end").is_not_null())
        .then(0)
    )
    turns = turns.with_columns(left_ns=pl.when(pl.col("waits_in").is_null()).then(left))
    return turns.sort("began", maintain_order=True)
