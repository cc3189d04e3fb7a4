"""The executor on real DDS topics of a closed domain, and asynchronous publication."""

import os
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from calm_runs import calm_run
from frozen_thread import freezing_publisher_of, need_threaded_cgroups
from hypothesis import given
from hypothesis import strategies as st
from known import known
from processes import children_of, wait_for
from small_chain import EXECUTOR_CORE, PERIOD_NS, small_chain

from chainshaper.flow.plan import plan_recording
from chainshaper.planning import PlanRequest
from chainshaper.planning.chain_plan import SENDS_PER_SLOT, SHORTEST_SLOT_NS
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import measure_latency
from chainshaper.workload import dds
from chainshaper.workload.description import Application
from chainshaper.workload.event_log import LAYOUT, WIDTH, EventLog
from chainshaper.workload.executor import (
    AsynchronousWriter,
    NodeExecutor,
    SubscriptionEntity,
    Synchroniser,
    Timer,
    start_publisher_thread,
)
from chainshaper.workload.live import run_application

pytestmark = pytest.mark.timed

MS = 1_000_000


@given(st.integers(0, 10**6), st.integers(1, 10**4), st.integers(0, 10**6))
def test_whatever_a_timer_missed_its_next_expiry_is_the_first_one_left(
    due: int, period: int, late: int
) -> None:
    timer = Timer(handle=1, period_ns=period, callback=lambda: None, due_ns=due)
    timer.call(due + late)
    assert (timer.due_ns - due) % period == 0, "the phase"
    assert timer.due_ns > due
    assert timer.due_ns >= due + late, "not in the past"
    assert timer.due_ns - (due + late) <= period, "none skipped that can still be met"


@dataclass
class Bench:
    """An executor with its participant, and a diary of what ran."""

    participant: Any
    log: EventLog
    executor: NodeExecutor
    diary: list[str] = field(default_factory=list)
    handles: int = 0

    def topic(self, name: str, depth: int = 10) -> tuple[dds.Publisher, dds.Subscription]:
        subscription = dds.Subscription(self.participant, name, "reliable", depth)
        publisher = dds.Publisher(self.participant, name, "reliable", depth)
        deadline = time.monotonic() + 10
        while not (publisher.matched() and subscription.matched()):
            assert time.monotonic() < deadline, f"{name}: writer and reader did not meet"
            time.sleep(0.001)
        return publisher, subscription

    def subscribe(
        self,
        name: str,
        depth: int = 10,
        then: Callable[[], None] = lambda: None,
        group: str | None = None,
    ) -> dds.Publisher:
        """A subscription that writes its name into the diary; the publisher of its topic."""
        publisher, subscription = self.topic(f"/{name}", depth)

        def callback(message: dds.Message) -> None:
            self.diary.append(name)
            then()

        self.handles += 2
        self.executor.add_subscription(
            SubscriptionEntity(self.handles, self.handles + 1, subscription, callback, group)
        )
        return publisher

    def timer(
        self, name: str, due_ns: int, period_ns: int, then: Callable[[], None] = lambda: None
    ) -> Timer:
        def callback() -> None:
            self.diary.append(name)
            then()

        self.handles += 2
        timer = Timer(self.handles, period_ns, callback, due_ns)
        self.executor.timers.append(timer)
        return timer

    def spin(self, for_ns: int = 30 * MS) -> None:
        now = time.monotonic_ns()
        self.executor.spin_until(now + for_ns, now + for_ns)

    def recorded(self, entry: str) -> list[list[int]]:
        """What was recorded under a name: time, then its fields."""
        number = list(LAYOUT).index(entry)
        rows = memoryview(self.log.rows).cast("q").tolist()
        all_rows = [rows[i : i + WIDTH] for i in range(0, len(rows), WIDTH)]
        return [[row[1], *row[3:]] for row in all_rows if row[0] == number]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setenv("CYCLONEDDS_URI", dds.closed_domain_configuration())
    log = EventLog()
    participant = dds.Participant(dds.free_domain())
    return Bench(participant, log, NodeExecutor(participant, log))


def _send(*publishers: dds.Publisher) -> None:
    for publisher in publishers:
        publisher.write(dds.data_message(bytes(8), 1), time.time_ns())


@pytest.mark.parametrize(
    ("groups", "beside"),
    [(("a", "b"), True), ((None, None), True), (("a", "a"), False)],
    ids=["two groups", "reentrant", "one group"],
)
def test_threads_run_callbacks_beside_each_other_unless_they_are_in_one_group(
    bench: Bench, groups: tuple[str | None, str | None], beside: bool
) -> None:
    """Both wait for each other, in vain if one begins when the other has ended."""
    bench.executor = NodeExecutor(bench.participant, bench.log, threads=2)
    meeting = threading.Barrier(2)
    met, running, most = [], [0], [0]

    def meet() -> None:
        running[0] += 1
        most[0] = max(most[0], running[0])
        try:
            meeting.wait(timeout=0.2 if not beside else 10)
            met.append(threading.get_native_id())
        except threading.BrokenBarrierError:
            meeting.reset()
        running[0] -= 1

    names = ("first", "second")
    publishers = [
        bench.subscribe(name, then=meet, group=group)
        for name, group in zip(names, groups, strict=True)
    ]
    _send(*publishers)
    bench.spin(800 * MS)
    assert (len(set(met)), most[0]) == ((2, 2) if beside else (0, 1))
    assert sorted(bench.diary) == ["first", "second"]
    assert len(bench.recorded("rclcpp_executor_wait_for_work")) < 20, "it spun while one was busy"


def test_timers_run_before_subscriptions_each_in_order_of_registration(bench: Bench) -> None:
    second = bench.subscribe("subscription1")
    bench.timer("timer1", due_ns=time.monotonic_ns(), period_ns=10_000 * MS)
    first = bench.subscribe("subscription2")
    bench.timer("timer2", due_ns=time.monotonic_ns() - 5 * MS, period_ns=10_000 * MS)
    _send(first, second)  # neither the order of arrival nor of expiry decides
    bench.spin()
    assert bench.diary == ["timer1", "timer2", "subscription1", "subscription2"]


def test_what_becomes_ready_meanwhile_waits_for_the_next_snapshot(bench: Bench) -> None:
    """Each runs at most once in one. `late` is registered between two others."""
    timer = bench.timer("timer", due_ns=time.monotonic_ns() + 3600_000 * MS, period_ns=10_000 * MS)

    def begin() -> None:
        _send(late)
        timer.due_ns = time.monotonic_ns()

    early, late = bench.subscribe("early", then=begin), bench.subscribe("late")
    last = bench.subscribe("last")
    _send(early, last, last, last)
    bench.spin()
    assert bench.diary == ["early", "last", "timer", "late", "last", "last"]


def test_a_timer_that_missed_periods_fires_once(bench: Bench) -> None:
    start = time.monotonic_ns()
    instants: list[int] = []

    def body() -> None:
        instants.append(time.monotonic_ns())
        if len(instants) == 1:
            time.sleep(0.045)  # over the expiries at 10, 20, 30 and 40 ms

    timer = bench.timer("timer", due_ns=start, period_ns=10 * MS, then=body)
    bench.executor.spin_until(start + 100 * MS, start + 95 * MS)
    assert len(instants) <= 7, "missed expiries were made up for"
    assert (timer.due_ns - start) % (10 * MS) == 0
    assert all(instant >= start for instant in instants)
    assert timer.due_ns > start + 95 * MS


def test_no_timer_expires_after_the_last_moment_but_messages_are_still_taken(bench: Bench) -> None:
    now = time.monotonic_ns()
    publisher = bench.subscribe("subscription")
    bench.timer("timer", due_ns=now + 20 * MS, period_ns=10 * MS, then=lambda: _send(publisher))
    bench.executor.spin_until(now + 80 * MS, last_timer_ns=now + 25 * MS)
    assert bench.diary == ["timer", "subscription"]


def test_an_idle_executor_waits_until_the_end_and_not_less(bench: Bench) -> None:
    stop = time.monotonic_ns() + 20 * MS
    bench.executor.spin_until(stop, stop)
    assert time.monotonic_ns() >= stop
    assert len(bench.recorded("rclcpp_executor_wait_for_work")) < 10, "it spun instead of waiting"


def test_a_slow_reader_has_the_last_messages_of_its_depth_byte_for_byte(bench: Bench) -> None:
    publisher, subscription = bench.topic("/numbers", depth=2)
    payloads = [dds.data_message(bytes([number] * 1000), number) for number in range(6)]
    for number, payload in enumerate(payloads):
        publisher.write(payload, source_timestamp=1000 + number)
    for number in (4, 5):
        message = known(subscription.take())
        assert message.source_timestamp == 1000 + number
        assert message.payload[4:] == payloads[number][4:], "behind the encapsulation header"
    assert subscription.take() is None
    assert not subscription.ready()


def test_takes_are_recorded_with_the_source_timestamp(bench: Bench) -> None:
    publisher = bench.subscribe("one")
    publisher.write(dds.data_message(bytes(8), 5), source_timestamp=123_456_789)
    bench.spin()
    (entity,) = bench.executor.subscriptions
    (take,), (execute,) = bench.recorded("take"), bench.recorded("execute")
    assert (take[1], take[3], take[4]) == (entity.rmw_handle, 123_456_789, 1)
    assert execute[1] == entity.handle


def test_a_set_is_the_oldest_message_of_every_input() -> None:
    synchroniser = Synchroniser[str]([2, 2])
    assert [synchroniser.add(0, message) for message in ("a1", "a2", "a3")] == [(), (), ()]
    assert synchroniser.add(1, "b1") == ("a2", "b1")  # the history had no place for a1
    assert synchroniser.add(1, "b2") == ("a3", "b2")
    assert synchroniser.add(1, "b3") == ()


def test_a_triggered_set_is_the_newest_message_of_the_other_inputs() -> None:
    synchroniser = Synchroniser[str]([2, 2], trigger=1)
    assert synchroniser.add(1, "b1") == ()  # without another one it is gone
    assert [synchroniser.add(0, message) for message in ("a1", "a2", "a3")] == [(), (), ()]
    assert synchroniser.add(1, "b2") == ("a3", "b2")
    assert synchroniser.add(1, "b3") == ("a3", "b3"), "the newest is kept"


SLOT = (22 * MS, 32 * MS)  # behind the longest latency of the small chain


class Wire:
    """What a writer gave to DDS, and what it noted."""

    def __init__(self, depth: int, lifespan_ns: int | None = None) -> None:
        self.sent: list[bytes] = []
        self.noted: list[tuple[int, str]] = []
        self.writer = AsynchronousWriter(
            write=lambda payload, _: self.sent.append(payload),
            depth=depth,
            lifespan_ns=lifespan_ns,
            note=lambda _, stamp, outcome, __: self.noted.append((stamp, outcome)),
            to_send=queue.SimpleQueue(),
        )


def test_a_message_older_than_its_lifespan_is_not_sent() -> None:
    wire = Wire(depth=10, lifespan_ns=1_000_000_000)
    now = time.time_ns()
    wire.writer.publish(b"old", now - 2_000_000_000)
    wire.writer.publish(b"new", now)
    wire.writer.send_next()
    wire.writer.send_next()
    assert wire.sent == [b"new"]
    assert wire.noted == [(now - 2_000_000_000, "expired"), (now, "sent")]


@given(st.integers(1, 5), st.lists(st.booleans(), max_size=40))
def test_every_message_has_one_outcome_and_order_is_kept(depth: int, steps: list[bool]) -> None:
    """Publishing (true) and sending (false) in any order."""
    wire = Wire(depth)
    published = 0
    for publishes in [*steps, *[False] * depth]:
        if publishes:
            published += 1
            wire.writer.publish(bytes([published]), published)
        else:
            wire.writer.send_next()
    assert sorted(stamp for stamp, _ in wire.noted) == list(range(1, published + 1))
    assert wire.sent == sorted(wire.sent)
    overwritten = sum(outcome == "overwritten" for _, outcome in wire.noted)
    assert len(wire.sent) == published - overwritten
    kept = [stamp for stamp, outcome in wire.noted if outcome == "sent"]
    assert kept[-depth:] == list(range(1, published + 1))[-depth:], "the last ones stay"


def test_one_thread_sends_for_all_writers() -> None:
    senders: set[int] = set()
    sent: list[tuple[bytes, int]] = []

    def write(payload: bytes, source_timestamp: int) -> None:
        senders.add(threading.get_native_id())
        sent.append((payload, source_timestamp))

    own = (write, 10, None, lambda *_: None, start_publisher_thread())
    writers = {name: AsynchronousWriter(*own) for name in (b"a", b"b")}
    expected = [(name, number) for number in range(3) for name in writers]
    for name, number in expected:
        writers[name].publish(name, number)
    wait_for(lambda: len(sent) == 6, "six messages")
    assert sent == expected
    assert len(senders) == 1
    assert threading.get_native_id() not in senders


def _asynchronous(folder: Path, **quality: object) -> Application:
    application = small_chain(folder, publication="asynchronous")
    topic = application.topic("/t3").model_copy(update=quality)
    return application.model_copy(update={"topics": {"/t3": topic}})


def _outcomes(recording: Recording) -> dict[str, int]:
    return dict(recording.events["asynchronous_send"]["outcome"].value_counts().iter_rows())


def test_the_publication_is_when_the_message_was_sent_not_handed_over(tmp_path: Path) -> None:
    application = _asynchronous(tmp_path)
    recording = calm_run(
        lambda place: run_application(application, place / "rec", cycles=12), tmp_path
    )
    (publisher,) = (thread for thread in recording.info.threads if thread.role == "publisher")
    assert (publisher.node, publisher.comm) == ("/third", "dds.asyn.0.1")
    assert publisher.cores == (EXECUTOR_CORE,)
    if recording.info.realtime:
        assert (publisher.policy, publisher.priority) == ("SCHED_FIFO", 79), "below its executor"
    events = recording.events
    sends = events["asynchronous_send"]
    analysis = measure_latency(recording).analysis
    assert analysis.incomplete == {}
    assert analysis.traversals["end"].to_list() == sends["time"].to_list()
    handed_over = events["rmw_publish"].join(
        sends, on=["pid", "rmw_publisher_handle", "timestamp"], suffix="_sent"
    )
    assert handed_over.height == sends.height
    assert (handed_over["tid"] == handed_over["pid"]).all(), "the executor hands over"
    assert (handed_over["tid_sent"] != handed_over["pid"]).all(), "another thread sends"
    assert (handed_over["time"] <= handed_over["time_sent"]).all()

    longest_ns = int(sends["duration"].max())  # type: ignore[arg-type]
    # No more room than that: a chain that the machine has made long has to fit, too.
    shortest_ns = max(SHORTEST_SLOT_NS, SENDS_PER_SLOT * longest_ns)
    request = PlanRequest(publication="asynchronous", publish_slot_ns=shortest_ns)
    plan = plan_recording(recording, request=request).chains[0]
    assert plan.chain.output_depth == 10
    assert plan.evidence.longest_send_ns in sends["duration"].to_list()
    assert plan_recording(recording).chains[0].evidence.longest_send_ns is None, (
        "nobody's thread is gated"
    )


@pytest.mark.parametrize(
    ("quality", "outcome", "longest_periods"),
    [
        ({"depth": 3}, "overwritten", 3),  # the newest stay
        ({"depth": 20, "lifespan_ns": 2 * PERIOD_NS}, "expired", 4),
    ],
)
def test_a_publisher_that_is_stopped_for_long_loses_messages_and_the_executor_goes_on(
    tmp_path: Path,
    quality: dict[str, object],
    outcome: str,
    longest_periods: int,
) -> None:
    """The thread runs in every tenth cycle only."""
    need_threaded_cgroups()
    gating = freezing_publisher_of("/third", SLOT, 10 * PERIOD_NS)
    application = _asynchronous(tmp_path, **quality)
    recording = run_application(application, tmp_path / "rec", cycles=20, enforcement=gating)
    analysis = measure_latency(recording).analysis
    outcomes = _outcomes(recording)
    assert set(outcomes) == {"sent", outcome}
    assert outcomes["sent"] < outcomes[outcome]
    # Messages of the warm-up, which is not recorded, have an outcome, too.
    assert 0 < analysis.incomplete["discarded"] <= outcomes[outcome]
    assert analysis.traversals.height == 20, "the executor went on"
    latencies = analysis.traversals.filter("complete")["latency_ns"]
    assert (latencies < longest_periods * PERIOD_NS).all()


def test_a_run_that_is_given_up_while_a_thread_is_frozen_leaves_nothing(tmp_path: Path) -> None:
    group = need_threaded_cgroups()

    def give_up(share: float, what: str) -> None:
        if what == "recording":
            raise OperationError("enough")

    gating = freezing_publisher_of("/third", SLOT, 10 * PERIOD_NS)
    children = children_of(os.getpid())
    with pytest.raises(OperationError, match="enough"):
        run_application(
            _asynchronous(tmp_path), tmp_path / "rec", enforcement=gating, progress=give_up
        )
    assert children_of(os.getpid()) == children
    assert list(group.glob("frozen-test-*")) == []
    assert not (tmp_path / "rec").exists()
