"""The eBPF tracer on a real program: bpftrace, real uprobes, real processes."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from known import known
from processes import children_of, wait_for
from strangers import NOBODY, named, open_folder, strange
from traced_program import (
    Program,
    Traced,
    assert_everything,
    build,
    built,
    of_process,
    skip_without_bpftrace,
    traced,
    traced_everything,
)

from chainshaper.analysis.flow import DataFlow, data_flow
from chainshaper.flow.record import record_command
from chainshaper.sources.ebpf import EbpfTracer
from chainshaper.sources.ebpf.late_attachment import with_found_nodes
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.recording import EndpointInfo

__all__ = ["open_folder"]

pytestmark = pytest.mark.waiting  # each has the kernel compile and check its programs

CYCLES, PERIOD_NS = 20, 50_000_000
TOPICS = ("/ebpf1", "/ebpf2")


@pytest.fixture(autouse=True)
def no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AMENT_PREFIX_PATH", "LD_LIBRARY_PATH"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def few(no_environment: None, monkeypatch: pytest.MonkeyPatch) -> Program:
    """Its trace points are those of callbacks alone, whose probes are set sooner; it is sourced."""
    skip_without_bpftrace()
    program = built("-DFEW")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(program.prefix))
    return program


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> tuple[Traced, dict[str, Any]]:
    skip_without_bpftrace()
    tracer = EbpfTracer(tmp_path_factory.mktemp("trace"), ["command"], ())
    return traced_everything(tracer, CYCLES)


def test_every_argument_of_every_function_arrives_as_it_was_passed(
    everything: tuple[Traced, dict[str, Any]],
) -> None:
    assert_everything(*everything)


def test_execution_times_are_the_threads_own_cpu_time(
    everything: tuple[Traced, dict[str, Any]],
) -> None:
    run, printed = everything
    every = {int(rows[0][1]) for rows in printed.values()}
    (chain,) = set(run.tables["callback_start"]["pid"]) - every
    switches = run.tables["sched_switch"]
    tables = {**of_process(run.tables, chain), "sched_switch": switches}
    instances = data_flow(tables).instances.drop_nulls("end")
    spent = [int(fields[4]) for fields in run.printed if fields[0] == "instance"]
    assert instances.height == len(spent) == 2 * CYCLES
    # Reading its own clocks costs the thread a little outside the callback, being traced inside.
    assert sum(instances["execution_ns"]) == pytest.approx(sum(spent), rel=0.15)
    assert (instances["execution_ns"] < instances["end"] - instances["start"]).all()
    tids = {tid for name, t in run.tables.items() if name != "sched_switch" for tid in t["tid"]}
    involved = switches.select(pl.any_horizontal(pl.col("prev_tid", "next_tid").is_in(tids)))
    assert involved.to_series().all()


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


def assert_attached(program: Program, folder: Path, distribution: str) -> None:
    """Attach to one of two that run: its chain is found, then with DDS discovery its nodes."""
    folder.mkdir()
    wanted, bystander = (program.waiting("chain", str(CYCLES), "wait") for _ in range(2))

    def both() -> list[list[str]]:
        for process in (bystander, wanted):
            out, _ = process.communicate("go\n", timeout=60)
        return [line.split("\t") for line in out.splitlines()]

    run = traced(EbpfTracer(folder, (), (wanted.pid,)), both)
    pids = {pid for name, t in run.tables.items() if name != "sched_switch" for pid in t["pid"]}
    assert pids == {wanted.pid}
    assert (run.info.rmw, run.info.distribution) == ("rmw_test_cpp", distribution)
    assert any("tracing began while the application ran" in note for note in run.info.notes)
    flow = data_flow(run.tables, run.info.clock_offset_ns)
    assert_chain(flow, run.printed)
    reader, timer = flow.objects.callbacks.sort("kind").iter_rows(named=True)
    assert (reader["kind"], reader["topic"], timer["kind"]) == ("subscription", "/ebpf1", "timer")
    assert PERIOD_NS / 2 < timer["period_ns"] < 2 * PERIOD_NS  # as late as the machine is busy
    assert reader["node"].startswith("unknown (process")

    graph = (
        EndpointInfo(node="/first", topic="/ebpf1", kind="publisher"),
        EndpointInfo(node="/second", topic="/ebpf2", kind="publisher"),
        EndpointInfo(node="/second", topic="/ebpf1", kind="subscription"),
    )
    tables, info = with_found_nodes(run.tables, run.info, graph, ())
    flow = data_flow(tables, run.info.clock_offset_ns)
    assert_chain(flow, run.printed)
    nodes = flow.objects.callbacks.sort("kind").select("node", "kind").rows()
    assert nodes == [("/second", "subscription"), ("/first", "timer")]
    assert info.processes == {wanted.pid: "/first, /second"}


@pytest.mark.timed  # a timer is known by wake-ups that are not late
def test_an_application_that_runs_already_is_attached_to_and_its_chain_is_found(
    open_folder: Path, tmp_path: Path
) -> None:
    """Its folder's name ends the quotes, and has bpftrace print a file that root alone may read."""
    skip_without_bpftrace()
    secret = open_folder / "secret"
    secret.touch(0o600)
    secret.write_text("nothing for strangers\n")
    plain = build(open_folder / "plain")
    library = shutil.copy(plain.tracetools, open_folder / "library")
    name = f'{library}":ros_trace_callback_end {{}} interval:ms:100 {{ cat("{secret}"); }} uprobe:"'
    crafted = build(Path(f"{name}{plain.prefix}"))
    assert_attached(crafted, tmp_path / "trace", "jazzy")
    assert "nothing for strangers" not in (tmp_path / "trace" / "events.txt").read_text()
    assert "cat(" not in (tmp_path / "trace" / "events.bt").read_text()


@pytest.mark.timed  # a timer is known by wake-ups that are not late
def test_an_application_of_humble_is_attached_to_by_the_handles_of_rcl(tmp_path: Path) -> None:
    skip_without_bpftrace()
    assert_attached(built("-DHUMBLE", version="4.1.1"), tmp_path / "trace", "humble")


def test_of_strangers_nothing_is_recorded_or_run_unless_they_are_named(
    open_folder: Path, tmp_path: Path
) -> None:
    """Uprobes belong to a file, which both use; QoS is asked for in the last node's environment."""
    skip_without_bpftrace()
    program = build(open_folder / "jazzy", "-DFEW")
    ran = open_folder / "ran"
    (open_folder / "evil").write_text(f"#!/bin/sh\nid -u > {ran}\n")
    (open_folder / "ros2").write_text(f"#!{open_folder}/evil\n")
    for file in ("evil", "ros2"):
        (open_folder / file).chmod(0o755)
    processes: list[subprocess.Popen[str]] = []

    def start() -> list[int]:
        processes.extend(
            program.waiting("chain", "3", "wait", user=user) for user in (None, NOBODY)
        )
        return [process.pid for process in processes]

    def run() -> list[list[str]]:
        while processes:
            processes.pop().communicate("go\n", timeout=60)
        return []

    def progress(_: float, phase: str) -> None:
        if "recording" in phase:
            run()

    ours, strangers = start()
    options: dict[str, Any] = {"source": "ebpf", "duration_ns": 1_000_000_000}
    with strange(named("listener"), {"PATH": f"{open_folder}:/bin:/usr/bin"}) as listener:
        made = record_command(tmp_path / "rec", **options, progress=progress)
    assert not ran.exists()
    assert f"/listener (process {listener.pid} of nobody)" in " ".join(made.recording.info.notes)
    seen = set(made.recording.events["callback_start"]["pid"])
    assert ours in seen
    assert strangers not in seen
    pids = start()
    (tmp_path / "trace").mkdir()
    named_too = traced(EbpfTracer(tmp_path / "trace", (), (), {0, NOBODY}), run)
    assert set(named_too.tables["callback_start"]["pid"]) >= set(pids)


def test_events_that_bpftrace_lost_are_counted(
    few: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its buffers fill while it is stopped."""
    monkeypatch.setenv("BPFTRACE_PERF_RB_PAGES", "4")
    count = 5_000
    tracer = EbpfTracer(tmp_path, few.command("flood"), ())

    def flood() -> list[list[str]]:
        bpftrace = bpftrace_of(os.getpid())
        os.kill(bpftrace, signal.SIGSTOP)
        process = few.waiting("flood", str(count))
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


def test_the_end_of_bpftrace_is_noticed_and_what_it_wrote_is_read(
    few: Program, tmp_path: Path
) -> None:
    tracer = EbpfTracer(tmp_path, few.command("chain"), ())
    try:
        tracer.start()
        few.run("chain", "3")
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
    (bpftrace,) = (
        child
        for child in children_of(parent)
        if b"events.bt" in Path(f"/proc/{child}/cmdline").read_bytes()
    )
    return bpftrace


def test_bpftrace_ends_when_the_tracer_is_killed(few: Program, tmp_path: Path) -> None:
    code = f"""
import time, pathlib
from chainshaper.sources.ebpf import EbpfTracer
EbpfTracer(pathlib.Path({str(tmp_path)!r}), ("any",), ()).start()
print("ready", flush=True)
time.sleep(60)
"""
    owner = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert known(owner.stdout).readline() == "ready\n"
    bpftrace = bpftrace_of(owner.pid)
    owner.kill()
    owner.wait()
    wait_for(lambda: not Path(f"/proc/{bpftrace}").exists(), "bpftrace to end")


def test_without_privileges_the_error_names_them_and_what_to_do() -> None:
    if os.geteuid() != 0:
        pytest.skip("giving up root needs root")
    code = """
import os, pathlib
from chainshaper.sources.ebpf import EbpfTracer
os.setuid(65534)
EbpfTracer(pathlib.Path("."), ("any",), ()).start()
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    for word in ("PlatformError", "CAP_BPF", "CAP_PERFMON", "sudo chainshaper record", "lttng"):
        assert word in run.stderr


def test_what_the_machine_lacks_is_named_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    skip_without_bpftrace()
    any_command = EbpfTracer(tmp_path, ("any",), ())
    monkeypatch.setattr("chainshaper.sources.tracing_library._INSTALLATIONS", tmp_path)
    with pytest.raises(PlatformError, match=r"no libtracetools.so in AMENT_PREFIX_PATH"):
        any_command.start()
    disabled = build(tmp_path / "prefix", "-DDISABLED")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(disabled.tracetools.parent))
    with pytest.raises(PlatformError, match=r"libtracetools.so: exports no trace point.*DISABLED"):
        any_command.start()
    with pytest.raises(InputError, match=rf"process {os.getpid()} neither uses libtracetools.so"):
        EbpfTracer(tmp_path, (), (os.getpid(),)).start()
    monkeypatch.setattr("chainshaper.sources.ebpf.mapped_libraries", lambda _: {})
    with pytest.raises(OperationError, match="no ROS 2 node to attach to"):
        EbpfTracer(tmp_path, (), ()).start()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(PlatformError, match=r"not installed: .*apt-get install bpftrace"):
        any_command.start()


def test_bpftraces_own_words_are_in_the_error_when_it_cannot_trace(
    few: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BPFTRACE_MAX_PROBES", "1")
    with pytest.raises(PlatformError, match=r"bpftrace cannot trace here: .*probes"):
        traced(EbpfTracer(tmp_path, few.command("every"), ()))
