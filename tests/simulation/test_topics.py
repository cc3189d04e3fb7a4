"""Topics: histories, lifespans, order, DDS threads, asynchronous publication, synchronisation."""

from pathlib import Path

import numpy as np
import pytest
from schedules import application, callbacks, simulated

from chainshaper.values import events
from chainshaper.values.recording import Recording

BEGIN = 1_500_000_000  # the sixth period of 100 ms


def taken(recording: Recording) -> list[float]:
    """When the messages that were taken had been published (ms)."""
    table = events.table(recording.events, "rmw_take").filter(taken=1)
    return [(stamp - BEGIN) / 1e6 for stamp in table["source_timestamp"]]


@pytest.mark.parametrize(("depth", "expected"), [(10, [0, 1, 2, 3]), (2, [0, 2, 3])])
def test_a_history_keeps_the_newest_messages(
    tmp_path: Path, depth: int, expected: list[float]
) -> None:
    described = application(
        f"""
        chain: source
        topics: {{/a: {{depth: {depth}}}}}
        nodes:
          source:
            core: 2
            callbacks:
              - {{timer: 100ms, publishes: [/a]}}
              - {{timer: 100ms, phase: 1ms, publishes: [/a]}}
              - {{timer: 100ms, phase: 2ms, publishes: [/a]}}
              - {{timer: 100ms, phase: 3ms, publishes: [/a]}}
          node: {{callbacks: [{{subscription: /a, execution: {{constant: 10ms}}}}]}}
        """
    )
    assert taken(simulated(tmp_path, described)) == expected


def test_a_message_that_waited_for_longer_than_its_lifespan_is_gone(tmp_path: Path) -> None:
    described = application(
        """
        chain: source
        topics: {/a: {lifespan: 9ms}}
        nodes:
          source:
            core: 2
            callbacks:
              - {timer: 100ms, publishes: [/a]}
              - {timer: 100ms, phase: 500us, publishes: [/a]}
              - {timer: 100ms, phase: 1ms, publishes: [/a]}
          node: {callbacks: [{subscription: /a, execution: {constant: 10ms}}]}
        """
    )
    # The first runs from 0 to 10 ms; then the second is 9.5 ms old, and the third exactly 9.
    assert taken(simulated(tmp_path, described)) == [0, 1]


def test_messages_of_one_publisher_do_not_overtake_each_other(tmp_path: Path) -> None:
    described = application(
        """
        chain: source
        nodes:
          source: {core: 2, callbacks: [{timer: 10ms, publishes: [/a]}]}
          node: {callbacks: [{subscription: /a}]}
        """,
        delivery={"uniform": ["0ms", "35ms"]},
    )
    recording = simulated(tmp_path, described, cycles=500)
    stamps = recording.events["rmw_take"]["source_timestamp"].to_numpy()
    delays = (recording.events["rmw_take"]["time"].to_numpy() - stamps) / 1e6
    assert (np.diff(stamps) > 0).all()
    assert delays.max() <= 35
    assert len(np.unique(recording.events["rmw_take"]["time"].to_numpy())) < len(stamps)  # queued


def test_a_dds_thread_works_for_a_message_before_its_subscriber_sees_it(tmp_path: Path) -> None:
    described = application(
        """
        chain: source
        nodes:
          source: {core: 2, callbacks: [{timer: 100ms, publishes: [/a, /b]}]}
          one: {callbacks: [{subscription: /a}]}
          two: {callbacks: [{subscription: /b}]}
        """,
        receive={"constant": "3ms"},
    )
    # Both DDS threads share core 0.
    assert callbacks(simulated(tmp_path, described)) == [
        ("source", 0, 0),
        ("one", 3, 3),
        ("two", 6, 6),
    ]


ASYNCHRONOUS = """
chain: node../a
topics: {/a: {publication: asynchronous, depth: 2}}
nodes:
  node:
    callbacks:
      - {timer: 100ms, execution: {constant: 5ms}, publishes: [/a]}
      - {timer: 100ms, phase: 1ms, execution: {constant: 5ms}}
  reader: {core: 2, callbacks: [{subscription: /a}]}
"""


def test_a_publisher_thread_sends_when_the_executor_leaves_it_the_core(tmp_path: Path) -> None:
    """It ranks one below: handed over at 5 ms, the message leaves behind the next callback."""
    recording = simulated(tmp_path, application(ASYNCHRONOUS, publish={"constant": "1ms"}))
    sends = recording.events["asynchronous_send"]
    handed_over = recording.events["rmw_publish"]["time"]
    assert (handed_over[0] - BEGIN) / 1e6 == 5
    assert (sends["time"][0] - BEGIN) / 1e6 == 11  # 5 + 1 handing over + 5
    assert sends["outcome"].to_list() == ["sent"]
    assert sends["duration"].to_list() == [1_000_000]
    assert sends["timestamp"][0] == handed_over[0]
    assert taken(recording) == [5]


def test_a_writers_history_overwrites_what_its_thread_could_not_send(tmp_path: Path) -> None:
    """From 105 ms on a hog of the publisher thread's priority runs for 30 ms, up to 143 ms.

    Meanwhile the executor hands over /a at 110, 120, 130 and 140, and /b a millisecond later. Of
    /a the writer keeps two, which move up to the places of those that are gone.
    """
    described = application(
        """
        chain: node../a
        topics: {/a: {publication: asynchronous, depth: 2}, /b: {publication: asynchronous}}
        nodes:
          node: {callbacks: [{timer: 10ms, publishes: [/a, /b]}]}
          hog:
            priority: 79
            callbacks: [{timer: 100ms, phase: 5ms, execution: {constant: 30ms}}]
          reader: {core: 2, callbacks: [{subscription: /a}, {subscription: /b}]}
        """,
        publish={"constant": "1ms"},
    )
    recording = simulated(tmp_path, described, cycles=10)
    table = recording.events["asynchronous_send"]
    sends = [
        (round((time - 1_100_000_000) / 1e6), round((stamp - 1_100_000_000) / 1e6), outcome)
        for time, stamp, outcome in table.select("time", "timestamp", "outcome").iter_rows()
        if 1_110_000_000 <= time < 1_149_000_000
    ]
    assert sends == [
        (30, 10, "overwritten"),
        (40, 20, "overwritten"),
        (43, 30, "sent"),
        (44, 11, "sent"),
        (45, 40, "sent"),
        (46, 21, "sent"),
        (47, 31, "sent"),
        (48, 41, "sent"),
    ]


def test_what_waited_longer_than_its_lifespan_is_not_sent(tmp_path: Path) -> None:
    text = ASYNCHRONOUS.replace("depth: 2", "lifespan: 4ms")
    recording = simulated(tmp_path, application(text, publish={"constant": "1ms"}))
    assert recording.events["asynchronous_send"]["outcome"].to_list() == ["expired"]
    assert taken(recording) == []


def test_a_synchronising_callback_runs_when_its_set_is_complete(tmp_path: Path) -> None:
    described = application(
        """
        chain: front../fused
        nodes:
          front: {core: 2, callbacks: [{timer: 100ms, publishes: [/front]}]}
          rear: {core: 3, callbacks: [{timer: 100ms, phase: 7ms, publishes: [/rear]}]}
          fusion:
            callbacks:
              - {synchronises: [/front, /rear], execution: {constant: 2ms}, publishes: [/fused]}
          sink: {core: 2, callbacks: [{subscription: /fused}]}
        """
    )
    recording = simulated(tmp_path, described)
    assert callbacks(recording) == [
        ("front", 0, 0),
        ("fusion", 0, 0),  # leaves its message
        ("rear", 7, 7),
        ("fusion", 7, 9),
        ("sink", 9, 9),
    ]


def test_a_synchroniser_pairs_the_oldest_messages_and_forgets_what_no_history_keeps(
    tmp_path: Path,
) -> None:
    described = application(
        """
        chain: rear../fused
        topics: {/front: {depth: 2}}
        nodes:
          front:
            core: 2
            callbacks:
              - {timer: 100ms, publishes: [/front]}
              - {timer: 100ms, phase: 1ms, publishes: [/front]}
              - {timer: 100ms, phase: 2ms, publishes: [/front]}
          rear: {core: 3, callbacks: [{timer: 100ms, phase: 7ms, publishes: [/rear]}]}
          fusion:
            callbacks: [{synchronises: [/front, /rear], publishes: [/fused]}]
          gate:
            callbacks:
              - {subscription: /fused, publishes: [/o], gate: {slots: [[50ms, 60ms]], cycle: 100ms}}
        """
    )
    recording = simulated(tmp_path, described)
    # The stamp is that of the front message of 1 ms: the first was forgotten when the third came.
    # (The one of 2 ms, left over, is older than those of the next cycle: it is first there.)
    origins = {(origin - BEGIN) / 1e6 for origin in recording.events["gate_release"]["origin"]}
    assert origins <= {1.0, 2.0 - 100}
