"""Threads as the kernel shows them, what their names say, and what is asked of it for them."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from actors import acting
from known import known
from processes import in_time_namespace, wait_for

from chainshaper.linux.scheduling import (
    SchedulingRequest,
    apply_scheduling,
    available_cores,
    check_cores,
    may_use_fifo,
    set_thread_name,
    throttle_fraction,
)
from chainshaper.linux.threads import (
    RunningThread,
    find_thread,
    foreign_realtime_processes,
    innermost_id,
    list_threads,
    role_of,
    start_of,
)
from chainshaper.values.errors import OperationError, PlatformError
from chainshaper.values.middleware import ThreadWork, thread_work

KINDS: dict[ThreadWork, tuple[str, ...]] = {
    "receive": ("recv", "recvUC", "recvMC", "dds.udp.7410", "dds.shm.7413", "dds.tcp.5100"),
    "delivery": ("dq.user", "dq.camera"),
    "transmit": ("xmit.user", "sendq"),
    "resend": ("dds.asyn.0.0",),
    "event": ("tev", "dds.ev.0"),
    "discovery": ("dq.builtins", "dds.ds_ev.0", "dds.tls.replies"),
    "lease": ("lease",),
    "garbage collection": ("gc",),
    "asynchronous publisher": ("dds.asyn.0.1", "dds.asyn.10.12"),
    "connection": ("dds.tcp_accept", "dds.tcp_keep", "fsm"),
    "housekeeping": (
        *("dds.shm.wdog", "dds.log", "dds.fwatch.cb", "dds.something", "debmon"),
        *("rCo00001##Evt", "rTr00001UDPv4", "Watchdog Confir", "Watchdog Valida"),
    ),
}


@pytest.mark.parametrize(("kind", "names"), KINDS.items(), ids=list(KINDS))
def test_threads_of_middleware_are_known_by_name(kind: ThreadWork, names: tuple[str, ...]) -> None:
    assert {thread_work(name) for name in names} == {kind}
    role = "publisher" if kind == "asynchronous publisher" else "dds"
    assert {role_of(name, is_main=False) for name in names} == {role}


OTHERS = ["talker", "recvX", "gcc", "ddsperf", "", "python3", "tevatron", "rx-0", "rController"]


@pytest.mark.parametrize("name", OTHERS)
def test_names_of_others_say_nothing(name: str) -> None:
    assert thread_work(name) is None
    assert role_of(name, is_main=False) == "unknown"
    assert role_of(name, is_main=True) == role_of("gc", is_main=True) == "executor"


ZENOH = ("app-0", "net-0", "acc-0", "tx-0", "rx-0", "rx-1", "rx-12")


def test_threads_of_zenoh_are_known_where_several_of_its_runtimes_are(tmp_path: Path) -> None:
    with acting(tmp_path, *ZENOH, "rx", "rx-0a") as actor:
        found = {one.comm: (one.role, one.kind) for one in list_threads(actor.pid)[1:]}
    assert [found[name][1] for name in ZENOH] == [
        *("event", "connection", "connection", "transmit", "receive", "receive", "receive")
    ]
    assert {found[name][0] for name in ZENOH} == {"dds"}
    assert found["rx"] == found["rx-0a"] == ("unknown", None)
    with acting(tmp_path, "rx-0", "tx-0", "rx-1", "tx-1") as actor:  # a serial line's, perhaps
        assert {one.kind for one in list_threads(actor.pid)} == {None}


def test_a_process_has_its_main_thread_first_and_named_threads_by_name() -> None:
    ready, done = threading.Event(), threading.Event()

    def body() -> None:
        set_thread_name("xmit.user with a long name")
        ready.set()
        done.wait()

    thread = threading.Thread(target=body)
    thread.start()
    ready.wait()
    try:
        threads = list_threads(os.getpid())
    finally:
        done.set()
        thread.join()
    assert threads[0].tid == os.getpid()
    assert threads[0].role == "executor"
    assert set(threads[0].cores) == os.sched_getaffinity(0)
    sender = next(t for t in threads if t.tid == thread.native_id)
    assert (sender.comm, sender.role) == ("xmit.user with ", "dds")  # the kernel keeps 15 bytes
    assert sender.kind == "transmit"
    assert sender.started >= threads[0].started
    assert sender.identity == (thread.native_id, sender.started)


def test_a_thread_is_found_by_its_id_alone_whatever_its_name_as_long_as_it_lives(
    tmp_path: Path,
) -> None:
    name = ") R 1 2 ("  # as in /proc/PID/stat
    with acting(tmp_path, name) as actor:
        tid = actor.tids[name]
        found = known(find_thread(tid))
        assert found == actor.thread(name)
        assert (found.pid, found.comm) == (actor.pid, name)
        assert start_of(actor.pid, tid) == found.started >= actor.thread("main").started
        actor.end(name)
        wait_for(lambda: find_thread(tid) is None, "the end of a thread")
        assert start_of(actor.pid, tid) is None
    assert list_threads(actor.pid) == ()


def test_in_a_container_a_thread_has_an_id_of_its_own() -> None:
    assert innermost_id(b"Name:\tx\nNSpid:\t4711\t12\t3\n") == 3
    assert innermost_id(b"Name:\tx\nNSpid:\t4711\n") == 4711
    assert innermost_id(b"Name:\tx\n") is None  # a kernel without pid namespaces


def _thread(tid: int) -> RunningThread:
    return RunningThread(tid, os.getpid(), "recv", "dds", "SCHED_OTHER", 0, (0,))


def test_scheduling_a_thread_that_has_ended_is_no_error_and_what_is_refused_is_named() -> None:
    ended = threading.Thread(target=lambda: None)
    ended.start()
    ended.join()
    apply_scheduling(
        _thread(known(ended.native_id)), SchedulingRequest(None, (available_cores()[0],))
    )
    thread = _thread(threading.get_native_id())
    with pytest.raises(OperationError, match=rf"thread {thread.tid} \(recv\).*priority 500"):
        apply_scheduling(thread, SchedulingRequest(500, None))
    with pytest.raises(OperationError, match=r"cores \(1023,\)"):
        apply_scheduling(thread, SchedulingRequest(None, (1023,)))


def test_asking_for_real_time_scheduling_changes_nothing() -> None:
    before = (os.sched_getscheduler(0), os.sched_getparam(0), os.sched_getaffinity(0))
    may_use_fifo()
    assert (os.sched_getscheduler(0), os.sched_getparam(0), os.sched_getaffinity(0)) == before


def test_a_missing_core_is_named_with_who_wants_it_and_what_there_is() -> None:
    core, *_ = cores = available_cores()
    check_cores({core: "scheduling.dds"})
    with pytest.raises(PlatformError, match=rf"core 1023, .*lidar.*{', '.join(map(str, cores))}"):
        check_cores({core: "scheduling.dds", 1023: "node lidar"})
    assert 0.0 < throttle_fraction() <= 1.0


def test_our_own_real_time_threads_are_not_foreign() -> None:
    if not may_use_fifo():
        pytest.skip("SCHED_FIFO is not permitted here")
    listed: list[tuple[str, ...]] = []

    def body() -> None:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        listed.append(foreign_realtime_processes())

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert not any(f"({os.getpid()})" in name for name in listed[0])


def test_a_process_has_the_same_start_for_those_in_other_time_namespaces() -> None:
    """Else whoever looks from there takes a run that is in force for one that has crashed."""
    ours = str(start_of(os.getpid(), os.getpid()))
    program = (
        "import sys; from chainshaper.linux.threads import has_ended, list_threads, start_of;"
        "pid, started = map(int, sys.argv[1:]); thread, = list_threads(pid)[:1];"
        "print(start_of(pid, pid), thread.started, has_ended(pid, started))"
    )
    command = [sys.executable, "-c", program, str(os.getpid()), ours]
    there = subprocess.run(
        in_time_namespace(200_000, *command), capture_output=True, text=True, check=True
    )
    assert there.stdout.split() == [ours, ours, "False"]
