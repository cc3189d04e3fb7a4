"""The user's command: started as from a terminal, and ended with all that belongs to it."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from processes import wait_for

from chainshaper.linux.own_processes import check_command, end_command, end_in_words, start_command
from chainshaper.values.errors import InputError

IGNORING = "trap '' INT; echo ready; exec sleep 60"
DEAF = "trap '' INT TERM; echo ready; exec sleep 60"


def started_and_ready(script: str) -> "subprocess.Popen[bytes]":
    reading, writing = os.pipe()
    process = start_command(["sh", "-c", script], stdout=writing)
    os.close(writing)
    with os.fdopen(reading) as said:
        assert said.readline() == "ready\n"
    return process


def test_ctrl_c_ends_a_command_even_if_we_are_a_background_job_that_ignores_it() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell does behind `&`
    try:
        process = start_command(["sleep", "60"])
    finally:
        signal.signal(signal.SIGINT, before)
    end_command(process)
    assert process.returncode == -signal.SIGINT


@pytest.mark.parametrize(("script", "end"), [(IGNORING, signal.SIGTERM), (DEAF, signal.SIGKILL)])
def test_a_command_that_does_not_listen_is_ended_harder(script: str, end: int) -> None:
    process = started_and_ready(script)
    end_command(process, patience_s=0.2)
    assert process.returncode == -end


def test_what_a_command_leaves_behind_in_its_group_is_ended_too() -> None:
    process = started_and_ready("sleep 60 & echo ready")
    process.wait(10)
    assert _group(process.pid)
    end_command(process, patience_s=0.5)  # a background job of a shell ignores SIGINT
    assert not _group(process.pid)


def test_the_environment_is_ours_and_what_is_added(tmp_path: Path) -> None:
    said = tmp_path / "said"
    with said.open("wb") as file:
        process = start_command(
            ["sh", "-c", 'echo "$ADDED $PATH"'], {"ADDED": "yes"}, file.fileno()
        )
        process.wait(10)
    assert said.read_text() == f"yes {os.environ['PATH']}\n"


def test_a_command_gets_a_sigint_when_we_are_killed(tmp_path: Path) -> None:
    said = tmp_path / "said"
    script = f"trap 'echo interrupted > {said}; exit' INT; echo ready; while :; do sleep 0.05; done"
    program = (
        "import time\n"
        "from chainshaper.linux.own_processes import start_command\n"
        f"start_command(['sh', '-c', {script!r}])\n"
        "time.sleep(60)"
    )
    owner = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
    )
    assert owner.stdout is not None
    assert owner.stdout.readline() == b"ready\n"
    owner.kill()
    owner.wait()
    wait_for(said.exists, "the command's reaction")


def test_commands_that_cannot_be_started_are_named_beforehand(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no_such_program: no such command; .*setup\.bash"):
        check_command(["no_such_program", "launch"])
    plain = tmp_path / "launch.sh"
    plain.write_text("echo hello")
    with pytest.raises(InputError, match=r"launch\.sh is not executable: .*chmod \+x"):
        start_command([str(plain)])


def test_the_end_of_a_command_in_words() -> None:
    assert end_in_words(3) == "ended with code 3"
    assert end_in_words(-11) == "was killed by SIGSEGV"
    assert end_in_words(-40) == "was killed by signal 40"


def _group(leader: int) -> list[int]:
    """Living processes of a group."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[2]) == leader and fields[0] != "Z":
                found.append(int(entry.name))
    return found
