"""Recording with a real LTTng: a program whose provider has the name and fields of ROS 2's."""

import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from lttng_daemon import lttng, users_daemon
from lttng_node import required_node

from chainshaper.sources.lttng.session import MIB, LttngSession, buffer_size
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.events import EventTables
from chainshaper.values.recording import RecordingInfo

DEPTH = 7  # of every queue in chain_node.c


@pytest.fixture(scope="module")
def node() -> Path:
    return required_node()


@pytest.fixture
def foreign_daemon(node: Path, tmp_path: Path) -> Iterator[dict[str, str]]:
    home = tmp_path / "user"
    home.mkdir()
    with users_daemon(home) as environment:
        yield environment


def recorded(
    session: LttngSession, *command: str | Path, look_every: float = 0.2
) -> tuple[int, EventTables, RecordingInfo]:
    """Run a command to its end while it is recorded; its process, and what was recorded."""
    try:
        environment = {**os.environ, **session.start()}
        process = subprocess.Popen([*map(str, command)], env=environment)
        while process.poll() is None:
            time.sleep(look_every)
            assert session.failure() is None
        session.stop()
    finally:
        session.remove()
    return process.pid, *session.recording()


def test_every_event_comes_with_its_fields(node: Path, tmp_path: Path) -> None:
    pid, tables, info = recorded(LttngSession(tmp_path, ["x"], ()), node, "flood", "50", "0")
    (created,) = tables["rcl_publisher_init"].iter_rows(named=True)
    assert created["topic_name"] == "/x"
    assert created["queue_depth"] == DEPTH
    assert created["publisher_handle"] == 0x3000
    assert created["rmw_publisher_handle"] == 0x3100
    assert tables["rmw_publisher_init"]["gid"].to_list() == [[0x01, 0x10, *[0] * 22]]
    assert tables["rcl_timer_init"]["period"].to_list() == [1000]
    assert tables["rclcpp_callback_register"]["symbol"].to_list() == ["Source::tick()"]
    assert tables["callback_start"].height == tables["callback_end"].height == 50
    for frame in tables.values():
        assert frame["pid"].unique().to_list() == frame["tid"].unique().to_list() == [pid]
    # The DDS source timestamp is the wall clock's, the event's the monotonic one.
    published = tables["rmw_publish"]
    late = published["time"] + info.clock_offset_ns - published["timestamp"]
    assert late.is_between(-1_000_000, 1_000_000_000).all()
    assert info.source == "lttng"
    assert info.processes == {pid: "/flood"}
    assert (info.distribution, info.rmw) == ("jazzy", "rmw_cyclonedds_cpp")
    assert not any(info.lost.values())


def test_nothing_is_left_when_it_is_over(
    node: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = LttngSession(tmp_path, ["x"], ())
    with (
        tempfile.TemporaryDirectory() as homes
    ):  # others record beside us; sockets' paths are short
        monkeypatch.setattr(tempfile, "tempdir", homes)
        recorded(session, node, "exit", "0")
        session.remove()  # once more does no harm
        assert list(Path(homes).iterdir()) == []
    assert subprocess.run(["pgrep", "-P", str(os.getpid()), "lttng"], check=False).returncode == 1


def test_a_users_daemon_and_sessions_stay_as_they_are(
    node: Path, foreign_daemon: dict[str, str], tmp_path: Path
) -> None:
    current = Path(foreign_daemon["LTTNG_HOME"]) / ".lttngrc"
    assert lttng(foreign_daemon, "create", "mine", f"--output={tmp_path / 'mine'}").returncode == 0
    try:
        before = current.read_text(), lttng(foreign_daemon, "list", "mine").stdout
        folder = tmp_path / "trace"
        folder.mkdir()
        recorded(LttngSession(folder, ["x"], ()), node, "exit", "0")
        assert (current.read_text(), lttng(foreign_daemon, "list", "mine").stdout) == before
        assert "chainshaper" not in lttng(foreign_daemon, "list").stdout
    finally:
        lttng(foreign_daemon, "destroy", "mine")


def test_applications_that_we_have_not_started_are_left_out(
    node: Path, foreign_daemon: dict[str, str], tmp_path: Path
) -> None:
    # Its parent ends at once, so it descends from nobody of ours.
    orphaned = ["sh", "-c", f"{node} flood 100000 1000 > /dev/null 2>&1 & echo $!"]
    started = subprocess.run(orphaned, capture_output=True, text=True, check=True)
    stranger = int(started.stdout)
    try:
        session = LttngSession(tmp_path, ["x"], ())
        pid, tables, info = recorded(session, node, "flood", "300", "1000")
    finally:
        os.kill(stranger, signal.SIGKILL)
    assert tables["callback_start"]["pid"].unique().to_list() == [pid]
    assert tables["callback_start"].height == 300
    assert info.processes == {pid: "/flood"}
    assert info.trace_events["ros2:callback_start"] == 300
    assert any("not started are left out" in note and str(stranger) in note for note in info.notes)


def test_events_that_did_not_fit_are_counted_and_the_remedy_is_named(
    node: Path, tmp_path: Path
) -> None:
    emitted = 200_000
    session = LttngSession(tmp_path, ["x"], (), buffer=16 << 10)
    _, tables, info = recorded(session, node, "flood", str(emitted), "0", look_every=2)
    lost = info.lost["discarded_events"]
    assert lost > 0
    kept = sum(tables[name].height for name in tables)
    assert kept + lost == 5 * emitted + 8  # five events each, eight for the node
    assert any(f"{lost} events were lost" in note and "--buffer 1" in note for note in info.notes)


def test_buffers_are_enlarged_while_the_application_runs(node: Path, tmp_path: Path) -> None:
    session = LttngSession(tmp_path, ["x"], (), buffer=16 << 10)
    _, tables, info = recorded(session, node, "flood", "12000", "200")
    assert sorted(path.name for path in tmp_path.iterdir())[:2] == ["session-1", "session-2"]
    assert any("enlarged from 16 KiB to 64 KiB a core" in note for note in info.notes)
    started = tables["callback_start"]["time"]
    assert started.is_sorted()
    assert tables["callback_start"].unique("time").height == started.len()  # nothing twice
    assert 6000 < started.len() + info.lost["discarded_events"] // 5 <= 12000


def test_a_daemon_that_dies_is_a_failure_in_words(node: Path, tmp_path: Path) -> None:
    session = LttngSession(tmp_path, ["x"], ())
    try:
        session.start()
        assert session.failure() is None
        daemon = session._lttng.daemon if session._lttng else None
        if daemon is None:
            pytest.skip("a session daemon of somebody else runs here, which is not ours to kill")
        daemon.send_signal(signal.SIGKILL)
        daemon.wait()
        assert session.failure() == "the LTTng session daemon ended with code -9"
    finally:
        session.remove()


def test_an_application_without_trace_points_is_said_to_have_none(
    node: Path, tmp_path: Path
) -> None:
    with pytest.raises(
        OperationError, match=r"no process with LTTng trace points .*`--source ebpf`"
    ):
        recorded(LttngSession(tmp_path, ["x"], ()), "true")


@pytest.mark.parametrize(("command", "pids"), [((), ()), ((), (1,)), (("x",), (1,))])
def test_attaching_is_refused(
    tmp_path: Path, command: tuple[str, ...], pids: tuple[int, ...]
) -> None:
    with pytest.raises(InputError, match="attach with `--source ebpf`"):
        LttngSession(tmp_path, command, pids)


def test_without_lttng_the_package_and_the_other_source_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    session = LttngSession(tmp_path, ["x"], ())
    with pytest.raises(PlatformError, match=r"`lttng` is not there: install .*lttng-tools.*ebpf"):
        session.start()
    session.remove()


def test_buffers_take_half_of_the_shared_memory_at_most() -> None:
    plenty = 1 << 40
    assert buffer_size(free=plenty, cores=2) == 4 * MIB
    assert buffer_size(wanted=16 * MIB, free=plenty, cores=2) == 16 * MIB
    assert buffer_size(wanted=5 * MIB, free=plenty, cores=2) == 4 * MIB  # a power of two
    assert buffer_size(free=64 * MIB, cores=16) == 2 * MIB  # a container's 64 MiB
    assert buffer_size(wanted=MIB, free=0, cores=4) == 16 << 10  # what LTTng needs at least


def test_the_disk_has_what_the_recording_says(node: Path, tmp_path: Path) -> None:
    """An independent decoder counts the same events."""
    if shutil.which("babeltrace2") is None:
        pytest.skip("babeltrace2 is not installed here (package babeltrace2)")
    _, tables, _ = recorded(LttngSession(tmp_path, ["x"], ()), node, "flood", "500", "0")
    shown = subprocess.run(["babeltrace2", tmp_path], capture_output=True, text=True, check=True)
    assert len(shown.stdout.splitlines()) == sum(tables[name].height for name in tables)
