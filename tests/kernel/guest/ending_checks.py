"""How the servers end, and what they refuse: the machine is as it was before, and says why."""

import os
import signal
import time
from pathlib import Path

from run_windows import cut, length
from scenes import (
    CYCLE,
    MS,
    A,
    Loader,
    scene,
    scheduler_state,
    server,
    table,
    wait,
    wait_for_phase,
    wait_for_state,
)

from chainshaper.enforcement.scx.back_end import is_realtime_kernel, missing


def killing_the_loader_frees_the_threads() -> str:
    """SIGKILL, outside the slot: nothing is left to be cleaned up."""
    with scene() as s:
        a = s.spinner("a")
        s.spinner("hog")
        loader = s.loader(table(A), {"A": [a]})
        loader.arm()
        wait(200)
        killed = wait_for_phase(25)
        loader.process.kill()
        loader.process.wait()
        wait_for_state("disabled", 100)
        wait(200)
        ran = cut(a.windows(), killed, killed + 200 * MS)
    outside = [a for a, b in ran if not 10 * MS <= a % CYCLE < 20 * MS or b - a > 10 * MS]
    assert outside, "the thread is still governed"
    assert length(ran) > 0.3 * 200 * MS, "the thread does not get about half of the core"
    return f"first run outside its slots {(outside[0] - killed) / MS:.1f} ms afterwards"


def killing_the_loader_disables_the_scheduler() -> str:
    """The same without virtual time, in which shares and delays can be relied on."""
    with scene() as s:
        a = s.spinner("a")
        loader = s.loader(table(A), {"A": [a]})
        loader.arm()
        wait(200)
        loader.process.kill()
        loader.process.wait()
        wait_for_state("disabled")
        killed = time.monotonic_ns()
        wait(1000)
        ran = cut(a.windows(), killed, killed + 1000 * MS)
    assert [a for a, _ in ran if a % CYCLE > 21 * MS], "the thread is still governed"
    return f"ran {length(ran) / MS:.0f} of 1000 ms afterwards"


def releasing_twice_leaves_nothing_behind() -> str:
    """And a new back end can begin where the old one ended."""
    with scene() as s:
        a = s.spinner("a")
        for _ in range(3):
            loader = s.loader(table(A), {"A": [a]})
            loader.arm()
            loader.ask("release")
            assert scheduler_state() == "disabled"
            loader.ask("release")
            assert loader.ask("failure") is None
            assert loader.answer("arm", 0)["error"] == "OperationError"
    return "three times"


def a_second_instance_is_refused() -> str:
    """There can be one scheduler only; the first one goes on."""
    with scene() as s:
        first, second = s.loader(table(A)), s.loader(table(A))
        first.arm()
        answer = second.answer("arm", 0)
        assert answer.get("error") == "OperationError", answer
        assert "chainshaper" in answer["text"], answer
        assert "chainshaper" in (missing() or "")
        assert first.ask("failure") is None
        first.ask("release")
        assert missing() is None
        second.arm()
    return str(answer["text"])


def without_privileges_the_missing_capabilities_are_named() -> str:
    """As another user than root."""
    try:
        Loader(table(A), user=65534)
    except AssertionError as error:
        text = str(error)
    else:
        raise AssertionError("it was permitted")
    wanted = ["PlatformError", "CAP_BPF", "CAP_PERFMON"]
    if is_realtime_kernel():
        wanted += ["CAP_SYS_NICE", "CAP_IPC_LOCK"]
    assert all(word in text for word in wanted), text
    return ", ".join(wanted[1:])


def threads_that_cannot_be_governed_are_refused() -> str:
    """Real-time ones; those that have ended are passed over."""
    with scene() as s:
        a = s.spinner("a")
        loader = s.loader(table(A))
        os.sched_setscheduler(a.tid, os.SCHED_FIFO, os.sched_param(5))
        answer = loader.answer("assign", a.tid, "A")
        os.sched_setscheduler(a.tid, os.SCHED_OTHER, os.sched_param(0))
        assert "SCHED_FIFO" in answer["text"], answer
        loader.ask("assign", a.tid, "A")
        a.windows()
        loader.arm()  # it has ended since it was assigned
        assert loader.ask("assign", a.tid, "A") is None, "and is passed over"
    return str(answer["text"])


def a_thread_without_a_slot_for_half_a_minute_ends_the_policy() -> str:
    """The kernel's own watchdog, which fails open, too."""
    far = server("A", 90_000, 91_000)
    with scene() as s:
        a = s.spinner("a")
        loader = s.loader(table(far, cycle_ms=100_000), {"A": [a]})
        loader.arm(time.monotonic_ns())
        wait(47_000)
        failure = loader.ask("failure")
        assert failure is not None, "the policy goes on"
        assert "stall" in failure, failure
        assert scheduler_state() == "disabled"
    return str(failure)


def _stop_kicker(stop: signal.Signals, loader_too: bool, busy: bool) -> tuple[str, float]:
    """Stop the kicker in the middle of a slot; what is said, and the time to the end in ms."""
    with scene() as s:
        a = s.spinner("a")
        if busy:
            s.spinner("hog")
        loader = s.loader(table(A), {"A": [a]})
        loader.arm()
        kicker = loader.ask("kickers")["0"]
        wait_for_phase(15 if busy else 30)
        if loader_too:
            loader.process.send_signal(signal.SIGSTOP)
        os.kill(kicker, stop)
        stopped = time.monotonic_ns()
        wait_for_state("disabled", 150)
        passed = (time.monotonic_ns() - stopped) / MS
        if loader_too:
            loader.process.send_signal(signal.SIGCONT)
        wait(100)
        failure = loader.ask("failure")
        freed = time.monotonic_ns()
        wait(100)
        assert failure is not None
        assert "kicker of core 0" in failure, failure
        assert not Path(f"/proc/{kicker}").exists(), "the kicker is left behind"
        ran = cut(a.windows(), freed, freed + 100 * MS)
        assert length(ran) > 30 * MS, "the thread is not free"
    return failure, passed


def a_kicker_that_is_killed_or_stopped_fails_open() -> str:
    """On a busy core and on an idle one; PREEMPT_RT only."""
    told = []
    for number in (signal.SIGKILL, signal.SIGSTOP):
        (_, busy), (said, idle) = (_stop_kicker(number, False, busy) for busy in (True, False))
        told.append(f"after {busy:.1f} ms, idle core {idle:.1f} ms: {said}")
    return "; ".join(told)


def the_policy_notices_a_stopped_kicker_by_itself() -> str:
    """With the loader stopped as well; PREEMPT_RT only."""
    failure, passed = _stop_kicker(signal.SIGSTOP, loader_too=True, busy=True)
    assert "overdue" in failure, failure
    return f"after {passed:.1f} ms: {failure}"
