"""What people do by mistake: one message with the place and the remedy, and the right exit code."""

import errno
import shutil
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import polars as pl
import pytest
from command_line import called, chainshaper, message_of, refused
from small_chain import small_chain_text

from chainshaper.planning import Plan, save_plan
from chainshaper.values.recording import Recording


@pytest.mark.parametrize(
    ("chain", "said"),
    [
        ("/t1../t9", "/t9"),
        ("/nobody../t3", "/nobody"),
        ("/t3../t1", "/t3../t1"),  # against the flow
        ("/t1../t2../t1", "stands twice"),  # cyclic
        ("/t1..", "way points"),
    ],
)
@pytest.mark.parametrize("verb", ["latency", "plan"])
def test_a_chain_that_does_not_exist(verb: str, chain: str, said: str, unshaped: Recording) -> None:
    assert said in refused(2, verb, unshaped.path, "--chain", chain)


@pytest.mark.parametrize("verb", ["run", "shape"])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("subscription: /t2", "subscription: /t9"), "subscription: no node publishes /t9"),
        (
            ("chain: /t1../t3", "chain: /t1../brake"),
            ":2: chain: no topic or node is called '/brake'",
        ),
        (("timer: 50ms", "timer: 50"), "50 is not a duration: write a number and a unit"),
        (("publishes: [/t3]", "publishes: [/t3, /t1]"), "the topics form a cycle"),
        (("nodes:", "nodes: ["), "not YAML"),
    ],
)
def test_a_mistake_in_the_application(
    verb: str, change: tuple[str, str], said: str, application_file: Path, plan: Plan
) -> None:
    application_file.write_text(small_chain_text().replace(*change))
    output = application_file.parent / "recording"
    arguments: list[str | Path] = [application_file]
    if verb == "shape":
        save_plan(plan, application_file.parent / "plan.yaml")
        arguments.append(application_file.parent / "plan.yaml")
    assert said in refused(2, verb, *arguments, "-o", output)
    assert not output.exists()


def test_a_missing_core_is_the_platforms_fault(application_file: Path) -> None:
    application_file.write_text(small_chain_text(executor_core=1023))
    output = application_file.parent / "recording"
    for verb, option in (("run", application_file), ("demo", f"--application={application_file}")):
        said = refused(3, verb, option, "-o", output)
        assert "core 1023, which node" in said
        assert "is not available: this process may use" in said
        assert not output.exists()


def test_a_missing_core_in_a_plan(application_file: Path, plan: Plan) -> None:
    text = _plan_text(application_file.parent, plan)
    plan_file = application_file.parent / "plan.yaml"
    core = next(line for line in text.splitlines() if line.startswith("  core: "))
    plan_file.write_text(text.replace(core, "  core: 1023"))
    output = application_file.parent / "recording"
    said = refused(3, "shape", application_file, plan_file, "-o", output)
    assert "core 1023, which node chainshaper_t3 asks for" in said


def _plan_text(folder: Path, plan: Plan) -> str:
    save_plan(plan, folder / "plan.yaml")
    return (folder / "plan.yaml").read_text()


def test_a_period_shorter_than_the_longest_latency(tmp_path: Path) -> None:
    latencies = tmp_path / "latencies.txt"
    latencies.write_text("30ms\n120ms\n")
    said = refused(1, "plan", "--latencies", latencies, "--period", "100ms")
    assert "the longest latency 120ms" in said
    assert "do not fit into the cycle of 100ms" in said
    assert "a longer period" in said


def test_a_plan_file_with_a_period_shorter_than_the_longest_latency(
    application_file: Path, plan: Plan
) -> None:
    text = _plan_text(application_file.parent, plan)
    plan_file = application_file.parent / "plan.yaml"
    plan_file.write_text(text.replace("50ms", "15ms"))
    said = refused(2, "shape", application_file, plan_file, "-o", application_file.parent / "rec")
    assert f"{plan_file}:" in said
    assert "15ms" in said


def test_a_plan_for_another_application(application_file: Path, plan: Plan) -> None:
    text = _plan_text(application_file.parent, plan)
    plan_file = application_file.parent / "plan.yaml"
    plan_file.write_text(text.replace("50ms", "60ms"))
    said = refused(2, "shape", application_file, plan_file, "-o", application_file.parent / "rec")
    assert "plan again from a recording of this application" in said


def test_real_time_scheduling_that_is_not_permitted(application_file: Path) -> None:
    if shutil.which("setpriv") is None:
        pytest.skip("setpriv, which takes privileges away, is not installed")
    output = application_file.parent / "recording"
    finished = chainshaper(
        *("run", application_file, "-o", output, "--realtime"),
        prefix=("setpriv", "--bounding-set=-sys_nice"),
    )
    if finished.code == 0:
        pytest.skip("SCHED_FIFO is permitted here without CAP_SYS_NICE")
    assert finished.code == 3
    assert "may not use SCHED_FIFO: run as root, give your user an rtprio limit" in finished.err
    assert not output.exists()


def test_without_the_privilege_it_runs_with_what_it_may(application_file: Path) -> None:
    if shutil.which("setpriv") is None:
        pytest.skip("setpriv, which takes privileges away, is not installed")
    output = application_file.parent / "recording"
    finished = chainshaper(
        *("run", application_file, "-o", output, "--cycles", "2"),
        prefix=("setpriv", "--bounding-set=-sys_nice"),
    )
    assert finished.code == 0, finished.err
    assert finished.out == f"{output}\n"


def test_outputs_that_exist_are_not_overwritten(
    application_file: Path, unshaped: Recording, plan: Plan
) -> None:
    folder = application_file.parent
    save_plan(plan, folder / "plan.yaml")
    before = {path: path.read_bytes() for path in folder.iterdir()}
    for arguments in (
        ("run", application_file, "-o", folder),
        ("run", application_file, "-o", application_file),
        ("shape", application_file, folder / "plan.yaml", "-o", folder),
        ("demo", "-o", folder),
        ("plan", unshaped.path, "-o", folder / "plan.yaml"),
    ):
        said = refused(2, *arguments)
        assert "exists already and is not overwritten: name another, or remove it" in said
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_outputs_in_folders_that_do_not_exist(application_file: Path, unshaped: Recording) -> None:
    missing = application_file.parent / "missing"
    for arguments in (
        ("run", application_file, "-o", missing / "recording"),
        ("demo", "-o", missing / "folder"),
        ("plan", unshaped.path, "-o", missing / "plan.yaml"),
    ):
        assert f"{missing}: no such folder to write" in refused(2, *arguments)
    assert not missing.exists()


def test_what_is_no_recording(tmp_path: Path, application_file: Path, unshaped: Recording) -> None:
    for verb in ("latency", "callbacks", "plan"):
        for path in (tmp_path, application_file, tmp_path / "nothing"):
            said = refused(2, verb, path)
            assert f"{path}: " in said
            assert "a recording is made with `chainshaper run" in said
    assert f"{tmp_path}: a folder without" in refused(2, "compare", unshaped.path, tmp_path)


def test_a_recording_whose_tables_are_broken(tmp_path: Path, unshaped: Recording) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(unshaped.path, broken)
    table = broken / "callback_start.parquet"
    table.write_bytes(table.read_bytes()[:100])
    for verb in ("latency", "callbacks"):
        assert f"{table}: not a readable event table" in refused(2, verb, broken)


def test_files_in_place_of_others(application_file: Path, unshaped: Recording, plan: Plan) -> None:
    folder = application_file.parent
    save_plan(plan, folder / "plan.yaml")
    output = folder / "recording"
    # An application as the plan, a plan as the application, a recording as either.
    said = refused(2, "shape", application_file, application_file, "-o", output)
    assert "nodes: unknown key" in said
    said = refused(2, "run", folder / "plan.yaml", "-o", output)
    assert "scheduling: is missing" in said
    assert "Is a directory" in refused(2, "run", unshaped.path, "-o", output)
    assert "one duration a line" in refused(
        2, "plan", "--latencies", unshaped.path / "callback_start.parquet", "--period", "1s"
    )


def test_options_that_do_not_go_together(tmp_path: Path, unshaped: Recording) -> None:
    latencies = tmp_path / "latencies.npy"
    np.save(latencies, np.array([1_000_000, 2_000_000]))
    assert "give either a recording or --latencies" in refused(2, "plan")
    assert "give either a recording or --latencies" in refused(
        2, "plan", unshaped.path, "--latencies", latencies
    )
    assert "add --period" in refused(2, "plan", "--latencies", latencies)
    assert "--period goes with --latencies" in refused(2, "plan", unshaped.path, "--period", "1s")
    assert "--instances goes with --json" in refused(2, "latency", unshaped.path, "--instances")
    assert "a comparison needs two recordings" in refused(2, "compare", unshaped.path)


@pytest.mark.parametrize(
    "arguments",
    [
        ("run",),
        ("run", "app.yaml"),
        ("run", "app.yaml", "-o", "rec", "--cycles", "0"),
        ("run", "app.yaml", "-o", "rec", "--cycles", "many"),
        ("doctor", "--watch", "5"),
        ("doctor", "--watch", "-5ms"),
        ("plan", "rec", "--epsilon", "-1ms"),
        ("plan", "rec", "--anchor", "clock"),
        ("shape", "app.yaml"),
        ("latency",),
        ("dance",),
        ("--louder",),
    ],
)
def test_wrong_use_ends_with_2_and_a_hint(arguments: tuple[str, ...]) -> None:
    finished = called(*arguments)
    assert finished.code == 2
    assert finished.out == ""
    assert "Usage: chainshaper" in finished.err
    assert "Traceback" not in finished.err


def test_the_exit_code_of_the_process_tells_the_kinds_of_failure_apart(
    application_file: Path, unshaped: Recording
) -> None:
    folder = application_file.parent
    latencies = folder / "latencies.txt"
    latencies.write_text("30ms\n120ms\n")
    elsewhere = folder / "elsewhere.yaml"
    elsewhere.write_text(small_chain_text(executor_core=1023))
    for code, arguments in (
        (0, ("callbacks", unshaped.path)),
        (1, ("plan", "--latencies", latencies, "--period", "100ms")),
        (2, ("latency", unshaped.path, "--chain", "/t1../t9")),
        (2, ("run", latencies, "-o", folder / "recording")),
        (3, ("run", elsewhere, "-o", folder / "recording")),
    ):
        finished = chainshaper(*arguments)
        if code == 0:
            assert finished.code == 0
        else:
            message_of(finished, code)


def _lack_of_memory_below() -> None:
    try:
        raise MemoryError
    except MemoryError as error:
        raise ValueError("no matrix") from error


def _enomem() -> None:
    raise OSError(errno.ENOMEM, "Cannot allocate memory")


def _polars_panics() -> None:
    raise pl.exceptions.PanicException("assertion failed:\n offset")


@pytest.mark.parametrize(
    ("fails", "said"),
    [
        (lambda: np.zeros(1 << 60, np.uint8), "memory ran out (Unable to allocate 1.00 EiB"),
        (lambda: bytearray(1 << 62), "memory ran out (Python could not allocate it)"),
        (_lack_of_memory_below, "memory ran out (Python could not allocate it)"),
        (_enomem, "memory ran out ([Errno 12] Cannot allocate memory)"),
        (_polars_panics, "Polars cannot process this data (assertion failed: offset): check"),
    ],
)
def test_memory_that_runs_out_is_one_message(fails: Callable[[], object], said: str) -> None:
    with mock.patch("chainshaper.cli.app.app", lambda *_, **__: fails()):
        message = refused(1, "info")
    assert said in message
    assert message.count("\n") == 1


def test_other_mistakes_of_ours_stay_tracebacks() -> None:
    with mock.patch("chainshaper.cli.app.app", side_effect=KeyError("x")), pytest.raises(KeyError):
        called("info")


@pytest.mark.parametrize("megabytes", [100, 400, 650])
def test_limited_memory_ends_in_one_message_whoever_wanted_more(
    megabytes: int, unshaped: Recording
) -> None:
    limited = ("sh", "-c", f'ulimit -v {megabytes * 1000}; exec "$@"', "sh")
    finished = chainshaper("latency", unshaped.path, prefix=limited)
    assert "Traceback" not in finished.err
    # OpenBLAS ends the process by itself, with its own message.
    last = finished.err.strip().splitlines()[-1]
    assert finished.code == 1
    assert last.startswith(("error: memory ran out", "OpenBLAS error: Memory allocation"))
