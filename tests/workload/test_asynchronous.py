"""Asynchronous publication: the history, and the one thread that sends, gated or not."""

import os
import queue
import threading
import time
from pathlib import Path

import pytest
from calm_runs import calm_run
from frozen_thread import freezing_publisher_of, need_threaded_cgroups
from hypothesis import given
from hypothesis import strategies as st
from processes import children_of, wait_for
from small_chain import EXECUTOR_CORE, PERIOD_NS, small_chain

from chainshaper.flow.plan import plan_recording
from chainshaper.planning import PlanRequest
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import measure_latency
from chainshaper.workload.description import Application
from chainshaper.workload.executor import AsynchronousWriter, start_publisher_thread
from chainshaper.workload.live import run_application

MS = 1_000_000
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

    request = PlanRequest(publication="asynchronous", publish_slot_ns=10 * MS)
    plan = plan_recording(recording, request=request)
    assert plan.chain.output_depth == 10
    assert plan.evidence.longest_send_ns in sends["duration"].to_list()
    assert plan_recording(recording).evidence.longest_send_ns is None, "nobody's thread is gated"


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
