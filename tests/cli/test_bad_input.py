"""What people do by mistake: one message with the place and the remedy, and the right exit code."""

import errno
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias
from unittest import mock

import numpy as np
import polars as pl
import pytest
from command_line import called, chainshaper, message_of, refused
from reference_traces import DATA
from small_chain import small_chain_plan, small_chain_text

from chainshaper.cli import main
from chainshaper.planning import ChainPlan, Plan, save_plan
from chainshaper.planning.shaping import server_per_chain
from chainshaper.values.recording import Recording

MISSING_CORE = small_chain_text(executor_core=1023)
Words: TypeAlias = Callable[[str], list[str]]
EXISTS = "exists already and is not overwritten: name another, or remove it"
NO_FOLDER = "missing: no such folder to write"
NO_RECORDING = "a recording is made with `chainshaper run"
OTHERS = "is a plan; wanted is a file "


@pytest.fixture
def folder(application_file: Path, plan: ChainPlan) -> Path:
    """An application, plans for it with and without shaping, latencies longer than the period."""
    save_plan(Plan.of(plan), application_file.with_name("plan.yaml"))
    servers = server_per_chain(small_chain_plan(8_000_000, 12_000_000))
    save_plan(Plan.of(servers), application_file.with_name("servers.yaml"))
    application_file.with_name("latencies.txt").write_text("30ms\n120ms\n")
    return application_file.parent


@pytest.fixture
def words(folder: Path, simulated: Recording) -> Words:
    """The words of a command, with files in their places; OUT and MISSING are not there."""
    places = {
        "APP": folder / "application.yaml",
        "PLAN": folder / "plan.yaml",
        "SERVERS": folder / "servers.yaml",
        "LATENCIES": folder / "latencies.txt",
        "REC": simulated.path,
        "OUT": folder / "recording",
        "DIR": folder,
        "TABLE": simulated.path / "callback_start.parquet",
        "MISSING": folder / "missing" / "recording",
    }
    return lambda text: [str(places.get(word, word)) for word in text.split()]


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("application", "on: /t2 → on: /t9", "subscription: no node publishes /t9"),
        ("application", "/t1../t3 → /t1../brake", ":2: chain: no topic or node is called '/bra"),
        ("application", "timer: 50ms → timer: 50", "50 is not a duration: write a number and"),
        ("application", ": \\[/t3] → : [/t3, /t1]", "the topics form a cycle"),
        ("application", "nodes: → nodes: [", "not YAML"),
        ("application", " core: \\d+ → core: 1023", "is not available: this process may use"),
        ("plan", "50ms → 15ms", "15 ms"),  # shorter than the longest latency
        ("plan", "50ms → 60ms", "plan again from a recording of this application"),
        ("plan", "node: /second → node: /secnod", "the plan names /secnod, which 'small chain'"),
        ("plan", " core: \\d+ →  core: 1023", "core 1023, which node chainshaper_t3 asks for"),
    ],
)
def test_a_mistake_in_a_file(
    file: str, change: str, message: str, folder: Path, words: Words
) -> None:
    path, code = folder / f"{file}.yaml", 3 if "1023" in change else 2
    old, new = change.split(" → ")
    changed = re.sub(old, new, path.read_text())
    path.write_text(MISSING_CORE if (file, code) == ("application", 3) else changed)
    assert message in refused(code, *words("shape APP PLAN -o OUT"))
    if file == "application":
        assert message in refused(code, *words("run APP -o OUT"))
        assert message in refused(code, *words("demo --application APP -o OUT"))
    assert not (folder / "recording").exists()


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="setpriv is not installed")
@pytest.mark.parametrize("options", [["--realtime"], ["--cycles", "2"]])
def test_without_the_privilege_it_runs_with_what_it_may(
    options: list[str], application_file: Path
) -> None:
    output = application_file.parent / "recording"
    prefix = ("setpriv", "--bounding-set=-sys_nice")
    finished = chainshaper("run", application_file, "-o", output, *options, prefix=prefix)
    if options != ["--realtime"]:
        assert (finished.code, finished.out) == (0, f"{output}\n"), finished.err
        return
    if finished.code == 0:
        pytest.skip("SCHED_FIFO is permitted here without CAP_SYS_NICE")
    assert "may not use SCHED_FIFO: run as root, give your user an" in message_of(finished, 3)
    assert not output.exists()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("run APP -o DIR", EXISTS),
        ("run APP -o APP", EXISTS),
        ("shape APP PLAN -o DIR", EXISTS),
        ("demo -o DIR", EXISTS),
        ("plan REC -o PLAN", EXISTS),
        ("run APP -o MISSING", NO_FOLDER),
        ("demo -o MISSING", NO_FOLDER),
        ("plan REC -o MISSING", NO_FOLDER),
        ("latency DIR", NO_RECORDING),
        ("callbacks APP", NO_RECORDING),
        ("plan OUT", NO_RECORDING),
        ("compare REC DIR", ": a folder without"),
        # An application as the plan, a plan as the application, a recording as either.
        ("shape APP APP -o OUT", "is the description of an application; wanted is a file written"),
        ("run PLAN -o OUT", OTHERS),
        ("shape PLAN APP -o OUT", OTHERS),
        ("run REC -o OUT", "is the folder of a recording; wanted is a file "),
        ("plan --latencies TABLE --period 1s", "one duration a line"),
        ("shape APP SERVERS -o OUT", "put server-per-chain in force with `chainshaper apply plan"),
        # Chains that do not exist.
        ("latency REC --chain /t1../t9", "/t9"),
        ("plan REC --chain /nobody../t3", "/nobody"),
        ("latency REC --chain /t3../t1", "/t3../t1"),  # against the flow
        ("latency REC --chain /t1../t2../t1", "stands twice"),
        ("latency REC --chain /t1..", "way points"),
        # Options that do not go together.
        ("plan", "give either a recording or --latencies"),
        ("plan REC --latencies LATENCIES", "give either a recording or --latencies"),
        ("plan --latencies LATENCIES", "add --period"),
        ("plan REC --period 1s", "--period goes with --latencies"),
        ("plan REC --sink /t1../t3", "is given twice"),
        ("latency REC --instances", "--instances goes with --json"),
        ("compare REC", "a comparison needs two recordings"),
        ("record -o OUT", "no command given"),
        ("record -o OUT --pid 1 -- true", "a COMMAND is started, --pid attaches"),
        ("profile -o OUT", "no command given"),
        ("profile -o OUT --chain /a../b -- true", "Add --like REC"),
        ("shape APP -o OUT", "a described application has its plan"),
        ("export REC -o OUT", "add --perfetto or --mcap"),
        ("release nothing", "no run 'nothing': "),
    ],
)
def test_what_does_not_go_is_refused_and_nothing_written(
    command: str, message: str, folder: Path, words: Words
) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert message in refused(2, *words(command))
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_what_cannot_be_shaped_is_refused_before_anything_is_launched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, out = tmp_path / "robot.launch.xml", tmp_path / "out"
    file.write_text("<launch/>\n")
    for words, reason in {
        "robot.yaml": "`shape APP.yaml plan.yaml -o REC`",
        "robot.yaml plan.yaml --bands 2": "is shaped as plan.yaml says",
        "-- sleep 1": "is not `ros2 launch",
        "--chain /a../b --chain /c../d --sink /a../e LAUNCH": "--sink goes with one chain",
        "--throttle /in=100ms LAUNCH": "name it, as in --throttle NODE:/in=PERIOD",
        "--throttle /node:/in LAUNCH": "write a topic and a period",
        "--policy pipelined --sink /a../e LAUNCH": "further sinks are shaped",
        "--modes /mode:city,highway LAUNCH": "nothing says which mode was in force",
        "--mode-profile city=before LAUNCH": "goes with --modes",
    }.items():
        given = words.replace("LAUNCH", f"-- ros2 launch {file}").split()
        assert reason in refused(2, "shape", "-o", out, *given)
    launch = ("--", "ros2", "launch", file)
    said = refused(3, "shape", "-o", out, "--cores", "0,4000", *launch)
    assert "core 4000, which --cores asks for" in said
    assert "exists already and is not overwritten" in refused(2, "shape", "-o", tmp_path, *launch)
    monkeypatch.setenv("PATH", str(tmp_path))
    said = refused(3, "shape", "-o", out, "--node", "cpp", *launch)
    assert "colcon, which building the shaping node needs" in said, "before minutes are spent"
    assert [entry.name for entry in tmp_path.iterdir()] == [file.name]


def test_with_json_an_error_is_json_too(words: Words) -> None:
    failed = called(*words("latency REC --chain /t1../t9 --json"))
    assert (failed.code, failed.out) == (2, "")
    error = json.loads(failed.err.splitlines()[-1])
    assert (error["format"], error["exit_code"]) == (1, 2)
    assert "/t9" in error["error"]


@pytest.mark.skipif(not DATA.is_dir(), reason="the reference traces are not here")
def test_without_a_chain_those_of_the_trace_are_proposed() -> None:
    message = refused(2, "latency", DATA / "jazzy_avp_cyclonedds" / "trace")
    proposed = [spec.split("..") for spec in re.findall(r"--chain (\S+)", message)]
    assert {(topics[0], topics[-1]) for topics in proposed} == {
        ("/lidar_front/points_raw", "/localization/ndt_pose"),
        ("/lidar_rear/points_raw", "/localization/ndt_pose"),
    }


@pytest.mark.parametrize(
    "command",
    [
        "run",
        "run app.yaml",
        "run app.yaml -o rec --cycles 0",
        "run app.yaml -o rec --cycles many",
        "doctor --watch 5",
        "doctor --watch -5ms",
        "plan rec --epsilon -1ms",
        "plan rec --anchor clock",
        "shape app.yaml",
        "watch --every 0ms --chain /a../b",
        "latency",
        "dance",
        "--louder",
    ],
)
def test_wrong_use_ends_with_2_and_a_hint(command: str) -> None:
    finished = called(*command.split())
    assert (finished.code, finished.out) == (2, "")
    (line,) = finished.err.splitlines()
    assert line.startswith("error: "), "in the style of all other errors"
    assert "see `chainshaper" in line
    assert line.endswith("--help`")
    assert "Traceback" not in finished.err


def test_the_exit_code_of_the_process_tells_the_kinds_of_failure_apart(
    folder: Path, words: Words
) -> None:
    """In processes; the other tests have the codes of the entry point."""
    (folder / "application.yaml").write_text(MISSING_CORE)
    for code, command in (
        (1, "plan --latencies LATENCIES --period 100ms"),
        (2, "run LATENCIES -o OUT"),
        (3, "run APP -o OUT"),
    ):
        message_of(chainshaper(*words(command)), code)


def _lack_of_memory_below() -> None:
    try:
        raise MemoryError
    except MemoryError as error:
        raise ValueError("no matrix") from error


def _raises(error: BaseException) -> Callable[[], None]:
    def fails() -> None:
        raise error

    return fails


@pytest.mark.parametrize(
    ("fails", "message"),
    [
        (lambda: np.zeros(1 << 60, np.uint8), "memory ran out (Unable to allocate 1.00 EiB"),
        (_lack_of_memory_below, "memory ran out (Python could not allocate it)"),
        (_raises(OSError(errno.ENOMEM, "Cannot allocate")), "memory ran out ([Errno 12] Cannot"),
        (
            _raises(pl.exceptions.PanicException("assertion failed:\n offset")),
            "Polars cannot process this data (assertion failed: offset): check",
        ),
    ],
)
def test_memory_that_runs_out_is_one_message(fails: Callable[[], object], message: str) -> None:
    with mock.patch("chainshaper.cli.app.app", lambda *_, **__: fails()):
        found = refused(1, "info")
    assert message in found
    assert found.count("\n") == 1
    with mock.patch("chainshaper.cli.app.app", side_effect=KeyError("x")), pytest.raises(KeyError):
        called("info")  # other mistakes of ours stay tracebacks


@pytest.mark.parametrize("plan", [{"1": "x"}, {}, {"chains": [1]}])
def test_a_recording_whose_plan_is_none_is_refused(
    tmp_path: Path, simulated: Recording, plan: dict[str, object]
) -> None:
    folder = Path(shutil.copytree(simulated.path, tmp_path / "recording"))
    facts = json.loads((folder / "recording.json").read_text())
    (folder / "recording.json").write_text(json.dumps({**facts, "plan": plan}))
    said = refused(2, "latency", folder)
    assert f"{folder}, its plan in force: " in said
    assert said.count("\n") == 1


def test_a_file_that_no_memory_is_left_for_is_not_called_damaged(
    monkeypatch: pytest.MonkeyPatch, simulated: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_thread(*_: object, **__: object) -> None:
        raise pl.exceptions.ComputeError("OS can't spawn worker thread: Resource unavailable")

    monkeypatch.setattr(pl, "scan_parquet", no_thread)
    with pytest.raises(SystemExit) as ended:
        main(["latency", str(simulated.path)])
    assert ended.value.code == 1
    assert capsys.readouterr().err.startswith("error: memory ran out (")


@pytest.mark.parametrize("megabytes", [100, 250, 400, 650])
def test_limited_memory_ends_in_one_message_whoever_wanted_more(
    megabytes: int, simulated: Recording
) -> None:
    limited = ("sh", "-c", f'ulimit -v {megabytes * 1000_000 // 1024}; exec "$@"', "sh")
    finished = chainshaper("latency", simulated.path, prefix=limited)
    assert "Traceback" not in finished.err
    if finished.code == 0 and megabytes > 250:  # it needs less than that since nothing is compiled
        assert "End-to-end latency" in finished.out
        return
    if megabytes == 250:
        assert "and loading tables takes 400 MB" in finished.err
    # OpenBLAS ends the process by itself, with its own message.
    last = finished.err.strip().splitlines()[-1]
    assert finished.code == 1
    assert last.startswith(("error: memory ran out", "OpenBLAS error: Memory allocation"))
