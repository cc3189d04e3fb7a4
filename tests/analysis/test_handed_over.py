"""What the user declares that no event shows: `--through /f=/cmd`."""

import json
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import called, json_of, refused
from loop_story import LOOP, PID, first_sleep, loop_behind, turn
from story import OFFSET, Story

from chainshaper.analysis import DataFlow, analyse_latency, data_flow, graph_of
from chainshaper.monitor.budgets import Budget, ChainBudget, check_budget, load_budget
from chainshaper.monitor.watch import Watch
from chainshaper.planning.plan_file import load_plan
from chainshaper.sources import open_source
from chainshaper.values.errors import InputError
from chainshaper.values.handed_over import parse_through
from chainshaper.values.recording import Recording, RecordingInfo, write_recording
from chainshaper.verify.slowdowns import slowdowns_in


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


def regular(path: Path, late: int = 0, count: int = 60) -> Path:
    """A recording of cycles of 100 ms, whose /cmd comes 35 ms behind the beginning, or later."""
    cycles = range(1000, 1000 + 100 * count, 100)
    story = hidden(tuple(cycles), tuple(at + 30 + late for at in cycles), 1_000_000)
    return write_recording(
        path, story.tables(), RecordingInfo(source="lttng", clock_offset_ns=OFFSET)
    ).path


def test_a_budget_keeps_what_was_declared(tmp_path: Path) -> None:
    path, slower = regular(tmp_path / "regular"), regular(tmp_path / "slower", late=20)
    words, budget = ("--chain", "/a../cmd", "--through", "a=/cmd"), tmp_path / "limits.yaml"
    assert called("budget", path, *words, "-o", budget).code == 0
    limits = load_budget(budget)
    assert limits.through == ("/a=/cmd",)
    assert limits.chains[0].maximum_ns == 38_500_000, "35 ms, and a tenth more"
    assert called("check", path, "--budget", budget).code == 0
    broken = called("check", slower, "--budget", budget, "--json")
    texts = [limit["text"] for limit in json.loads(broken.out)["limits"] if not limit["met"]]
    assert broken.code == 1 and "/a../cmd: maximum 55 ms, budget 38.5 ms" in texts[0]
    undeclared = tmp_path / "undeclared.yaml"
    undeclared.write_text(budget.read_text().replace("through: [/a=/cmd]\n", ""))
    missing = called("check", path, "--budget", undeclared)
    assert missing.code == 1 and "no path leads" in " ".join(missing.out.split())
    declared = ("check", path, "--budget", undeclared, "--through", "/a=/cmd")
    assert called(*declared).code == 0


def test_a_declaration_in_a_budget_that_is_none_names_its_line(tmp_path: Path) -> None:
    budget = tmp_path / "limits.yaml"
    budget.write_text("format: 1\nthrough: [/a]\nchains: [{chain: /a../cmd, maximum: 1ms}]\n")
    said = refused(2, "check", regular(tmp_path / "regular"), "--budget", budget)
    assert "limits.yaml:2" in said and "with = between them" in " ".join(said.split())


def test_a_declaration_that_cannot_be_in_a_recording_breaks_its_own_chain_alone(
    tmp_path: Path,
) -> None:
    recording = open_source(regular(tmp_path / "regular"))
    limits = Budget(
        through=("/other=/cmd",),
        chains=(
            ChainBudget(chain="/a../debug", maximum_ns=100_000_000),
            ChainBudget(chain="/a../cmd", maximum_ns=100_000_000),
        ),
    )
    found, missing = check_budget(recording, limits)
    assert found.met and not missing.met
    assert "no path leads" in missing.text and "reads /other" in missing.text


def test_a_comparison_with_a_baseline_takes_it(tmp_path: Path) -> None:
    paths = [regular(tmp_path / "before")], [regular(tmp_path / "after")]
    for through, is_missing in ((("/a=/cmd",), False), ((), True), (("/x=/cmd",), True)):
        _, notes = slowdowns_in(*paths, ["/a../cmd"], through=through)
        assert any("/a../cmd is not in" in note for note in notes) == is_missing
        assert any("no node of the recording reads /x" in note for note in notes) == (
            through == ("/x=/cmd",)
        )


@pytest.mark.parametrize(
    ("through", "problem"),
    [
        (("/a=/cmd",), None),
        ((), "no path leads"),
        (("/x=/cmd",), "no node of the recording reads /x"),
    ],
)
def test_a_watch_takes_it(
    monkeypatch: pytest.MonkeyPatch, through: tuple[str, ...], problem: str | None
) -> None:
    """Three cycles of four, by hand; the message of the second one was not used."""
    now = time.monotonic_ns() - 10_000
    sent, acted = (tuple(now + at for at in of_callback) for of_callback in (SENT, ACTED))
    tables = hidden(sent, acted).tables()
    watch = Watch(["/a../cmd"], users=(), longest_ns=1, through=parse_through(through))
    monkeypatch.setattr(watch, "read", lambda: None)
    monkeypatch.setattr(watch, "_tables", lambda _: tables)
    monkeypatch.setattr(watch, "processes", {10: SimpleNamespace(pid=10, lost=0, dropped=0)})
    monkeypatch.setattr(watch, "_ended", lambda: [])
    watch._over_ns = 0
    (chain,) = watch.look().chains
    if problem is None:
        assert chain.problem is None
        assert (chain.counted["complete"], chain.counted["not_used"]) == (3, 1)
        assert chain.spans["hour"].max_ns == 35
    else:
        assert problem in str(chain.problem)


def test_a_plan_has_it_and_whoever_takes_the_plan(tmp_path: Path) -> None:
    """Without it `compare` would not find the chain that the plan names."""
    path, planned = regular(tmp_path / "regular"), tmp_path / "plan.yaml"
    words = ("--chain", "/a../cmd", "--through", "/a=/cmd")
    assert called("plan", path, *words, "-o", planned).code == 0
    assert load_plan(planned).chains[0].chain.through == ("/a=/cmd",)
    again = regular(tmp_path / "again")
    assert called("compare", path, again, "--plan", planned).code in (0, 1)
    measured = json_of("compare", path, again, "--plan", planned)
    assert measured["chain"] == "/a../cmd"
    watch = Watch(["/a../cmd"], users=(), plan=load_plan(planned))
    assert watch.through == (("/a", "/cmd"),)


def test_an_output_that_is_shaped_is_what_its_publisher_was_to_publish(tmp_path: Path) -> None:
    """The actor publishes /cmd/unshaped now, and a gate /cmd: the declaration still names /cmd."""
    story = Story()
    node = story.node("/sensor", 10)
    timer, sensor = story.timer(node, 100), story.publisher(node, "/a")
    filtering, actor = story.node("/filter", PID), story.node("/actor", PID)
    reader, debug = story.subscription(filtering, "/a"), story.publisher(filtering, "/debug")
    acting, cmd = story.timer(actor, 100), story.publisher(actor, "/cmd/unshaped")
    shaping = story.node("/shaping", 30)
    gate, shaped = story.subscription(shaping, "/cmd/unshaped"), story.publisher(shaping, "/cmd")
    for at in (1000, 1100, 1200):
        story.runs(timer, at, at + 2, writes=((sensor, at + 1),))
        story.runs(reader, at + 10, at + 12, reads=at + 1, writes=((debug, at + 11),), tid=21)
        story.runs(acting, at + 30, at + 38, writes=((cmd, at + 35),), tid=LOOP)
        story.runs(gate, at + 40, at + 62, reads=at + 35, writes=((shaped, at + 60),))
        gated = {"callback": gate.handle, "source_timestamp": at + 35 + OFFSET, "arrival": at + 40}
        gated |= {"origin": at, "release": at + 60, "slot": 0, "cycles_waited": 0}
        story.event("gate_release", at + 60, 30, **gated, anchor="stamp")
    assert latencies(flow_of(story, "/a=/cmd"), "/a../cmd") == [60, 60, 60]
    path = tmp_path / "shaped"
    write_recording(
        path,
        story.tables(),
        RecordingInfo(source="lttng", clock_offset_ns=OFFSET, chain="/a../cmd"),
    )
    assert json_of("latency", path, "--through", "/a=/cmd")["max_ns"] == 60
