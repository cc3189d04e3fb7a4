"""More messages than a cycle has room for, and logs that cannot be written: nothing is lost that is
not counted, and nothing stops the output. The Python node, on a stand-in for rclpy."""

import os
import signal
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from known import known
from node_run import NodeRun, leaving_in, outputs, parameters_of, running_node, stamped
from processes import wait_for

from chainshaper.planning import ChainPlan
from chainshaper.sources.gate_log import read_gate_log, rows_missing
from chainshaper.splicing.shaped_outputs import output_text
from chainshaper.splicing.shaping_process import write_shaping_process

MS = 1_000_000
OPEN = (0, 50 * MS)  # a slot that is always open


@contextmanager
def at_work(
    plan: ChainPlan,
    folder: Path,
    log: Path,
    slot: tuple[int, int] = (20 * MS, 45 * MS),
    **changes: Any,
) -> Iterator[NodeRun]:
    """The node of a plan with one slot; ``log_bytes`` is no part of a plan."""
    log_bytes = changes.pop("log_bytes", 100_000_000)
    plan = leaving_in(plan, slot, anchor="cycle", **changes)
    process = write_shaping_process(plan, known(plan.shaping_node), "python", folder, log=log)
    parameters_of(process, log_bytes=log_bytes)
    with running_node(process, folder) as run:
        yield run


def send(run: NodeRun, count: int, first: int = 0, pause_s: float = 0.0) -> list[bytes]:
    payloads = [stamped(number.to_bytes(4, "big")) for number in range(first, first + count)]
    for number, payload in enumerate(payloads, start=first):
        run.send(payload, time.time_ns(), number=number)
        time.sleep(pause_s)
    return payloads


def wait_until_counted(folder: Path, count: int) -> None:
    """Until `status` knows of so many messages of the one output, those that DDS lost included."""

    def counted() -> int:
        return sum(output.published + sum(output.lost.values()) for output in outputs(folder))

    wait_for(lambda: counted() == count, "all to be counted")


def wait_for_rows(log: Path, count: int) -> pl.DataFrame:
    wait_for(lambda: log.exists() and read_gate_log(log).height >= count, f"{count} rows in {log}")
    return read_gate_log(log)


@pytest.mark.parametrize(
    ("messages", "lost"),
    [("all-in-order", "overflowed"), ("newest", "replaced")],
)
def test_bursts_leave_as_planned_and_the_rest_is_counted(
    tmp_path: Path, plan: ChainPlan, messages: str, lost: str
) -> None:
    log, bursts, size = tmp_path / "gate.csv", 2, 20
    sent: list[bytes] = []
    with at_work(plan, tmp_path, log, messages=messages) as run:
        for burst in range(bursts):
            # When the slot has just closed: what comes while it is open leaves at once.
            time.sleep((plan.cycle_ns - time.monotonic_ns() % plan.cycle_ns) / 1e9)
            sent += send(run, size, burst * size)
            wait_for_rows(log, len(sent))
        wait_until_counted(tmp_path, len(sent))
        (output,) = outputs(tmp_path)
        assert run.end() == 0
    out, rows = run.published, read_gate_log(log)
    dropped = Counter(rows["dropped"].drop_nulls())
    assert len(sent) == len(out) + dropped.total()
    assert rows["release"].count() == len(out)
    assert out == [payload for payload in sent if payload in out], "in the order they came"
    assert (output.published, output.lost) == (len(out), dropped)
    assert output.late == rows["overrun"].count()
    text = output_text(output)
    assert f"so far {len(out)} messages published, {output.late} late, " in text
    assert dropped[lost] > 0
    assert f", {dropped[lost]} {lost}" in text
    assert set(dropped) <= {lost, "overflowed"}
    if messages == "all-in-order":
        assert len(out) >= bursts * 10, "the history has room for ten"
    assert any("messages so far" in text for text in run.logged)
    assert rows_missing(rows) == (0, 0)


def test_what_dds_lost_before_the_gate_is_counted(tmp_path: Path, plan: ChainPlan) -> None:
    log = tmp_path / "gate.csv"
    with at_work(plan, tmp_path, log) as run:
        for number in (5, 6, 9, 10, 2):  # the last is from a publisher that was started again
            send(run, 1, number)
        rows = wait_for_rows(log, 5)
        wait_until_counted(tmp_path, 5 + 2)
        (output,) = outputs(tmp_path)
        assert run.end() == 0
    assert output.lost["lost by DDS"] == 2
    assert rows["lost"].to_list() == [0, 0, 2, 0, 0]
    assert any("2 lost by DDS" in text for text in run.logged)


def test_the_log_is_bounded_and_says_which_rows_are_gone(tmp_path: Path, plan: ChainPlan) -> None:
    log = tmp_path / "gate.csv"
    with at_work(plan, tmp_path, log, OPEN, log_bytes=4_000) as run:
        for number in range(60):
            send(run, 1, number)
            run.hear_published()
        run.end()
    assert sum(file.stat().st_size for file in tmp_path.glob("gate.csv*")) <= 4_000
    rows = read_gate_log(log)
    removed, unwritten = rows_missing(rows)
    assert (rows["row"][-1], unwritten) == (60, 0)
    assert removed == 60 - rows.height > 0


def test_a_full_disk_does_not_stop_the_output(
    full_disk: Path, tmp_path: Path, plan: ChainPlan
) -> None:
    log = full_disk / "gate.csv"
    with at_work(plan, tmp_path, log, OPEN) as run:
        sent = send(run, 5, pause_s=0.02)
        run.hear_published(sent[-1])
        (full_disk / "filling").unlink()
        wait_for(lambda: bool(send(run, 1, 99, 0.1)) and bool(log.stat().st_size), "rows")
        run.end()
    removed, unwritten = rows_missing(read_gate_log(log))
    assert removed + unwritten > 0, "those that found no room"


def test_a_log_that_is_removed_is_made_anew(tmp_path: Path, plan: ChainPlan) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    log = folder / "gate.csv"
    with at_work(plan, tmp_path, log, OPEN) as run:
        send(run, 1, 1)
        wait_for_rows(log, 1)
        log.unlink()
        folder.rmdir()
        (last,) = send(run, 1, 2)
        run.hear_published(last)
        time.sleep(0.3)  # until its row has found no file
        folder.mkdir()
        wait_for(lambda: bool(send(run, 1, 3, 0.1)) and log.exists(), "a new log")
        run.end()
    rows = read_gate_log(log)
    assert rows["row"][0] > 2, "what came while there was no folder is missing"
    assert rows_missing(rows)[0] == rows["row"][0] - 1


def test_a_disk_that_hangs_does_not_stop_the_output(tmp_path: Path, plan: ChainPlan) -> None:
    """The process that writes the log stands still."""
    log = tmp_path / "gate.csv"
    with at_work(plan, tmp_path, log, OPEN) as run:
        send(run, 1)
        wait_for_rows(log, 1)
        children = Path(f"/proc/{run.process.pid}/task/{run.process.pid}/children")
        (writer,) = (
            int(pid)
            for pid in children.read_text().split()
            if b"_write_rows" in Path(f"/proc/{pid}/cmdline").read_bytes()
        )
        os.kill(writer, signal.SIGSTOP)
        try:
            sent = send(run, 30, 1, 0.005)
            run.hear_published(sent[-1])
            assert read_gate_log(log).height == 1
        finally:
            os.kill(writer, signal.SIGCONT)
        run.end()
    rows = read_gate_log(log)
    assert rows["row"].to_list() == list(range(1, 32)), "the pipe had room for them"


def test_a_link_in_the_place_of_the_log_is_not_followed(tmp_path: Path, plan: ChainPlan) -> None:
    """Before the node starts, and while it runs: the output goes on, the target is not touched."""
    secret, log = tmp_path / "secret", tmp_path / "gate.csv"
    secret.write_text("mine\n")
    log.symlink_to(secret)
    with at_work(plan, tmp_path, log, OPEN) as run:
        (first,) = send(run, 1, 1)
        run.hear_published(first)
        log.unlink()
        wait_for(lambda: bool(send(run, 1, 2, 0.1)) and log.exists(), "a new log")
        log.unlink()
        log.hardlink_to(secret)
        (last,) = send(run, 1, 99)
        run.hear_published(last)
        assert any("no log is written to" in text for text in run.logged)
        run.end()
    assert secret.read_text() == "mine\n"
