"""From the engine's log to the event tables, as the live workload writes them.

One entry of the log often stands for several events of the same instant: what an executor chose
is got ready and executed, a publication passes rclcpp, rcl and rmw, and so does a message that is
taken. Their tables share the entry's columns.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.simulation import layout as at
from chainshaper.simulation.arrays import System
from chainshaper.simulation.layout import NONE, Memory
from chainshaper.values import events
from chainshaper.workload.event_log import WORDS

__all__ = ["Names", "created_objects", "event_frames", "name_objects"]

FIRST_HANDLE = 0x55D0_0000_0000
HANDLE_STEP = 0x100

Columns = dict[str, pl.Series]


@dataclass(frozen=True)
class Names:
    """What the rows of the engine's arrays are called in events, as arrays to look up in.

    ``pids``, ``tids``, ``cpus``: by thread. ``callbacks``, ``handles`` (timer or subscription),
    ``rmw_handles``: by entity. ``publishers``, ``rmw_publishers``: by publisher. ``created`` are
    the initialisation events, a list of rows per event.
    """

    pids: npt.NDArray[np.int32]
    tids: npt.NDArray[np.int32]
    cpus: npt.NDArray[np.int32]
    comms: tuple[str, ...]
    callbacks: npt.NDArray[np.uint64]
    handles: npt.NDArray[np.uint64]
    rmw_handles: npt.NDArray[np.uint64]
    publishers: npt.NDArray[np.uint64]
    rmw_publishers: npt.NDArray[np.uint64]
    created: Mapping[str, list[dict[str, Any]]]


def name_objects(system: System, machine: Memory, cores: Sequence[int]) -> Names:
    """Give every object a handle, unique in its process, and note its creation.

    ``cores`` has the number of each of the machine's cores.
    """
    given = [FIRST_HANDLE] * len(system.processes)
    created: dict[str, list[dict[str, Any]]] = {}

    def handle(process: int) -> int:
        given[process] += HANDLE_STEP
        return given[process]

    def note(event: str, process: int, **fields: Any) -> None:
        pid = system.processes[process].pid
        core = core_of[executors[process]]
        row = {"time": 0, "pid": pid, "tid": pid, "cpu": core, **fields}
        created.setdefault(event, []).append(row)

    core_of = [cores[row] for row in _core_rows(machine)]
    executors = {t.process: n for n, t in enumerate(system.threads) if t.role == "executor"}
    nodes = []
    for number, process in enumerate(system.processes):
        namespace, _, name = process.node.rpartition("/")
        nodes.append(handle(number))
        note("rcl_init", number, context_handle=handle(number), version="simulation")
        named = {"node_name": name, "namespace": namespace or "/"}
        note("rcl_node_init", number, node_handle=nodes[number], rmw_handle=handle(number), **named)
    publishers = []
    for publisher in system.publishers:
        own, rmw = handle(publisher.process), handle(publisher.process)
        publishers.append((own, rmw))
        note(
            "rcl_publisher_init",
            publisher.process,
            publisher_handle=own,
            node_handle=nodes[publisher.process],
            rmw_publisher_handle=rmw,
            topic_name=publisher.topic,
            queue_depth=system.application.topic(publisher.topic).depth,
            asynchronous=int(publisher.asynchronous),
        )
    entities = []
    for entity in system.entities:
        owner, node = entity.process, nodes[entity.process]
        callback, own, rmw = handle(owner), handle(owner), handle(owner)
        entities.append((callback, own, rmw))
        if entity.topic is None:
            period = entity.described.timer_ns
            note("rcl_timer_init", owner, timer_handle=own, period=period)
            note("rclcpp_timer_callback_added", owner, timer_handle=own, callback=callback)
            note("rclcpp_timer_link_node", owner, timer_handle=own, node_handle=node)
        else:
            rclcpp = handle(owner)
            note(
                "rcl_subscription_init",
                owner,
                subscription_handle=own,
                node_handle=node,
                rmw_subscription_handle=rmw,
                topic_name=entity.topic,
                queue_depth=system.application.topic(entity.topic).depth,
            )
            note("rclcpp_subscription_init", owner, subscription_handle=own, subscription=rclcpp)
            added = "rclcpp_subscription_callback_added"
            note(added, owner, subscription=rclcpp, callback=callback)
        filtered = "message_filters::" if entity.described.synchronises else ""
        symbol = f"{filtered}{system.processes[owner].node}::callback{entity.index}"
        note("rclcpp_callback_register", owner, callback=callback, symbol=symbol)
    by_entity = np.array(entities, dtype=np.uint64).reshape(-1, 3)
    by_publisher = np.array(publishers, dtype=np.uint64).reshape(-1, 2)
    return Names(
        pids=np.array([system.processes[t.process].pid for t in system.threads], dtype=np.int32),
        tids=np.array([t.tid for t in system.threads], dtype=np.int32),
        cpus=np.array(core_of, dtype=np.int32),
        comms=tuple(
            system.processes[t.process].node.strip("/").replace("/", ".")[:15]
            if t.role == "executor"
            else f"dds.{t.role}"
            for t in system.threads
        ),
        callbacks=by_entity[:, 0].copy(),
        handles=by_entity[:, 1].copy(),
        rmw_handles=by_entity[:, 2].copy(),
        publishers=by_publisher[:, 0].copy(),
        rmw_publishers=by_publisher[:, 1].copy(),
        created=created,
    )


def created_objects(names: Names) -> dict[str, pl.DataFrame]:
    """The tables of the initialisation events."""
    tables = {}
    for event, rows in names.created.items():
        types = {**events.COMMON_COLUMNS, **events.FIELDS[event]}
        types |= events.OPTIONAL_FIELDS.get(event, {})
        schema = {name: type_ for name, type_ in types.items() if name in rows[0]}
        tables[event] = pl.DataFrame(rows, schema=schema)
    return tables


def event_frames(system: System, names: Names, machine: Memory) -> dict[str, pl.DataFrame]:
    """What is in the log, as event tables; only those in which there is something."""
    started, (callback, used, *_) = _entries(names, machine, at.L_START)
    ended, (ended_callback, ended_used, *_) = _entries(names, machine, at.L_END)
    published, (publisher, address, *_) = _entries(names, machine, at.L_PUBLISH)
    chosen, (executed, *_) = _entries(names, machine, at.L_EXECUTE)
    waited, (timeout, *_) = _entries(names, machine, at.L_WAIT)
    took, (entity, taken_address, source, taken) = _entries(names, machine, at.L_TAKE)
    message, taken_message = address.view(np.uint64), taken_address.view(np.uint64)
    passed_on = _frame(took, message=taken_message).filter(pl.Series(taken == 1))
    frames = {
        "callback_start": _frame(
            started,
            callback=names.callbacks[callback],
            is_intra_process=np.zeros(callback.size, dtype=np.int32),
            thread_time=used,
        ),
        "callback_end": _frame(
            ended, callback=names.callbacks[ended_callback], thread_time=ended_used
        ),
        "rclcpp_publish": _frame(published, message=message),
        "rcl_publish": _frame(
            published, publisher_handle=names.publishers[publisher], message=message
        ),
        "rmw_publish": _frame(
            published,
            rmw_publisher_handle=names.rmw_publishers[publisher],
            message=message,
            timestamp=published["time"].to_numpy(),
        ),
        "rmw_take": _frame(
            took,
            rmw_subscription_handle=names.rmw_handles[entity],
            message=taken_message,
            source_timestamp=source,
            taken=taken.astype(np.int32),
        ),
        "rcl_take": passed_on,
        "rclcpp_take": passed_on,
        "rclcpp_executor_get_next_ready": _frame(chosen),
        "rclcpp_executor_execute": _frame(chosen, handle=names.handles[executed]),
        "rclcpp_executor_wait_for_work": _frame(waited, timeout=timeout),
        "asynchronous_send": _sends(names, machine),
        "sched_switch": _switches(system, names, machine),
        "gate_release": _releases(system, names, machine),
    }
    return {name: frame for name, frame in frames.items() if frame.height}


def _log(machine: Memory, kind: int) -> at.Int64s:
    """The entries of a kind: a row of times, one of threads, and one for each field."""
    return machine[f"log {kind}"][:, : machine["counts"][kind, at.A_COUNT]]


def _entries(names: Names, machine: Memory, kind: int) -> tuple[Columns, list[at.Int64s]]:
    """The columns that all events have, and the fields, of the entries of a kind."""
    times, threads, *fields = _log(machine, kind)
    columns = {
        "time": pl.Series("time", times),
        "pid": pl.Series("pid", names.pids[threads]),
        "tid": pl.Series("tid", names.tids[threads]),
        "cpu": pl.Series("cpu", names.cpus[threads]),
    }
    return columns, fields


def _frame(common: Columns, **fields: npt.NDArray[Any]) -> pl.DataFrame:
    return pl.DataFrame(
        [*common.values(), *(pl.Series(name, values) for name, values in fields.items())]
    )


def _sends(names: Names, machine: Memory) -> pl.DataFrame:
    """Sends are logged when they are over; an event has the time at which one began."""
    over, (publisher, timestamp, outcome, duration) = _entries(names, machine, at.L_SEND)
    return _frame(
        {**over, "time": over["time"] - duration},
        rmw_publisher_handle=names.rmw_publishers[publisher],
        timestamp=timestamp,
        outcome=np.array(WORDS["outcome"])[outcome],
        duration=duration,
    ).sort("time", maintain_order=True)


def _switches(system: System, names: Names, machine: Memory) -> pl.DataFrame:
    """What ran where: `sched_switch`, the idle thread being number 0."""
    times, following, core, before, runnable, _ = _log(machine, at.L_SWITCH)
    # One place more than threads are: NONE, the last one, is the idle thread.
    tids = np.append(names.tids, 0).astype(np.int32)
    pids = np.append(names.pids, 0).astype(np.int32)
    comms = np.array([*names.comms, "swapper"])
    priorities = np.array([99 - t.priority for t in system.threads] + [120], dtype=np.int32)
    rows_of = _core_rows(machine)
    core_numbers = np.zeros(rows_of.max() + 1, dtype=np.int32)
    core_numbers[rows_of] = names.cpus
    return pl.DataFrame(
        {
            "time": times,
            "pid": pids[before],
            "tid": tids[before],
            "cpu": core_numbers[core],
            "prev_comm": comms[before],
            "prev_tid": tids[before],
            "prev_prio": priorities[before],
            "prev_state": 1 - runnable,
            "next_comm": comms[following],
            "next_tid": tids[following],
            "next_prio": priorities[following],
        },
        schema_overrides={"cpu": pl.Int32()},
    )


def _core_rows(machine: Memory) -> at.Int64s:
    rows: at.Int64s = (
        machine["threads"][:, at.T_CORE] - machine.array[at.X_CORES]
    ) // at.CORE_COLUMNS
    return rows


def _releases(system: System, names: Names, machine: Memory) -> pl.DataFrame:
    columns, fields = _entries(names, machine, at.L_RELEASE)
    callback, source, arrival, release, origin, slot, cycles, stamped, overrun, mode, why = fields
    frame = _frame(
        columns,
        callback=names.callbacks[callback],
        source_timestamp=source,
        arrival=arrival,
        origin=origin,
        release=release,
        slot=slot.astype(np.int32),
        cycles_waited=cycles.astype(np.int32),
        anchor=np.array(["cycle", "stamp"])[stamped],
        overrun=np.array([*WORDS["overrun"], ""])[overrun],
        mode=np.array([*system.modes, ""])[mode],
        dropped=np.array([*WORDS["dropped"], ""])[why],
    )
    absent = [pl.col(name).replace({NONE: None}) for name in ("release", "slot")]
    unsaid = [pl.col(name).replace({"": None}) for name in ("overrun", "mode", "dropped")]
    return frame.with_columns(*absent, *unsaid).sort("time", maintain_order=True)
