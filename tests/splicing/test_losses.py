"""More messages than a cycle has room for, and logs that cannot be written: nothing is lost that is
not counted, and nothing stops the output. The Python node, on a stand-in for rclpy."""

import os
import signal
import time
from collections import Counter
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from node_run import RELIABLE, NodeRun, running_node, stamped
from processes import wait_for

from chainshaper.planning import Plan
from chainshaper.planning.plan import revised
from chainshaper.sources.gate_log import read_gate_log, rows_missing
from chainshaper.splicing.shaped_outputs import ShapedOutput, find_outputs, output_text
from chainshaper.splicing.shaping_process import ShapingProcess, write_shaping_process

MS = 1_000_000
PUBLISHERS = {"/t3_tmp": [{"type": "sensor_msgs/msg/Image", "qos": RELIABLE}]}


def process_of(
    plan: Plan, folder: Path, log: Path, slot: tuple[int, int] = (20 * MS, 45 * MS), **changes: Any
) -> ShapingProcess:
    """The node of a plan with one slot; ``log_bytes`` is no part of a plan."""
    servers = tuple(
        server.model_copy(update={"slots": (slot,)}) if server.name == "output" else server
        for server in plan.servers
    )
    log_bytes = changes.pop("log_bytes", None)
    plan = revised(plan, servers=servers, anchor="cycle", **changes)
    assert plan.shaping_node is not None
    process = write_shaping_process(plan, plan.shaping_node, "python", folder, log=log)
    if log_bytes is not None:
        with process.parameters_file.open("a") as file:
            file.write(f"    log_bytes: {log_bytes}\n")
    return process


def send(run: NodeRun, count: int, first: int = 0, pause_s: float = 0.0) -> list[str]:
    payloads = [stamped(first.to_bytes(4, "big")).hex() for first in range(first, first + count)]
    for number, payload in enumerate(payloads, start=first):
        run.tell(topic="/t3_tmp", payload=payload, source=time.time_ns(), number=number)
        time.sleep(pause_s)
    return payloads


def came_out(run: NodeRun) -> list[str]:
    return [words["payload"] for words in run.said if words.get("published") == "/t3"]


def outputs(folder: Path) -> tuple[ShapedOutput, ...]:
    return find_outputs(iter([str(folder / "outputs"), str(folder / "chainshaper" / "outputs")]))


def counted(folder: Path) -> int:
    """How many messages of the one output `status` knows of, those that DDS lost included."""
    return sum(output.published + sum(output.lost.values()) for output in outputs(folder))


def wait_for_rows(run: NodeRun, log: Path, count: int) -> pl.DataFrame:
    """The log, when it has so many rows."""
    run.hear(lambda words: words.get("event") == "spinning") if not run.said else None
    wait_for(lambda: log.exists() and read_gate_log(log).height >= count, f"{count} rows in {log}")
    return read_gate_log(log)


@pytest.mark.parametrize(
    ("messages", "lost"),
    [("all-in-order", "overflowed"), ("newest", "replaced"), ("first", "surplus")],
)
def test_bursts_leave_as_planned_and_the_rest_is_counted(
    tmp_path: Path, plan: Plan, messages: str, lost: str
) -> None:
    log, bursts, size = tmp_path / "gate.csv", 3, 20
    process = process_of(plan, tmp_path, log, messages=messages)
    sent: list[str] = []
    with running_node(process, tmp_path, PUBLISHERS) as run:
        run.hear(lambda words: words.get("event") == "spinning")
        for burst in range(bursts):
            # When the slot has just closed: what comes while it is open leaves at once.
            time.sleep((plan.cycle_ns - time.monotonic_ns() % plan.cycle_ns) / 1e9)
            sent += send(run, size, burst * size)
            wait_for_rows(run, log, len(sent))
        wait_for(lambda: counted(tmp_path) == len(sent), "all to be counted")
        (output,) = outputs(tmp_path)
        assert run.end() == 0
    out, rows = came_out(run), read_gate_log(log)
    dropped = Counter(rows["dropped"].drop_nulls())
    assert len(sent) == len(out) + dropped.total()
    assert rows["release"].count() == len(out)
    assert out == [payload for payload in sent if payload in out], "in the order they came"
    assert dropped[lost] > 0
    assert (output.published, output.lost) == (len(out), dropped)
    assert output.late == rows["overrun"].count()
    said_of_it = f"so far {len(out)} messages published, {output.late} late, "
    assert said_of_it in output_text(output)
    assert f", {dropped[lost]} {lost}" in output_text(output)
    assert set(dropped) <= {lost, "overflowed"}
    if messages == "all-in-order":
        assert len(out) >= bursts * 10, "the history has room for ten"
    said = [words["log"] for words in run.said if "messages so far" in words.get("log", "")]
    assert said
    assert rows_missing(rows) == (0, 0)


def test_what_the_history_can_hold_leaves_and_nothing_is_lost(tmp_path: Path, plan: Plan) -> None:
    """Ten times the cycle's rate, beside which the slot is open half of the time."""
    log, count = tmp_path / "gate.csv", 100
    process = process_of(plan, tmp_path, log)
    with running_node(process, tmp_path, PUBLISHERS) as run:
        run.hear(lambda words: words.get("event") == "spinning")
        sent = send(run, count, pause_s=0.005)
        rows = wait_for_rows(run, log, count)
        run.end()
    dropped = rows["dropped"].drop_nulls()
    assert len(sent) == len(came_out(run)) + len(dropped)
    assert rows["lost"].sum() == 0


def test_what_dds_lost_before_the_gate_is_counted(tmp_path: Path, plan: Plan) -> None:
    log = tmp_path / "gate.csv"
    with running_node(process_of(plan, tmp_path, log), tmp_path, PUBLISHERS) as run:
        for number in (5, 6, 9, 10, 2):  # the last is from a publisher that was started again
            send(run, 1, number)
        rows = wait_for_rows(run, log, 5)
        wait_for(lambda: counted(tmp_path) == 5 + 2, "all to be counted")
        (output,) = outputs(tmp_path)
        assert run.end() == 0
    assert output.lost["lost by DDS"] == 2
    assert rows["lost"].to_list() == [0, 0, 2, 0, 0]
    assert any("2 lost by DDS" in words.get("log", "") for words in run.said)


def test_the_log_is_bounded_and_says_which_rows_are_gone(tmp_path: Path, plan: Plan) -> None:
    log = tmp_path / "gate.csv"
    process = process_of(plan, tmp_path, log, (0, 50 * MS), log_bytes=4_000)
    with running_node(process, tmp_path, PUBLISHERS) as run:
        run.hear(lambda words: words.get("event") == "spinning")
        for number in range(60):
            send(run, 1, number)
            run.hear(lambda words: words.get("published") == "/t3")
        run.end()
    assert sum(file.stat().st_size for file in tmp_path.glob("gate.csv*")) <= 4_000
    rows = read_gate_log(log)
    removed, unwritten = rows_missing(rows)
    assert (rows["row"][-1], unwritten) == (60, 0)
    assert removed == 60 - rows.height > 0


def test_a_full_disk_does_not_stop_the_output(full_disk: Path, tmp_path: Path, plan: Plan) -> None:
    log = full_disk / "gate.csv"
    process = process_of(plan, tmp_path, log, (0, 50 * MS))
    with running_node(process, tmp_path, PUBLISHERS) as run:
        run.hear(lambda words: words.get("event") == "spinning")
        sent = send(run, 5, pause_s=0.02)
        run.hear(lambda words: words.get("payload") == sent[-1])
        (full_disk / "filling").unlink()
        wait_for(lambda: bool(send(run, 1, 99, 0.1)) and bool(log.stat().st_size), "rows")
        run.end()
    removed, unwritten = rows_missing(read_gate_log(log))
    assert removed + unwritten > 0, "those that found no room"


def test_a_log_that_is_removed_is_made_anew(tmp_path: Path, plan: Plan) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    log = folder / "gate.csv"
    process = process_of(plan, tmp_path, log, (0, 50 * MS))
    with running_node(process, tmp_path, PUBLISHERS) as run:
        send(run, 1, 1)
        wait_for_rows(run, log, 1)
        log.unlink()
        folder.rmdir()
        (last,) = send(run, 1, 2)
        run.hear(lambda words: words.get("payload") == last)
        time.sleep(0.5)  # until its row has found no file
        folder.mkdir()
        wait_for(lambda: bool(send(run, 1, 3, 0.1)) and log.exists(), "a new log")
        run.end()
    rows = read_gate_log(log)
    assert rows["row"][0] > 2, "what came while there was no folder is missing"
    assert rows_missing(rows)[0] == rows["row"][0] - 1


def test_a_disk_that_hangs_does_not_stop_the_output(tmp_path: Path, plan: Plan) -> None:
    """The process that writes the log stands still."""
    log = tmp_path / "gate.csv"
    process = process_of(plan, tmp_path, log, (0, 50 * MS))
    with running_node(process, tmp_path, PUBLISHERS) as run:
        send(run, 1)
        wait_for_rows(run, log, 1)
        children = Path(f"/proc/{run.process.pid}/task/{run.process.pid}/children")
        writers = [
            int(pid)
            for pid in children.read_text().split()
            if b"_write_rows" in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]
        (writer,) = writers
        os.kill(writer, signal.SIGSTOP)
        try:
            sent = send(run, 30, 1, 0.005)
            run.hear(lambda words: words.get("payload") == sent[-1])
            assert read_gate_log(log).height == 1
        finally:
            os.kill(writer, signal.SIGCONT)
        run.end()
    rows = read_gate_log(log)
    assert rows["row"].to_list() == list(range(1, 32)), "the pipe had room for them"
