"""Finding `libtracetools.so`, and what it exports."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from traced_program import build

from chainshaper.sources.ebpf import trace_points as tracing_libraries
from chainshaper.sources.ebpf.functions import exported_functions
from chainshaper.sources.ebpf.trace_points import installed_libraries, mapped_libraries


def test_exported_functions_are_those_that_nm_shows(tmp_path: Path) -> None:
    if shutil.which("nm") is None:
        pytest.skip("no nm to compare with")
    library = build(tmp_path / "prefix").tracetools
    run = subprocess.run(
        ["nm", "-D", "--defined-only", str(library)], capture_output=True, text=True, check=True
    )
    shown = {fields[2] for line in run.stdout.splitlines() if (fields := line.split())[1] == "T"}
    assert exported_functions(library) == shown
    assert "ros_trace_callback_start" in shown


def test_what_is_no_library_exports_nothing(tmp_path: Path) -> None:
    for content in (b"", b"text", b"\x7fELF\x02\x01", b"\x7fELF\x02\x01" + bytes(200)):
        file = tmp_path / "file"
        file.write_bytes(content)
        assert exported_functions(file) == frozenset()
    assert exported_functions(tmp_path / "absent") == frozenset()


def test_a_truncated_library_exports_nothing(tmp_path: Path) -> None:
    library = build(tmp_path / "prefix").tracetools
    library.write_bytes(library.read_bytes()[: library.stat().st_size // 2])
    assert exported_functions(library) == frozenset()


def test_every_prefix_of_the_environment_is_searched_and_a_file_counts_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jazzy = build(tmp_path / "jazzy")
    humble = build(tmp_path / "humble", "-DHUMBLE", version="4.1.1")
    monkeypatch.setattr(tracing_libraries, "_INSTALLATIONS", tmp_path)  # finds both once more
    found = installed_libraries(
        {
            "AMENT_PREFIX_PATH": f"{tmp_path}/nothing:{jazzy.prefix}:",
            "LD_LIBRARY_PATH": f"{jazzy.prefix}/lib/../lib",
        }
    )
    assert [(one.path, one.version, one.major) for one in found] == [
        (jazzy.tracetools, "8.2.3", 8),
        (humble.tracetools, "4.1.1", 4),
    ]


def test_running_processes_show_the_library_that_they_have_mapped(tmp_path: Path) -> None:
    program = build(tmp_path / "a prefix")
    process = program.waiting("chain", "0", "wait")
    found = mapped_libraries([process.pid, os.getpid(), 2**22 + 1])
    process.communicate("go\n", timeout=60)
    ((pid, (library,)),) = found.items()
    assert (pid, library.path, library.version) == (process.pid, program.tracetools, "8.2.3")


def test_a_library_in_a_containers_file_system_is_reached_through_its_process(
    tmp_path: Path,
) -> None:
    """A mount namespace of its own, in which another folder lies where ours is."""
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("a mount namespace needs root and unshare")
    program = build(tmp_path / "inside")
    outside = tmp_path / "outside"
    outside.mkdir()
    unshared = ("unshare", "--mount", "sh", "-c")
    command = (f"{outside}/lib/application", "chain", "0", "wait")
    script = f'mount --bind "{program.prefix}" "{outside}" && exec "$@"'
    process = subprocess.Popen(
        [*unshared, script, "sh", *command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    if process.stdout.readline() != "ready\n":
        pytest.skip("no mount namespace can be made here")
    found = mapped_libraries([process.pid])
    inside = Path(f"/proc/{process.pid}/root{outside}/lib/libtracetools.so")
    assert [one.path for one in found[process.pid]] == [inside]
    assert found[process.pid][0].version == "8.2.3"
    assert "ros_trace_callback_end" in found[process.pid][0].functions
    process.communicate("go\n", timeout=60)
