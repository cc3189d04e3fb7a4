"""Messages that wait in a gate for longer than a cycle: which output is whose, worked by hand.

A message is sent at 1 behind the beginning of each cycle of 20, and leaves at 51 of it. So while
one waits, two more come.
"""

import pytest
from story import OFFSET, Callback, Publisher, Story

from chainshaper.analysis import analyse_latency, data_flow

GATE = 30


def chain(count: int) -> tuple[Story, Callback, Publisher]:
    story = Story()
    timer, sensor = story.source("/sensor", 10, "/scan_tmp", 20)
    gate, shaped = story.relay("/shaping", GATE, "/scan_tmp", "/scan")
    for number in range(count):
        at = 1000 + 20 * number
        story.runs(timer, at, at + 2, writes=((sensor, at + 1),))
    return story, gate, shaped


def sent(number: int) -> int:
    return 1001 + 20 * number


def log(story: Story, gate: Callback, numbers: range) -> None:
    """What the gate has decided; a node in ROS 2 does not know its callback's handle."""
    for number in numbers:
        story.gate(gate, sent(number), sent(number) + 2, sent(number) + 49, callback=0, origin=0)


def latencies(story: Story) -> list[int | None]:
    flow = data_flow(story.tables(), OFFSET, complete=True)  # no event was lost
    return (
        analyse_latency(flow, "/scan_tmp../scan").traversals.sort("start")["latency_ns"].to_list()
    )


def let_go(story: Story, gate: Callback, shaped: Publisher, number: int, start: int) -> None:
    story.start(gate, start)
    story.publish(shaped, sent(number) + 50)
    story.end(gate, sent(number) + 51)


def test_a_message_that_was_taken_while_another_waited_has_its_own_output() -> None:
    """Each is taken once. The latest take before 1053 is that of the third message (1043), and the
    second one's output had counted as the third's, 31 behind its beginning.
    """
    story, gate, shaped = chain(4)
    for number in range(4):
        story.take(gate, sent(number) + 2, sent(number))
    starts = (1004, 1053, 1073, 1093)
    for number, start in enumerate(starts):
        let_go(story, gate, shaped, number, start)
    log(story, gate, range(4))
    assert latencies(story) == [51, 51, 51, 51]


def test_an_instance_that_only_queues_a_message_is_not_the_one_in_which_it_leaves() -> None:
    """The executor takes the third message at 1053, between the outputs of the first two."""
    story, gate, shaped = chain(3)
    story.take(gate, 1003, sent(0))
    story.take(gate, 1023, sent(1))
    let_go(story, gate, shaped, 0, 1004)
    story.take(gate, 1053, sent(2))
    story.start(gate, 1054)
    story.end(gate, 1055)
    story.take(gate, 1056, sent(1))  # again, so that a trace says whose the callback is
    let_go(story, gate, shaped, 1, 1057)
    story.take(gate, 1073, sent(2))
    let_go(story, gate, shaped, 2, 1074)
    log(story, gate, range(3))
    assert latencies(story) == [51, 51, 51]


@pytest.mark.parametrize("has_log", [True, False])
def test_a_gate_that_takes_each_message_again_is_followed_by_its_takes(has_log: bool) -> None:
    story, gate, shaped = chain(4)
    for number in range(4):
        story.take(gate, sent(number) + 2, sent(number))
    for number, start in enumerate((1004, 1054, 1074, 1094)):
        if number:
            story.take(gate, start - 1, sent(number))
        let_go(story, gate, shaped, number, start)
    if has_log:
        log(story, gate, range(4))
    assert latencies(story) == [51, 51, 51, 51]


def test_a_message_that_was_dropped_has_no_output() -> None:
    """The second one overflows while the first waits; the third leaves in the instance after it."""
    story, gate, shaped = chain(3)
    for number in range(3):
        story.take(gate, sent(number) + 2, sent(number))
    let_go(story, gate, shaped, 0, 1004)
    let_go(story, gate, shaped, 2, 1073)
    log(story, gate, range(0, 3, 2))
    story.gate(
        gate, sent(1), sent(1) + 2, None, callback=0, origin=0, slot=None, dropped="overflowed"
    )
    assert latencies(story) == [51, None, 51]


def test_a_log_that_does_not_fit_the_events_changes_nothing() -> None:
    """Two messages cannot have left in one instance: as where a log is of another run."""
    story, gate, shaped = chain(2)
    for number, start in enumerate((1004, 1054)):
        story.take(gate, start - 1, sent(number))
        let_go(story, gate, shaped, number, start)
    for number in range(2):
        story.gate(gate, sent(number), sent(number) + 2, 1100, callback=0, origin=0)
    assert latencies(story) == [51, 51]
