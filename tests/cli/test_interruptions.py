"""Whatever ends a run: nothing is left of it, and no recording that looks whole."""

import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import Running, chainshaper, message_of
from small_chain import NODES

from chainshaper import measure_latency
from chainshaper.cli.output import stop_on_signals
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.values.recording import Recording

pytestmark = pytest.mark.timed


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


@pytest.mark.parametrize("name", ["second", "stall-meter"])
def test_a_process_that_dies_is_named_with_its_killer(
    name: str, run: Running, application_file: Path
) -> None:
    if name not in run.nodes() and not may_use_fifo():
        pytest.skip("without SCHED_FIFO no process watches for stalls")
    pid = run.nodes()[name]
    os.kill(pid, signal.SIGKILL)
    finished = run.end()
    message = message_of(finished, 1)
    if name == "second":
        assert f"error: node second (pid {pid}) was killed by SIGKILL before" in message
        assert "the run was ended and nothing recorded" in message
    else:
        assert "error: stall meter of core" in message
    _assert_nothing_was_written(application_file)


@pytest.mark.parametrize(
    ("number", "times"),
    [
        (signal.SIGINT, 1),
        (signal.SIGINT, 20),
        (signal.SIGTERM, 1),
        (signal.SIGHUP, 1),
        (signal.SIGKILL, 1),  # only the kernel is left to end the nodes
    ],
)
def test_interrupted_it_ends_in_order(
    run: Running, application_file: Path, number: signal.Signals, times: int
) -> None:
    for _ in range(times):
        run.process.send_signal(number)
        if run.process.poll() is not None:
            break
    finished = run.end()
    assert finished.code != 0
    by_itself = times > 1 or number == signal.SIGKILL
    assert finished.code != -number or by_itself, "it ends by itself, without success"
    if times == 1:
        assert "Traceback" not in finished.err
        assert finished.out == ""
    _assert_nothing_was_written(application_file)


def test_whole_cycles_until_an_interruption_are_recorded_and_marked(
    run: Running, application_file: Path
) -> None:
    time.sleep(1.2)
    run.process.send_signal(signal.SIGINT)
    finished = run.end()
    assert finished.code == 1
    assert "error: interrupted: " in finished.err
    assert finished.err.endswith(f"they are in {_recording(application_file)}\n")
    recorded = measure_latency(_recording(application_file))
    (note,) = (one for one in recorded.analysis.notes if one.startswith("interrupted: "))
    cycles = int(note.split()[1])
    assert 5 < cycles < 60
    assert abs(recorded.analysis.statistics.count - cycles) <= 1, "whole ones"


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="setpriv is not installed")
@pytest.mark.parametrize("command", ["latency {}/x", "simulate {1} -o {0}/x"])
def test_a_folder_that_may_not_be_searched_is_named(command: str, application_file: Path) -> None:
    closed = application_file.parent / "closed"
    closed.mkdir(mode=0)
    prefix = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
    finished = chainshaper(*command.format(closed, application_file).split(), prefix=prefix)
    closed.chmod(0o700)
    assert "closed/x" in message_of(finished, 2)
    assert "permission denied" in finished.err


def test_a_full_disk_is_named_and_nothing_stays_on_it(
    application_file: Path, full_disk: Path
) -> None:
    path = full_disk / "recording"
    finished = chainshaper("run", application_file, "-o", path, "--cycles", "2")
    said = message_of(finished, 1)
    assert f"{path}: the recording cannot be written" in said
    assert "No space left on device" in said
    assert [entry.name for entry in full_disk.iterdir()] == ["filling"]


def test_standard_output_on_a_full_disk(simulated: Recording) -> None:
    redirected = ("sh", "-c", '"$@" > /dev/full', "sh")
    finished = chainshaper("latency", simulated.path, prefix=redirected)
    assert finished.code == 1
    assert finished.err.startswith("error: standard output cannot be written (No space left")
    assert "Traceback" not in finished.err


@pytest.mark.parametrize("form", [(), ("--json",)])
def test_a_reader_that_has_seen_enough_is_no_error(
    form: tuple[str, ...], simulated: Recording
) -> None:
    pipe = ("sh", "-c", '"$@" | true', "sh")
    finished = chainshaper("latency", simulated.path, *form, prefix=pipe)
    assert finished.code == 0, "of `true`"
    assert not {"Broken", "Traceback", "Exception"}.intersection(finished.err.split())


def test_a_signal_that_comes_while_the_event_is_waited_for_is_heard() -> None:
    """Its handler interrupts who has the event's lock, and must not want it itself."""
    with stop_on_signals() as stop:
        with stop._cond:  # type: ignore[attr-defined]
            os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(5)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does: nothing is stopped
    try:
        with stop_on_signals() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.wait(0.05)
    finally:
        signal.signal(signal.SIGHUP, before)
