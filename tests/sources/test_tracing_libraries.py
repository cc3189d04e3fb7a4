"""Finding `libtracetools.so`, and what it exports; functions of callbacks in a program's memory."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from traced_program import built

from chainshaper.sources import tracing_library
from chainshaper.sources.ebpf.functions import callback_functions, demangled, type_argument
from chainshaper.sources.elf import exported_functions
from chainshaper.sources.tracing_library import installed_libraries, mapped_libraries

SOURCE = Path(__file__).with_name("callbacks.cpp")
BOUND = "std::_Bind<void (Relay::*(Relay*"


def test_exported_functions_are_those_that_nm_shows(tmp_path: Path) -> None:
    if shutil.which("nm") is None:
        pytest.skip("no nm to compare with")
    library, file, elf = built().tracetools, tmp_path / "file", b"\x7fELF\x02\x01"
    shown = subprocess.check_output(["nm", "-D", "--defined-only", str(library)], text=True)
    functions = {line.split()[2] for line in shown.splitlines() if line.split()[1] == "T"}
    assert exported_functions(library) == functions
    assert "ros_trace_callback_start" in functions
    cut = library.read_bytes()[: library.stat().st_size // 2]
    for content in (b"", b"text", elf, elf + bytes(200), cut):
        file.write_bytes(content)
        assert exported_functions(file) == frozenset()
    assert exported_functions(tmp_path / "absent") == frozenset()


def test_every_prefix_of_the_environment_is_searched_and_a_file_counts_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jazzy, humble = built(), built("-DHUMBLE", version="4.1.1")
    for name, program in (("jazzy", jazzy), ("humble", humble)):
        (tmp_path / name).symlink_to(program.prefix)
    monkeypatch.setattr(tracing_library, "_INSTALLATIONS", tmp_path)  # finds both once more
    libraries = installed_libraries(
        {
            "AMENT_PREFIX_PATH": f"{tmp_path}/nothing:{jazzy.prefix}:",
            "LD_LIBRARY_PATH": f"{jazzy.prefix}/lib/../lib",
        }
    )
    assert [(library.path, library.version, library.major) for library in libraries] == [
        (jazzy.tracetools, "8.2.3", 8),
        (tmp_path / "humble/lib/libtracetools.so", "4.1.1", 4),
    ]


def test_a_library_in_a_containers_file_system_is_reached_through_its_process(
    tmp_path: Path,
) -> None:
    """A mount namespace of its own, in which another folder lies where ours is."""
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("a mount namespace needs root and unshare")
    outside = tmp_path / "outside"
    outside.mkdir()
    script = f'mount --bind "{built().prefix}" "{outside}" && exec "$@"'
    command = ("unshare", "--mount", "sh", "-c", script, "sh", f"{outside}/lib/application")
    with subprocess.Popen(
        [*command, "chain", "0", "wait"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            pytest.skip("no mount namespace can be made here")
        ((library,),) = mapped_libraries([process.pid]).values()
        assert library.path == Path(f"/proc/{process.pid}/root{outside}/lib/libtracetools.so")
        assert library.version == "8.2.3"
        assert "ros_trace_callback_end" in library.functions
        process.communicate("go\n", timeout=60)


def _named(program: Path) -> list[str | None]:
    """What is found out about each of the program's callbacks."""
    with subprocess.Popen(
        [program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout is not None
        handles = [int(running.stdout.readline()) for _ in range(7)]
        functions = callback_functions((running.pid, handle) for handle in handles)
        running.communicate()
    assert callback_functions([(running.pid, handles[0]), (0, 4096)]) == {}, "it has ended"
    return [functions.get((running.pid, handle)) for handle in handles]


def test_functions_are_named_as_lttng_would_name_them(tmp_path: Path) -> None:
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not installed, so there is no program with callbacks in C++")
    program = tmp_path / "callbacks"
    subprocess.run([compiler, "-std=c++17", "-O1", SOURCE, "-o", program], check=True)
    timer, bound_timer, member, subscription, bound, service, none = _named(program)
    assert timer == "main::{lambda()#1}"
    assert bound_timer == member == f"{BOUND}))()>"
    assert subscription is not None
    assert subscription.startswith("main::{lambda(std::shared_ptr<std::map<")
    assert subscription.endswith("#2}")
    assert bound is not None
    assert bound.startswith(f"{BOUND}, std::_Placeholder<1>))(std::shared_ptr<std::map<")
    assert (service, none) == ("void (*)(int)", None)
    subprocess.run(["strip", "-s", program], check=True)
    timer, bound_timer, _, subscription, *_ = _named(program)
    assert (timer, bound_timer, subscription) == ("main::{lambda()#1}", f"{BOUND}))()>", None)


@pytest.mark.parametrize(
    ("name", "number", "argument"),
    [
        ("a::B<c<d, e>, f>::g()", 0, "c<d, e>"),
        ("a::B<c<d, e>, f>::g()", 1, "f"),
        ("B<void (x<1>, y), z::{lambda(u<v, w>)#1}>", 1, "z::{lambda(u<v, w>)#1}"),
        ("B<auto (*)(a, b) -> c, d>", 0, "auto (*)(a, b) -> c"),
        ("B<a>", 1, None),
        ("plain()", 0, None),
        (None, 0, None),
    ],
)
def test_an_argument_of_a_template_is_cut_out(
    name: str | None, number: int, argument: str | None
) -> None:
    assert type_argument(name, number) == argument
    assert (demangled(b"_Z3fooi"), demangled(b"what?")) == ("foo(int)", None)
