"""Names of callbacks' functions, out of the memory of a program that holds them as rclcpp does."""

import shutil
import subprocess
from pathlib import Path

import pytest

from chainshaper.sources.ebpf.functions import callback_functions, demangled, type_argument

SOURCE = Path(__file__).with_name("callbacks.cpp")
BOUND = "std::_Bind<void (Relay::*(Relay*"


def _named(folder: Path, *flags: str) -> list[str | None]:
    """What is found out about each of the program's callbacks."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not installed, so there is no program with callbacks in C++")
    program = folder / "callbacks"
    subprocess.run([compiler, "-std=c++17", "-O1", *flags, SOURCE, "-o", program], check=True)
    with subprocess.Popen(
        [program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout is not None
        handles = [int(running.stdout.readline()) for _ in range(7)]
        found = callback_functions((running.pid, handle) for handle in handles)
        running.communicate()
    return [found.get((running.pid, handle)) for handle in handles]


def test_functions_are_named_as_lttng_would_name_them(tmp_path: Path) -> None:
    timer, bound_timer, held, subscription, bound, service, none = _named(tmp_path)
    assert timer == "main::{lambda()#1}"
    assert bound_timer == held == f"{BOUND}))()>"
    assert subscription is not None
    assert subscription.startswith("main::{lambda(std::shared_ptr<std::map<")
    assert subscription.endswith("#2}")
    assert bound is not None
    assert bound.startswith(f"{BOUND}, std::_Placeholder<1>))(std::shared_ptr<std::map<")
    assert service == "void (*)(int)"
    assert none is None


def test_a_stripped_file_still_names_timers(tmp_path: Path) -> None:
    timer, bound_timer, _, subscription, *_ = _named(tmp_path, "-s")
    assert timer == "main::{lambda()#1}"
    assert bound_timer == f"{BOUND}))()>"
    assert subscription is None


def test_processes_that_have_ended_are_left_out() -> None:
    with subprocess.Popen(["true"]) as ended:
        ended.wait()
    assert callback_functions([(ended.pid, 4096), (0, 4096)]) == {}


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


def test_what_is_no_mangled_name_stays_unknown() -> None:
    assert demangled(b"_Z3fooi") == "foo(int)"
    assert demangled(b"what?") is None
