"""Write a small LTTng trace to try things on, as `ros2 trace` would have recorded it.

    python examples/write_trace.py FOLDER

A camera (timer, 50 ms) publishes /image, a detector makes /objects of it, a planner makes
/command of those, and a brake takes them. All share one core, which a logger takes from them now
and then; the kernel's `sched_switch` lies beside the events of user space.
"""

import random
import sys
from pathlib import Path
from typing import Any

import polars as pl

from chainshaper.values import events

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests/helpers"))
from ctf_writing import write_lttng_trace

CYCLES = 40
PERIOD_NS = 50_000_000
CLOCK_OFFSET_NS = 1_700_000_000_000_000_000
BOOTED_NS = 3_600_000_000_000  # one hour before the trace
NODES = ("camera", "detector", "planner", "brake")
TOPICS = ("/image", "/objects", "/command")
EXECUTION_MS = ((1, 2), (8, 14), (3, 9), (0.1, 0.2))
LOGGER = 2000

Rows = dict[str, list[dict[str, Any]]]


def add(rows: Rows, name: str, time: float, pid: int, **fields: Any) -> None:
    """One event; every process has one thread."""
    row = {"time": BOOTED_NS + int(time), "pid": pid, "tid": pid, "cpu": 0, **fields}
    rows.setdefault(name, []).append(row)


def create(rows: Rows, place: int) -> None:
    """The objects of one node: its publisher, and the timer or subscription that drives it."""
    pid, at = 1000 + place, 1_000 * place
    add(rows, "rcl_init", at, pid, context_handle=1, version="8.2.2")
    add(rows, "rcl_node_init", at, pid, node_handle=2, rmw_handle=3,
        node_name=NODES[place], namespace="/")  # fmt: skip
    if place < len(TOPICS):
        add(rows, "rcl_publisher_init", at, pid, publisher_handle=4, node_handle=2,
            rmw_publisher_handle=5, topic_name=TOPICS[place], queue_depth=10)  # fmt: skip
        gid = [1, 16, place, *[0] * 21]  # 1, 16: Eclipse Cyclone DDS
        add(rows, "rmw_publisher_init", at, pid, rmw_publisher_handle=5, gid=gid)
    if place == 0:
        add(rows, "rcl_timer_init", at, pid, timer_handle=6, period=PERIOD_NS)
        add(rows, "rclcpp_timer_callback_added", at, pid, timer_handle=6, callback=7)
        add(rows, "rclcpp_timer_link_node", at, pid, timer_handle=6, node_handle=2)
    else:
        add(rows, "rcl_subscription_init", at, pid, subscription_handle=8, node_handle=2,
            rmw_subscription_handle=9, topic_name=TOPICS[place - 1], queue_depth=10)  # fmt: skip
        add(rows, "rclcpp_subscription_init", at, pid, subscription_handle=8, subscription=10)
        add(rows, "rclcpp_subscription_callback_added", at, pid, subscription=10, callback=7)
    function = f"{NODES[place].capitalize()}::run()"
    add(rows, "rclcpp_callback_register", at, pid, callback=7, symbol=function)


def switch(rows: Rows, time: float, before: int, after: int) -> None:
    """The core goes from one thread to another; 0 is the idle thread."""
    add(rows, "sched_switch", time, before, prev_comm=f"thread_{before}", prev_tid=before,
        prev_prio=20, prev_state=0, next_comm=f"thread_{after}", next_tid=after,
        next_prio=20)  # fmt: skip


def run(rows: Rows, chance: random.Random, start: float) -> None:
    """One cycle: every node takes the message of the one before it, computes and publishes."""
    now, stamp = start, 0
    for place, (low, high) in enumerate(EXECUTION_MS):
        pid = 1000 + place
        switch(rows, now, 0, pid)
        if place:
            add(rows, "rmw_take", now + 5_000, pid, rmw_subscription_handle=9, message=12,
                source_timestamp=stamp, taken=1)  # fmt: skip
        add(rows, "callback_start", now + 10_000, pid, callback=7, is_intra_process=0)
        needs = chance.uniform(low, high) * 1e6
        if chance.random() < 0.2:
            switch(rows, now + needs / 2, pid, LOGGER)
            switch(rows, now + needs / 2 + 2e6, LOGGER, pid)
            needs += 2e6
        end = now + 10_000 + needs
        stamp = CLOCK_OFFSET_NS + BOOTED_NS + int(end) - 20_000
        if place < len(TOPICS):
            add(rows, "rmw_publish", end - 15_000, pid, rmw_publisher_handle=5, message=12,
                timestamp=stamp)  # fmt: skip
        add(rows, "callback_end", end, pid, callback=7)
        switch(rows, end + 5_000, pid, 0)
        now = end + chance.uniform(50_000, 400_000)


def main() -> None:
    """Tell the story of the run, and write it."""
    chance, rows = random.Random(1), dict[str, list[dict[str, Any]]]()
    for place in range(len(NODES)):
        create(rows, place)
    for cycle in range(CYCLES):
        run(rows, chance, PERIOD_NS * (cycle + 1))
    tables = {
        name: pl.DataFrame(
            told, schema_overrides={**events.COMMON_COLUMNS, **events.FIELDS[name]}
        ).sort("time")
        for name, told in rows.items()
    }
    write_lttng_trace(sys.argv[1], tables, clock_offset_ns=CLOCK_OFFSET_NS)


if __name__ == "__main__":
    main()
