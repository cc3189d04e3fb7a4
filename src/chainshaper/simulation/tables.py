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

from chainshaper import events
from chainshaper.simulation import layout as at
from chainshaper.simulation.layout import NONE, Machine
from chainshaper.simulation.system import System
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


def name_objects(system: System, machine: Machine, cores: Sequence[int]) -> Names:
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
        note(
            "rcl_node_init",
            number,
            node_handle=nodes[number],
            rmw_handle=handle(number),
            node_name=name,
            namespace=namespace or "/",
        )
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
            note(
                "rclcpp_subscription_callback_added",
                owner,
                subscription=rclcpp,
                callback=callback,
            )
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


def event_frames(system: System, names: Names, machine: Machine) -> dict[str, pl.DataFrame]:
    """What is in the log, as event tables; only those in which there is something."""
    columns = {kind: _entries(names, machine, kind) for kind in range(at.L_RELEASE)}
    frames = {
        **_callbacks(names, machine, columns),
        **_publications(names, machine, columns),
        **_takes(names, machine, columns),
        **_executors(names, machine, columns),
        "asynchronous_send": _sends(names, machine, columns),
        "sched_switch": _switches(system, names, machine),
        "gate_release": _releases(system, names, machine),
    }
    return {name: frame for name, frame in frames.items() if frame.height}


def _field(machine: Machine, kind: int, field: int) -> at.Int64s:
    return machine.logs[kind][2 + field, : machine.counts[kind, at.A_COUNT]]


def _common(names: Names, times: at.Int64s, threads: at.Int64s) -> Columns:
    return {
        "time": pl.Series("time", times),
        "pid": pl.Series("pid", names.pids[threads]),
        "tid": pl.Series("tid", names.tids[threads]),
        "cpu": pl.Series("cpu", names.cpus[threads]),
    }


def _entries(names: Names, machine: Machine, kind: int) -> Columns:
    rows = machine.counts[kind, at.A_COUNT]
    return _common(names, machine.logs[kind][0, :rows], machine.logs[kind][1, :rows])


def _frame(common: Columns, **fields: npt.NDArray[Any]) -> pl.DataFrame:
    return pl.DataFrame(
        [*common.values(), *(pl.Series(name, values) for name, values in fields.items())]
    )


def _callbacks(
    names: Names, machine: Machine, columns: dict[int, Columns]
) -> dict[str, pl.DataFrame]:
    start, end = at.L_START, at.L_END
    return {
        "callback_start": _frame(
            columns[start],
            callback=names.callbacks[_field(machine, start, 0)],
            is_intra_process=np.zeros(machine.counts[start, at.A_COUNT], dtype=np.int32),
            thread_time=_field(machine, start, 1),
        ),
        "callback_end": _frame(
            columns[end],
            callback=names.callbacks[_field(machine, end, 0)],
            thread_time=_field(machine, end, 1),
        ),
    }


def _publications(
    names: Names, machine: Machine, columns: dict[int, Columns]
) -> dict[str, pl.DataFrame]:
    common = columns[at.L_PUBLISH]
    publisher = _field(machine, at.L_PUBLISH, 0)
    message = _field(machine, at.L_PUBLISH, 1).view(np.uint64)
    handle, rmw = names.publishers[publisher], names.rmw_publishers[publisher]
    now = machine.logs[at.L_PUBLISH][0, : len(publisher)]
    return {
        "rclcpp_publish": _frame(common, message=message),
        "rcl_publish": _frame(common, publisher_handle=handle, message=message),
        "rmw_publish": _frame(common, rmw_publisher_handle=rmw, message=message, timestamp=now),
    }


def _takes(names: Names, machine: Machine, columns: dict[int, Columns]) -> dict[str, pl.DataFrame]:
    entity, source, taken = (_field(machine, at.L_TAKE, field) for field in (0, 2, 3))
    message = _field(machine, at.L_TAKE, 1).view(np.uint64)
    rmw_take = _frame(
        columns[at.L_TAKE],
        rmw_subscription_handle=names.rmw_handles[entity],
        message=message,
        source_timestamp=source,
        taken=taken.astype(np.int32),
    )
    passed_on = _frame(columns[at.L_TAKE], message=message)
    if not taken.all():
        passed_on = passed_on.filter(pl.Series(taken == 1))
    return {"rmw_take": rmw_take, "rcl_take": passed_on, "rclcpp_take": passed_on}


def _executors(
    names: Names, machine: Machine, columns: dict[int, Columns]
) -> dict[str, pl.DataFrame]:
    handle = names.handles[_field(machine, at.L_EXECUTE, 0)]
    return {
        "rclcpp_executor_get_next_ready": _frame(columns[at.L_EXECUTE]),
        "rclcpp_executor_execute": _frame(columns[at.L_EXECUTE], handle=handle),
        "rclcpp_executor_wait_for_work": _frame(
            columns[at.L_WAIT], timeout=_field(machine, at.L_WAIT, 0)
        ),
    }


def _sends(names: Names, machine: Machine, columns: dict[int, Columns]) -> pl.DataFrame:
    """Sends are logged when they are over; an event has the time at which one began."""
    publisher, timestamp, outcome, duration = (
        _field(machine, at.L_SEND, field) for field in range(4)
    )
    sent = machine.logs[at.L_SEND][0, : len(publisher)] - duration
    return _frame(
        {**columns[at.L_SEND], "time": pl.Series("time", sent)},
        rmw_publisher_handle=names.rmw_publishers[publisher],
        timestamp=timestamp,
        outcome=np.array(WORDS["outcome"])[outcome],
        duration=duration,
    ).sort("time", maintain_order=True)


def _switches(system: System, names: Names, machine: Machine) -> pl.DataFrame:
    """What ran where: `sched_switch`, the idle thread being number 0."""
    rows = machine.counts[at.L_SWITCH, at.A_COUNT]
    times, following = machine.logs[at.L_SWITCH][0, :rows], machine.logs[at.L_SWITCH][1, :rows]
    core, before, runnable = (_field(machine, at.L_SWITCH, field) for field in range(3))
    # One place more than threads are: NONE, the last one, is nobody.
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


def _core_rows(machine: Machine) -> at.Int64s:
    rows: at.Int64s = (
        machine.threads[:, at.T_CORE] - machine.memory[at.X_CORES]
    ) // at.CORE_COLUMNS
    return rows


def _releases(system: System, names: Names, machine: Machine) -> pl.DataFrame:
    rows = machine.counts[at.L_RELEASE, at.A_COUNT]
    columns = machine.logs[at.L_RELEASE][:, :rows]
    frame = _frame(
        _common(names, columns[0], columns[1]),
        callback=names.callbacks[columns[2]],
        source_timestamp=columns[3],
        arrival=columns[4],
        origin=columns[6],
        release=columns[5],
        slot=columns[7].astype(np.int32),
        cycles_waited=columns[8].astype(np.int32),
        anchor=np.array(["cycle", "stamp"])[columns[9]],
        overrun=np.array([*WORDS["overrun"], ""])[columns[10]],
        mode=np.array([*system.modes, ""])[columns[11]],
    )
    absent = [pl.col(name).replace({NONE: None}) for name in ("release", "slot")]
    unsaid = [pl.col(name).replace({"": None}) for name in ("overrun", "mode")]
    return frame.with_columns(*absent, *unsaid).sort("time", maintain_order=True)
