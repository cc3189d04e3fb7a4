"""Write a recording of a chain that ends in a control loop: `python examples/write_loop.py REC`.

A sensor publishes /scan every 20 ms. In the process of /controller a subscription stores it, some
milliseconds later, and a loop in a thread of its own, every 10 ms, publishes /command from what is
stored. Its thread sleeps in between. What `chainshaper record` writes has the same tables.
"""

import sys
from collections import defaultdict
from random import Random
from typing import Any

import polars as pl

from chainshaper.values import events
from chainshaper.values.event_declarations import SLEEPING_CALLS
from chainshaper.values.recording import RecordingInfo, write_recording

MS = 1_000_000
SENSOR, CONTROLLER, LOOP = 100, 200, 203  # processes, and the loop's thread
CLOCK_OFFSET = 1_800_000_000_000_000_000
CLOCK_NANOSLEEP = SLEEPING_CALLS.index("clock_nanosleep")

rows = defaultdict[str, list[dict[str, Any]]](list)


def event(name: str, /, time: int, pid: int, tid: int, **fields: Any) -> None:
    rows[name].append({"time": time, "pid": pid, "tid": tid, **fields})


def create(name: str, pid: int, publishes: str, subscribes: str | None = None) -> None:
    """Create a node with a publisher, and with a subscription or a timer."""
    node = {"node_name": name, "namespace": "/", "rmw_handle": 2}
    event("rcl_node_init", 0, pid, pid, node_handle=1, **node)
    of_topic = {"node_handle": 1, "queue_depth": 1}
    publisher = {"publisher_handle": 3, "rmw_publisher_handle": 4, "topic_name": publishes}
    event("rcl_publisher_init", 0, pid, pid, **publisher, **of_topic)
    if subscribes is None:
        event("rcl_timer_init", 0, pid, pid, timer_handle=5, period=20 * MS)
        event("rclcpp_timer_callback_added", 0, pid, pid, timer_handle=5, callback=9)
        event("rclcpp_timer_link_node", 0, pid, pid, timer_handle=5, node_handle=1)
        return
    handles = {"subscription_handle": 6, "rmw_subscription_handle": 7}
    event("rcl_subscription_init", 0, pid, pid, **handles, topic_name=subscribes, **of_topic)
    event("rclcpp_subscription_init", 0, pid, pid, subscription_handle=6, subscription=8)
    event("rclcpp_subscription_callback_added", 0, pid, pid, subscription=8, callback=9)


def callback(start: int, end: int, pid: int) -> None:
    event("callback_start", start, pid, pid, callback=9, is_intra_process=0, thread_time=start)
    event("callback_end", end, pid, pid, callback=9, thread_time=end)


def publish(time: int, pid: int, tid: int) -> None:
    message = {"message": 1, "timestamp": time + CLOCK_OFFSET}
    event("rmw_publish", time, pid, tid, rmw_publisher_handle=4, **message)


def main(output: str) -> None:
    times = Random(1)
    create("sensor", SENSOR, "/scan")
    create("controller", CONTROLLER, "/command", "/scan")
    for at in range(20 * MS, 4000 * MS, 20 * MS):
        callback(at, at + MS, SENSOR)
        publish(at + MS // 2, SENSOR, SENSOR)
        stored = at + times.randrange(2 * MS, 9 * MS)
        taken = {"source_timestamp": at + MS // 2 + CLOCK_OFFSET, "taken": 1, "message": 1}
        event("rmw_take", stored, CONTROLLER, CONTROLLER, rmw_subscription_handle=7, **taken)
        callback(stored + 10_000, stored + 30_000, CONTROLLER)
    for due in range(33 * MS, 4000 * MS, 10 * MS):
        asleep, woke = due - 8 * MS, due + times.randrange(20_000, 90_000)
        event("thread_sleep", asleep, CONTROLLER, LOOP, until=due, call=CLOCK_NANOSLEEP)
        rows["thread_sleep"][-1]["thread_time"] = asleep
        event("thread_wake", woke, CONTROLLER, LOOP, call=CLOCK_NANOSLEEP, thread_time=woke)
        publish(woke + MS, CONTROLLER, LOOP)
    types = {name: events.column_types(name) for name in rows}
    tables = {
        name: pl.DataFrame(of_event, schema_overrides=types[name]).sort("time")
        for name, of_event in rows.items()
    }
    info = RecordingInfo(source="preload", clock_offset_ns=CLOCK_OFFSET)
    sys.stdout.write(f"{write_recording(output, tables, info).path}\n")


if __name__ == "__main__":
    main(sys.argv[1])
