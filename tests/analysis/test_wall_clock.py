"""Humble's takes while the wall clock moves: every link that is made is right."""

from pathlib import Path

import pytest
from ctf_writing import write_lttng_trace
from humble_story import MS, WALL, HumbleRun, Wall, humble_run, slewed, stepped

from chainshaper import open_source
from chainshaper.analysis import analyse_latency, data_flow


def links(run: HumbleRun, offset: int = WALL) -> tuple[int, int, int]:
    """Messages that were linked rightly, wrongly, and not at all though they could be."""
    flow = data_flow(run.tables, offset)
    sent = flow.publications["time"].gather(flow.takes["publication"])
    right = wrong = missed = 0
    for topic, stamp, time in zip(
        flow.takes["topic"], flow.takes["source_timestamp"], sent, strict=True
    ):
        truth = run.truth.get((str(topic), stamp))
        right += time is not None and time == truth
        wrong += time is not None and time != truth
        missed += time is None and truth is not None
    return right, wrong, missed


MOVES = {
    "forward": stepped((1100, 120)),
    "backward": stepped((1100, -120)),
    "a little backward": stepped((1100, -5)),
    "a little forward": stepped((1100, 5)),
    "by less than a transport": stepped((1100, -0.3)),
    "by its period": stepped((1100, -50)),
    "by two periods forward": stepped((1100, 100)),
    "by an hour": stepped((1100, 3_600_000)),
    "back by an hour": stepped((1100, -3_600_000)),
    "several times": stepped((400, -35), (700, 120), (760, -3), (1100, -300), (1650, 7)),
    "there and back": stepped((600, 500), (1200, -500)),
    "before the first message": stepped((50, -777)),
    "adjtime": slewed(300, 2000, -0.0005),
    "adjtime forward": slewed(300, 2000, 0.0005),
    "chrony": slewed(300, 1500, -0.08),
    "chrony forward": slewed(300, 1500, 0.08),
    "not at all": stepped(),
}


@pytest.mark.parametrize("wall", MOVES.values(), ids=MOVES)
@pytest.mark.parametrize("seed", range(3))
def test_a_clock_that_is_moved_does_not_mislead(wall: Wall, seed: int) -> None:
    assert links(humble_run(wall, seed=seed)) == (80, 0, 0)


@pytest.mark.parametrize("by", [120, -120, -5])
@pytest.mark.parametrize("at", [1101.3, 1102, 1105, 1111, 1113.4])
def test_messages_may_be_in_flight_when_it_is(by: int, at: float) -> None:
    """Messages need from 5 to 12 ms; the clock steps within a cycle, also behind a publication."""
    for seed in range(3):
        run = humble_run(stepped((at, by)), communication_ns=(5 * MS, 12 * MS), seed=seed)  # type: ignore[arg-type]
        right, wrong, missed = links(run)
        assert wrong == 0
        assert missed <= 1
        assert right == 80 - missed


@pytest.mark.parametrize("by", [120, -120, -5, -50, 0])
def test_publications_whose_events_were_lost_have_no_take(by: int) -> None:
    """One right at the step, one far from it, and several in a row."""
    run = humble_run(stepped((1100, by)), lost=frozenset({5, 20, 30, 31, 32}))
    right, wrong, missed = links(run)
    assert (right + missed, wrong) == (75, 0)
    assert missed <= 2


@pytest.mark.parametrize("by", [-50, -100, 100, 50])
def test_a_perfectly_regular_topic_that_steps_by_its_period(by: int) -> None:
    run = humble_run(stepped((1100, by)), jitter_ns=0)
    right, wrong, missed = links(run)
    assert (wrong, right + missed) == (0, 80)
    assert missed <= 2


def test_a_message_between_two_steps_is_left_out() -> None:
    """Of one message alone no distance of the clocks can be known."""
    for seed in range(3):
        run = humble_run(stepped((700, 120), (705, -3)), seed=seed)
        assert links(run) == (79, 0, 1)


def test_an_offset_that_was_never_right_is_found() -> None:
    assert links(humble_run(stepped()), WALL + 250 * MS) == (80, 0, 0)
    assert links(humble_run(stepped()), WALL - 20 * MS) == (80, 0, 0)


@pytest.mark.parametrize("by", [120, -120, -5])
def test_a_trace_of_a_clock_that_stepped_has_the_right_latencies(tmp_path: Path, by: int) -> None:
    """The very latencies of the same run without a step, from a trace as LTTng writes it."""
    spans = []
    for number, wall in enumerate((stepped(), stepped((1100, by)))):
        run = humble_run(wall)
        folder = write_lttng_trace(tmp_path / str(number), run.tables, clock_offset_ns=WALL)
        found = analyse_latency(open_source(folder), "/image../objects")
        assert found.statistics.count == 40
        assert sum("wall clock was moved" in note for note in found.notes) == number
        spans.append(found.traversals.select("start", "end", "reception_ns").rows())
    assert spans[0] == spans[1]
