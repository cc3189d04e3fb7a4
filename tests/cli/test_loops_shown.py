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


def command_for(verb: str, folder: Path) -> tuple[str, ...]:
    """A command that a verb starts; `shape` takes launch files alone."""
    (folder / "a.launch.py").write_text("")
    return ("ros2", "launch", str(folder / "a.launch.py")) if verb == "shape" else ("true",)


@pytest.mark.parametrize("source", ["ebpf", "lttng"])
@pytest.mark.parametrize("verb", ["record", "profile", "shape"])
def test_a_loop_is_named_for_the_library_in_front_only(
    tmp_path: Path, verb: str, source: str
) -> None:
    words = (verb, "-o", tmp_path / "r", "--source", source, "--loop", "/a", "--")
    said = refused(2, *words, *command_for(verb, tmp_path))
    assert f"--source {source} does not see how threads sleep" in said
    assert "leave out --loop" in said


@pytest.mark.parametrize("verb", ["record", "profile", "shape", "watch"])
def test_a_name_that_no_loop_can_have_is_refused_before_anything_starts(
    tmp_path: Path, verb: str
) -> None:
    command = command_for(verb, tmp_path)
    output = () if verb == "watch" else ("-o", tmp_path / "r")
    for name, reason in (("/a b", "names no loop"), ("a_name_of_18_bytes", "no thread")):
        assert reason in refused(2, verb, *output, "--loop", name, "--", *command)


def test_verbs_that_name_no_loops_say_where_they_are_named(recording: Path) -> None:
    for verb in ("latency", "callbacks", "plan"):
        said = refused(2, verb, recording, "--loop", "/actor")
        assert "loops are named where their sleeps are recorded" in said


def test_a_described_application_has_its_loops_in_its_description(tmp_path: Path) -> None:
    app, plan = tmp_path / "app.yaml", tmp_path / "plan.yaml"
    assert called("init", "-o", app).code == 0
    latencies = tmp_path / "latencies"
    latencies.write_text("10ms\n11ms\n12ms\n" * 20)
    planned = called("plan", "--latencies", latencies, "--period", "100ms", "-o", plan)
    assert planned.code == 0, planned.err
    said = refused(2, "shape", app, plan, "-o", tmp_path / "r", "--loop", "/actor")
    assert "those of its description" in said and "leave out --loop" in said


def test_an_end_that_is_not_there_says_how_to_get_it(recording: Path) -> None:
    for verb in ("latency", "plan", "describe"):
        output = ("-o", recording.parent / "described.yaml") if verb == "describe" else ()
        said = refused(2, verb, recording, "--chain", "/a../actor:end", *output)
        assert "/actor has no loop that was named" in said
        assert "chainshaper record --loop /actor" in said
        assert "end the chain with what its loop publishes: /cmd" in said
    said = refused(2, "latency", recording, "--chain", "/a../aktor:end")
    assert "no node is called /aktor" in said and "/actor" in said


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
