"""What verbs print when all is well: for people on stdout, for scripts as JSON."""

import io
import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest
import yaml
from command_line import called, chainshaper, json_of, refused
from known import known
from processes import wait_for
from rich.console import Console
from small_chain import DDS_CORE, EXECUTOR_CORE, small_chain_text

import chainshaper as cs
from chainshaper import load_plan, measure_latency
from chainshaper.cli import output
from chainshaper.cli.app import VERBS
from chainshaper.flow import doctor
from chainshaper.flow.describing import application_file
from chainshaper.planning import ChainPlan, Plan, save_plan
from chainshaper.reporting.tables import ResultTable, figures, words
from chainshaper.values.durations import parse_duration
from chainshaper.values.recording import Recording

STATISTICS = {
    *("count", "incomplete", "disturbed", "min_ns", "mean_ns", "max_ns", "jitter_ns"),
    *("spread_ns", "percentiles_ns"),
}


def test_every_verb_explains_itself() -> None:
    overview = chainshaper("--help")
    assert overview.code == 0
    for verb in VERBS:
        assert f" {verb} " in overview.out
        finished = called(verb, "-h")
        assert (finished.code, finished.err) == (0, "")
        assert f"Usage: chainshaper {verb}" in finished.out


def test_latency_as_json_is_what_the_library_finds(unshaped: Recording) -> None:
    process = chainshaper("latency", unshaped.path, "--json")
    assert (process.code, process.err) == (0, "")
    values = json.loads(process.out)
    assert values == json_of("latency", unshaped.path)
    found = measure_latency(unshaped).analysis.statistics
    assert set(values) >= STATISTICS
    assert "instances" not in values
    for name in ("count", "incomplete", "min_ns", "max_ns"):
        assert values[name] == getattr(found, name)
    assert values["jitter_ns"] == values["max_ns"] - values["min_ns"]
    values = json_of("latency", unshaped.path, "--instances", "--chain", "/t1../t2")
    latencies = [instance["latency_ns"] for instance in values["instances"]]
    assert len(latencies) == values["count"]
    assert (min(latencies), max(latencies)) == (values["min_ns"], values["max_ns"])
    modified = (unshaped.path / "recording.json").stat().st_mtime_ns
    for instance in values["instances"]:
        assert instance["end_ns"] - instance["start_ns"] == instance["latency_ns"]
        assert modified - 600 * 10**9 < instance["start_ns"] < modified, "an epoch, not an uptime"


def test_compare_as_json_and_with_figures(
    tmp_path: Path, unshaped: Recording, shaped: Recording
) -> None:
    figures = tmp_path / "figures"
    values = json_of("compare", unshaped.path, shaped.path, "--figures", figures)
    before, after = values["recordings"]
    assert (before["recording"], after["recording"]) == (str(unshaped.path), str(shaped.path))
    assert (before["overruns"], "predicted" in before) == (None, False)
    assert isinstance(after["overruns"], int)
    assert after["predicted"]["max_ns"] == 22_000_000
    prediction = after["prediction"]
    assert (prediction["max_ns"]["at_start"], prediction["max_ns"]["at_end"]) == (21e6, 22e6)
    (band,) = prediction["bands"]
    slot = (band["slot_start_ns"], band["slot_end_ns"])
    assert (slot, band["predicted_share"]) == ((21e6, 22e6), 1.0)
    assert before["count"] == after["count"] or not unshaped.info.realtime
    for name in ("latency.png", "distribution.png"):
        assert (figures / name).read_bytes().startswith(b"\x89PNG")
    again = refused(2, "compare", unshaped.path, shaped.path, "--figures", figures)
    assert "exists already and is not overwritten" in again


def test_doctor_as_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bpftrace that does not work is not good, and the warning before is not the reason."""
    program = tmp_path / "bpftrace"
    program.write_text(
        "#!/bin/sh\necho 'WARNING: RLIMIT_MEMLOCK is low' >&2\n"
        "echo 'ERROR: tracepoint not found: sched:sched_switch' >&2\nexit 1\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    values = json_of("doctor", "--watch", "100ms")
    checks = {check["name"]: check for check in values["checks"]}
    assert {"cores", "SCHED_FIFO", "memory locking", "Cyclone DDS for Python"} <= checks.keys()
    for check in checks.values():
        assert check["state"] in ("good", "limited", "absent")
        assert check["state"] == "good" or check["remedy"], f"{check['name']} has no remedy"
    assert {row["core"] for row in values["stalls"]} >= {DDS_CORE, EXECUTOR_CORE}
    assert values["watched_ns"] == 100_000_000
    assert checks["bpftrace"]["state"] == "limited"
    as_root = "does not work: ERROR: tracepoint not found: sched:sched_switch"
    assert checks["bpftrace"]["found"] == (as_root if os.geteuid() == 0 else "needs root")


@pytest.mark.parametrize(
    ("variables", "found"),
    [
        ("", None),
        ("ROS_DISTRO=jazzy", "rmw_fastrtps_cpp"),
        ("ROS_DISTRO=humble", "have no names"),
        ("RMW_IMPLEMENTATION=rmw_cyclonedds_cpp", "rmw_cyclonedds_cpp"),
        ("RMW_IMPLEMENTATION=rmw_cyclonedds_cpp CYCLONEDDS_URI=<x:name='iox'/>", "iceoryx"),
        ("RMW_IMPLEMENTATION=rmw_connextdds", "RTI Connext"),
        ("RMW_IMPLEMENTATION=rmw_own_cpp", "rmw_own_cpp is not known"),
    ],
)
def test_doctor_says_what_is_limited_on_a_middleware(
    variables: str, found: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("ROS_DISTRO", "RMW_IMPLEMENTATION", "CYCLONEDDS_URI"):
        monkeypatch.delenv(name, raising=False)
    for variable in variables.split():
        monkeypatch.setenv(*variable.split("=", 1))
    checks = list(doctor._middleware())
    assert [(found or "") in check.found for check in checks] == [True] * bool(found)
    works = found in ("rmw_cyclonedds_cpp", "rmw_fastrtps_cpp")
    assert {check.state for check in checks} <= {"good" if works else "limited"}


def test_doctor_says_whether_zenohs_router_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
    router = tmp_path / "rmw_zenohd"
    shutil.copy(known(shutil.which("sleep")), router)
    with subprocess.Popen([router, "60"]) as process:
        wait_for(lambda: "(process " in str(list(doctor._middleware())), "the router", 10)
        middleware, check = doctor._middleware()
        assert (middleware.state, middleware.found) == ("good", "rmw_zenoh_cpp")
        assert check.found.startswith("rmw_zenohd (process "), "another router may run here"
        process.kill()
    monkeypatch.setattr(doctor, "list_processes", tuple)
    _, check = doctor._middleware()
    assert (check.state, check.found) == ("limited", "none runs on this machine")
    assert "ros2 run rmw_zenoh_cpp rmw_zenohd" in check.remedy


def test_tables_are_for_people(
    unshaped: Recording, shaped: Recording, plan: ChainPlan, tmp_path: Path
) -> None:
    save_plan(Plan.of(plan), tmp_path / "plan.yaml")
    dry_run: list[str | Path] = [
        "apply",
        tmp_path / "plan.yaml",
        "--dry-run",
        "--backend",
        "litmus",
    ]
    compared = ["before", "after", "Prediction and measurement", "[21.000, 22.000)"]
    shown: list[tuple[list[str | Path], list[str]]] = [
        (["latency", unshaped.path], ["latency of /t1../t3 [ms]", "disturbed by the machine"]),
        (["callbacks", unshaped.path], ["Callbacks [ms]", "/actuator"]),
        (["compare", unshaped.path, shaped.path], compared),
        (["plan", unshaped.path], ["Plan for /t1../t3 [ms]"]),
        (["status"], ["plan"]),
        (["status", "--outputs"], []),
        (dry_run, ["resctl -n"]),
    ]
    for command, texts in shown:
        finished = called(*command)
        assert finished.code == 0, finished
        assert [text for text in texts if text not in finished.out] == [], command
    assert "note: the sample is small" in called("plan", unshaped.path).err
    assert json_of(*dry_run)["back_end"] == "litmus"


def test_a_plan_is_written_and_printed(tmp_path: Path, unshaped: Recording) -> None:
    folder = tmp_path / ("a" * 100) / ("b" * 100)
    folder.mkdir(parents=True)
    file = folder / "plan.yaml"
    options = ("--epsilon", "2ms", "--anchor", "cycle")
    values = json_of("plan", unshaped.path, "-o", file, *options)
    planned = load_plan(file).chains[0]
    assert values["anchor"] == planned.anchor == "cycle"
    assert values["margin"]["epsilon_ns"] == planned.margin.epsilon_ns == 2_000_000
    assert values["bands_ns"] == [planned.servers[-1].slots[-1][1]]
    figures = {"mean_ns", "max_ns", "jitter_ns", "shares", "modes", "receivers"}
    assert set(values["predicted"]) == figures
    assert [server["core"] for server in values["servers"]] == [EXECUTOR_CORE, EXECUTOR_CORE]
    longest = measure_latency(unshaped).analysis.undisturbed.max_ns
    assert values["evidence"]["max_latency_ns"] == longest
    file.unlink()
    printed = called("plan", unshaped.path, "-o", file).out.splitlines()
    assert printed[-1] == str(file), "on one line, however long"


@pytest.mark.parametrize("patience_s", [0.2, 60])
def test_what_takes_longer_says_what_it_does(
    patience_s: float, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(output, "PATIENCE_S", patience_s)
    said = ""
    with output.late_progress("latency") as report:
        report(0.1, "opening the trace")
        for _ in range(200 if patience_s < 1 else 1):
            time.sleep(0.01)
            said += capsys.readouterr().err
            if said:
                break
        report(0.5, "decoding events")
    said += capsys.readouterr().err
    stages = ["latency: opening the trace", "latency: decoding events"] if patience_s < 1 else []
    assert said.splitlines() == stages


def test_a_promise_is_judged_in_one_line_and_an_exit_code(tmp_path: Path) -> None:
    application = Path(__file__).parents[2] / "examples" / "synthetic_chain.yaml"
    before, after, plan = tmp_path / "before", tmp_path / "after", tmp_path / "plan.yaml"
    assert called("simulate", application, "-o", before).code == 0
    planned = called("plan", before, "-o", plan)
    assert planned.code == 0, planned.err
    printed = planned.out
    assert "outputs leave at" in printed
    assert "expected jitter 0.1" in printed
    assert called("simulate", application, plan, "-o", after).code == 0
    kept = called("compare", before, after, "--strict")
    assert kept.code == 0
    said = "after: promise met: jitter 0.000 ms, at most 1.000 ms; 0 of 320 outputs late"
    assert kept.out.splitlines()[-1].startswith(said)
    broken = called("compare", after, before, "--plan", plan, "--strict")
    assert broken.code == 1
    assert "before: promise broken: jitter" in broken.out.splitlines()[-1]
    assert broken.err.splitlines()[-1] == "error: the plan's promise is not met (--strict)"
    assert "name the plan in force" in called("compare", before, before, "--strict").err
    assert json_of("compare", before, after)["recordings"][1]["prediction"]["kept"] is True
    assert json_of("plan", before)["expected"]["jitter_ns"] == 100_000


def test_an_application_is_described_from_scratch_and_from_a_recording(tmp_path: Path) -> None:
    first, again, copy = tmp_path / "first", tmp_path / "again", tmp_path / "copy.yaml"
    assert called("init", "-o", tmp_path / "app.yaml").code == 0
    assert called("simulate", tmp_path / "app.yaml", "-o", first).code == 0
    assert called("describe", first, "-o", copy).code == 0
    assert called("simulate", copy, "-o", again).code == 0
    one, two = json_of("latency", first), json_of("latency", again)
    assert one["chain"] == two["chain"]
    assert two["mean_ns"] == pytest.approx(one["mean_ns"], rel=0.02)
    assert two["max_ns"] == pytest.approx(one["max_ns"], rel=0.05)
    assert called("--version").out.startswith("chainshaper 1.")


def test_an_execution_that_came_once_is_in_a_description_as_often(tmp_path: Path) -> None:
    """One of 200 executions of 4 ms took 40 ms: the mean is 4.18 ms, the longest 40."""
    text = small_chain_text().replace(
        "execution: {uniform: [1ms, 4ms]}", f"execution: {{samples: [{'4ms, ' * 199}40ms]}}"
    )
    (tmp_path / "app.yaml").write_text(text)
    simulated = cs.simulate(cs.load_application(tmp_path / "app.yaml"), tmp_path / "r", cycles=400)
    described = yaml.safe_load(application_file(simulated)[0])
    for name in ("first", "second", "third"):
        (callback,) = described["nodes"][name]["callbacks"]
        times = list(map(parse_duration, callback["execution"]["sequence"]))
        usual = [time for time in times if time < 5_000_000]
        assert len(usual) > 0.97 * len(times)
        assert all(time >= 4_000_000 for time in usual)
        assert all(40_000_000 <= time < 42_000_000 for time in times if time not in usual)


def test_names_stay_whole_in_a_narrow_terminal() -> None:
    table = ResultTable("Callbacks", [*words("node", "callback"), *figures("response\nmin", "max")])
    names = "/a_node_with_a_long_name", "subscription /and/a/long_topic"
    table.add(*names, "1.000", "20.000")
    shown = {}
    for width in (40, 100):
        with io.StringIO() as text:
            Console(file=text, width=width).print(table)
            shown[width] = text.getvalue()
    assert "  ".join(names).replace("  ", " ") in " ".join(shown[40].split())
    assert shown[40].splitlines()[-1].split() == ["1.000", "20.000"]
    assert f"{names[0]} │ {names[1]}" in shown[100]
