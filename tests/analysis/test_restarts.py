"""Nodes that were started again, and nodes of one name at once, with answers worked by hand.

    /camera (process 100) → /image → /detector → /objects → /sink (process 300)

every 50 ms. The camera publishes 1 ms after its start, 0.5 ms later the detector starts; its
instance k publishes k·0.1 ms + 3.5 ms after that.
"""

import json
from pathlib import Path

import pytest
import yaml
from command_line import called
from ctf_writing import write_lttng_trace
from reference_traces import DATA
from story import OFFSET, Story

from chainshaper.analysis import analyse_latency, data_flow, find_chain, graph_of
from chainshaper.analysis.chains import SeveralPathsError
from chainshaper.values.errors import InputError
from chainshaper.values.recording import RecordingInfo, write_recording

MS = 1_000_000
CHAIN = "/image../objects"


def respawned(*deaths: int, cycles: int = 20) -> Story:
    """The detector dies in the cycles ``deaths``, and is back in the next."""
    story = Story()
    camera, image = story.source("/camera", 100, "/image", 50 * MS)
    detector, objects = story.relay("/detector", 200, "/image", "/objects")
    sink = story.subscription(story.node("/sink", 300), "/objects")
    for cycle in range(cycles):
        begin = (100 + 50 * cycle) * MS
        story.runs(camera, begin, begin + 2 * MS, writes=((image, begin + MS),))
        start = begin + 3 * MS // 2
        if cycle in deaths:
            story.runs(detector, start, None, reads=begin + MS)
            again, pid = start + 20 * MS, detector.pid + 1
            node = story.node("/detector", pid, again)
            detector = story.subscription(node, "/image", again)
            objects = story.publisher(node, "/objects", again)
            continue
        sent = start + 7 * MS // 2 + cycle * MS // 10
        writes = ((objects, sent),)
        story.runs(detector, start, sent + MS, reads=begin + MS, writes=writes)
        story.runs(sink, sent + MS // 2, sent + MS, reads=sent)
    return story


def namesakes() -> Story:
    """Two talkers at once: /talker (100) is 3 ms from /out, /talker (101) is 7 ms."""
    story = Story()
    talkers = [story.source("/talker", pid, "/chatter", 50 * MS) for pid in (100, 101)]
    relay, out = story.relay("/relay", 200, "/chatter", "/out")
    for cycle in range(20):
        for place, (timer, chatter) in enumerate(talkers):
            begin = (100 + 50 * cycle + 20 * place) * MS
            sent, start = begin + MS, begin + (2 + 4 * place) * MS
            story.runs(timer, begin, begin + 2 * MS, writes=((chatter, sent),))
            writes = ((out, start + MS),)
            story.runs(relay, start, start + 2 * MS, reads=sent, writes=writes)
    return story


def run(*arguments: str, code: int = 0) -> str:
    """What a verb prints, its results or its refusal."""
    finished = called(*arguments)
    assert finished.code == code, finished.err
    return finished.err if code else finished.out


def trace(tmp_path: Path, story: Story) -> str:
    return str(write_lttng_trace(tmp_path / "trace", story.tables()))


@pytest.mark.parametrize("deaths", [(), (10,), (10, 15), (3, 10, 15)])
def test_a_node_that_was_started_again_is_one_node(deaths: tuple[int, ...]) -> None:
    found = analyse_latency(respawned(*deaths).tables(), CHAIN)
    whole = [cycle for cycle in range(20) if cycle not in deaths]
    assert found.traversals.drop_nulls("latency_ns")["latency_ns"].to_list() == [
        5 * MS + cycle * MS // 10 for cycle in whole
    ]
    assert found.incomplete == ({"not published": len(deaths)} if deaths else {})
    detectors = [one for one in found.graph.callbacks if one.node == "/detector"]
    assert [one.processes for one in detectors] == [tuple(range(200, 201 + len(deaths)))]
    assert [one.name for one in found.graph.nodes] == ["/camera", "/detector", "/sink"]
    assert [one.id for one in found.graph.callbacks] == [0, 1, 2], "they are places in the graph"
    assert sum("was started again" in note for note in found.notes) == bool(deaths)


def test_a_first_callback_that_dies_is_no_silent_one() -> None:
    story = Story()
    for pid, last in ((1, None), (2, 1012)):
        timer, topic = story.source("/source", pid, "/t1")
        for row in (rows[-1] for rows in story.rows.values() if rows[-1]["pid"] == pid):
            row["time"] = (pid - 1) * 500
        begin = (pid - 1) * 1000
        story.runs(timer, begin + 10, begin + 20, writes=((topic, begin + 12),))
        story.runs(timer, begin + 110, last and begin + 120)
    found = analyse_latency(story.tables(), "/t1")
    assert (found.statistics.count, found.silent) == (2, 1)
    assert found.incomplete == {"not published": 1}


def test_what_a_dead_process_stored_is_not_published_by_the_next() -> None:
    """A timer publishes what a subscription of its node stored; the process dies in between."""
    story = Story()
    camera, image = story.source("/camera", 1, "/image")
    for pid, begin in ((2, 0), (3, 200)):
        node = story.node("/store", pid, begin)
        reader = story.subscription(node, "/image", begin)
        timer = story.timer(node, 100, begin)
        out = story.publisher(node, "/out", begin)
        for sent in (begin + 12, begin + 112):
            story.runs(camera, sent - 2, sent + 2, writes=((image, sent),))
            story.runs(reader, sent + 5, sent + 8, reads=sent)
            if sent != 112:
                story.runs(timer, sent + 20, sent + 28, writes=((out, sent + 25),))
    found = analyse_latency(story.tables(), "/image../out")
    assert found.traversals["latency_ns"].to_list() == [27, None, 27, 27]


def test_who_watches_knows_which_processes_run() -> None:
    tables = respawned(10).tables()
    with pytest.raises(SeveralPathsError):
        find_chain(graph_of(data_flow(tables, ended=())), CHAIN)
    assert find_chain(graph_of(data_flow(tables, ended=(200,))), CHAIN)


@pytest.mark.parametrize("of", ["hand-made", "field"])
def test_every_verb_that_takes_a_chain_measures_across_a_restart(tmp_path: Path, of: str) -> None:
    folder = DATA / "field/respawned_node/respawn"
    if of == "field" and not folder.is_dir():
        pytest.skip(f"the field's traces are not here ({folder})")
    file = str(folder) if of == "field" else trace(tmp_path, respawned(10))
    chain = ("--chain", CHAIN)
    latency = json.loads(run("latency", file, *chain, "--json"))
    assert (latency["count"], latency["mean_ns"], latency["max_ns"]) == (19, 5_947_368, 6_900_000)
    assert latency["incomplete_by_reason"] == {"not published": 1}
    plan, budget, report = (str(tmp_path / name) for name in ("p.yaml", "b.yaml", "r.html"))
    planned = json.loads(run("plan", file, *chain, "-o", plan, "--json"))
    assert planned["predicted"]["max_ns"] > 6_900_000
    run("budget", file, *chain, "-o", budget)
    run("check", file, "--budget", budget)
    run("report", file, *chain, "-o", report)
    compared = json.loads(run("compare", file, file, *chain, "--json"))
    assert [one["count"] for one in compared["recordings"]] == [19, 19]
    callbacks = {one["node"]: one for one in json.loads(run("callbacks", file, "--json"))}
    assert (callbacks["/detector"]["pid"], callbacks["/detector"]["pids"]) == (201, [200, 201])
    assert callbacks["/detector"]["count"] == 20
    nodes = {one["name"]: one for one in json.loads(run("graph", file, "--json"))["nodes"]}
    assert nodes["/detector"] == {"name": "/detector", "pid": 201, "pids": [200, 201]}
    (row,) = (line for line in run("graph", file).splitlines() if "/detector" in line)
    assert "200, 201" in row
    assert json.loads(run("chains", file, "--json"))["count"] == 1
    assert run("describe", file, "-o", str(tmp_path / "a.yaml"))


@pytest.mark.parametrize(
    ("chain", "latency_ms"),
    [
        ("/talker@100../out", 3),
        ("/talker@101../out", 7),
        ("talker@101../chatter../out", 7),
    ],
)
def test_of_two_nodes_of_one_name_a_way_point_names_the_process(
    tmp_path: Path, chain: str, latency_ms: int
) -> None:
    file = trace(tmp_path, namesakes())
    found = json.loads(run("latency", file, "--chain", chain, "--json"))
    assert (found["count"], found["min_ns"], found["max_ns"]) == (20, *[latency_ms * MS] * 2)


@pytest.mark.parametrize(("pid", "latency_ms"), [(100, 3), (101, 7)])
def test_a_chain_through_a_node_of_a_process_is_described(
    tmp_path: Path, pid: int, latency_ms: int
) -> None:
    """Both talkers are in the description, and the chain is that of the process."""
    file, described = trace(tmp_path, namesakes()), tmp_path / "app.yaml"
    run("describe", file, "--chain", f"/talker@{pid}../out", "-o", str(described))
    text = described.read_text()
    assert f"chain: /talker_{pid}../out" in text
    assert "in process 100 is talker_100 in the" in text
    assert {"talker_100", "talker_101", "relay"} == yaml.safe_load(text)["nodes"].keys()
    run("simulate", str(described), "--cycles", "20", "-o", str(tmp_path / "simulated"))
    found = json.loads(run("latency", str(tmp_path / "simulated"), "--json"))
    assert found["count"] == 20
    assert found["mean_ns"] == pytest.approx(latency_ms * MS, rel=0.02)


def test_nodes_whose_names_become_alike_stay_two(tmp_path: Path) -> None:
    """A description permits no ~ and no - in a name."""
    story = Story()
    camera, image = story.source("/a~b", 100, "/image", 50 * MS)
    reader, out = story.relay("/a-b", 200, "/image", "/out")
    for cycle in range(20):
        begin = (100 + 50 * cycle) * MS
        story.runs(camera, begin, begin + 2 * MS, writes=((image, begin + MS),))
        writes = ((out, begin + 4 * MS),)
        story.runs(reader, begin + 3 * MS, begin + 5 * MS, reads=begin + MS, writes=writes)
    described = tmp_path / "app.yaml"
    run("describe", trace(tmp_path, story), "--chain", "/a~b../out", "-o", str(described))
    values = yaml.safe_load(described.read_text())
    assert (values["chain"], {*values["nodes"]}) == ("/a_b../out", {"a_b", "a_b_2"})


def test_nodes_of_one_name_are_told_apart_wherever_they_are_listed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = trace(tmp_path, namesakes())
    said = run("latency", file, "--chain", "/chatter../out", code=2)
    assert "/talker@100 every 50ms → /chatter → /out  (only this one passes /talker@100)" in said
    assert "/talker@101 every 50ms → /chatter → /out  (only this one passes /talker@101)" in said
    listed = json.loads(run("chains", file, "--json"))["chains"]
    assert [one["chain"] for one in listed] == [
        "/talker@100../chatter../out",
        "/talker@101../chatter../out",
    ]
    for one in listed:  # what is listed can be given
        assert json.loads(run("latency", file, "--chain", one["chain"], "--json"))["count"] == 20
    assert "write /talker@100, /talker@101" in run(
        "latency", file, "--chain", "/talker@7../out", code=2
    )
    assert run("graph", file).count("/talker") == 2


def test_paths_that_no_way_point_tells_apart_are_named_by_their_function() -> None:
    story = Story()
    node = story.node("/talker", 1)
    topic = story.publisher(node, "/chatter")
    for place, symbol in enumerate(("Talker::fast", "Talker::slow")):
        timer = story.timer(node, symbol=symbol)
        story.runs(timer, 10 + place * 10, 18 + place * 10, writes=((topic, 12 + place * 10),))
    with pytest.raises(InputError, match=r"by Talker::fast of /talker"):
        find_chain(graph_of(data_flow(story.tables())), "/chatter")


def shaped(killed: int = 10, back: int = 14, cycles: int = 20) -> Story:
    """/source → /out_tmp → shaping node (process 300, killed in a cycle; then 400) → /out.

    Its standby (500) has each message, too, and publishes at once what the node does not: 3 ms
    behind the cycle's start, where the shaping node does it 40 ms behind it.
    """
    story = Story()
    source, raw = story.source("/source", 100, "/out_tmp", 50 * MS)
    gate, out = story.relay("/chainshaper_out", 300, "/out_tmp", "/out")
    standby, beside = story.relay("/chainshaper_out_standby", 500, "/out_tmp", "/out")
    sink = story.subscription(story.node("/sink", 600), "/out")
    for cycle in range(cycles):
        begin = (100 + 50 * cycle) * MS
        sent = begin + MS
        story.runs(source, begin, begin + 2 * MS, writes=((raw, sent),))
        dead = killed <= cycle < back
        left = begin + (3 if dead else 40) * MS
        writes = ((beside, left),) if dead else ()
        story.runs(standby, begin + 2 * MS, begin + 4 * MS, reads=sent, writes=writes)
        if dead:
            came = begin + 2 * MS
            story.gate(standby, sent, came, came, overrun="bypass", origin=came)
            if cycle == killed:
                story.runs(gate, begin + 2 * MS, None, reads=sent)
        else:
            if cycle == back:
                node = story.node("/chainshaper_out", 400, begin)
                gate = story.subscription(node, "/out_tmp", begin)
                out = story.publisher(node, "/out", begin)
            writes = ((out, left),)
            story.runs(gate, begin + 2 * MS, left + MS, reads=sent, writes=writes)
            story.gate(gate, sent, begin + 2 * MS, left, origin=begin)
        story.runs(sink, left + MS, left + 2 * MS, reads=left)
    return story


def test_a_shaping_node_that_was_killed_and_came_back_is_one_chain_and_its_standby_publishes_for_it(
    tmp_path: Path,
) -> None:
    found = analyse_latency(shaped().tables(), "/out_tmp../out")
    wanted = [3 if 10 <= cycle < 14 else 40 for cycle in range(20)]
    assert found.traversals["latency_ns"].to_list() == [MS * one for one in wanted]
    assert found.traversals["late"].to_list() == [False] * 20, "what went around was early"
    assert found.traversals["reception_ns"].null_count() == 0
    assert found.incomplete == {}
    gates = [one.node for one in found.graph.path(found.chain)]
    assert gates == ["/source", "/chainshaper_out"]
    info = RecordingInfo(source="lttng", clock_offset_ns=OFFSET)
    file = str(write_recording(tmp_path / "recording", shaped().tables(), info).path)
    latency = json.loads(run("latency", file, "--chain", "/out_tmp../out", "--json"))
    assert (latency["count"], latency["late"], latency["overrun_outcomes"]) == (20, 0, {})
    assert latency["overruns_by_policy"] == {"bypass": 4}
    run("report", file, "--chain", "/out_tmp../out", "-o", str(tmp_path / "r.html"))
