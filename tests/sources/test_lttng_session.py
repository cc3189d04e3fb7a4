"""Recording with a real LTTng: a program whose provider has the name and fields of ROS 2's."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from known import known
from lttng_node import required_node
from processes import children_of, marked_processes, wait_for

from chainshaper.sources.lttng import MIB, LttngSession, buffer_size
from chainshaper.values.errors import InputError, PlatformError
from chainshaper.values.events import EventTables
from chainshaper.values.recording import RecordingInfo

pytestmark = pytest.mark.waiting  # other tests' recordings are sessions of the same one

DEPTH = 7  # of every queue in chain_node.c
ANOTHER = """
import pathlib, sys
from chainshaper.sources.lttng import LttngSession
session = LttngSession(pathlib.Path(sys.argv[1]), ["x"], ())
try:
    session.start()
    print(session.home, flush=True)
    input()
    session.stop()
finally:
    session.remove()
"""
UNPRIVILEGED = ("setpriv", "--bounding-set=-sys_admin")


@contextmanager
def users_daemon(home: Path) -> Iterator[dict[str, str]]:
    """Have one, started unless it is there; the environment of who uses it."""
    if os.geteuid() != 0:
        pytest.skip("only root can start the session daemon that traces everybody")
    environment = {**os.environ, "LTTNG_HOME": str(home)}
    running = lttng(environment, "list").returncode == 0
    daemon = None if running else subprocess.Popen(["lttng-sessiond", "--quiet"], env=environment)
    try:
        wait_for(lambda: lttng(environment, "list").returncode == 0, "the session daemon")
        yield environment
    finally:
        if daemon is not None:
            daemon.terminate()
            daemon.wait(20)


def lttng(environment: dict[str, str], *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run `lttng` as the daemon's user."""
    command = ["lttng", "--no-sessiond", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def sessions(environment: dict[str, str]) -> list[str]:
    """The names of all sessions."""
    said = lttng(environment, "--mi=xml", "list").stdout
    return sorted(re.findall(r"<session>\s*<name>(.*?)</name>", said))


@pytest.fixture(scope="module")
def node() -> Path:
    return required_node()


@pytest.fixture
def daemon_of_our_own(node: Path) -> None:
    if lttng(dict(os.environ), "list").returncode == 0:
        pytest.skip("a session daemon of another program runs here, so none of ours would")


@contextmanager
def recorded(session: LttngSession) -> Iterator[dict[str, str]]:
    """The environment of the application that the session records."""
    try:
        yield {**os.environ, **session.start()}
        assert session.failure() is None
        session.stop()
    finally:
        session.remove()


def result(
    session: LttngSession, *command: str | Path, look_every: float = 0.2
) -> tuple[int, EventTables, RecordingInfo]:
    """Run a command to its end while it is recorded; its process, and what was recorded."""
    with recorded(session) as environment:
        process = subprocess.Popen([*map(str, command)], env=environment)
        while process.poll() is None:
            time.sleep(look_every)
            assert session.failure() is None
    return process.pid, *session.recording()


def test_every_event_comes_with_its_fields_and_nothing_is_left(
    node: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And an independent decoder counts the same events."""
    session = LttngSession(tmp_path, ["x"], ())
    with tempfile.TemporaryDirectory() as homes:  # others record beside us; its path is short
        monkeypatch.setattr(tempfile, "tempdir", homes)
        pid, tables, info = result(session, node, "flood", "50", "0")
        session.remove()  # once more does no harm
        assert list(Path(homes).iterdir()) == []
    names = (Path(f"/proc/{child}/comm").read_text() for child in children_of(os.getpid()))
    assert not any("lttng" in name for name in names)
    (created,) = tables["rcl_publisher_init"].iter_rows(named=True)
    assert (created["topic_name"], created["queue_depth"]) == ("/x", DEPTH)
    assert (created["publisher_handle"], created["rmw_publisher_handle"]) == (0x3000, 0x3100)
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
    assert (info.source, info.processes) == ("lttng", {pid: "/flood"})
    assert (info.distribution, info.rmw) == ("jazzy", "rmw_cyclonedds_cpp")
    assert not any(info.lost.values())
    if shutil.which("babeltrace2") is None:
        pytest.skip("babeltrace2 is not installed here (package babeltrace2)")
    shown = subprocess.run(["babeltrace2", tmp_path], capture_output=True, text=True, check=True)
    assert len(shown.stdout.splitlines()) == sum(tables[name].height for name in tables)


def test_in_a_users_daemon_all_stays_as_it_is_and_others_applications_are_left_out(
    node: Path, tmp_path: Path
) -> None:
    (tmp_path / "user").mkdir()
    (tmp_path / "trace").mkdir()
    with users_daemon(tmp_path / "user") as users:
        current = Path(users["LTTNG_HOME"]) / ".lttngrc"
        assert lttng(users, "create", "mine", f"--output={tmp_path / 'mine'}").returncode == 0
        # Its parent ends at once, so it does not descend from us.
        orphaned = ["sh", "-c", f"{node} flood 100000 1000 > /dev/null 2>&1 & echo $!"]
        started = subprocess.run(orphaned, capture_output=True, text=True, check=True)
        stranger = int(started.stdout)
        try:
            before = current.read_text(), lttng(users, "list", "mine").stdout
            session = LttngSession(tmp_path / "trace", ["x"], ())
            pid, tables, info = result(session, node, "flood", "300", "1000")
            assert (current.read_text(), lttng(users, "list", "mine").stdout) == before
            assert "chainshaper" not in lttng(users, "list").stdout
        finally:
            os.kill(stranger, signal.SIGKILL)
            lttng(users, "destroy", "mine")
    assert tables["callback_start"]["pid"].to_list() == [pid] * 300
    assert info.processes == {pid: "/flood"}
    assert info.trace_events["ros2:callback_start"] == 300
    assert any("not started are left out" in note and str(stranger) in note for note in info.notes)


def test_events_that_did_not_fit_are_counted_and_the_remedy_is_named(
    node: Path, tmp_path: Path
) -> None:
    emitted = 100_000
    session = LttngSession(tmp_path, ["x"], (), buffer=16 << 10)
    _, tables, info = result(session, node, "flood", str(emitted), "0", look_every=2)
    lost = info.lost["discarded_events"]
    assert lost > 0
    there = sum(tables[name].height for name in tables)
    assert there + lost == 5 * emitted + 8  # five events each, eight for the node
    assert any(f"{lost} events were lost" in note and "--buffer 1" in note for note in info.notes)


def test_buffers_are_enlarged_while_the_application_runs(node: Path, tmp_path: Path) -> None:
    session = LttngSession(tmp_path, ["x"], (), buffer=16 << 10)
    _, tables, info = result(session, node, "flood", "8000", "200")
    assert sorted(path.name for path in tmp_path.iterdir())[:2] == ["session-1", "session-2"]
    assert any("enlarged from 16 KiB to 64 KiB a core" in note for note in info.notes)
    started = tables["callback_start"]["time"]
    assert started.is_sorted()
    assert tables["callback_start"].unique("time").height == started.len()  # nothing twice
    assert 4000 < started.len() + info.lost["discarded_events"] // 5 <= 8000


def test_a_daemon_that_dies_is_a_failure_in_words(node: Path, tmp_path: Path) -> None:
    session = LttngSession(tmp_path, ["x"], ())
    try:
        session.start()
        assert session.failure() is None
        daemon = session.daemon
        if daemon is None:
            pytest.skip("a session daemon of another program runs here, which is not ours to kill")
        daemon.send_signal(signal.SIGKILL)
        daemon.wait()
        assert session.failure() == "the LTTng session daemon ended with code -9"
        session.stop()  # what is there already is of use
        assert "the last events may be missing: " in session._notes[-1]
    finally:
        session.remove()


def test_attaching_is_refused_and_without_lttng_package_and_other_source_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for command, pids in ((), ()), ((), (1,)), (("x",), (1,)):
        with pytest.raises(InputError, match="attach with `--source ebpf`"):
            LttngSession(tmp_path, command, pids)
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


def session_in(folder: Path) -> LttngSession:
    folder.mkdir()
    return LttngSession(folder, ["x"], ())


def run(node: Path, environment: Mapping[str, str], count: int) -> int:
    """Run a node that has so many callbacks; its process."""
    process = subprocess.Popen([node, "flood", str(count), "0"], env=environment)
    assert process.wait() == 0
    return process.pid


def callbacks(session: LttngSession) -> dict[int, int]:
    """How many there are of each process; none may be lost."""
    tables, info = session.recording()
    assert not any(info.lost.values())
    return dict(tables["callback_start"].group_by("pid").len().iter_rows())


class Another:
    """A process that records at the same time until it has to end."""

    def __init__(self, folder: Path, *prefix: str) -> None:
        """Start it, and return when it records or has failed to."""
        folder.mkdir()
        mark, command = uuid.uuid4().hex, [*prefix, sys.executable, "-c", ANOTHER, str(folder)]
        options: dict[str, Any] = {"text": True, "env": {**os.environ, "MARK": mark}}
        options |= dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process: subprocess.Popen[str] = subprocess.Popen(command, **options)
        self.mark, self.home = f"MARK={mark}", Path(known(self.process.stdout).readline().strip())

    def end(self) -> str:
        """Have it end, with all that it started; its last words."""
        _, said = self.process.communicate("\n", timeout=60)
        wait_for(lambda: not marked_processes(self.mark), "the end of all that it started")
        return said


@pytest.mark.usefixtures("daemon_of_our_own")
def test_recordings_at_once_hear_their_own_command_only_and_one_that_is_killed_leaves_nothing(
    node: Path, tmp_path: Path
) -> None:
    first, second = (session_in(tmp_path / name) for name in ("1", "2"))
    with ExitStack() as later:
        with recorded(first) as environment:
            of_first = {run(node, environment, 100): 100}
            another = later.enter_context(recorded(second))
            killed = Another(tmp_path / "killed")
            assert killed.home.is_dir()
            assert "lttng-sessiond" in marked_processes(killed.mark).values()
            of_second = {run(node, another, 200): 200}
            killed.process.kill()
            killed.end()
            of_first[run(node, environment, 300)] = 300
        of_second[run(node, another, 400)] = 400
    assert callbacks(first) == of_first
    assert callbacks(second) == of_second
    assert not killed.home.exists()


def test_a_users_daemon_is_as_it_was_when_one_is_killed_and_does_not_meet_ours(
    node: Path, tmp_path: Path
) -> None:
    before, lasting = (session_in(tmp_path / name) for name in ("before", "lasting"))
    with recorded(before) as environment, users_daemon(tmp_path) as users:
        assert not set(before._sessions) & set(sessions(users))
        alone = run(node, environment, 100)
    assert callbacks(before) == {alone: 100}
    with users_daemon(tmp_path) as users:
        lttng(users, "create", "mine", f"--output={tmp_path / 'mine'}")
        try:
            mine, names = lttng(users, "list", "mine").stdout, sessions(users)
            with recorded(lasting) as environment:
                killed = Another(tmp_path / "killed")
                assert len(sessions(users)) == len(names) + 2
                killed.process.kill()
                killed.end()
                assert len(sessions(users)) == len(names) + 1
                pid = run(node, environment, 100)
            assert callbacks(lasting) == {pid: 100}
            assert sessions(users) == names
            assert lttng(users, "list", "mine").stdout == mine
        finally:
            lttng(users, "destroy", "mine")


@pytest.mark.usefixtures("daemon_of_our_own")
def test_where_root_may_not_mount_a_second_recording_is_refused_and_the_first_goes_on(
    node: Path, tmp_path: Path
) -> None:
    if os.geteuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root can give up the privilege to mount, with setpriv")
    first = Another(tmp_path / "first", *UNPRIVILEGED)
    refused = Another(tmp_path / "second", *UNPRIVILEGED)
    assert "PlatformError: another recording runs" in refused.end()
    third = session_in(tmp_path / "third")
    with recorded(third) as environment:  # which may mount
        pid = run(node, environment, 100)
    assert callbacks(third) == {pid: 100}
    assert first.end() == ""
    assert first.process.returncode == 0
