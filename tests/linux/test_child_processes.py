"""Processes of ours run our code wherever they start; commands end with all that is theirs."""

import os
import pwd
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import pytest
from known import known
from processes import is_alive, wait_for
from small_chain import small_chain_text

import chainshaper
from chainshaper.linux import child_processes
from chainshaper.linux.child_processes import (
    check_command,
    end_command,
    end_in_words,
    is_installed,
    module_command,
    start_command,
)
from chainshaper.linux.threads import all_stats
from chainshaper.values.errors import InputError

SOURCES = Path(chainshaper.__file__).parent
MODULES = [
    "chainshaper.enforcement.slot_dispatcher",
    "chainshaper.enforcement.guardian",
    "chainshaper.enforcement.scx.back_end",
    "chainshaper.workload.node_process",
    "chainshaper.workload.stall_meter",
]
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="giving files to another user needs root")


@pytest.fixture
def evil(tmp_path: Path) -> Path:
    """A folder with a module of every name that Python has, and of ours: each leaves a mark."""
    folder = tmp_path / "evil"
    (folder / "chainshaper").mkdir(parents=True)
    leaves_mark = f"open({str(tmp_path / 'marks')!r}, 'a').write(__name__ + '\\n')\n"
    names = {*sys.stdlib_module_names, "sitecustomize", "usercustomize", "numpy", "cyclonedds"}
    for name in {f"{name}.py" for name in names} | {"chainshaper/__init__.py"}:
        (folder / name).write_text(leaves_mark)
    return folder


def marks(evil: Path) -> str:
    file = evil.with_name("marks")
    return file.read_text() if file.exists() else ""


def test_one_place_starts_python() -> None:
    """And the processes of ROS 2 nodes, which run without our package: those have a line each.

    What starts a node again starts it as `ros2 launch` does: rclpy is where PYTHONPATH leads. What
    `ros2` loads of us runs `chainshaper` as a user would: it has found us in the same places.
    """
    starting = {
        path.relative_to(SOURCES).as_posix(): path.read_text()
        for path in SOURCES.rglob("*.py")
        if re.search(r"sys\.executable|multiprocessing|ProcessPool", path.read_text())
    }
    in_nodes, again = "robot/clear_core.py", "robot/python/respawning.py"
    by_ros2 = {"cli/ros2_chain.py", "launch_actions.py"}
    assert starting.keys() == {"linux/child_processes.py", in_nodes, again, *by_ros2}
    assert '[sys.executable, "-I", "-S", "-c"' in starting[in_nodes]


@pytest.mark.parametrize("module", MODULES)
def test_nothing_of_the_current_folder_or_of_python_variables_runs(module: str, evil: Path) -> None:
    variables = ("PYTHONPATH", "PYTHONHOME", "PYTHONUSERBASE", "PYTHONSTARTUP", "HOME")
    with mock.patch.dict(os.environ, dict.fromkeys(variables, str(evil))):
        command = module_command(module, child_processes.LIBRARIES)
        run = subprocess.run(
            command, cwd=evil, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
        )
    assert marks(evil) == ""
    assert "No module named" not in run.stderr
    # It came as far as its arguments, which are missing.
    assert not run.stderr or "argv" in run.stderr


@pytest.mark.parametrize(
    ("verb", "options"),
    [
        ("run", "--cycles 3 -o {0}/rec"),
        ("sweep", "--vary bands=1,2 --cycles 20 --workers 2 -o {0}/out.parquet"),
    ],
)
def test_a_command_that_starts_processes_runs_nothing_of_the_current_folder(
    verb: str, options: str, evil: Path, tmp_path: Path
) -> None:
    (tmp_path / "application.yaml").write_text(small_chain_text())
    program = "import sys; from chainshaper.cli import main; main(sys.argv[1:])"
    command = [sys.executable, "-I", "-c", program, verb, str(tmp_path / "application.yaml")]
    command += options.format(tmp_path).split()
    run = subprocess.run(command, cwd=evil, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert marks(evil) == ""


def test_python_dash_m_imports_from_no_current_folder(tmp_path: Path) -> None:
    """What was imported before the package's own first line is Python's affair."""
    (tmp_path / "typer.py").write_text("raise SystemExit('evil')")
    command = [sys.executable, "-m", "chainshaper", "--help"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    assert (run.returncode, run.stderr) == (0, b"")


def copied(folder: Path) -> Path:
    """The package where nothing but PYTHONPATH leads to, as colcon installs it."""
    root = folder / "install"
    values = ("__init__", "durations", "errors", "files", "leftovers", "middleware")
    linux = ("__init__", "child_processes", "scheduling", "threads")
    package = ("__init__", "vendored_packages")
    for name in (*package, *(f"values/{v}" for v in values), *(f"linux/{one}" for one in linux)):
        place = root / "chainshaper" / f"{name}.py"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes((SOURCES / f"{name}.py").read_bytes())
    (root / "chainshaper" / "said.py").write_text("print(__file__); import library")
    (root / "library.py").write_text("print('library')")
    (root / "json.py").write_text("raise SystemExit('no module of Python is hidden')")
    return root


_STARTS = (
    "import subprocess, sys; sys.path[:0] = [{root!r}]; "
    "from chainshaper.linux.child_processes import module_command; "
    "sys.exit(subprocess.run(module_command('chainshaper.said', ['library'])).returncode)"
)


# An editable install of ours goes before PYTHONPATH, so it is none of an environment's.
BASE_PYTHON: str = getattr(sys, "_base_executable", sys.executable)


def started(root: Path, python: str = BASE_PYTHON) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [python, "-B", "-c", _STARTS.format(root=str(root))],
        env={**os.environ, "PYTHONPATH": str(root)},
        cwd="/",
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("version", ["3.10", "3.11", "3.12", "3.13", "3.14"])
def test_a_package_that_only_pythonpath_leads_to_is_the_one_that_runs(
    version: str, tmp_path: Path
) -> None:
    of_pyenv = (Path.home() / ".pyenv" / "versions").glob(f"{version}.*/bin/python3")
    python = next((str(path) for path in of_pyenv), shutil.which(f"python{version}"))
    if python is None:
        pytest.skip(f"Python {version} is not here")
    root = copied(tmp_path)
    run = started(root, python)
    assert run.stdout.splitlines() == [str(root / "chainshaper" / "said.py"), "library"], run.stderr


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda root: root.chmod(0o777), "is writable by others than"),
        (lambda root: (root / "chainshaper").chmod(0o775), "is writable by others than"),
        pytest.param(
            lambda root: os.chown(root, pwd.getpwnam("nobody").pw_uid, -1),
            "belongs to nobody",
            marks=as_root,
        ),
    ],
)
def test_a_package_that_others_may_change_is_refused_with_the_reason(
    tmp_path: Path, spoil: Callable[[Path], None], said: str
) -> None:
    root = copied(tmp_path)
    os.chown(root / "chainshaper", -1, 1)  # a group that is not only its user's own
    spoil(root)
    run = started(root)
    assert f"chainshaper's own processes do not run from {root}" in run.stderr
    assert said in run.stderr
    assert run.stdout == ""


def test_libraries_that_others_may_change_are_not_handed_on(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "a_library.py").touch()
    with mock.patch.object(sys, "path", [*sys.path, str(theirs)]):
        assert str(theirs) in module_command("any", ["a_library", "numpy", "absent"])
        theirs.chmod(0o777)
        assert str(theirs) not in module_command("any", ["a_library", "numpy", "absent"])


def test_tools_are_not_found_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tool = tmp_path / "chainshaper-tool"
    tool.write_text("#!/bin/sh")
    tool.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    for path in (".", "", f":{os.environ['PATH']}", f"./:{os.environ['PATH']}:."):
        monkeypatch.setenv("PATH", path)
        assert not is_installed(tool.name)
        assert all(map(os.path.isabs, child_processes.tool_environment()["PATH"].split(":")))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert is_installed(tool.name)


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


NODE = (
    "import signal, sys, time\n"
    "def end(*_):\n"
    "    signal.signal(signal.SIGINT, signal.SIG_DFL)\n"  # as rclcpp and rclpy do
    "    time.sleep(1)\n"
    "    sys.exit(0)\n"
    "signal.signal(signal.SIGINT, end)\n"
    "print('ready', flush=True)\n"
    "time.sleep(60)\n"
)
LAUNCHER = f"""
import signal, subprocess, sys, time
nodes = [subprocess.Popen([sys.executable, '-c', {NODE!r}], stdout=-1) for _ in range(3)]
for node in nodes:
    node.stdout.readline()
forwards = '--noninteractive' in sys.argv or not sys.stdin.isatty()  # as `ros2 launch` does
def end(*_):
    time.sleep(0.3)  # it is an event like others
    for node in nodes if forwards else ():
        node.send_signal(signal.SIGINT)
signal.signal(signal.SIGINT, end)
print('ready', flush=True)
print([node.wait() for node in nodes], flush=True)
"""
"""Launches three nodes, which take a second to shut down, and says how these ended."""


@pytest.fixture
def terminal() -> Iterator[None]:
    """Our input is a terminal, and so is that of what we start."""
    outer, inner = os.openpty()
    before = os.dup(0)
    os.dup2(inner, 0)
    yield
    os.dup2(before, 0)
    for descriptor in (outer, inner, before):
        os.close(descriptor)


def ends_of_nodes(command: list[str]) -> str:
    """How the nodes of a launcher ended, by its own words, when the command was ended."""
    reading, writing = os.pipe()
    process = start_command(command, stdout=writing)
    os.close(writing)
    with os.fdopen(reading) as said:
        assert said.readline() == "ready\n"
        end_command(process)
        return said.readline()


@pytest.mark.parametrize(
    "command",
    [
        [sys.executable, "-c", LAUNCHER],
        ["bash", "-c", f"{shlex.join([sys.executable, '-c', LAUNCHER])}; echo after"],
        ["sh", "-c", f"{shlex.join([sys.executable, '-c', LAUNCHER])}; echo after"],
    ],
    ids=["a launcher", "a script of bash", "a script of dash"],
)
def test_without_a_terminal_nodes_get_the_signal_from_their_launcher_alone(
    command: list[str],
) -> None:
    assert ends_of_nodes(command) == "[0, 0, 0]\n"


@pytest.mark.parametrize("words", [[], ["--noninteractive"]])
@pytest.mark.usefixtures("terminal")
def test_in_a_terminal_nodes_get_one_signal_whoever_sends_it(words: list[str]) -> None:
    assert ends_of_nodes([sys.executable, "-c", LAUNCHER, *words]) == "[0, 0, 0]\n"


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
        "from chainshaper.linux.child_processes import start_command\n"
        f"start_command(['sh', '-c', {script!r}])\n"
        "time.sleep(60)"
    )
    owner = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    assert known(owner.stdout).readline() == b"ready\n"
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
    codes = {3: "ended with code 3", -11: "was killed by SIGSEGV", -40: "was killed by signal 40"}
    assert {code: end_in_words(code) for code in codes} == codes


def _group(leader: int) -> list[int]:
    """Living processes of a group."""
    stats = ((pid, fields) for pid, fields in all_stats() if fields[0] != b"Z")
    return [pid for pid, (_, _, group, *_) in stats if int(group) == leader]


def test_a_group_whose_leader_was_waited_for_is_ended_by_who_is_in_it(tmp_path: Path) -> None:
    """The number of a process that was waited for may be another's: it is not signalled."""
    left = tmp_path / "left"
    command = start_command(["sh", "-c", f"sleep 60 & echo $! > {left}"])
    command.wait()
    pid = int(left.read_text())
    end_command(command, patience_s=2)
    wait_for(lambda: not is_alive(pid), "what it had left behind to end")
