"""Whatever ends a run: nothing is left of it, and no recording that looks whole."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import Running, chainshaper, message_of
from processes import wait_for
from small_chain import NODES

from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.values.recording import Recording


@pytest.fixture
def run(application_file: Path) -> Iterator[Running]:
    """A run of many cycles, in the middle."""
    running = Running.start("run", application_file, "-o", _recording(application_file))
    try:
        running.wait_until_it_says("recording")
        assert set(NODES) <= set(running.nodes())
        yield running
    finally:
        running.process.kill()
        running.process.wait()


def _recording(application_file: Path) -> Path:
    return application_file.parent / "recording"


def _assert_nothing_was_written(application_file: Path) -> None:
    left = [entry.name for entry in application_file.parent.iterdir()]
    assert left == [application_file.name], "a recording, or a hidden part of one"


def test_a_node_that_dies_is_named_with_its_killer(run: Running, application_file: Path) -> None:
    pid = run.nodes()["second"]
    os.kill(pid, signal.SIGKILL)
    finished = run.end()
    assert finished.code == 1
    assert f"error: node second (pid {pid}) was killed by SIGKILL before" in finished.err
    assert "the run was ended and nothing recorded" in finished.err
    assert "Traceback" not in finished.err
    assert finished.out == ""
    _assert_nothing_was_written(application_file)


@pytest.mark.skipif(not may_use_fifo(), reason="without SCHED_FIFO nobody watches for stalls")
def test_a_stall_meter_that_dies_is_named_too(run: Running, application_file: Path) -> None:
    os.kill(run.nodes()["stall-meter"], signal.SIGKILL)
    finished = run.end()
    assert finished.code == 1
    assert "error: stall meter of core" in finished.err
    _assert_nothing_was_written(application_file)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_it_ends_in_order(
    run: Running, application_file: Path, number: signal.Signals
) -> None:
    run.process.send_signal(number)
    finished = run.end()
    assert finished.code not in (0, -number), "it has to end by itself, and not with success"
    assert "Traceback" not in finished.err
    assert finished.out == ""
    _assert_nothing_was_written(application_file)


def test_pressing_ctrl_c_again_and_again_changes_nothing(
    run: Running, application_file: Path
) -> None:
    for _ in range(20):
        run.process.send_signal(signal.SIGINT)
        if run.process.poll() is not None:
            break
    finished = run.end()
    assert finished.code != 0
    _assert_nothing_was_written(application_file)


def test_killed_it_leaves_no_orphans(run: Running, application_file: Path) -> None:
    """SIGKILL: nobody is left to end the nodes but the kernel."""
    run.process.kill()
    run.process.wait()
    wait_for(lambda: not run.nodes(), f"the end of {sorted(run.nodes())}", seconds=2)
    _assert_nothing_was_written(application_file)


def test_a_full_disk_is_named_and_nothing_stays_on_it(
    application_file: Path, full_disk: Path
) -> None:
    path = full_disk / "recording"
    finished = chainshaper("run", application_file, "-o", path, "--cycles", "2")
    said = message_of(finished, 1)
    assert f"{path}: the recording cannot be written" in said
    assert "No space left on device" in said
    assert [entry.name for entry in full_disk.iterdir()] == ["filling"]


def test_standard_output_on_a_full_disk(unshaped: Recording) -> None:
    redirected = ("sh", "-c", '"$@" > /dev/full', "sh")
    finished = chainshaper("latency", unshaped.path, prefix=redirected)
    assert finished.code == 1
    assert finished.err.startswith("error: standard output cannot be written (No space left")
    assert "Traceback" not in finished.err


@pytest.mark.parametrize("verb", ["latency", "callbacks"])
@pytest.mark.parametrize("form", [(), ("--json",)])
def test_a_reader_that_has_seen_enough_is_no_error(
    verb: str, form: tuple[str, ...], unshaped: Recording
) -> None:
    pipe = ("sh", "-c", '"$@" | true', "sh")
    finished = chainshaper(verb, unshaped.path, *form, prefix=pipe)
    assert finished.code == 0, "of `true`"
    assert "Broken" not in finished.err
    assert "Traceback" not in finished.err
    assert "Exception" not in finished.err
