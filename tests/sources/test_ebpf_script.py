"""The bpftrace script and its output, without tracing: what bpftrace accepts, what we read."""

import re
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from traced_program import built, skip_without_bpftrace

from chainshaper.sources.ebpf import lost_events
from chainshaper.sources.ebpf.trace_points import (
    FIRST_POINT,
    HEADER,
    NAME_PLACE,
    RMW_PLACE,
    TEXT_BYTES,
    TEXT_CODE,
    TEXT_LINES,
    Printed,
    TracePoint,
    bpftrace_script,
    read_printed,
    trace_points,
)
from chainshaper.sources.tracing_library import (
    FUNCTION_PREFIX,
    TracingLibrary,
    installed_libraries,
)
from chainshaper.values import events
from chainshaper.values.errors import InputError

ALL = frozenset(FUNCTION_PREFIX + event for event in events.FIELDS)


def library(version: str | None) -> TracingLibrary:
    return TracingLibrary(Path("/opt/ros/any/lib/libtracetools.so"), ALL, version)


def point(event: str, version: str | None = "8.2.3") -> TracePoint:
    (trace_point,) = (
        trace_point
        for trace_point in trace_points([library(version)])
        if trace_point.event == event
    )
    return trace_point


@pytest.mark.waiting
def test_bpftrace_accepts_the_script_of_a_distribution_that_is_not_traced_here(
    tmp_path: Path,
) -> None:
    """Humble's and Jazzy's are traced (`test_ebpf`)."""
    skip_without_bpftrace()
    prefix = built(version="7.1.0").prefix
    points = trace_points(installed_libraries({"AMENT_PREFIX_PATH": str(prefix)}))
    script = tmp_path / "events.bt"
    script.write_text(bpftrace_script(points, (1, 2), attached=True))
    options = subprocess.run(["bpftrace", "--help"], capture_output=True, text=True, check=False)
    dry_run = "--dry-run" if "--dry-run" in options.stdout + options.stderr else "-d"
    command = ["bpftrace", dry_run, str(script)]
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert run.returncode == 0, run.stderr[-2000:]


def test_events_are_limited_to_processes_and_what_they_start_or_else_to_users() -> None:
    """And only exported functions get a probe."""
    few = TracingLibrary(Path("/lib.so"), frozenset({"ros_trace_callback_end", "other"}), None)
    assert [trace_point.event for trace_point in trace_points([few])] == ["callback_end"]
    points = trace_points([library("8.2.3")])

    def limits(script: str) -> set[str]:
        probes = [line for line in script.splitlines() if line.startswith("uprobe:")]
        assert len(probes) == len(points)
        return {probe.partition(" ")[2] for probe in probes}

    script = bpftrace_script(points, (17, 18), users=(0,))
    assert "@traced[17] = 1;" in script
    assert "tracepoint:sched:sched_process_fork /@traced[pid]/" in script
    assert "uid" not in script
    assert limits(script) == {"/@traced[pid]/"}
    by_user = bpftrace_script(points, users=(1000, 0))
    assert limits(by_user) == {"/uid == 0 || uid == 1000/"}
    assert "@traced" not in by_user
    assert limits(bpftrace_script(points)) == {""}


@given(st.text(min_size=1))
def test_no_path_gets_into_the_script_that_could_end_its_quotes_or_mean_several_files(
    name: str,
) -> None:
    path = f"/opt/{name}/lib/libtracetools.so"
    end = TracePoint("callback_end", Path(path), library(None))
    try:
        script = bpftrace_script([end])
    except InputError as error:
        assert repr(str(Path(path))) in str(error)
        return
    assert not re.search(r'["\\:*?\[{$`\s]', name.replace(" ", ""))
    assert f'uprobe:"{Path(path)}":ros_trace_callback_end\n' in script


def read(folder: Path, points: list[TracePoint], *lines: str, ahead_ns: int = 0) -> Printed:
    file = folder / "events.txt"
    file.write_text(HEADER + "\n".join(lines))
    return read_printed(file, points, ahead_ns)


def printed_text(text: bytes, place: int, skipped: int) -> list[str]:
    """What the script prints of a text that lies ``skipped`` bytes behind an aligned address."""
    memory = b"\xab" * skipped + text + b"\0" + b"\xcd" * 64 * TEXT_LINES
    lines = []
    for number in range(TEXT_LINES):
        part = memory[64 * number : 64 * (number + 1)]
        words = [int.from_bytes(part[at : at + 8], "little", signed=True) for at in range(0, 64, 8)]
        values = [TEXT_CODE, 1000, 7, 7, 0, 16 * place + number, skipped, *words]
        lines.append("\t".join(map(str, values)))
        if part[-1] == 0:
            break
    return lines


@given(
    name=st.binary(max_size=TEXT_BYTES - 1).filter(lambda text: b"\0" not in text),
    skipped=st.integers(0, 7),
    reversed_lines=st.booleans(),
)
def test_names_of_any_length_and_alignment_are_put_together_again(
    tmp_path_factory: pytest.TempPathFactory, name: bytes, skipped: int, reversed_lines: bool
) -> None:
    lines = printed_text(name, 3, skipped)
    lines += printed_text(b"/other", 8, 0)  # another text of the same event
    code = FIRST_POINT
    event = f"{code}\t1000\t7\t7\t0\t21\t22\t23"
    lines = [*reversed(lines), event] if reversed_lines else [event, *lines]
    printed = read(tmp_path_factory.mktemp("printed"), [point("rcl_service_init")], *lines, "")
    row = printed.tables["rcl_service_init"].row(0, named=True)
    assert row["service_name"] == name.decode(errors="backslashreplace")
    assert (row["service_handle"], row["node_handle"], row["rmw_service_handle"]) == (21, 22, 23)
    assert printed.cut_names == 0


def test_a_name_whose_beginning_was_lost_is_unknown_and_a_longer_one_is_cut_and_counted(
    tmp_path: Path,
) -> None:
    lost = printed_text(b"/a" * 60, 3, 0)[1:]
    long = [line.replace("\t1000\t", "\t2000\t") for line in printed_text(b"/b" * 600, 3, 5)]
    rows = [f"{FIRST_POINT}\t{time}\t7\t7\t0\t21\t22\t23" for time in (1000, 2000)]
    printed = read(tmp_path, [point("rcl_service_init")], *rows, *lost, *long, "")
    first, second = printed.tables["rcl_service_init"]["service_name"]
    assert first is None
    assert ("/b" * 600).startswith(second)
    assert len(second) >= TEXT_BYTES
    assert printed.cut_names == 1


def test_lines_of_other_cores_are_sorted_and_bpftraces_own_are_left_out(tmp_path: Path) -> None:
    printed = read(
        tmp_path,
        [point("callback_end")],
        "Attaching 3 probes...",
        f"{FIRST_POINT}\t3000\t7\t8\t1\t140737488355327",
        "Lost 12 events",
        f"{FIRST_POINT}\t1000\t7\t7\t0\t5",
        "Lost 30 events",
        '1\t2000\t0\t0\t0\t0\t120\t0\t7\t-81\t\t\t\t\t\tswapper/0\tnode with "',
        "1\t2500\t7\t7\t0\t\t\t\t8",
        "",
        f"{FIRST_POINT}\t40",  # it was killed here
        ahead_ns=100,
    )
    log = tmp_path / "said.log"
    log.write_text("Lost 1 events\n")
    assert printed.tables["callback_end"].rows() == [(900, 7, 7, 0, 5), (2900, 7, 8, 1, 2**47 - 1)]
    switches = printed.tables["sched_switch"]
    assert switches.select("time", "prev_tid", "next_tid", "next_prio").rows() == [
        (1900, 0, 7, -81),
        (2400, None, 8, None),
    ]
    assert switches.row(0, named=True)["next_comm"] == 'node with "'
    assert lost_events(tmp_path / "events.txt", log, tmp_path / "absent") == 43


def test_names_of_handles_come_with_their_event_and_versions_from_the_librarys_package(
    tmp_path: Path,
) -> None:
    points = [point("rcl_init"), point("rmw_take")]
    init = f"{FIRST_POINT}\t900\t7\t7\t0\t76"
    take = f"{FIRST_POINT + 1}\t1000\t7\t7\t0\t77\t78\t79\t1"
    names = [*printed_text(b"/t1", NAME_PLACE, 2), *printed_text(b"rmw_x", RMW_PLACE, 0)]
    printed = read(tmp_path, points, init, take, *names, "")
    assert printed.handles.rows() == [(7, "rmw_take", 77, "/t1")]
    assert printed.rmw == "rmw_x"
    assert printed.tables["rcl_init"].select("context_handle", "version").rows() == [(76, "8.2.3")]
