"""Verbs that take a chain to the hardware: to `write()` of a controller manager (ros2_control)."""

from pathlib import Path

import pytest
from command_line import called, json_of, refused
from loop_story import LOOP, NANOSLEEP, PID
from story import OFFSET, Story

from chainshaper.values.event_declarations import MANAGER_FUNCTIONS
from chainshaper.values.recording import RecordingInfo, write_recording

MS = 1_000_000
MANAGER = 0x77
CHAIN = "/scan../cm:write"
CYCLES = 60


def manager_turn(story: Story, at: int) -> None:
    """read(), update() and write() take 1 ms each; the thread then sleeps until its next turn."""
    for place, name in enumerate(("read", "update", "write")):
        began, ended = at + place * MS, at + (place + 1) * MS
        about = {"manager": MANAGER, "function": MANAGER_FUNCTIONS.index(name), "began": began}
        times = {"thread_time_began": began, "thread_time": ended}
        story.event("controller_manager_call", ended, PID, LOOP, **about, **times)
    until = at + 10 * MS
    about = {"call": NANOSLEEP, "thread_time": at + 3 * MS}
    story.event("thread_sleep", at + 3 * MS, PID, LOOP, until=until, **about)
    story.event("thread_wake", until, PID, LOOP, **about)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sensor every 20 ms sends at 0.5 ms, a filter stores at 1.5 to 2.5 ms, sending at 1 to 2;
    the manager has a turn every 10 ms from 7 ms on: it calls update() at 8.
    """
    story = Story()
    timer, sensor = story.source("/sensor", PID + 1, "/scan", period=20 * MS)
    taker, filtered = story.relay("/filter", PID + 2, "/scan", "/a")
    story.node("/cm", PID)
    reader = story.subscription(story.node("/forward", PID), "/a")
    story.event("controller_manager_found", 1, PID, LOOP, manager=MANAGER, name="/cm")
    for cycle in range(1, CYCLES):
        at = cycle * 20 * MS
        took = (cycle % 3) * MS // 2
        sent, stored = at + MS // 2, at + MS + took
        story.runs(timer, at, at + MS // 2 + 1, writes=((sensor, sent),))
        story.runs(taker, at + MS // 2 + 2, stored + 1, reads=sent, writes=((filtered, stored),))
        story.runs(reader, stored + MS // 2, stored + MS // 2 + 10, reads=stored, tid=LOOP + 1)
        for turn in (7, 17):
            manager_turn(story, at + turn * MS)
    info = RecordingInfo(source="preload", clock_offset_ns=OFFSET)
    folder = tmp_path_factory.mktemp("manager") / "recording"
    return write_recording(folder, story.tables(), info).path


def test_the_reaction_is_the_first_write_with_the_message(recording: Path) -> None:
    measured = json_of("latency", recording, "--chain", CHAIN)
    assert (measured["min_ns"], measured["max_ns"]) == (10 * MS, 10 * MS)
    assert measured["data_age"]["messages"]["again"] == CYCLES - 1


def test_a_chain_to_write_is_planned_as_one_to_the_end_of_a_loop(recording: Path) -> None:
    planned = json_of("plan", recording, "--chain", CHAIN, "--epsilon", "1ms")
    loop = planned["loop"]
    assert (planned["chain"]["output"], loop["chain"]) == ("/a", CHAIN)
    assert (loop["node"], loop["topic"], loop["period_ns"]) == ("/cm", "/a", 10 * MS)
    assert loop["age"]["uses"] == [2, 2]
    in_step = json_of("plan", recording, "--chain", CHAIN, "--epsilon", "1ms", "--in-step")
    assert in_step["loop"]["in_step"] == "output"


def test_a_manager_is_described_as_a_loop_and_has_limits(recording: Path, tmp_path: Path) -> None:
    described, budget = tmp_path / "described.yaml", tmp_path / "budget.yaml"
    done = called("describe", recording, "--chain", CHAIN, "-o", described)
    assert done.code == 0, done.err
    assert "loop: 10ms" in described.read_text()
    done = called("budget", recording, "--chain", CHAIN, "-o", budget)
    assert done.code == 0, done.err
    limits_of_loops = budget.read_text().partition("loops:")[2]
    assert "node: /cm" in limits_of_loops
    assert ":write" not in limits_of_loops, "that it writes is no topic of the loop"
    assert called("check", recording, "--budget", budget).code == 0


def test_a_node_without_a_controller_manager_has_no_write(recording: Path) -> None:
    said = refused(2, "latency", recording, "--chain", "/scan../forward:write")
    assert "/forward is no controller manager" in said
