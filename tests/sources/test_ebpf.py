"""The eBPF tracer on a real program: bpftrace, real uprobes, real processes."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from command_line import called, json_of
from processes import children_of, wait_for
from strangers import NOBODY, named, open_folder, strange
from traced_program import Program, Traced, build, skip_without_bpftrace, traced

from chainshaper.analysis.flow import DataFlow, data_flow
from chainshaper.flow.record import record_command
from chainshaper.sources.ebpf.late_attachment import with_found_nodes
from chainshaper.sources.ebpf.session import EbpfTracer
from chainshaper.values import events
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.recording import EndpointInfo, open_recording

__all__ = ["open_folder"]

CYCLES, PERIOD_NS = 20, 50_000_000
TOPICS = ("/ebpf1", "/ebpf2")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Program:
    """Jazzy's trace points, in a folder whose name has spaces."""
    skip_without_bpftrace()
    return build(tmp_path_factory.mktemp("a prefix of ours") / "jazzy")


@pytest.fixture(scope="module")
def humble(tmp_path_factory: pytest.TempPathFactory) -> Program:
    skip_without_bpftrace()
    return build(tmp_path_factory.mktemp("other") / "humble", "-DHUMBLE", version="4.1.1")


@pytest.fixture(autouse=True)
def set_up(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """The environment is as after sourcing the programs' set-up files."""
    found = {"program", "humble"} & set(request.fixturenames)
    prefixes = [str(request.getfixturevalue(name).prefix) for name in sorted(found)]
    monkeypatch.setenv("AMENT_PREFIX_PATH", ":".join(prefixes))
    monkeypatch.delenv("LD_LIBRARY_PATH", raising=False)


def folder_in(path: Path) -> Path:
    folder = path / "trace"
    folder.mkdir()
    return folder


def expected_rows(printed: list[list[str]]) -> dict[str, list[dict[str, Any]]]:
    """What the program says it passed, as rows of the tables."""
    found: dict[str, list[dict[str, Any]]] = {}
    for event, tid, before, after, *passed in printed:
        columns, values = list(events.FIELDS[event]), passed
        if event == "rcl_init":
            values = [*passed, b"8.2.3".hex()]
        elif event == "rclcpp_publish":
            values = passed[1:]
        elif event == "rmw_publish" and len(passed) == 1:
            columns = ["message"]
        row: dict[str, Any] = {"tid": int(tid), "after": int(before), "before": int(after)}
        for column, value in zip(columns, values, strict=True):
            kind = events.FIELDS[event][column]
            if isinstance(kind, pl.String):
                row[column] = bytes.fromhex(value).decode()
            elif isinstance(kind, pl.List):
                row[column] = list(bytes.fromhex(value))[:16]
            else:
                row[column] = int(value)
        found.setdefault(event, []).append(row)
    return found


def assert_same(tables: Mapping[str, pl.DataFrame], printed: list[list[str]]) -> None:
    expected = expected_rows(printed)
    assert set(tables) - {"sched_switch"} == set(expected)
    for event, rows in expected.items():
        table = tables[event]
        assert table.schema == {
            name: kind
            for name, kind in {**events.COMMON_COLUMNS, **events.FIELDS[event]}.items()
            if name in table.columns
        }
        assert table["time"].is_sorted()
        assert table.height == len(rows), event
        for found, row in zip(table.iter_rows(named=True), rows, strict=True):
            after, before = row.pop("after"), row.pop("before")
            assert after <= found["time"] <= before, event
            assert row.items() <= found.items(), event


def test_every_argument_of_every_function_arrives_as_it_was_passed(
    program: Program, tmp_path: Path
) -> None:
    run = traced(
        EbpfTracer(folder_in(tmp_path), program.command("every"), ()), lambda: program.run("every")
    )
    assert_same(run.tables, run.printed)
    assert run.tables["rcl_take"].item(0, "tid") != run.tables["rcl_take"].item(0, "pid")
    assert run.info.lost == {"lost_events": 0}
    assert run.info.distribution == "jazzy"


def test_a_version_without_handles_at_the_rmw_is_read_by_its_own_signatures(
    program: Program, humble: Program, tmp_path: Path
) -> None:
    """Both libraries are there, as on a machine with two distributions."""
    run = traced(
        EbpfTracer(folder_in(tmp_path), humble.command("every"), ()), lambda: humble.run("every")
    )
    version = run.tables["rcl_init"]["version"].to_list()
    assert version == ["4.1.1"]
    tables = {
        **run.tables,
        "rcl_init": run.tables["rcl_init"].with_columns(version=pl.lit("8.2.3")),
        "rmw_publish": run.tables["rmw_publish"].select("time", "pid", "tid", "cpu", "message"),
    }
    assert_same(tables, run.printed)


def test_execution_times_are_the_threads_own_cpu_time(program: Program, tmp_path: Path) -> None:
    command = ("chain", str(CYCLES))
    tracer = EbpfTracer(folder_in(tmp_path), program.command(*command), ())
    run = traced(tracer, lambda: program.run(*command))
    instances = data_flow(run.tables).instances.drop_nulls("end")
    own = [int(fields[4]) for fields in run.printed if fields[0] == "instance"]
    assert instances.height == len(own) == 2 * CYCLES
    # Reading its own clocks costs the thread a little outside the callback, being traced inside.
    assert sum(instances["execution_ns"]) == pytest.approx(sum(own), rel=0.15)
    assert (instances["execution_ns"] < instances["end"] - instances["start"]).all()
    switches = run.tables["sched_switch"]
    tid = run.tables["callback_start"].item(0, "tid")
    involved = (switches["prev_tid"] == tid).fill_null(False) | (switches["next_tid"] == tid)
    assert involved.all()


def assert_chain(flow: DataFlow, printed: list[list[str]]) -> None:
    """Both publications of every cycle, and the second in the instance that read the first."""
    published = flow.publications.with_columns(pl.col("topic").cast(pl.String))
    said = [(fields[1], int(fields[2])) for fields in printed if fields[0] == "publication"]
    assert published["topic"].to_list() == [topic for topic, _ in said] == [*TOPICS] * CYCLES
    ends = [int(fields[3]) for fields in printed if fields[0] == "instance"]
    for at, (_, before), after in zip(published["time"], said, ends, strict=True):
        assert before < at < after
    answers = published.filter(topic=TOPICS[1]).select("instance", answer="publication")
    read = flow.takes.join(answers, on="instance")
    assert read["publication"].to_list() == list(range(0, 2 * CYCLES, 2))
    assert read["answer"].to_list() == list(range(1, 2 * CYCLES, 2))


def assert_found(flow: DataFlow) -> None:
    """The callbacks, without a node; a timer is as late as the machine is busy."""
    reader, timer = flow.objects.callbacks.sort("kind").iter_rows(named=True)
    assert (reader["kind"], reader["topic"]) == ("subscription", "/ebpf1")
    assert timer["kind"] == "timer"
    assert PERIOD_NS / 2 < timer["period_ns"] < 2 * PERIOD_NS
    assert reader["node"].startswith("unknown (process")


def attached(program: Program, path: Path) -> tuple[int, Traced]:
    """Attach to one of two that run; the process, and what was traced of it."""
    path.mkdir(exist_ok=True)
    wanted, other = (program.waiting("chain", str(CYCLES), "wait") for _ in range(2))

    def both() -> list[list[str]]:
        for process in (other, wanted):
            out, _ = process.communicate("go\n", timeout=60)
        return [line.split("\t") for line in out.splitlines()]

    return wanted.pid, traced(EbpfTracer(folder_in(path), (), (wanted.pid,)), both)


def test_what_a_folder_is_called_never_becomes_part_of_the_script(
    open_folder: Path, tmp_path: Path
) -> None:
    """The name ends the quotes, and has root's bpftrace print a file that root alone may read."""
    skip_without_bpftrace()
    secret = open_folder / "secret"
    secret.touch(0o600)
    secret.write_text("nothing for strangers\n")
    plain = build(open_folder / "plain")
    library = shutil.copy(plain.tracetools, open_folder / "library")
    name = f'{library}":ros_trace_callback_end {{}} interval:ms:100 {{ cat("{secret}"); }} uprobe:"'
    crafted = build(Path(f"{name}{plain.prefix}"))
    pid, run = attached(crafted, tmp_path / "beside")
    folder = tmp_path / "beside" / "trace"
    assert "nothing for strangers" not in (folder / "events.txt").read_text()
    assert "cat(" not in (folder / "events.bt").read_text()
    assert set(run.tables["callback_start"]["pid"]) == {pid}


def test_a_recording_runs_nothing_that_a_stranger_has_named(
    program: Program, open_folder: Path, tmp_path: Path
) -> None:
    """Types and QoS are asked for in the environment of the node that was started last."""
    ran = open_folder / "ran"
    (open_folder / "evil").write_text(f"#!/bin/sh\nid -u > {ran}\n")
    (open_folder / "ros2").write_text(f"#!{open_folder}/evil\n")
    for file in ("evil", "ros2"):
        (open_folder / file).chmod(0o755)
    with (
        program.waiting("chain", "3", "wait") as ours,
        strange(named("listener"), {"PATH": f"{open_folder}:/bin:/usr/bin"}) as stranger,
    ):
        done = record_command(tmp_path / "rec", source="ebpf", duration_ns=1_000_000_000)
        ours.communicate("go\n", timeout=60)
    assert not ran.exists()
    assert f"/listener (process {stranger.pid} of nobody)" in " ".join(done.recording.info.notes)


def test_processes_of_other_users_are_attached_to_where_these_are_named(
    open_folder: Path, tmp_path: Path
) -> None:
    """Uprobes belong to a file, which here both use."""
    skip_without_bpftrace()
    program = build(open_folder / "jazzy")
    for users, also in ((None, False), ({0, NOBODY}, True)):
        ours = program.waiting("chain", "3", "wait")
        strangers = program.waiting("chain", "3", "wait", user=NOBODY)

        def both(running: tuple[Any, ...] = (ours, strangers)) -> list[list[str]]:
            for process in running:
                process.communicate("go\n", timeout=60)
            return []

        folder = tmp_path / str(also)
        folder.mkdir()
        seen = set(traced(EbpfTracer(folder, (), (), users), both).tables["callback_start"]["pid"])
        assert ours.pid in seen
        assert (strangers.pid in seen) is also


def test_an_application_that_runs_already_is_attached_to_and_its_chain_is_found(
    program: Program, tmp_path: Path
) -> None:
    pid, run = attached(program, tmp_path)
    pids = {one for name, t in run.tables.items() if name != "sched_switch" for one in t["pid"]}
    assert pids == {pid}
    assert run.info.rmw == "rmw_test_cpp"
    assert any("tracing began while the application ran" in note for note in run.info.notes)
    flow = data_flow(run.tables)
    assert_chain(flow, run.printed)
    assert_found(flow)

    graph = (
        EndpointInfo(node="/first", topic="/ebpf1", kind="publisher"),
        EndpointInfo(node="/second", topic="/ebpf2", kind="publisher"),
        EndpointInfo(node="/second", topic="/ebpf1", kind="subscription"),
    )
    tables, info = with_found_nodes(run.tables, run.info, graph, ())
    flow = data_flow(tables)
    assert_chain(flow, run.printed)
    nodes = flow.objects.callbacks.sort("kind").select("node", "kind").rows()
    assert nodes == [("/second", "subscription"), ("/first", "timer")]
    assert info.processes == {pid: "/first, /second"}


def test_an_application_of_humble_is_attached_to_by_the_handles_of_rcl(
    humble: Program, tmp_path: Path
) -> None:
    _, run = attached(humble, tmp_path)
    flow = data_flow(run.tables, run.info.clock_offset_ns)
    assert_chain(flow, run.printed)
    assert_found(flow)
    assert run.info.distribution == "humble"


def test_events_that_bpftrace_lost_are_counted(
    program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its buffers fill while it is stopped."""
    monkeypatch.setenv("BPFTRACE_PERF_RB_PAGES", "4")
    count = 5_000
    tracer = EbpfTracer(folder_in(tmp_path), program.command("flood"), ())

    def flood() -> list[list[str]]:
        bpftrace = bpftrace_of(os.getpid())
        os.kill(bpftrace, signal.SIGSTOP)
        process = program.waiting("flood", str(count))
        os.kill(bpftrace, signal.SIGCONT)
        time.sleep(0.5)
        process.communicate("go\n", timeout=60)
        return []

    run = traced(tracer, flood)
    lost = run.info.lost["lost_events"]
    assert lost > 0
    # What is lost may be a `sched_switch` as well.
    assert run.tables["callback_end"].height < count
    assert run.tables["callback_end"].height + lost >= count + 1
    assert any("BPFTRACE_PERF_RB_PAGES" in note for note in run.info.notes)


def test_a_recording_is_made_and_its_latency_computed_by_the_command_line(
    program: Program, tmp_path: Path
) -> None:
    recording = tmp_path / "recording"
    command = program.command("chain", str(CYCLES))
    made = called("record", "--source", "ebpf", "-o", recording, "--", *command)
    assert made.code == 0, made.err
    latency = json_of("latency", recording, "--chain", "/ebpf1../ebpf2", "--json")
    assert latency["count"] == CYCLES
    assert latency["incomplete"] == 0
    assert open_recording(recording).info.source == "ebpf"
    assert (recording / "trace/events.bt").is_file()
    callbacks = json_of("callbacks", recording, "--json")
    assert {(one["node"], one["kind"], one["topic"]) for one in callbacks} == {
        ("/first", "timer", None),
        ("/second", "subscription", "/ebpf1"),
    }
    assert all(one["execution_ns"] is not None for one in callbacks)


def test_the_end_of_bpftrace_is_noticed_and_what_it_wrote_is_read(
    program: Program, tmp_path: Path
) -> None:
    tracer = EbpfTracer(folder_in(tmp_path), program.command("chain"), ())
    try:
        tracer.start()
        program.run("chain", "3")
        os.kill(bpftrace_of(os.getpid()), signal.SIGKILL)
        wait_for(lambda: tracer.failure() is not None, "the tracer to notice")
        assert "bpftrace ended" in str(tracer.failure())
        tracer.stop()
    finally:
        tracer.remove()
        tracer.remove()
    tracer.recording()


def bpftrace_of(parent: int) -> int:
    """The tracer's bpftrace: it alone has been given the script."""
    (found,) = (
        child
        for child in children_of(parent)
        if b"events.bt" in Path(f"/proc/{child}/cmdline").read_bytes()
    )
    return found


def test_bpftrace_ends_when_the_tracer_is_killed(program: Program, tmp_path: Path) -> None:
    code = (
        "import sys, time, pathlib\n"
        "from chainshaper.sources.ebpf.session import EbpfTracer\n"
        f"EbpfTracer(pathlib.Path({str(folder_in(tmp_path))!r}), ('any',), ()).start()\n"
        "print('ready', flush=True)\n"
        "time.sleep(60)\n"
    )
    owner = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    assert owner.stdout.readline() == "ready\n"
    bpftrace = bpftrace_of(owner.pid)
    owner.kill()
    owner.wait()
    wait_for(lambda: not Path(f"/proc/{bpftrace}").exists(), "bpftrace to end")


def test_without_privileges_the_error_names_them_and_what_to_do(tmp_path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("giving up root needs root")
    code = (
        "import os, pathlib\n"
        "from chainshaper.values.errors import PlatformError\n"
        "from chainshaper.sources.ebpf.session import EbpfTracer\n"
        "os.setuid(65534)\n"
        "try:\n"
        "    EbpfTracer(pathlib.Path('.'), ('any',), ()).start()\n"
        "except PlatformError as error:\n"
        "    print(error)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for word in ("CAP_BPF", "CAP_PERFMON", "sudo chainshaper record --source ebpf", "lttng"):
        assert word in run.stdout


def test_a_missing_bpftrace_is_named_with_the_package_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if os.geteuid() != 0:
        pytest.skip("privileges are looked at before bpftrace")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        PlatformError, match=r"bpftrace is not installed: .*apt-get install bpftrace"
    ):
        EbpfTracer(tmp_path, ("any",), ()).start()


def test_a_machine_without_ros_2_is_told_to_set_it_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    skip_without_bpftrace()
    monkeypatch.setattr("chainshaper.sources.ebpf.trace_points._INSTALLATIONS", tmp_path)
    with pytest.raises(PlatformError, match=r"no libtracetools.so in AMENT_PREFIX_PATH"):
        EbpfTracer(tmp_path, ("any",), ()).start()


def test_tracing_that_was_compiled_out_is_named_with_the_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    skip_without_bpftrace()
    disabled = build(tmp_path / "prefix", "-DDISABLED")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(disabled.tracetools.parent))
    monkeypatch.setattr("chainshaper.sources.ebpf.trace_points._INSTALLATIONS", tmp_path)
    with pytest.raises(PlatformError, match=r"libtracetools.so: exports no trace point.*DISABLED"):
        EbpfTracer(tmp_path, ("any",), ()).start()


def test_a_process_without_ros_2_cannot_be_attached_to(tmp_path: Path) -> None:
    skip_without_bpftrace()
    with pytest.raises(InputError, match=rf"process {os.getpid()} neither uses libtracetools.so"):
        EbpfTracer(tmp_path, (), (os.getpid(),)).start()


def test_without_any_node_there_is_nothing_to_attach_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    skip_without_bpftrace()
    monkeypatch.setattr("chainshaper.sources.ebpf.session.mapped_libraries", lambda _: {})
    with pytest.raises(OperationError, match="no ROS 2 node to attach to"):
        EbpfTracer(tmp_path, (), ()).start()


def test_bpftraces_own_words_are_in_the_error_when_it_cannot_trace(
    program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BPFTRACE_MAX_PROBES", "1")
    with pytest.raises(PlatformError, match=r"bpftrace cannot trace here: .*probes"):
        traced(EbpfTracer(folder_in(tmp_path), program.command("every"), ()))
