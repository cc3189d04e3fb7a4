"""What the user declares that no event shows: `--through /f=/cmd`."""

from dataclasses import replace
from pathlib import Path

import pytest
from command_line import called, json_of, refused
from loop_story import LOOP, PID, first_sleep, loop_behind, turn
from story import OFFSET, Story

from chainshaper.analysis import DataFlow, analyse_latency, data_flow, graph_of
from chainshaper.values.errors import InputError
from chainshaper.values.handed_over import parse_through
from chainshaper.values.recording import Recording, RecordingInfo, write_recording


def flow_of(story: Story, *through: str) -> DataFlow:
    return replace(data_flow(story.tables(), OFFSET), through=parse_through(through))


SENT, ACTED = (1000, 1040, 1100, 1200), (1030, 1130, 1210, 1230)


def hidden(sent: tuple[int, ...] = SENT, acted: tuple[int, ...] = ACTED, unit: int = 1) -> Story:
    """/sensor sends /a; /filter stores it and publishes /debug, and a timer of /actor, in the same
    process, publishes /cmd from it. Since /filter publishes, nothing shows that it stores as well.
    Times are in ``unit`` ns.
    """
    story = Story()
    node = story.node("/sensor", 10)
    timer, sensor = story.timer(node, 100 * unit), story.publisher(node, "/a")
    filtering, actor = story.node("/filter", PID), story.node("/actor", PID)
    reader, debug = story.subscription(filtering, "/a"), story.publisher(filtering, "/debug")
    acting, cmd = story.timer(actor, 100 * unit), story.publisher(actor, "/cmd")
    for at in sent:
        took, sends = (at + 10) * unit, (at + 1) * unit
        story.runs(timer, at * unit, (at + 2) * unit, writes=((sensor, sends),))
        writes = ((debug, took + unit),)
        story.runs(reader, took, took + 2 * unit, reads=sends, writes=writes, tid=21)
    for at in acted:
        acts = at * unit
        story.runs(acting, acts, acts + 8 * unit, writes=((cmd, acts + 5 * unit),), tid=LOOP)
    return story


def latencies(flow: DataFlow, chain: str) -> list[int | None]:
    return analyse_latency(flow, chain).traversals.sort("start")["latency_ns"].to_list()


def test_without_a_declaration_there_is_no_such_chain() -> None:
    with pytest.raises(InputError, match=r"no path leads from /a to /cmd"):
        analyse_latency(flow_of(hidden()), "/a../cmd")


def test_the_newest_message_before_the_publication_is_the_one_in_it() -> None:
    """By hand: 1000 goes into 1030's; 1040 and 1100 before 1130's, which has 1100; 1200 is read at
    1210, so 1210's instance has begun without it, as at the same instant, and 1230's has it.
    """
    flow = flow_of(hidden(), "/a=/cmd")
    assert latencies(flow, "/a../cmd") == [35, None, 35, 35]
    (_, reason, *_) = analyse_latency(flow, "/a../cmd").traversals.sort("start")["reason"]
    assert reason == "not used"


def test_a_loop_that_begins_with_data_of_another_node_is_followed_to_its_end() -> None:
    """Also an age of its data: a loop reads them."""
    story = loop_behind((1000, 1200), (1060, 1160, 1260))
    declared, plain = (flow_of(story, *through) for through in (("/a=/cmd",), ()))
    assert latencies(declared, "/a../cmd") == latencies(plain, "/a../cmd") != []
    age = analyse_latency(declared, "/a../cmd").data_age
    assert age is not None and age.cycles["age_at_end_ns"].to_list() == [90, 190, 90]


def test_it_may_end_with_a_loop_that_is_named() -> None:
    story = hidden()
    story.event("loop_named", 1, PID, LOOP + 1, name="/actor", is_thread=0)
    first_sleep(story, 1001, 1019, LOOP + 1)
    for woke in (1020, 1120, 1220):
        turn(story, woke, woke + 50, woke + 99, tid=LOOP + 1)
    flow = flow_of(story, "/a=/actor:end")
    assert latencies(flow, "/a../actor:end")[0] == 70


def test_graph_and_callbacks_that_it_says_nothing_of_stay_as_they_are() -> None:
    declared, plain = (graph_of(flow_of(hidden(), *t)) for t in (("/a=/cmd",), ()))
    changed = [d for d, p in zip(declared.callbacks, plain.callbacks, strict=True) if d != p]
    assert [(callback.node, callback.passes_on) for callback in changed] == [("/filter", ("/cmd",))]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("/a", "write the topic that is read and the one that is published"),
        ("/a=", "write the topic"),
        ("/a=/b=/c", "write the topic"),
        ("/a b=/c", "write the topic"),
        ("/a=a", "not handed over to itself"),
    ],
)
def test_what_is_no_pair_of_topics_is_refused(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse_through([text])


def test_a_slash_may_be_left_out_and_repeats_count_once() -> None:
    assert parse_through(["a=cmd", "/a=/cmd"]) == (("/a", "/cmd"),)


@pytest.mark.parametrize(
    ("through", "said"),
    [
        ("/ab=/cmd", r"no node of the recording reads /ab; did you mean /a\?"),
        ("/a=/cmds", r"no node of the recording publishes /cmds; did you mean .*/cmd"),
        ("/xyzzy=/cmd", r"no node of the recording reads /xyzzy"),
        ("/a=/debug", r"one callback does both"),
    ],
)
def test_what_cannot_be_says_what_to_do(through: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        graph_of(flow_of(hidden(), through))


def test_what_goes_from_process_to_process_is_a_message() -> None:
    story = hidden()
    far = story.node("/far", 30)
    timer, far_cmd = story.timer(far, 100), story.publisher(far, "/far_cmd")
    story.runs(timer, 1500, 1520, writes=((far_cmd, 1510),))
    with pytest.raises(InputError, match=r"/filter \(process 20\) reads /a, /far \(process 30\)"):
        graph_of(flow_of(story, "/a=/far_cmd"))


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    info = RecordingInfo(source="lttng", clock_offset_ns=OFFSET)
    return write_recording(tmp_path / "hidden", hidden().tables(), info)


def test_verbs_that_take_chains_take_it(recording: Recording, tmp_path: Path) -> None:
    words = (recording.path, "--chain", "/a../cmd", "--through", "/a=/cmd")
    measured = json_of("latency", *words, "--instances")
    found = [row["latency_ns"] for row in measured["instances"]]
    assert found == [35, 35, 35]
    page = tmp_path / "report.html"
    assert called("report", *words, "-o", page).code == 0
    assert page.exists()
    listed = json_of("chains", recording.path, "--through", "/a=/cmd")
    assert "/a../cmd" in {chain["chain"] for chain in listed["chains"]}


def test_a_plan_is_made_from_it(tmp_path: Path) -> None:
    cycles = range(1000, 4000, 100)
    story = hidden(tuple(cycles), tuple(at + 30 for at in cycles), 1_000_000)
    info = RecordingInfo(source="lttng", clock_offset_ns=OFFSET)
    path = write_recording(tmp_path / "regular", story.tables(), info).path
    planned = json_of("plan", path, "--chain", "/a../cmd", "--through", "/a=/cmd")
    assert planned["cycle_ns"] == 100_000_000
    assert planned["bands_ns"][0] > 35_000_000, "the slot lies behind the longest latency"
    assert "no path leads" in refused(2, "plan", path, "--chain", "/a../cmd")


def test_wrong_use_on_the_command_line(recording: Recording) -> None:
    for through, said in (("/b=/cmd", "no node of the recording reads /b"), ("/a", "with = ")):
        words = (recording.path, "--chain", "/a../cmd", "--through", through)
        assert said in " ".join(refused(2, "latency", *words).split())
