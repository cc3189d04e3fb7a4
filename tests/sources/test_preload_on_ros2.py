"""The library in front of a real ROS 2, LTTng behind it: both record one and the same run."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Event, Thread

import numpy as np
import polars as pl
import pytest
from containers import in_container
from small_chain import small_chain

import chainshaper as cs
from chainshaper.flow.record import record_command
from chainshaper.monitor.watch import SECOND, Watch
from chainshaper.sources.preload import PreloadTracer, event_names, installed_library

SECONDS = 6
LENGTHS = {"gid": 16}  # LTTng has what follows the gid as well


@pytest.fixture
def launch(in_ros2: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command that launches a generated package of C++ nodes."""
    workspace = tmp_path / "ws"
    (workspace / "src").mkdir(parents=True)
    cs.generate_package(small_chain(tmp_path), workspace / "src/small")
    build = ["colcon", "build", "--merge-install", "--packages-select", "small"]
    subprocess.run(build, cwd=workspace, check=True, capture_output=True)
    prefixes = f"{workspace}/install:{os.environ['AMENT_PREFIX_PATH']}"
    monkeypatch.setenv("AMENT_PREFIX_PATH", prefixes)
    return ["ros2", "launch", "small", "small.launch.py"]


@pytest.mark.ros2("rclcpp", "launch_ros")
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("lttng_of_ros2")
def test_events_are_those_of_lttng_one_by_one(
    launch: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trace").mkdir()
    tracer = PreloadTracer(tmp_path / "trace", launch, ())
    for name, value in tracer.start().items():
        monkeypatch.setenv(name, value)
    try:
        done = record_command(
            tmp_path / "lttng", launch, source="lttng", duration_ns=SECONDS * 1_000_000_000
        )
    finally:
        tracer.remove()
    ours, info = tracer.recording()
    theirs = {
        name: table
        for name, table in done.recording.events.items()
        if name in event_names() and table.height  # not those of an executor that waits
    }
    assert info.lost == {"lost_events": 0}
    assert theirs.keys() <= ours.keys()
    assert {"rmw_take", "rmw_publish", "callback_end", "rclcpp_callback_register"} <= theirs.keys()
    ended = max(int(table["time"][-1]) for table in theirs.values())
    for name, table in theirs.items():
        same = [column for column in table.columns if column in ours[name].columns]
        same = [column for column in same if column not in ("time", "cpu")]
        threads = ours[name].partition_by("pid", "tid", as_dict=True, maintain_order=True)
        for thread, expected in table.group_by("pid", "tid", maintain_order=True):
            recorded = threads[thread]
            assert (recorded["time"][expected.height :] > ended - 1_000_000_000).all(), name
            recorded = recorded.head(expected.height)
            assert cut(recorded.select(same)).equals(cut(expected.select(same))), (name, thread)
            assert (recorded["time"] <= expected["time"]).all(), "ours is written first"
    assert info.distribution == done.recording.info.distribution
    assert info.rmw in (None, done.recording.info.rmw)


def cut(table: pl.DataFrame) -> pl.DataFrame:
    return table.with_columns(
        pl.col(name).list.head(length) for name, length in LENGTHS.items() if name in table.columns
    )


@pytest.mark.ros2("rclcpp", "launch_ros")
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("lttng_of_ros2")
def test_what_is_watched_is_what_lttng_records(
    launch: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attached and detached while LTTng records: the same cycles, but for where both are unsure."""
    monkeypatch.setenv("LD_PRELOAD", str(installed_library()))
    watch, over = Watch(["/t1../t3"], users={os.geteuid()}, longest_ns=SECOND // 2), Event()

    def follow() -> None:
        while not over.wait(0.1):
            watch.read()
            if int(time.monotonic() * 10) % 5 == 0:
                watch.look()

    thread = Thread(target=follow)
    thread.start()
    try:
        record_command(tmp_path / "lttng", launch, source="lttng", duration_ns=SECONDS * SECOND)
    finally:
        over.set()
        thread.join()
    (seen,) = watch.chains
    known = cs.measure_latency(tmp_path / "lttng", "/t1../t3").analysis.traversals
    theirs = known.drop_nulls("latency_ns")
    last = theirs["start"].to_numpy()[-1]  # LTTng's session ends before the application does
    cycles = seen.cycles.drop_nulls("latency_ns").filter(pl.col("start") < last)
    start, latency = cycles["start"].to_numpy(), cycles["latency_ns"].to_numpy()
    assert start.size > 20, "enough to compare; a busy machine finds the nodes late"
    nearest = np.abs(theirs["start"].to_numpy()[:, None] - start).argmin(axis=0)
    assert np.unique(nearest).size == start.size, "one of theirs for each of ours"
    assert (np.diff(nearest) == 1).all(), "none is passed over"
    expected = theirs["latency_ns"].to_numpy()[nearest]
    assert np.median(np.abs(latency - expected) / expected) < 0.01


@pytest.mark.ros2("rclcpp", "launch_ros", "diagnostic_msgs", "ros2topic")
@pytest.mark.timeout(300)
def test_diagnostics_are_published_where_ros_2_reads_them(launch: list[str]) -> None:
    words = [sys.executable, "-m", "chainshaper", "watch", "--chain", "/t1../t3", "--longest"]
    words += ["500ms", "--diagnostics", "--json", "--", *launch]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as watching:
        time.sleep(8)  # for the nodes, and for what publishes beside them
        topic = ["/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"]
        echo = ["ros2", "topic", "echo", "--no-daemon", "--once", "--full-length", *topic]
        heard = subprocess.run(
            ["env", *echo], capture_output=True, text=True, check=False, timeout=60
        )
        watching.send_signal(signal.SIGINT)
        streamed, said = watching.communicate(timeout=60)
    assert watching.returncode == 0, said
    assert "chainshaper: /t1../t3" in heard.stdout, heard.stderr + said
    assert "max of the last minute [ms]" in heard.stdout
    counted = [
        json.loads(line)["chains"][0]["counted"]["complete"] for line in streamed.split("\n")[:-1]
    ]
    assert counted == sorted(counted)
    assert counted[-1] > 20


@pytest.mark.ros2("rclcpp", "launch_ros")
@pytest.mark.timeout(300)
def test_a_launch_in_a_container_is_recorded_under_the_numbers_of_here(
    launch: list[str], tmp_path: Path
) -> None:
    if os.geteuid() != 0:
        pytest.skip("a container needs root")
    done = record_command(
        tmp_path / "rec", in_container(launch), source="preload", duration_ns=SECONDS * SECOND
    )
    tables, info = done.recording.events, done.recording.info
    executing = {(thread.pid, thread.tid) for thread in info.threads if thread.role == "executor"}
    started = set(tables["callback_start"].select("pid", "tid").unique().iter_rows())
    assert started <= executing
    assert min(pid for pid, _ in executing) > 100, "in there they are among the first"
    assert info.lost == {"lost_events": 0}
    assert len({thread.node for thread in info.threads}) > 1
