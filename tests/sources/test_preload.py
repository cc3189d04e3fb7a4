"""The library in front of ROS 2: real processes that have it loaded, killed, forked and crowded."""

import fcntl
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import called, json_of
from native_build import built_for_arm64
from processes import children_of, in_time_namespace, wait_for
from traced_program import (
    Traced,
    assert_everything,
    build,
    built,
    of_process,
    traced,
    traced_everything,
)

import chainshaper as cs
from chainshaper.monitor.watch import Watch
from chainshaper.reporting.overviews import watch_tables
from chainshaper.sources.preload import (
    PreloadTracer,
    TracedProcess,
    event_names,
    installed_library,
    memories,
    preloading,
    running,
    tracer,
)
from chainshaper.values.errors import InputError, OperationError, PlatformError

pytestmark = pytest.mark.waiting

RING, RINGS = 1 << 14, 64
CYCLES, PERIOD_NS = 20, 50_000_000

CALLER = """
import ctypes, os, sys, threading
library = ctypes.CDLL(None)
def take(message): library.ros_trace_rcl_take(ctypes.c_uint64(message))
"""
"""The beginning of a program in Python whose process has the library in front, and nothing else."""


def tracer_of(folder: Path) -> PreloadTracer:
    return PreloadTracer(folder, ["command"], ())


def python(program: str) -> list[list[str]]:
    subprocess.run([sys.executable, "-c", CALLER + program], check=True, timeout=60)
    return []


def taken(run: Traced) -> list[int]:
    return run.tables["rcl_take"]["message"].to_list()


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> tuple[Traced, dict[str, Any]]:
    return traced_everything(tracer_of(tmp_path_factory.mktemp("trace")), CYCLES)


WAITING = ("rclcpp_executor_get_next_ready", "rclcpp_executor_wait_for_work")
"""What an executor of several threads emits while it waits, and nothing reads."""


TIMERS = """
int rcl_timer_call_with_info(long timer, void *information) { return timer == 13; }
int rcl_timer_call(long timer) { return rcl_timer_call_with_info(timer, 0); }
"""
"""As rcl since Jazzy; the timer 13 is cancelled."""


def test_calls_of_timers_are_recorded_once(tmp_path: Path) -> None:
    """Also where rcl is in no global scope, as Python loads it."""
    words = ["gcc", "-x", "c", "-shared", "-fPIC", "-Wl,-soname,librcl.so", "-o"]
    library = tmp_path / "librcl.so"
    subprocess.run([*words, str(library), "-"], input=TIMERS.encode(), check=True)
    program = f"""
ctypes.CDLL({str(library)!r})
library.rcl_timer_call(7)
library.rcl_timer_call_with_info(8, 1)
open({str(tmp_path / "said")!r}, "w").write(str(library.rcl_timer_call(13)))
"""
    run = traced(tracer_of(tmp_path), lambda: python(program))
    assert run.tables["rcl_timer_call"]["timer_handle"].to_list() == [7, 8]
    assert (tmp_path / "said").read_text() == "1", "what rcl returned"


def test_every_argument_of_every_function_arrives_as_it_was_passed(
    everything: tuple[Traced, dict[str, Any]],
) -> None:
    assert_everything(*everything, WAITING)
    emitted = {row[0] for rows in everything[1].values() for row in rows}
    apart = {"rcl_timer_call", *OURS, *OF_RCLPY, *SERVICE_CALLS}
    apart |= {"controller_manager_found", "controller_manager_call"}
    assert set(event_names()) - emitted == apart, "tested apart"


@pytest.mark.timeout(900)
def test_every_argument_arrives_on_arm64(tmp_path: Path) -> None:
    program = build(tmp_path / "prefix", compiler="aarch64-linux-gnu-gcc")
    if shutil.which("qemu-aarch64") is None:
        pytest.skip("qemu-aarch64 is not installed (package qemu-user)")
    library = built_for_arm64() / installed_library().name
    emulated = ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu", "-E", f"LD_PRELOAD={library}"]

    def run() -> list[list[str]]:
        command = ["env", "-u", "LD_PRELOAD", *emulated, *program.command("every")]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return [line.split("\t") for line in done.stdout.splitlines()]

    (tmp_path / "trace").mkdir()
    run_there = traced(tracer_of(tmp_path / "trace"), run)
    assert_everything(run_there, {"8.2.3": run_there.printed}, WAITING)


def test_execution_times_are_the_threads_own_cpu_time(
    everything: tuple[Traced, dict[str, Any]],
) -> None:
    run, printed = everything
    every = {int(rows[0][1]) for rows in printed.values()}
    (chain,) = set(run.tables["callback_start"]["pid"]) - every
    starts, ends = (
        of_process(run.tables, chain)[name]["thread_time"].to_numpy()
        for name in ("callback_start", "callback_end")
    )
    used = np.array([int(row[4]) for row in run.printed if row[0] == "instance"])
    assert len(used) == 2 * CYCLES
    # The program reads the clock around both calls, so it counts them too; time that the host takes
    # from a thread on its core is in what is reckoned since the last reading, SURELY_USED at most.
    assert ((ends - starts) <= used + 200_000).all()
    assert np.median(used - (ends - starts)) < 50_000


STINTS = """
import time
parent = os.getpid()
first, *others = sorted(os.sched_getaffinity(0))
cores, clock, rows = [first, *others[:1]], time.thread_time_ns, []
os.sched_setaffinity(0, {first})
rivals = [os.fork() for _ in range(2)]
if 0 in rivals:
    while os.getppid() == parent: pass
    os._exit(0)
for n in range(4000):
    if n % 400 < 200: os.sched_setaffinity(0, {cores[n // 50 % len(cores)]})
    if n % 7 == 0: time.sleep(3e-5)
    if n % 11 == 0:
        until = clock() + 30_000 * (n % 30)
        while clock() < until: pass
    before = clock()
    library.ros_trace_callback_start(ctypes.c_uint64(n), False)
    rows.append((before, clock()))
    if n == 2000:
        child = os.fork()
        if child == 0:  # its clock begins anew
            before = clock()
            for again in range(10): library.ros_trace_callback_start(ctypes.c_uint64(again), False)
            print(before, clock(), flush=True)
            os._exit(0)
        os.waitpid(child, 0)
for rival in rivals: os.kill(rival, 9)
for before, after in rows: print(before, after)
"""
"""Sleeps, moves between cores, rivals on the same core, a fork: what it read around events."""


@pytest.mark.parametrize("tunables", ["", "glibc.pthread.rseq=0"])
def test_cpu_time_is_the_clocks_though_that_is_rarely_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tunables: str
) -> None:
    """Without rseq it is read each time; with it, 0.2 ms is what it may be off, and rarely is."""
    printed: list[list[str]] = []

    def run() -> list[list[str]]:
        command = [sys.executable, "-c", CALLER + STINTS]
        done = subprocess.run(command, check=True, timeout=60, capture_output=True, text=True)
        printed.extend(line.split() for line in done.stdout.splitlines())
        return []

    monkeypatch.setenv("GLIBC_TUNABLES", tunables)
    table = traced(tracer_of(tmp_path), run).tables["callback_start"]
    (child_before, child_after), *of_parent = np.array(printed, np.int64)
    before, after = np.array(of_parent).T
    parts = table.partition_by("pid", maintain_order=True)
    of_child, said = (
        part["thread_time"].to_numpy() for part in sorted(parts, key=lambda part: part.height)
    )
    assert (said.size, of_child.size) == (4000, 10)
    assert (np.diff(said) >= 0).all()
    slack = 0 if tunables else 200_000
    assert (said >= before - min(slack, 5_000)).all()
    assert (said <= after + slack).all()
    assert (said <= after + 5_000).mean() > 0.98
    assert child_before - 5_000 <= of_child[0] <= of_child[-1] <= child_after + slack


RMW = """
#include <stdbool.h>
#include <stdint.h>
#include <string.h>
struct info { int64_t sent, received; uint8_t writer[16]; int64_t number; };
int rmw_send_request(const void *c, const void *r, int64_t *number) { *number = 41; return c == r; }
int rmw_send_response(const void *s, void *id, void *r) { return 0; }
int rmw_take_request(const void *s, struct info *info, void *r, bool *taken)
{
    info->sent = 1234, info->number = 42, memset(info->writer, 7, 16), *taken = r != 0;
    return 0;
}
int rmw_take_response(const void *c, struct info *info, void *r, bool *taken)
{
    info->sent = 5678, info->number = 43, *taken = true;
    return 0;
}
void ros_trace_rmw_take(const void *s, const void *m, int64_t sent, bool taken);
int rmw_take_with_info(const void *s, void *message, bool *taken, int64_t *info, void *allocation)
{
    *info = 77, *taken = message != 0;
    if (s == (void *)1) ros_trace_rmw_take(s, message, *info, *taken);
    return s == (void *)3;
}
"""
"""An rmw that stands behind the library: what fails, and what takes nothing, is no call."""
CALLS = """
address, number, taken = ctypes.c_void_p, ctypes.c_int64(), ctypes.c_bool()
info = ctypes.create_string_buffer(40)
for client in (1, 2): library.rmw_send_request(address(client), address(2), ctypes.byref(number))
for request in (0, 3):
    library.rmw_take_request(address(4), info, address(request), ctypes.byref(taken))
library.rmw_send_response(address(4), ctypes.byref(info, 16), address(5))
library.rmw_take_response(address(1), info, address(6), ctypes.byref(taken))
assert number.value == 41 and taken.value
for subscription, message in ((1, 9), (2, 9), (2, 0), (2, 9), (3, 9)):
    library.rmw_take_with_info(
        address(subscription), address(message), ctypes.byref(taken), info, None
    )
"""


OURS = {"loop_named", "loop_moved", "thread_sleep", "thread_wake"}  # of how threads sleep
OF_RCLPY = {"rclpy_followed", "rclpy_callback_added", "coroutine_step"}
SERVICE_CALLS = {
    "rmw_send_request": [(1, 2, 41)],
    "rmw_take_request": [(4, 3, [7] * 16, 42, 1234)],
    "rmw_send_response": [(4, 5, [7] * 16, 42)],
    "rmw_take_response": [(1, 6, 43, 5678)],
}


def test_calls_of_services_and_takes_without_an_event_are_seen_between_rcl_and_rmw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what has its event is recorded once."""
    (tmp_path / "rmw.c").write_text(RMW)
    library = tmp_path / "librmw.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, tmp_path / "rmw.c"], check=True)
    monkeypatch.setenv("LD_PRELOAD", str(library))
    tables = traced(tracer_of(tmp_path), lambda: python(CALLS)).tables
    seen = {name: tables[name].drop("time", "pid", "tid", "cpu").rows() for name in SERVICE_CALLS}
    assert seen == SERVICE_CALLS
    taken = tables["rmw_take"].select("rmw_subscription_handle", "message", "source_timestamp")
    assert taken.rows() == [(1, 9, 77), (2, 9, 77), (2, 9, 77)]


@contextmanager
def memory_behind(program: str) -> Iterator[Path]:
    """The file of the memory of a process that has run a program, and waits until the end."""
    with subprocess.Popen(
        [sys.executable, "-c", f"{CALLER}{program}\nprint(os.getpid(), flush=True)\ninput()"],
        env={**os.environ, "LD_PRELOAD": str(installed_library())},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert int(process.stdout.readline()) == process.pid
        files = Path(f"/proc/{process.pid}/fd").iterdir()
        (memory_file,) = (file for file in files if "chainshaper-trace" in str(file.readlink()))
        yield memory_file
        process.communicate("\n")


def test_a_ring_that_runs_over_has_the_newest_and_counts_the_others() -> None:
    """Read once, behind ten rings' worth of events: a reader that was not scheduled meanwhile."""
    with memory_behind(f"for n in range(10 * {RING} + 7): take(n)") as file:
        with file.open("rb") as opened:
            memory = TracedProcess(opened.fileno())
        (records,) = memory.new_records()
        messages = records["values"][:, 0]
        assert messages[-1] == 10 * RING + 6
        assert (np.diff(messages) == 1).all()
        assert records.size == RING - 1  # the room of the oldest may be being written
        assert memory.lost + records.size == 10 * RING + 7
        assert memory.new_records() == []


def ours_in_shared_memory(recorder: int) -> list[Path]:
    """What tracing left there, or this recorder; others make and remove files there meanwhile."""
    names = ("*chainshaper-trace*", f"*chainshaper-{recorder}*")
    return [file for name in names for file in Path("/dev/shm").glob(name)]


def test_a_process_that_is_killed_has_lost_nothing_and_leaves_nothing(tmp_path: Path) -> None:
    def run() -> list[list[str]]:
        with pytest.raises(subprocess.CalledProcessError):
            python("for n in range(100): take(n)\nos.kill(os.getpid(), 9)")
        return []

    assert taken(traced(tracer_of(tmp_path), run)) == list(range(100))
    assert not ours_in_shared_memory(os.getpid())


@pytest.mark.parametrize("ahead_s", [-1000, 100_000])
def test_a_process_of_another_clock_is_refused_and_named(tmp_path: Path, ahead_s: int) -> None:
    """In a time namespace: its times fit to no other process's, whether they seem to lie ahead."""

    def run() -> list[list[str]]:
        python("for n in range(5): take(n)")
        command = in_time_namespace(ahead_s, sys.executable, "-c", CALLER + "take(99)")
        subprocess.run(command, check=True, timeout=60)
        return []

    recorded = traced(tracer_of(tmp_path), run)
    assert taken(recorded) == list(range(5))
    (note,) = (note for note in recorded.info.notes if note.startswith("nothing of process"))
    assert "another clock, that of a time namespace" in note
    assert re.match(r"nothing of process \d+ \(python[\d.]*\) is recorded: ", note)


def test_a_process_that_has_ended_before_it_was_looked_at_is_named_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its program's name comes with its memory: `/proc` has forgotten it."""

    def forgotten(pid: int) -> str:
        raise ProcessLookupError(pid)

    monkeypatch.setattr(tracer, "name_of", forgotten)
    monkeypatch.setattr(running, "name_of", forgotten)
    command = in_time_namespace(100_000, sys.executable, "-c", CALLER + "take(99)")

    def run() -> list[list[str]]:
        python("take(1)")
        subprocess.run(command, check=True, timeout=60)
        return []

    recorded = traced(tracer_of(tmp_path), run)
    (note,) = (note for note in recorded.info.notes if note.startswith("nothing of process"))
    assert re.match(r"nothing of process \d+ \(python[\d.]*\) is recorded: ", note)
    assert [name for name in recorded.info.processes.values() if name.startswith("python")]


TAKES_A_LINE = """
take(1)
print("ready", flush=True)
while not sys.stdin.readline().startswith("end"):
    take(2)
"""


@contextmanager
def waiting_in_time_namespace() -> Iterator[int]:
    """A program with the library in front and another clock, that takes a message for each line
    that it reads; its number here.
    """
    environment = {**os.environ, "LD_PRELOAD": str(installed_library())}
    program = CALLER + TAKES_A_LINE
    command = in_time_namespace(100_000, sys.executable, "-c", program)
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "ready\n"
            yield children_of(process.pid)[0]
        finally:
            process.communicate("end\n")


def test_a_running_process_of_another_clock_is_named_where_it_is_attached_to(
    tmp_path: Path,
) -> None:
    """By `record`, which says so and records the others, or fails with the reason; and `watch`."""
    with waiting_in_time_namespace() as pid:
        left_out = rf"nothing of process {pid} \(python.*\) is recorded: it has another clock, that"
        left_out += (
            rf" of a time namespace: record it in there \(`nsenter --time --target {pid} …`\)"
        )
        tracer = PreloadTracer(tmp_path / "one", (), (pid,))
        with pytest.raises(OperationError, match=rf"{left_out}, or attach with"):
            tracer.start()
        tracer.remove()
        with memory_behind("take(7)") as file:
            (tmp_path / "two").mkdir()
            here = int(file.parts[2])
            tracer = PreloadTracer(tmp_path / "two", (), (pid, here))
            tracer.start()
            tracer.stop()
            _, info = tracer.recording()
            tracer.remove()
            watched = Watch(["/a../b"], users={os.geteuid()})
            seen = watched.look()
        (note,) = info.notes
        assert re.fullmatch(left_out + r"\.", note)
        assert [sentence for sentence in seen.left_out if re.match(left_out, sentence)]
        assert here in seen.processes
        assert f"process {pid} " in (watch_tables(seen)[-1].caption or "")
    watched._searched_ns = 0  # it looks again, and the process has ended
    assert not [sentence for sentence in watched.look().left_out if re.match(left_out, sentence)]


FLOOD = """
#include <stdint.h>
void ros_trace_rmw_publish(uint64_t, uint64_t, uint64_t) __attribute__((weak));
int main(void) {
  for (uint64_t n = 1;; n++) ros_trace_rmw_publish(n, ~n, 3 * n);
}
"""


def test_who_is_stopped_or_killed_in_the_middle_of_a_write_leaves_no_wrong_record(
    tmp_path: Path,
) -> None:
    """All that the process does is to write: read are whole records, in order, each once."""
    (tmp_path / "flood.c").write_text(FLOOD)
    subprocess.run(["cc", "-o", tmp_path / "flood", tmp_path / "flood.c"], check=True)
    environment = {**os.environ, "LD_PRELOAD": str(installed_library())}
    dice, last, total = random.Random(39), 0, 0
    with subprocess.Popen([tmp_path / "flood"], env=environment) as process:
        there: dict[int, TracedProcess] = {}

        def look() -> None:
            nonlocal last, total
            for records in there[process.pid].new_records():
                numbers, inverted, thrice = records["values"].T[:3]
                assert (inverted == ~numbers).all()
                assert (thrice == 3 * numbers).all()
                assert (np.diff(numbers) == 1).all()
                assert numbers[0] > last
                last, total = int(numbers[-1]), total + records.size

        try:
            users = {os.geteuid()}
            wait_for(lambda: process.pid in dict(memories(users, ())), "its memory")
            there.update(memories(users, ()))
            for _ in range(50):
                process.send_signal(signal.SIGSTOP)
                look()
                process.send_signal(signal.SIGCONT)
                time.sleep(dice.random() * 0.01)
        finally:
            process.kill()
        process.wait()
        look()
    memory = there[process.pid]
    assert total + memory.lost == last > 0
    assert memory.damage is None


def test_a_reader_that_is_killed_disturbs_nothing_and_leaves_nothing(tmp_path: Path) -> None:
    program = built()
    output, ran = tmp_path / "recording", tmp_path / "ran"
    script = f'"{program.executable}" chain 40 > "{ran}"; mv "{ran}" "{ran}.whole"'
    record = [sys.executable, "-m", "chainshaper", "record", "--source", "preload"]
    recorder = subprocess.Popen(
        [*record, "-o", str(output), "--", "setsid", "bash", "-c", script],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    wait_for(ran.exists, "the application to run")
    time.sleep(0.5)
    recorder.send_signal(signal.SIGKILL)
    recorder.wait()
    wait_for(Path(f"{ran}.whole").exists, "the application to end by itself")
    instances = [
        line for line in Path(f"{ran}.whole").read_text().splitlines() if "instance" in line
    ]
    assert len(instances) == 80
    assert not ours_in_shared_memory(recorder.pid)
    assert f"chainshaper-{recorder.pid}-" not in Path("/proc/net/unix").read_text()


CHILDREN = """
for n in range(3): take(n)
child = os.fork()
for n in range(3, 6) if child else range(10, 15): take(n)
if child: os.waitpid(child, 0)
else: os._exit(0)
"""
CHILDREN_THAT_NOBODY_IS_TOLD_OF = CHILDREN.replace("os.fork()", "library._Fork()")
"""Made by a bare system call, behind the back of `pthread_atfork`."""
THREADS = """
for n in range(300):
    thread = threading.Thread(target=take, args=(n,))
    thread.start()
    thread.join()
"""
MORE_THREADS_THAN_RINGS = f"""
all_there = threading.Barrier({RINGS} + 6)
def run(n):
    take(n)
    all_there.wait()
threads = [threading.Thread(target=run, args=(n,)) for n in range({RINGS} + 6)]
for thread in threads: thread.start()
for thread in threads: thread.join()
"""


@pytest.mark.parametrize(("program", "by_process", "lost"), [
    (CHILDREN, [6, 5], 0), (CHILDREN_THAT_NOBODY_IS_TOLD_OF, [6, 5], 0),
    (THREADS, [300], 0), (MORE_THREADS_THAN_RINGS, [RINGS], 6),
    (f"for n in range(40 * {RING}): take(n)", [40 * RING], None),  # faster than it may be read
])  # fmt: skip
def test_every_event_is_there_or_counted(
    tmp_path: Path, program: str, by_process: list[int], lost: int | None
) -> None:
    """Children have memories of their own; threads that end give their rings back."""
    run = traced(tracer_of(tmp_path), lambda: python(program))
    messages_of = run.tables["rcl_take"].group_by("pid").agg("message")["message"].to_list()
    assert all(len(set(messages)) == len(messages) for messages in messages_of), "none twice"
    counted = run.info.lost["lost_events"]
    if lost is None:
        assert len(messages_of[0]) + counted == by_process[0]
    else:
        assert (sorted(map(len, messages_of), reverse=True), counted) == (by_process, lost)
    assert ("events were lost" in "".join(run.info.notes)) == (counted > 0)


def test_objects_that_find_no_room_are_counted(tmp_path: Path) -> None:
    name = b"/a" * 3000  # is cut
    program = f"""
for n in range(400):
    library.ros_trace_rcl_node_init(ctypes.c_uint64(n), None, {name!r}, b"/")
"""
    run = traced(tracer_of(tmp_path), lambda: python(program))
    nodes = run.tables["rcl_node_init"]
    assert nodes.height + run.info.lost["lost_events"] == 400
    assert nodes.height > 250
    assert set(nodes["node_name"]) == {name[:4096].decode()}


def test_what_cannot_have_memory_runs_on(tmp_path: Path) -> None:
    """No descriptor is left: nothing is traced, and the application runs on."""
    program = "import resource\nresource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))\ntake(1)"
    with pytest.raises(OperationError, match="no process has loaded the tracing library"):
        traced(tracer_of(tmp_path), lambda: python(program))


@pytest.mark.parametrize("limit", ["RLIMIT_FSIZE", "RLIMIT_AS"])
def test_limits_cost_the_trace_only(tmp_path: Path, limit: str) -> None:
    """Of the size of files, for which the kernel sends SIGXFSZ, which nodes do not ignore as Python
    does; and of memory.
    """
    program = f"""
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
resource.setrlimit(resource.{limit}, (4096, 4096))
take(1)
assert not signal.sigpending()
print("ran", flush=True)
"""
    with pytest.raises(OperationError, match="no process has loaded the tracing library"):
        traced(tracer_of(tmp_path), lambda: python(program))


REUSED = """
take(1)
os.closerange(3, 100)  # as daemons do
files = [os.open("/dev/null", os.O_RDONLY) for _ in range(20)]
if not os.fork():
    take(2)
    assert {os.fstat(file).st_rdev for file in files} == {os.stat('/dev/null').st_rdev}
    os._exit(0)
_, status = os.wait()
assert status == 0, "a file of the node was closed in the child"
"""


def test_a_descriptor_of_the_node_under_our_number_stays_open_in_its_children(
    tmp_path: Path,
) -> None:
    assert sorted(taken(traced(tracer_of(tmp_path), lambda: python(REUSED)))) == [1, 2]


FAILING = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>
int memfd_create(const char *name, unsigned flags) {  /* the first thread stays within */
  static int (*behind)(const char *, unsigned);
  static int calls;
  if (!behind) behind = (int (*)(const char *, unsigned))dlsym(RTLD_NEXT, "memfd_create");
  if (__sync_fetch_and_add(&calls, 1) == 0 && getenv("SLOW_MEMORY")) {
    if (write(atoi(getenv("SLOW_MEMORY")), "w", 1) != 1) abort();
    nanosleep(&(struct timespec){3, 0}, NULL);
    if (write(atoi(getenv("SLOW_MEMORY")), "e", 1) != 1) abort();
  }
  return behind(name, flags);
}
int madvise(void *area, size_t size, int advice) {
  static int (*behind)(void *, size_t, int);
  if (!behind) behind = (int (*)(void *, size_t, int))dlsym(RTLD_NEXT, "madvise");
  if (advice == 23 && size == (1 << 20) && getenv("NO_MEMORY")) return errno = ENOMEM, -1;
  return behind(area, size, advice);
}
"""
"""Stands before the C library: the memory of a process is made slowly, or there is none left."""


@pytest.fixture
def failing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "failing.c").write_text(FAILING)
    library = tmp_path / "failing.so"
    source = tmp_path / "failing.c"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    monkeypatch.setenv("LD_PRELOAD", str(library))


@pytest.mark.usefixtures("failing")
def test_a_thread_waits_for_no_other_that_makes_the_memory(tmp_path: Path) -> None:
    """A SCHED_FIFO thread that did would keep an ordinary one of its core from ever ending it."""
    program = """
reading, writing = os.pipe()
os.environ["SLOW_MEMORY"] = str(writing)
first = threading.Thread(target=take, args=(1,))
first.start()
assert os.read(reading, 1) == b"w"  # it makes the memory
take(2)
os.set_blocking(reading, False)
try:
    assert not os.read(reading, 1), "the second thread has waited for it"
except BlockingIOError:
    pass
first.join()
take(3)
"""
    assert sorted(taken(traced(tracer_of(tmp_path), lambda: python(program)))) == [1, 2, 3]


@pytest.mark.usefixtures("failing")
def test_where_the_kernel_has_no_memory_left_events_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written to without having been claimed it would be a SIGBUS."""
    monkeypatch.setenv("NO_MEMORY", "1")
    run = traced(tracer_of(tmp_path), lambda: python("for n in range(5): take(n)"))
    assert run.info.lost["lost_events"] == 5


def test_a_node_built_with_address_sanitizer_is_traced_as_any_other(tmp_path: Path) -> None:
    source, node = tmp_path / "node.c", tmp_path / "node"
    source.write_text("extern void ros_trace_rcl_take(long) __attribute__((weak));\n"
                      "int main(void) { ros_trace_rcl_take(13); return 0; }\n")  # fmt: skip
    words = ["cc", "-fsanitize=address", "-o", str(node), str(source)]
    if subprocess.run(words, check=False, capture_output=True).returncode:
        pytest.skip("this compiler has no AddressSanitizer")

    def run() -> list[list[str]]:
        subprocess.run([node], check=True, timeout=60)
        return []

    assert taken(traced(tracer_of(tmp_path), run)) == [13]


def test_memory_of_others_is_refused(tmp_path: Path) -> None:
    plain = os.open(tmp_path / "file", os.O_RDWR | os.O_CREAT)
    shrinking, garbage = (
        os.memfd_create("chainshaper-trace", os.MFD_ALLOW_SEALING) for _ in range(2)
    )
    fcntl.fcntl(garbage, 1033, 2)  # F_ADD_SEALS, F_SEAL_SHRINK
    none = "no memory of a traced process"
    for descriptor, message in ((plain, none), (shrinking, none), (garbage, "another version")):
        os.write(descriptor, os.urandom(1 << 20))
        with pytest.raises(InputError, match=message):
            TracedProcess(descriptor)
        os.close(descriptor)


def all_but(pid: int) -> set[int]:
    """All processes but this one."""
    return {int(folder.name) for folder in Path("/proc").iterdir() if folder.name.isdigit()} - {pid}


HOSTILE = """
import fcntl, os, struct
header = (0x63687368, 2, os.getpid(), {rings}, {records}, {objects})
file = os.memfd_create("chainshaper-trace", os.MFD_ALLOW_SEALING)
os.truncate(file, {size})
os.pwrite(file, struct.pack("<6I", *header), 0)
fcntl.fcntl(file, 1033, 2)
print(os.getpid(), flush=True)
input()
"""


@pytest.mark.parametrize(
    ("rings", "records", "objects", "size"),
    [
        (8_000_000, 1, 0, 64 + 8_000_000 * 128),
        (64, 1 << 14, 1 << 15, 1 << 40),
        (64, 1 << 14, 1 << 15, 1 << 20),
        (0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 1 << 20),
    ],
)
def test_a_memory_of_another_shape_is_refused_at_once(
    rings: int, records: int, objects: int, size: int
) -> None:
    program = HOSTILE.format(rings=rings, records=records, objects=objects, size=size)
    assert memories_of(program) == []


def memories_of(program: str) -> list[tuple[int, TracedProcess]]:
    """What is found in a process that says its number, and waits until it has been looked at."""
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert int(process.stdout.readline()) == process.pid
        seen = [*memories({os.geteuid()}, all_but(process.pid))]
        process.communicate(b"\n")
    return seen


@pytest.mark.skipif(os.geteuid() != 0, reason="a file in the root of a file system takes root")
def test_a_pipe_with_the_name_of_a_memory_is_not_opened() -> None:
    """Opening it would wait for a writer for ever; a device might do something."""
    program = """
import os
file = os.open("/memfd:chainshaper-trace", os.O_RDWR)
print(os.getpid(), flush=True)
input()
"""
    pipe = Path("/memfd:chainshaper-trace")
    os.mkfifo(pipe)
    try:
        assert memories_of(program) == []
    finally:
        pipe.unlink(missing_ok=True)


def test_the_command_records_and_the_chain_is_measured(tmp_path: Path) -> None:
    program, recording = built(), tmp_path / "recording"
    made = called("record", "-o", recording, "--", *program.command("chain", str(CYCLES)))
    assert made.code == 0, made.err
    assert not (recording / "trace").exists(), "the tables have all of it"
    measured = json_of("latency", recording, "--chain", "/ebpf1../ebpf2", "--json")
    assert measured["count"] >= CYCLES - 1
    callbacks = json_of("callbacks", recording, "--json")
    assert all(2_000_000 <= callback["execution_ns"]["mean"] < 3_000_000 for callback in callbacks)
    assert json_of("info", recording, "--json")["source"] == "preload"


def test_what_runs_with_the_library_is_attached_to_and_left(tmp_path: Path) -> None:
    """Objects of before are known, events of before are not: the run lasts longer than its part."""
    environment = {**os.environ, "LD_PRELOAD": str(installed_library())}
    words = built().command(
        "chain", "200"
    )  # ten seconds: `record` takes its time on a busy machine
    with (
        subprocess.Popen(words, env=environment, stdout=subprocess.PIPE) as process,
        subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL) as bystander,
    ):
        time.sleep(0.7)
        begun = time.monotonic_ns()
        attach = ("--duration", "500ms", "--pid", str(process.pid))
        made = called("record", "--source", "preload", "-o", tmp_path / "rec", *attach)
        assert (made.code, process.poll()) == (0, None), made.err
        printed = process.communicate()[0]
        bystander.kill()
    assert printed.count(b"instance") == 400
    tables = cs.open_recording(tmp_path / "rec").events
    started = tables["callback_start"]
    assert set(started["pid"]) == {process.pid}
    assert (started["time"] >= begun).all()
    assert 10 <= started.height < 350
    assert (tables["rcl_node_init"]["time"] < begun).all()
    assert json_of("latency", tmp_path / "rec", "--chain", "/ebpf1../ebpf2", "--json")["count"] >= 5


def test_wrong_use_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    attach = ("--pid", str(os.getpid()))  # not 1, whose descendants are all that runs here
    attached = called("record", "--source", "preload", "-o", tmp_path / "r", *attach)
    assert attached.code == 1
    assert "no process of these users runs with the library in front" in attached.err
    assert "attach with `--source ebpf`" in attached.err
    with pytest.raises(PlatformError, match="a space or a colon in it, so LD_PRELOAD cannot"):
        preloading(Path("/my home/library.so"))
    monkeypatch.setenv("LD_PRELOAD", "/other.so")
    assert preloading(Path("/ours.so")) == "/ours.so:/other.so"


def test_a_ring_whose_count_is_damaged_costs_no_other() -> None:
    """A node may write where it should not: what its memory says then is no count of events."""
    with memory_behind("take(1)") as path, path.open("r+b") as file:
        memory = TracedProcess(file.fileno())
        counts = [(1 << 63) + 5, 1]
        for count in counts:
            file.seek(64)  # behind the header: how much the first thread has written
            file.write(count.to_bytes(8, "little"))
            file.flush()
            assert memory.new_records() == []
        assert memory.lost == len(counts)
