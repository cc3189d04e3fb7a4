"""What several rooms' tests stand on: a real recording, and a disk that is full."""

import os
import re
import subprocess
from collections.abc import Generator, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TypeVar
from unittest import mock

import pytest
from calm_runs import calm_run
from cores import cores
from hypothesis import settings
from ros2 import require_lttng_of_ros2, require_packages, ros2_environment
from small_chain import EXECUTOR_CORE, small_chain, small_chain_plan, small_chain_text

from chainshaper import run_application, shape_application, simulate
from chainshaper.planning import ChainPlan, Plan
from chainshaper.values.recording import Recording

CYCLES = 12

# How long an example takes is the machine's affair: no test asserts an absolute time.
settings.register_profile("chainshaper", deadline=None)
settings.load_profile("chainshaper")


# Fixtures that run an application live: tests that ask for them are timed.
LIVE_RUNS = {"unshaped", "shaped"}

Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)


@pytest.hookimpl(tryfirst=True)  # before the command line's choice of marks is looked at
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests of a real ROS 2 or of a live run as timed: they need the machine's cores for
    themselves, as all tests that are marked so where they stand.
    """
    for item in items:
        live = LIVE_RUNS & set(getattr(item, "fixturenames", ()))
        if live or item.get_closest_marker("ros2"):
            item.add_marker("timed")


@pytest.hookimpl(tryfirst=True)  # before its fixtures are made
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test of a real ROS 2 where there is none, or it lacks a package that a mark names."""
    for mark in item.iter_markers("ros2"):
        require_packages(*mark.args)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Timed tests have the cores, also while their fixtures are made."""
    with cores() if item.get_closest_marker("timed") else nullcontext():
        return (yield)


ALLOWED_SKIPS = [
    re.compile(line)
    for line in Path(__file__).with_name("allowed_skips.txt").read_text().splitlines()
    if line and not line.startswith("#")
]


# Where scripts/run-tests wants the list of failures; tests that run pytest have none of it.
FAILURES = os.environ.pop("CHAINSHAPER_FAILURES", None)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Append each failure to the list of failures: the test, and the first line of why."""
    if report.failed and FAILURES is not None:
        crash = getattr(report.longrepr, "reprcrash", None)
        reason = str(report.longrepr) if crash is None else crash.message
        stage = "" if report.when == "call" else f" ({report.when})"
        with Path(FAILURES).open("a", encoding="utf-8") as failures:
            failures.write(f"  {report.nodeid}{stage}: {reason.strip().splitlines()[0]}\n")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """In CI a skip is a failure, unless its reason is in allowed_skips.txt."""
    report = yield
    return _no_hidden_skip(report)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """The same for a whole file that skips."""
    report = yield
    return _no_hidden_skip(report)


def _no_hidden_skip(report: Report) -> Report:
    if os.environ.get("CI") != "true" or report.outcome != "skipped" or hasattr(report, "wasxfail"):
        return report
    text = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    reason = text.removeprefix("Skipped: ")
    if not any(pattern.search(reason) for pattern in ALLOWED_SKIPS):
        report.outcome = "failed"
        report.longrepr = f"CI=true, and tests/allowed_skips.txt has no such skip: {reason}"
    return report


@pytest.fixture
def application_file(tmp_path: Path) -> Path:
    """The small chain as a person would have it on disk."""
    path = tmp_path / "application.yaml"
    path.write_text(small_chain_text())
    return path


@pytest.fixture(scope="session")
def plan() -> ChainPlan:
    """Single-band shaping of the small chain: publish slot [21 ms, 22 ms)."""
    return small_chain_plan(5_000_000, 20_000_000, core=EXECUTOR_CORE)


@pytest.fixture(scope="session")
def unshaped(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A live run of the small chain, with real-time scheduling where it is permitted."""
    folder = tmp_path_factory.mktemp("unshaped")
    application = small_chain(folder)
    return calm_run(
        lambda place: run_application(application, place / "before", cycles=CYCLES), folder
    )


@pytest.fixture(scope="session")
def shaped(tmp_path_factory: pytest.TempPathFactory, plan: ChainPlan) -> Recording:
    """The same with the shaping node, anchored to the messages' stamps."""
    folder = tmp_path_factory.mktemp("shaped")
    application = small_chain(folder)
    return calm_run(
        lambda place: shape_application(application, Plan.of(plan), place / "after", cycles=CYCLES),
        folder,
    )


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The same as ``unshaped``, simulated: where nothing depends on what the machine did."""
    folder = tmp_path_factory.mktemp("simulated")
    return simulate(small_chain(folder), folder / "before", cycles=CYCLES)


@pytest.fixture(scope="session")
def simulated_shaped(tmp_path_factory: pytest.TempPathFactory, plan: ChainPlan) -> Recording:
    """The same as ``shaped``, simulated."""
    folder = tmp_path_factory.mktemp("simulated_shaped")
    return simulate(small_chain(folder), folder / "after", Plan.of(plan), cycles=CYCLES)


@pytest.fixture
def in_ros2() -> Iterator[None]:
    """What a test starts is started in the environment of ROS 2."""
    with mock.patch.dict(os.environ, ros2_environment()):
        yield


@pytest.fixture
def lttng_of_ros2() -> None:
    """LTTng records ROS 2 here; else the test is skipped, with the reason."""
    require_lttng_of_ros2()


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own on which not one byte more can be written."""
    if os.geteuid() != 0:
        pytest.skip("mounting a small file system needs root")
    mount = tmp_path / "full"
    mount.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(mount)]
    mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    if mounted.returncode:
        pytest.skip(f"a tmpfs cannot be mounted here: {mounted.stderr.strip()}")
    try:
        with pytest.raises(OSError, match="No space left"):
            (mount / "filling").write_bytes(bytes(1_000_000))
        yield mount
    finally:
        subprocess.run(["umount", str(mount)], check=True)
