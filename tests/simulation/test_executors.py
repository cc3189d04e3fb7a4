"""ROS 2's executors: snapshots, orders, and when messages are taken, worked out by hand."""

from pathlib import Path
from typing import Any

import pytest
from schedules import application, simulated

from chainshaper.analysis import data_flow
from chainshaper.values.recording import Recording

BUSY = """
chain: source
nodes:
  source:
    core: 2
    callbacks: [{timer: 100ms, execution: {constant: 1ms}, publishes: [/a, /b, /a2]}]
  again:
    core: 3
    callbacks: [{timer: 100ms, phase: 4ms, publishes: [/c]}]
  node:
    callbacks:
      - {subscription: /b, execution: {constant: 1ms}}
      - {subscription: /c, execution: {constant: 1ms}}
      - {subscription: /a, execution: {constant: 1ms}}
      - {timer: 100ms, execution: {constant: 2ms}}
"""


def order(recording: Recording, node: str = "/node") -> list[str]:
    """What a node executed, by topic (or `timer`), in order."""
    flow = data_flow(recording.events)
    names = flow.objects.callbacks.select("callback_id", "node", "topic").unique()
    named = flow.instances.join(names, on="callback_id").sort("start", "instance")
    return [
        (topic or "timer").strip("/")
        for owner, topic in named.select("node", "topic").iter_rows()
        if owner == node
    ]


def test_a_snapshot_runs_timers_first_then_subscriptions_as_registered(tmp_path: Path) -> None:
    """While the timer runs, /b and /a arrive; while they run, /c does and has to wait for both."""
    text = BUSY.replace("phase: 4ms", "phase: 2500us")
    assert order(simulated(tmp_path, application(text))) == ["timer", "b", "a", "c"]


def test_services_and_clients_come_behind_subscriptions(tmp_path: Path) -> None:
    text = BUSY.replace("{subscription: /b,", "{subscription: /b, kind: client,")
    text = text.replace("{subscription: /c,", "{subscription: /c, kind: service,")
    text = text.replace("phase: 4ms", "phase: 1ms")
    assert order(simulated(tmp_path, application(text))) == ["timer", "a", "c", "b"]


@pytest.mark.parametrize(
    ("executor", "expected"),
    [
        # /b and /a are ready at 1 ms; /c at 1.2 and the timer at 1.5 ms have to wait for both.
        ("single-threaded", ["b", "a", "timer", "c"]),
        # A wait set of its own for each: at 2 ms /c, which was registered before /a, then /a, and
        # the timer behind all subscriptions.
        ("static", ["b", "c", "a", "timer"]),
    ],
)
def test_the_static_executor_looks_anew_each_time_and_at_subscriptions_first(
    tmp_path: Path, executor: str, expected: list[str]
) -> None:
    text = BUSY.replace("phase: 4ms", "phase: 1200us")
    text = text.replace(
        "{timer: 100ms, execution: {constant: 2ms}}", "{timer: 100ms, phase: 1500us}"
    )
    assert order(simulated(tmp_path, application(text, executor=executor))) == expected


def test_the_events_executor_follows_the_order_in_which_things_happened(tmp_path: Path) -> None:
    text = BUSY.replace("publishes: [/a, /b, /a2]", "publishes: [/a2, /a, /b]")
    text = text.replace("phase: 4ms", "phase: 500us")
    described = application(text, executor="events")
    assert order(simulated(tmp_path, described)) == ["timer", "c", "a", "b"]


@pytest.mark.parametrize(
    ("executor", "times"),
    [("single-threaded", [0, 35, 40, 50]), ("events", [0, 35, 36, 37, 40, 50])],
)
def test_missed_expiries_are_skipped_or_executed_one_by_one(
    tmp_path: Path, executor: str, times: list[float]
) -> None:
    described = application(
        """
        chain: node
        nodes:
          node:
            callbacks:
              - {timer: 10ms, execution: {constant: 1ms}}
              - {timer: 100ms, phase: 51ms, execution: {constant: 34ms}}
        """,
        executor=executor,
    )
    recording = simulated(tmp_path, described, cycles=6)
    flow = data_flow(recording.events)
    timers = flow.objects.callbacks.filter(period_ns=10_000_000)["callback_id"]
    own = flow.instances.filter(flow.instances["callback_id"].is_in(timers.implode()))
    begin = 1_050_000_000
    assert [(start - begin) / 1e6 for start in own["start"]] == times


def test_a_subscription_is_executed_once_per_snapshot_however_many_messages_wait(
    tmp_path: Path,
) -> None:
    described = application(
        """
        chain: source
        nodes:
          source: {core: 2, callbacks: [{timer: 100ms, publishes: [/a, /a, /b]}]}
          node:
            callbacks:
              - {subscription: /a, execution: {constant: 1ms}}
              - {subscription: /b, execution: {constant: 1ms}}
        """
    )
    assert order(simulated(tmp_path, described)) == ["a", "b", "a"]


def test_a_message_is_taken_when_its_callback_is_about_to_run(tmp_path: Path) -> None:
    """With a history of one, what arrives before the take overwrites what the snapshot saw."""
    described = application(
        """
        chain: source
        topics: {/a: {depth: 1}}
        nodes:
          source:
            core: 2
            callbacks:
              - {timer: 100ms, publishes: [/a, /b]}
              - {timer: 100ms, phase: 1ms, publishes: [/a]}
          node:
            callbacks:
              - {subscription: /b, execution: {constant: 2ms}}
              - {subscription: /a}
        """
    )
    recording = simulated(tmp_path, described)
    taken = recording.events["rmw_take"].filter(taken=1)
    stamps = [(at - 1_500_000_000) / 1e6 for at in taken["source_timestamp"]]
    assert stamps == [0, 1]  # /b of 0 ms, then /a of 1 ms: that of 0 ms is gone


def test_costs_of_waking_taking_and_publishing_are_the_threads_own(tmp_path: Path) -> None:
    costs: dict[str, Any] = {
        "wake_up": {"constant": "1ms"},
        "take": {"constant": "2ms"},
        "publish": {"constant": "4ms"},
        "delivery": {"constant": "10ms"},
    }
    described = application(
        """
        chain: /a../b
        nodes:
          one: {callbacks: [{timer: 100ms, execution: {constant: 20ms}, publishes: [/a]}]}
          two: {callbacks: [{subscription: /a, execution: {constant: 20ms}, publishes: [/b]}]}
        """,
        **costs,
    )
    recording = simulated(tmp_path, described)
    begin = 1_500_000_000
    starts = [(time - begin) / 1e6 for time in recording.events["callback_start"]["time"]]
    published = [(time - begin) / 1e6 for time in recording.events["rmw_publish"]["time"]]
    # one: wakes 0–1, computes to 21, publishes, ends at 25. The message is there at 31;
    # two: wakes to 32, takes to 34, computes to 54.
    assert starts == [1, 34]
    assert published == [21, 54]
    used = recording.events["callback_end"]["thread_time"] // 1_000_000
    assert list(used) == [6 * 25, 6 * 27]  # the sixth cycle: five warmed up
