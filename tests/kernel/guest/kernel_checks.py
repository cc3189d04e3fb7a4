"""What the sched_ext back end must do on a kernel that has it.

Each check is a function whose name says what holds; it returns what was measured and fails by
assertion. Bounds are shares of the slots' lengths, and meant for virtual time, in which a machine
is as fast as its instructions are few, and nothing else runs.
"""

import os
import signal
import time
from dataclasses import replace
from statistics import median

from ending_checks import (
    a_kicker_that_is_killed_or_stopped_fails_open,
    a_second_instance_is_refused,
    a_thread_without_a_slot_for_half_a_minute_ends_the_policy,
    killing_the_loader_disables_the_scheduler,
    killing_the_loader_frees_the_threads,
    releasing_twice_leaves_nothing_behind,
    the_policy_notices_a_stopped_kicker_by_itself,
    threads_that_cannot_be_governed_are_refused,
    without_privileges_the_missing_capabilities_are_named,
)
from run_windows import (
    Intervals,
    cut,
    length,
    overlap,
    precision,
    slots_between,
)
from scenes import (
    CYCLE,
    MS,
    A,
    scene,
    scheduler_state,
    server,
    table,
    wait,
    wait_for_phase,
)

from chainshaper.enforcement.servers import ServerTable
from chainshaper.planning.offsets import LEAD_NS

RUN_MS = 1200
SLOT = 10 * MS


def _exact(ran: Intervals, slots: Intervals, slot: int = SLOT) -> str:
    """Enter within 1 %, typically 0.2 %; leave within 0.01 %; 0.1 % of all slots outside."""
    ran = cut(ran, slots[0][1], slots[-1][0])
    measured = precision(ran, slots[1:-1])
    assert measured.unused == 0, f"{measured.unused} slots were not used"
    assert max(measured.enter) < slot / 100, measured.text()
    assert median(measured.enter) < slot * 0.002, measured.text()
    assert max(measured.leave) < slot / 10_000, measured.text()
    assert measured.outside < len(measured.enter) * slot / 1000, measured.text()
    return measured.text()


def a_thread_keeps_its_slots_beside_best_effort() -> str:
    """And best effort gets the rest."""
    with scene() as s:
        a, hog = s.spinner("a"), s.spinner("hog")
        loader = s.loader(table(A), {"A": [a]})
        start = loader.arm()
        wait(RUN_MS)
        end = time.monotonic_ns()
        failure = loader.ask("failure")
        ran, others = cut(a.windows(), start, end), cut(hog.windows(), start, end)
    assert failure is None
    slots = slots_between(A.slots, CYCLE, 0, start, end)
    assert overlap(others, slots) < length(slots) / 100, "best effort ran inside the slots"
    assert length(others) > 0.9 * (end - start - length(slots)), "best effort was starved"
    return _exact(ran, slots)


def a_thread_alone_on_its_core_keeps_its_slots() -> str:
    """Nothing else is there that the core could turn to."""
    with scene() as s:
        a = s.spinner("a")
        loader = s.loader(table(A), {"A": [a]})
        start = loader.arm()
        wait(RUN_MS)
        end = time.monotonic_ns()
        ran = cut(a.windows(), start, end)
    return _exact(ran, slots_between(A.slots, CYCLE, 0, start, end))


def a_worse_server_gets_nothing_while_a_better_one_has_work() -> str:
    """A server that has [5, 25) beside that of the job."""
    return _a_job_goes_first(table(A, server("low", 5, 25, priority=2)), ("A", 0), ("low", 0), 5)


def of_a_servers_threads_the_one_in_the_first_place_runs_whenever_it_wants_to() -> str:
    """Both are in the server [10, 25)."""
    both = replace(server("both", 10, 25), places=2)
    return _a_job_goes_first(table(both), ("both", 0), ("both", 1), 10)


def _a_job_goes_first(
    servers: ServerTable, home: tuple[str, int], rivals: tuple[str, int], from_ms: int
) -> str:
    """A job of 4 ms, released at 12 ms, over a rival that may run from ``from_ms`` to 25 ms."""
    with scene() as s:
        job = s.spinner("job", job=(0, CYCLE, 12 * MS, 4 * MS))
        rival, hog = s.spinner("rival"), s.spinner("hog")
        loader = s.loader(servers)
        loader.ask("assign", job.tid, *home)
        loader.ask("assign", rival.tid, *rivals)
        start = loader.arm()
        wait(RUN_MS)
        end = time.monotonic_ns()
        counted = loader.ask("counters")[rivals[0]]
        jobs, others = cut(job.windows(), start, end), cut(rival.windows(), start, end)
        best_effort = cut(hog.windows(), start, end)
    pending = slots_between(((12 * MS, 16 * MS),), CYCLE, 0, start, end)[1:-1]
    used = overlap(jobs, pending)
    # A wake-up may come 50 us late: the kernel's timer slack for threads that are not real-time.
    assert used > 0.97 * length(pending), f"jobs got {used} of {length(pending)} ns"
    taken = overlap(others, [(a + MS // 10, b - MS // 10) for a, b in pending])
    assert taken == 0, f"the rival took {taken} ns"
    left = ((from_ms * MS, 12 * MS), (17 * MS, 25 * MS))
    rest = slots_between(left, CYCLE, 0, start, end)[2:-2]
    assert overlap(others, rest) > 0.99 * length(rest), "the rival did not get the rest"
    both = slots_between(((from_ms * MS, 25 * MS),), CYCLE, 0, start, end)[1:-1]
    assert overlap(best_effort, both) < length(both) / 200
    assert abs(counted["overruns"] - counted["slots"]) <= 1, "the rival never has enough"
    return f"{len(pending)} jobs, {used / len(pending) / MS:.2f} of 4 ms at once, rival 0"


def threads_of_one_place_take_turns() -> str:
    """Three of them, in 20 ms per cycle."""
    with scene() as s:
        threads = [s.spinner(f"t{i}") for i in range(3)]
        s.spinner("hog")
        loader = s.loader(table(server("R", 10, 30)), {"R": threads})
        start = loader.arm() + 2 * CYCLE  # by then, all are in their queue
        wait(1500)
        end = time.monotonic_ns()
        runs = [cut(t.windows(), start, end) for t in threads]
    slots = slots_between(((10 * MS, 30 * MS),), CYCLE, 0, start, end)
    shares = [overlap(run, slots) / length(slots) for run in runs]
    longest = max(b - a for run in runs for a, b in run)
    outside = sum(length(run) for run in runs) - sum(overlap(run, slots) for run in runs)
    text = ", ".join(f"{share:.1%}" for share in shares)
    assert all(abs(share - 1 / 3) < 0.02 for share in shares), text
    assert longest < 2.2 * MS, f"a turn took {longest} ns"
    assert outside < length(slots) / 1000, f"{outside} ns outside"
    return f"shares {text}, longest turn {longest / MS:.2f} ms"


def moving_the_cycles_lets_nobody_slip_between() -> str:
    """Seven new anchors while a thread wants to run all the time."""
    anchors = [0, 17, 3, 31, 46, 9, 24]
    with scene() as s:
        a = s.spinner("a")
        s.spinner("hog")
        loader = s.loader(table(A), {"A": [a]})
        since = []
        for anchor in anchors:
            since.append(loader.arm(anchor * MS))
            wait(173)
        end = time.monotonic_ns()
        ran = cut(a.windows(), since[0], end)
        kept = loader.ask("counters")["A"]
    allowed: Intervals = []
    for anchor, start, until in zip(anchors, since, [*since[1:], end], strict=True):
        allowed += slots_between(A.slots, CYCLE, anchor * MS, start, until)
    used, outside = overlap(ran, allowed), length(ran) - overlap(ran, allowed)
    assert used > 0.995 * length(allowed), f"used {used} of {length(allowed)} ns"
    assert outside < 10_000, f"{outside} ns outside over {len(anchors) - 1} changes"
    assert kept["late_entries"] == 0, kept
    return f"{len(anchors) - 1} changes, {outside / 1e3:.1f} us outside in {len(allowed)} slots"


def a_thread_assigned_while_running_is_governed_at_once() -> str:
    """It runs outside the slot, or waits behind another, when it is assigned."""
    leaks = []
    for waiting in (False, True):
        with scene() as s:
            a = s.spinner("a")
            if waiting:
                s.spinner("hog")
            loader = s.loader(table(A))
            loader.arm()
            wait_for_phase(30)
            loader.ask("assign", a.tid, "A")
            assigned = time.monotonic_ns()
            wait(300)
            end = time.monotonic_ns()
            ran = cut(a.windows(), assigned, end)
        slots = slots_between(A.slots, CYCLE, 0, assigned, end)
        leaks.append(length(ran) - overlap(ran, slots))
        assert leaks[-1] < 100_000, f"{leaks[-1]} ns outside after the assignment"
        assert overlap(ran, slots) > 0.9 * length(slots)
    return f"ran on for {leaks[0] / 1e3:.1f} us; {leaks[1] / 1e3:.1f} us when it was waiting"


def a_gate_publishes_exactly_in_a_server_that_opens_before_its_slot() -> str:
    """R_m and R_m° of a plan (paper, section 3.2.2): the chain computes until 12 ms of its slot
    [0, 25), a message comes at 15; the gate's slot starts at 25, its server opens at 20.
    """
    chain, output = server("chain", 0, 25, priority=2), server("output", 20, 30)
    with scene() as s:
        gate = s.spinner("gate", job=(CYCLE, 15 * MS, 25 * MS, MS), gate=True)
        computing, hog = s.spinner("chain", job=(0, CYCLE, 0, 12 * MS)), s.spinner("hog")
        loader = s.loader(table(chain, output), {"chain": [computing], "output": [gate]})
        start = loader.arm() + CYCLE
        wait(RUN_MS)
        end = time.monotonic_ns()
        counted = loader.ask("counters")
        published = [each for each in gate.windows() if start < each[0] < end]
        ran, others = cut(computing.windows(), start, end), cut(hog.windows(), start, end)
    lateness = [at - slot for slot, at in published]
    assert len(published) >= (end - start) // CYCLE - 1, f"{len(published)} messages left"
    assert all(slot % CYCLE == 25 * MS for slot, _ in published)
    assert max(lateness) < MS // 10, f"late by up to {max(lateness)} ns"
    assert overlap(ran, slots_between(((12 * MS + MS // 2, CYCLE),), CYCLE, 0, start, end)) == 0
    assert length(others) > 0.5 * (end - start), "best effort was starved"
    assert counted["chain"]["overruns"] == 0, counted
    worst = max(lateness) / 1e3
    return f"{len(published)} messages, {median(lateness) / 1e3:.1f} us late, at most {worst:.1f}"


def counters_tell_slots_and_overruns() -> str:
    """A thread that never has enough overruns each slot, one that is ready in time none."""
    with scene() as s:
        greedy = s.spinner("greedy")
        modest = s.spinner("modest", job=(0, CYCLE, 30 * MS, 2 * MS))
        servers = table(A, server("B", 30, 40), server("unused", 45, 48))
        loader = s.loader(servers, {"A": [greedy], "B": [modest]})
        loader.arm()
        before = loader.ask("counters")
        wait(1000)
        after = loader.ask("counters")
        loader.ask("release")
        kept = loader.ask("counters")
    slots = {name: after[name]["slots"] - before[name]["slots"] for name in after}
    overruns = {name: after[name]["overruns"] - before[name]["overruns"] for name in after}
    assert all(19 <= count <= 21 for count in slots.values()), slots
    assert abs(overruns["A"] - slots["A"]) <= 1, overruns
    assert overruns["B"] == overruns["unused"] == 0, overruns
    assert all(each["late_entries"] == 0 for each in after.values()), after
    assert all(kept[name]["slots"] >= after[name]["slots"] for name in after), kept
    worst = max(each["longest_lateness_ns"] for each in after.values())
    return f"slots {slots}, overruns {overruns}, longest lateness {worst / 1e3:.1f} us"


def a_real_time_thread_in_the_way_counts_as_a_late_entry() -> str:
    """FIFO from 9 to 13 ms of each cycle, over a slot that begins at 10."""
    with scene() as s:
        a = s.spinner("a")
        fifo = s.spinner("fifo", job=(0, CYCLE, 9 * MS, 4 * MS))
        os.sched_setscheduler(fifo.tid, os.SCHED_FIFO, os.sched_param(50))
        loader = s.loader(table(A), {"A": [a]})
        loader.arm()
        wait(1000)
        counted = loader.ask("counters")["A"]
        ran, taken = a.windows(), fifo.windows()
    late, slots = counted["late_entries"], counted["slots"]
    assert late >= slots - 2, counted
    assert 2.8 * MS < counted["longest_lateness_ns"] < 3.3 * MS, counted
    assert overlap(ran, taken) == 0
    return f"{late} of {slots} slots late, by {counted['longest_lateness_ns'] / MS:.2f} ms"


def a_stopped_loader_changes_nothing() -> str:
    """SIGSTOP: the slots are kept, because the kernel keeps them."""
    with scene() as s:
        a = s.spinner("a")
        s.spinner("hog")
        loader = s.loader(table(A), {"A": [a]})
        loader.arm()
        loader.process.send_signal(signal.SIGSTOP)
        start = time.monotonic_ns()
        wait(1000)
        end = time.monotonic_ns()
        ran = cut(a.windows(), start, end)
    return _exact(ran, slots_between(A.slots, CYCLE, 0, start, end))


def slots_follow_a_timer_that_drifts() -> str:
    """By `apply`, 300 ppm slow: 18 ms in a minute, where the job would fit 6 ms later in its slot.

    Its output is due where the slot ends that opens 2 ms after the timer.
    """
    period, work, due = CYCLE + 15_000, 4 * MS, 12 * MS
    job = (0, period, 0, work, "--ros-args", "-r", "__node:=sensor")
    late, said = [], list[str]()
    for follows in (1, 0):
        with scene() as s:
            sensor = s.spinner("sensor", job=job)
            applied, governed = s.applied(CYCLE, 10 * MS, follows), time.monotonic_ns()
            wait(60_000)
            end = time.monotonic_ns()
            applied.terminate()
            said.append(applied.communicate()[0].decode().strip())
            ran = cut(sensor.windows(), governed, end)
        expiries = range(governed + period - governed % period, end - CYCLE, period)
        late.append(sum(length(cut(ran, at, at + due)) < 0.97 * work for at in expiries))
    text = f"late of {len(expiries)}: {late[0]} ({said[0]}), not followed {late[1]} ({said[1]})"
    assert late[0] < len(expiries) / 200 < len(expiries) / 3 < late[1], text
    return text


def closed_servers_let_nobody_run_behind_their_slots() -> str:
    """By `apply`, `slot_ends: closed`: a callback that always overruns [12, 22) of 50 ms stops at
    22, and goes on at 62; with the servers that stay open it runs on (so the check would see it).
    """
    named = ("--ros-args", "-r")
    beyond = []
    for slot_ends in ("closed", "open-until-done"):
        with scene() as s:
            sensor = (0, CYCLE, 0, 4 * MS, *named, "__node:=sensor")
            s.spinner("sensor", job=sensor)
            endless = (0, CYCLE, 0, 3600_000 * MS, *named, "__node:=worker")
            worker, hog = s.spinner("worker", job=endless), s.spinner("hog")
            s.applied(CYCLE, 10 * MS, 0, slot_ends)
            start = time.monotonic_ns()
            wait(RUN_MS)
            end = time.monotonic_ns()
            ran, others = cut(worker.windows(), start, end), cut(hog.windows(), start, end)
        planned = (10 * MS + LEAD_NS, 20 * MS + LEAD_NS)
        slots = slots_between((planned,), CYCLE, 0, start, end)
        beyond.append((length(ran) - overlap(ran, slots)) / length(slots))
        if slot_ends == "closed":
            text = _exact(ran, slots)
            assert length(others) > 0.5 * (end - start), "best effort was starved"
    assert beyond[1] > 1, f"left open, the server gave {beyond[1]:.1%} beyond its slots"
    return f"{text}; left open until done {beyond[1]:.0%} of the slots' time beyond them"


def two_cores_are_governed_independently() -> str:
    """What can be said without virtual time: each thread runs in its slots, mostly."""
    b = server("B", 25, 45, core=1)
    with scene() as s:
        threads = [s.spinner("a", core=-1), s.spinner("b", core=-1)]
        hogs = [s.spinner("hog0", core=0), s.spinner("hog1", core=1)]
        loader = s.loader(table(A, b), {"A": [threads[0]], "B": [threads[1]]})
        start = loader.arm()
        wait(RUN_MS)
        end = time.monotonic_ns()
        assert scheduler_state() == "enabled", loader.ask("failure")
        assert loader.ask("failure") is None
        runs = [cut(t.windows(), start, end) for t in threads]
        others = [cut(t.windows(), start, end) for t in hogs]
    told = []
    for run, other, slots in zip(runs, others, (A.slots, b.slots), strict=True):
        allowed = slots_between(slots, CYCLE, 0, start, end)
        inside, taken = overlap(run, allowed), overlap(other, allowed)
        outside = (length(run) - inside) / length(run)
        used, hog = inside / length(allowed), taken / length(allowed)
        # What the host leaves to a core shows in what best effort gets when no slot is open.
        elsewhere = (length(other) - taken) / (end - start - length(allowed))
        told.append(f"used {used:.0%}, hog {hog:.0%} (else {elsewhere:.0%}), outside {outside:.1%}")
        assert inside > 3 * taken, "; ".join(told)
        assert outside < 0.2, "; ".join(told)
        assert used > 0.5 * elsewhere, "; ".join(told)
    return "; ".join(told)


VIRTUAL_TIME = (
    a_thread_keeps_its_slots_beside_best_effort,
    a_thread_alone_on_its_core_keeps_its_slots,
    a_worse_server_gets_nothing_while_a_better_one_has_work,
    of_a_servers_threads_the_one_in_the_first_place_runs_whenever_it_wants_to,
    threads_of_one_place_take_turns,
    moving_the_cycles_lets_nobody_slip_between,
    a_thread_assigned_while_running_is_governed_at_once,
    a_gate_publishes_exactly_in_a_server_that_opens_before_its_slot,
    counters_tell_slots_and_overruns,
    a_real_time_thread_in_the_way_counts_as_a_late_entry,
    a_stopped_loader_changes_nothing,
    killing_the_loader_frees_the_threads,
    releasing_twice_leaves_nothing_behind,
    a_second_instance_is_refused,
    without_privileges_the_missing_capabilities_are_named,
    threads_that_cannot_be_governed_are_refused,
    a_thread_without_a_slot_for_half_a_minute_ends_the_policy,
    slots_follow_a_timer_that_drifts,
    closed_servers_let_nobody_run_behind_their_slots,
)
REAL_TIME_KERNEL = (
    a_kicker_that_is_killed_or_stopped_fails_open,
    the_policy_notices_a_stopped_kicker_by_itself,
)
TWO_CORES = (two_cores_are_governed_independently, killing_the_loader_disables_the_scheduler)
