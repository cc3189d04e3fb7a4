"""Several recordings with a real LTTng at the same time, and those that are killed."""

import os
import shutil
import subprocess
import sys
import uuid
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from lttng_daemon import lttng, sessions, users_daemon
from lttng_node import required_node
from processes import marked_processes, wait_for

from chainshaper.sources.lttng.session import LttngSession

ANOTHER = """
import pathlib, sys
from chainshaper.sources.lttng.session import LttngSession
session = LttngSession(pathlib.Path(sys.argv[1]), ["x"], ())
try:
    session.start()
    print(session._lttng.home, flush=True)
    input()
    session.stop()
finally:
    session.remove()
"""
UNPRIVILEGED = ("setpriv", "--bounding-set=-sys_admin")


@pytest.fixture(scope="module")
def node() -> Path:
    return required_node()


@pytest.fixture
def daemon_of_our_own(node: Path) -> None:
    if lttng(dict(os.environ), "list").returncode == 0:
        pytest.skip("a session daemon of somebody else runs here, so none of ours would")


@contextmanager
def recorded(folder: Path) -> Iterator[tuple[LttngSession, dict[str, str]]]:
    """A session, and the environment of the application that it records."""
    folder.mkdir()
    session = LttngSession(folder, ["x"], ())
    try:
        yield session, {**os.environ, **session.start()}
        assert session.failure() is None
        session.stop()
    finally:
        session.remove()


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


@dataclass(frozen=True)
class Another:
    """A process that records at the same time until it is told to end."""

    process: "subprocess.Popen[str]"
    mark: str
    home: Path

    @classmethod
    def start(cls, folder: Path, *prefix: str) -> "Another":
        """Start it, and return when it records or has failed to."""
        folder.mkdir()
        mark = f"MARK={uuid.uuid4().hex}"
        process = subprocess.Popen(
            [*prefix, sys.executable, "-c", ANOTHER, folder],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "MARK": mark.partition("=")[2]},
        )
        assert process.stdout is not None
        return cls(process, mark, Path(process.stdout.readline().strip()))

    def end(self) -> str:
        """Have it end, with all that it started; its last words."""
        _, said = self.process.communicate("\n", timeout=60)
        wait_for(lambda: not marked_processes(self.mark), "the end of all that it started")
        return said


def test_recordings_at_once_hear_their_own_command_only_and_lose_nothing(
    node: Path, tmp_path: Path
) -> None:
    with ExitStack() as later:
        with recorded(tmp_path / "1") as (first, environment):
            of_first = {run(node, environment, 100): 100}
            second, another = later.enter_context(recorded(tmp_path / "2"))
            of_second = {run(node, another, 200): 200}
            of_first[run(node, environment, 300)] = 300
        of_second[run(node, another, 400)] = 400
    assert callbacks(first) == of_first
    assert callbacks(second) == of_second


def test_a_daemon_that_somebody_starts_meanwhile_and_ours_do_not_meet(
    node: Path, tmp_path: Path
) -> None:
    with recorded(tmp_path / "ours") as (ours, environment), users_daemon(tmp_path) as users:
        assert not set(ours._sessions) & set(sessions(users))
        pid = run(node, environment, 100)
    assert callbacks(ours) == {pid: 100}


@pytest.mark.usefixtures("daemon_of_our_own")
def test_one_that_is_killed_ends_no_other_and_leaves_nothing(node: Path, tmp_path: Path) -> None:
    killed = Another.start(tmp_path / "killed")
    assert killed.home.is_dir()
    with recorded(tmp_path / "lasting") as (lasting, environment):
        first = run(node, environment, 100)
        assert "lttng-sessiond" in marked_processes(killed.mark).values()
        killed.process.kill()
        killed.end()
        second = run(node, environment, 200)
    assert callbacks(lasting) == {first: 100, second: 200}
    assert not killed.home.exists()


def test_one_that_is_killed_leaves_a_users_daemon_as_it_was(node: Path, tmp_path: Path) -> None:
    with users_daemon(tmp_path) as users:
        lttng(users, "create", "mine", f"--output={tmp_path / 'mine'}")
        try:
            before, names = lttng(users, "list", "mine").stdout, sessions(users)
            with recorded(tmp_path / "lasting") as (lasting, environment):
                killed = Another.start(tmp_path / "killed")
                assert len(sessions(users)) == len(names) + 2
                killed.process.kill()
                killed.end()
                assert len(sessions(users)) == len(names) + 1
                pid = run(node, environment, 100)
            assert callbacks(lasting) == {pid: 100}
            assert sessions(users) == names
            assert lttng(users, "list", "mine").stdout == before
        finally:
            lttng(users, "destroy", "mine")


@pytest.mark.usefixtures("daemon_of_our_own")
def test_where_root_may_not_mount_a_second_recording_is_refused_and_the_first_goes_on(
    node: Path, tmp_path: Path
) -> None:
    if os.geteuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root can give up the privilege to mount, with setpriv")
    first = Another.start(tmp_path / "first", *UNPRIVILEGED)
    refused = Another.start(tmp_path / "second", *UNPRIVILEGED)
    assert "PlatformError: another recording runs" in refused.end()
    with recorded(tmp_path / "third") as (third, environment):  # which may
        pid = run(node, environment, 100)
    assert callbacks(third) == {pid: 100}
    assert first.end() == ""
    assert first.process.returncode == 0
