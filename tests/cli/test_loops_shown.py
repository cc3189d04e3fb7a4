"""Verbs that show a loop that is no callback, and chains that end in one."""

from pathlib import Path

import pytest
from command_line import called, json_of, refused
from loop_story import loop_behind
from story import OFFSET

from chainshaper.values.recording import RecordingInfo, write_recording

MS = 1_000_000


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A loop of 100 ms behind a sensor of 200 ms. Times are worked out in the tests of analysis."""
    inputs, wakes = tuple(range(0, 2000, 200)), tuple(range(100, 2100, 100))
    tables = loop_behind(inputs, wakes, unit=MS).tables()
    info = RecordingInfo(source="preload", clock_offset_ns=OFFSET)
    return write_recording(tmp_path_factory.mktemp("loop") / "recording", tables, info).path


def test_callbacks_show_a_loop_like_a_timer(recording: Path) -> None:
    (loop,) = (row for row in json_of("callbacks", recording) if row["kind"] == "loop")
    assert (loop["node"], loop["period_ns"], loop["count"]) == ("/actor", 100 * MS, 20)
    assert loop["response_ns"] == {"min": 50 * MS, "mean": 50 * MS, "max": 50 * MS}
    assert loop["execution_ns"]["mean"] == 30 * MS
    assert (loop["phase_ns"], loop["start_jitter_ns"], loop["overruns"]) == (0, 0, 0)
    text = called("callbacks", recording).out
    assert "loop every 100ms" in text and "overruns" in text


def test_graph_shows_a_loop_and_what_goes_through_it(recording: Path, tmp_path: Path) -> None:
    callbacks = json_of("graph", recording)["callbacks"]
    (loop,) = (callback for callback in callbacks if callback["kind"] == "loop")
    assert loop["publishes"] == ["/cmd"]
    (reader,) = (callback for callback in callbacks if callback["topic"] == "/a")
    assert reader["passes_on"] == ["/cmd"]
    assert "loop 100ms" in called("graph", recording).out
    picture = tmp_path / "graph.svg"
    assert called("graph", recording, "-o", picture).code == 0
    assert "loop 100ms" in picture.read_text()


def test_latency_has_a_cycle_for_each_message_and_an_age_for_each_turn(recording: Path) -> None:
    measured = json_of("latency", recording, "--chain", "/a../cmd", "--instances")
    assert (measured["count"], measured["min_ns"], measured["max_ns"]) == (10, 130 * MS, 130 * MS)
    age = measured["data_age"]
    assert (age["cycles"], age["topic"]) == (20, "/cmd")
    assert (age["at_loop"]["min_ns"], age["at_loop"]["max_ns"]) == (100 * MS, 200 * MS)
    assert (age["at_end"]["min_ns"], age["at_end"]["max_ns"]) == (130 * MS, 230 * MS)
    assert age["messages"] == {"never": 0, "once": 0, "again": 10, "most_uses": 2}
    uses = [cycle["use"] for cycle in measured["loop_cycles"]]
    assert uses == [1, 2] * 10
    text = " ".join(called("latency", recording, "--chain", "/a../cmd").out.split())
    assert "Age of the data of /actor loop every 100ms" in text
    assert "in several cycles: 10, up to 2 times" in text


def test_the_report_has_the_age_of_the_loops_data(recording: Path, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    assert called("report", recording, "--chain", "/a../cmd", "-o", page).code == 0
    assert "Age of the data" in page.read_text()


@pytest.mark.parametrize("source", ["ebpf", "lttng"])
def test_a_loop_is_named_for_the_library_in_front_only(tmp_path: Path, source: str) -> None:
    words = ("record", "-o", tmp_path / "r", "--source", source, "--loop", "/a", "--", "true")
    assert "leave out --loop" in refused(2, *words)


def test_plan_states_the_age_at_the_loop_and_puts_the_slot_before_it(
    recording: Path, tmp_path: Path
) -> None:
    """The sensor sends 1 ms behind its start; 9 to 11 ms later it is stored."""
    chain = (recording, "--chain", "/a../cmd", "--epsilon", "1ms")
    planned = json_of("plan", *chain)
    loop = planned["loop"]
    assert (planned["chain"]["spec"], loop["chain"]) == ("/a", "/a../cmd")
    assert (loop["node"], loop["topic"], loop["period_ns"]) == ("/actor", "/a", 100 * MS)
    assert loop["delivery_ns"] == [9 * MS, 11 * MS, 11 * MS]
    assert loop["age"]["first_ns"] == [100 * MS, 100 * MS]
    assert (loop["age"]["constant"], loop["age"]["uses"]) == (True, [2, 2])
    assert any("--in-step puts the slot" in warning for warning in planned["warnings"])
    text = called("plan", *chain).out
    assert "loop of /actor, every 100 ms" in text
    output = tmp_path / "plan.yaml"
    in_step = json_of("plan", *chain, "--in-step", "-o", output)
    # The lead is 11 ms and a quarter of that.
    assert in_step["servers"][1]["slots"] == [[86_250_000, 87_250_000]]
    assert "in_step: output" in output.read_text()
    moved = json_of("plan", *chain, "--move-loop")
    assert moved["servers"][1]["slots"] == [[2 * MS, 3 * MS]]
    assert moved["loop"]["move_ns"] == 15_750_000  # from 0 to 2 + 13.75 ms, modulo 100
    assert moved["loop"]["age"]["first_ns"] == [15_750_000, 15_750_000]
    assert "give one of the two" in refused(2, "plan", *chain, "--in-step", "--move-loop")
    without = refused(2, "plan", recording, "--chain", "/a", "--in-step")
    assert "goes through no loop" in without
