"""What verbs print when all is well: for people on stdout, for scripts as JSON."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from command_line import called, chainshaper, json_of
from small_chain import DDS_CORE, EXECUTOR_CORE, small_chain_text

from chainshaper import load_plan, measure_latency, open_recording
from chainshaper.values.recording import Recording

VERBS = (
    "demo",
    "run",
    "latency",
    "info",
    "graph",
    "callbacks",
    "chains",
    "convert",
    "plan",
    "shape",
    "compare",
    "threads",
    "doctor",
)

STATISTICS = {
    *("count", "incomplete", "disturbed", "min_ns", "mean_ns", "max_ns", "jitter_ns"),
    *("spread_ns", "percentiles_ns"),
}


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself(verb: str) -> None:
    for option in ("--help", "-h"):
        finished = called(verb, option)
        assert finished.code == 0
        assert f"Usage: chainshaper {verb}" in finished.out
        assert finished.err == ""


def test_the_overview_names_every_verb() -> None:
    finished = chainshaper("--help")
    assert finished.code == 0
    assert all(f" {verb} " in finished.out for verb in VERBS)


def test_latency_as_json_is_what_the_library_finds(unshaped: Recording) -> None:
    values = json_of("latency", unshaped.path)
    found = measure_latency(unshaped).analysis.statistics
    assert set(values) >= STATISTICS
    assert "instances" not in values
    assert (values["count"], values["incomplete"]) == (found.count, found.incomplete)
    assert (values["min_ns"], values["max_ns"]) == (found.min_ns, found.max_ns)
    assert values["jitter_ns"] == values["max_ns"] - values["min_ns"]
    assert all(isinstance(values[key], int) for key in ("min_ns", "mean_ns", "max_ns", "spread_ns"))


def test_a_process_prints_its_document_and_nothing_else(unshaped: Recording) -> None:
    finished = chainshaper("latency", unshaped.path, "--json")
    assert (finished.code, finished.err) == (0, "")
    assert json.loads(finished.out) == json_of("latency", unshaped.path)


def test_instances_are_in_wall_clock_time(unshaped: Recording) -> None:
    values = json_of("latency", unshaped.path, "--instances", "--chain", "/t1../t2")
    assert len(values["instances"]) == values["count"]
    latencies = [instance["latency_ns"] for instance in values["instances"]]
    assert (min(latencies), max(latencies)) == (values["min_ns"], values["max_ns"])
    modified = (unshaped.path / "recording.json").stat().st_mtime_ns
    for instance in values["instances"]:
        assert set(instance) == {"start_ns", "end_ns", "latency_ns", "disturbed"}
        assert instance["end_ns"] - instance["start_ns"] == instance["latency_ns"]
        assert modified - 600 * 10**9 < instance["start_ns"] < modified, "an epoch, not an uptime"


def test_callbacks_as_json(unshaped: Recording) -> None:
    rows = json_of("callbacks", unshaped.path)
    by_node = {row["node"]: row for row in rows}
    assert set(by_node) == {"/first", "/second", "/third", "/actuator"}
    for row in rows:
        assert set(row) == {
            *("node", "kind", "topic", "period_ns", "pid", "tids", "count"),
            *("response_ns", "execution_ns"),
        }
        assert row["tids"] == [row["pid"]]
        assert set(row["execution_ns"]) == {"min", "mean", "max"}
        assert 0 < row["execution_ns"]["min"] <= row["response_ns"]["max"]
    assert (by_node["/first"]["kind"], by_node["/first"]["period_ns"]) == ("timer", 50_000_000)
    assert (by_node["/third"]["kind"], by_node["/third"]["topic"]) == ("subscription", "/t2")


def test_a_plan_is_written_and_printed(tmp_path: Path, unshaped: Recording) -> None:
    file = tmp_path / "plan.yaml"
    values = json_of("plan", unshaped.path, "-o", file, "--epsilon", "2ms", "--anchor", "cycle")
    planned = load_plan(file)
    assert values["anchor"] == planned.anchor == "cycle"
    assert values["margin"]["epsilon_ns"] == planned.margin.epsilon_ns == 2_000_000
    assert values["bands_ns"] == [planned.servers[-1].slots[-1][1]]
    assert set(values["predicted"]) == {"mean_ns", "max_ns", "jitter_ns", "shares"}
    assert [server["core"] for server in values["servers"]] == [EXECUTOR_CORE, EXECUTOR_CORE]
    longest = measure_latency(unshaped).analysis.undisturbed.max_ns
    assert values["evidence"]["max_latency_ns"] == longest


@pytest.mark.parametrize("suffix", [".txt", ".npy"])
def test_a_plan_from_bare_latencies(suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"latencies{suffix}"
    if suffix == ".npy":
        np.save(file, np.array([60_000_000, 63_250_000]))
    else:
        file.write_text("# from another tool\n60ms\n\n63.25ms  # the longest\n")
    values = json_of(
        *("plan", "--latencies", file, "--period", "100ms", "--publish-slot", "500us"),
        *("--anchor", "cycle", "--chain", "/t1../t5"),
    )
    assert values["bands_ns"] == [63_250_000 + 1_000_000 + 500_000]
    assert values["evidence"]["max_latency_ns"] == 63_250_000
    assert (values["anchor"], values["chain"]["spec"]) == ("cycle", "/t1../t5")


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
    assert before["count"] == after["count"] or not unshaped.info.realtime
    for name in ("latency.png", "distribution.png"):
        assert (figures / name).read_bytes().startswith(b"\x89PNG")
    again = called("compare", unshaped.path, shaped.path, "--figures", figures)
    assert again.code == 2
    assert "exists already and is not overwritten" in again.err


def test_doctor_as_json() -> None:
    values = json_of("doctor", "--watch", "300ms")
    names = [check["name"] for check in values["checks"]]
    assert {"cores", "SCHED_FIFO", "memory locking", "Cyclone DDS for Python"} <= set(names)
    for check in values["checks"]:
        assert check["state"] in ("good", "limited", "absent")
        assert check["state"] == "good" or check["remedy"], f"{check['name']} has no remedy"
    assert {row["core"] for row in values["stalls"]} >= {DDS_CORE, EXECUTOR_CORE}
    assert values["watched_ns"] == 300_000_000


def test_doctor_tries_bpftrace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is there and does not work is not good, and the warning before is not the reason."""
    program = tmp_path / "bpftrace"
    program.write_text(
        "#!/bin/sh\necho 'WARNING: RLIMIT_MEMLOCK is low' >&2\n"
        "echo 'ERROR: tracepoint not found: sched:sched_switch' >&2\nexit 1\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    checks = json_of("doctor", "--watch", "100ms")["checks"]
    (found,) = (check for check in checks if check["name"] == "bpftrace")
    assert found["state"] == "limited"
    as_root = "does not work: ERROR: tracepoint not found: sched:sched_switch"
    assert found["found"] == (as_root if os.geteuid() == 0 else "needs root")


def test_demo_keeps_everything_in_one_folder(application_file: Path) -> None:
    """With the small chain and few cycles: the flow is the same."""
    for cycles in ("8", "40", "120"):  # a busy machine may disturb eight of eight
        folder = application_file.parent / f"demo{cycles}"
        made = called(
            *("demo", "--application", application_file, "--cycles", cycles),
            *("-o", folder, "--json"),
        )
        if made.code == 0:
            break
    values = json.loads(made.out)
    assert values["folder"] == str(folder)
    assert len(values["recordings"]) == 2
    assert sorted(entry.name for entry in folder.iterdir()) == [
        *("after", "application.yaml", "before", "comparison.json"),
        *("distribution.png", "latency.png", "plan.yaml"),
    ]
    assert (folder / "application.yaml").read_text() == small_chain_text()
    assert open_recording(folder / "after").info.plan is not None
    # Every figure can be recomputed from what is on disk.
    assert (
        json_of("compare", folder / "before", folder / "after")["recordings"]
        == (values["recordings"])
    )


def test_tables_are_for_people(unshaped: Recording, shaped: Recording) -> None:
    latency = called("latency", unshaped.path).out
    assert "End-to-end latency of /t1../t3 [ms]" in latency, "figures without a unit"
    assert "cycles disturbed by the machine" in latency
    callbacks = called("callbacks", unshaped.path).out
    assert "Callbacks [ms]" in callbacks
    assert "/actuator" in callbacks
    compared = called("compare", unshaped.path, shaped.path)
    assert "before" in compared.out
    assert "after" in compared.out
    assert "slots [21.000, 22.000)" in compared.out
    plan = called("plan", unshaped.path)
    assert "Plan for /t1../t3 [ms]" in plan.out
    assert "note: the sample is small" in plan.err


def test_a_long_path_is_printed_on_one_line(tmp_path: Path, unshaped: Recording) -> None:
    folder = tmp_path / ("a" * 100) / ("b" * 100)
    folder.mkdir(parents=True)
    finished = chainshaper("plan", unshaped.path, "-o", folder / "plan.yaml")
    assert finished.out.splitlines()[-1] == str(folder / "plan.yaml")
