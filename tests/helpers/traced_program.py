"""A program with the trace points of ROS 2, without ROS 2, and runs of it under a tracer."""

import atexit
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from chainshaper.sources import Tracer
from chainshaper.values import events
from chainshaper.values.events import EventTables
from chainshaper.values.recording import RecordingInfo

_SOURCES = Path(__file__).parents[1] / "sources/tracetools"
_PACKAGE = "<package><name>tracetools</name><version>{}</version></package>"

NOT_EMITTED = {"sched_switch", "thread_wake"}
"""Events that no call of the program emits. It publishes outside callbacks, so the tracing library
looks at how it sleeps."""


@dataclass(frozen=True)
class Program:
    """Where it is installed, as below a prefix of ROS 2."""

    prefix: Path

    @property
    def executable(self) -> Path:
        return self.prefix / "lib/application"

    @property
    def tracetools(self) -> Path:
        return self.prefix / "lib/libtracetools.so"

    def command(self, *arguments: str) -> tuple[str, ...]:
        return (str(self.executable), *arguments)

    def run(self, *arguments: str) -> list[list[str]]:
        """Run it to its end; the fields of what it printed."""
        run = subprocess.run(
            self.command(*arguments), capture_output=True, text=True, check=True, timeout=60
        )
        return [line.split("\t") for line in run.stdout.splitlines()]

    def waiting(self, *arguments: str, user: int | None = None) -> "subprocess.Popen[str]":
        """Start it, and return when it says that it is ready; it goes on when it reads a line."""
        process = subprocess.Popen(
            self.command(*arguments),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            user=user,
        )
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process


@dataclass(frozen=True)
class Traced:
    """What the tracer made of a run, and what the program printed itself."""

    tables: EventTables
    info: RecordingInfo
    printed: list[list[str]]


@functools.cache
def skip_without_bpftrace() -> None:
    if shutil.which("bpftrace") is None:
        pytest.skip("bpftrace is not installed")
    if os.geteuid() != 0:
        pytest.skip("tracing with eBPF needs root")
    # bpftrace finds `tracepoint:sched:sched_switch` there; mounted until the tests end.
    folder = Path("/sys/kernel/tracing")
    if not (folder / "events").exists():
        mount = ["mount", "-t", "tracefs", "tracefs", str(folder)]
        mounted = subprocess.run(mount, capture_output=True, text=True, check=False)
        if mounted.returncode:
            pytest.skip(
                f"{folder} has no tracefs, and it cannot be mounted: {mounted.stderr.strip()}"
            )
        atexit.register(subprocess.run, ["umount", str(folder)], check=False)
    trial = ["bpftrace", "-e", "BEGIN { exit(); } tracepoint:sched:sched_switch { }"]
    run = subprocess.run(trial, capture_output=True, text=True, check=False, timeout=60)
    if run.returncode:
        pytest.skip(f"bpftrace does not work here: {run.stderr.strip().splitlines()[-1:]}")


@functools.cache
def built(*flags: str, version: str = "8.2.3") -> Program:
    """A program for all tests, in a folder whose name has spaces."""
    folder = Path(tempfile.mkdtemp(prefix="a prefix of ours "))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return build(folder / "prefix", *flags, version=version)


def build(prefix: Path, *flags: str, version: str = "8.2.3", compiler: str = "gcc") -> Program:
    """Compile library and program; ``version`` is what the library's package says."""
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} to build the traced program with")
    program = Program(prefix)
    program.tracetools.parent.mkdir(parents=True)
    package = prefix / "share/tracetools/package.xml"
    package.parent.mkdir(parents=True)
    package.write_text(_PACKAGE.format(version))
    gcc = [compiler, "-O1", *flags]
    library = [str(_SOURCES / "tracetools.c"), "-shared", "-fPIC", "-o", str(program.tracetools)]
    subprocess.run([*gcc, *library], check=True)
    if "-DDISABLED" not in flags:
        linking = ["-L" + str(program.tracetools.parent), "-ltracetools", "-Wl,-rpath,$ORIGIN"]
        application = [str(_SOURCES / "application.c"), *linking, "-pthread"]
        subprocess.run([*gcc, *application, "-o", str(program.executable)], check=True)
    return program


def traced(tracer: Tracer, run: Callable[[], list[list[str]]] = list) -> Traced:
    """Trace while ``run`` runs, in the environment that the tracer asks for."""
    try:
        with pytest.MonkeyPatch.context() as patch:
            for name, value in tracer.start().items():
                patch.setenv(name, value)
            printed = run()
        assert tracer.failure() is None
        tracer.stop()
    finally:
        tracer.remove()
    return Traced(*tracer.recording(), printed)


def traced_everything(tracer: Tracer, cycles: int) -> tuple[Traced, dict[str, list[list[str]]]]:
    """`every` of two versions, as on a machine with two distributions, and a chain: one recording.

    And what the former printed, by version.
    """
    programs = {"8.2.3": built(), "4.1.1": built("-DHUMBLE", version="4.1.1")}
    printed = {}

    def run_all() -> list[list[str]]:
        printed.update({version: program.run("every") for version, program in programs.items()})
        return programs["8.2.3"].run("chain", str(cycles))

    with pytest.MonkeyPatch.context() as patch:
        prefixes = (str(program.prefix) for program in programs.values())
        patch.setenv("AMENT_PREFIX_PATH", ":".join(prefixes))
        return traced(tracer, run_all), printed


def assert_everything(
    run: Traced, printed: Mapping[str, list[list[str]]], left_out: Collection[str] = ()
) -> None:
    """Every argument of every function arrived as it was passed, but of events ``left_out``.

    So what the tracers say of events (arguments, texts, gids) is what the functions have.
    """
    assert run.info.lost == {"lost_events": 0}
    assert run.info.distribution == "jazzy"
    for version, rows in printed.items():
        pid = int(rows[0][1])
        tables = of_process(run.tables, pid)
        assert set(left_out) <= {row[0] for row in rows}
        assert_same(tables, [row for row in rows if row[0] not in left_out], version)
        assert tables["rcl_take"].item(0, "tid") != pid


def assert_same(tables: Mapping[str, pl.DataFrame], printed: list[list[str]], version: str) -> None:
    """The tables have what the program says it passed."""
    assert tables.keys() - NOT_EMITTED == {event for event, *_ in printed}
    rows = {name: table.iter_rows(named=True) for name, table in tables.items()}
    for event, tid, before, after, *passed in printed:
        types = events.FIELDS[event]
        columns, values = list(types), passed
        if event == "rcl_init":
            values = [*passed, version.encode().hex()]
        elif event == "rclcpp_publish":
            values = passed[1:]
        elif event == "rmw_publish" and len(passed) == 1:
            columns = ["message"]
        row: dict[str, Any] = {"tid": int(tid)}
        for column, value in zip(columns, values, strict=True):
            if isinstance(types[column], pl.String):
                row[column] = bytes.fromhex(value).decode()
            elif isinstance(types[column], pl.List):
                row[column] = list(bytes.fromhex(value))[:16]
            else:
                row[column] = int(value)
        recorded = next(rows[event])
        assert int(before) <= recorded["time"] <= int(after), event
        assert row.items() <= recorded.items(), event
    for event, table in tables.items():
        kinds = events.column_types(event)
        assert table.schema == {name: kinds[name] for name in kinds if name in table.columns}
        assert table["time"].is_sorted()
        assert event in NOT_EMITTED or next(rows[event], None) is None, event


def of_process(tables: EventTables, pid: int) -> dict[str, pl.DataFrame]:
    tables_of_process = {name: table.filter(pid=pid) for name, table in tables.items()}
    return {name: table for name, table in tables_of_process.items() if table.height}
