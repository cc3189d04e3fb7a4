"""Real traces through the command line, against ground truth that was computed independently."""

import json
from pathlib import Path
from typing import Any

import pytest
from command_line import called, json_of, refused
from field_traces import chain_tables, write_chain
from reference_traces import CHAINS, TRACES, reference_folder, reference_trace

from chainshaper.verify.measure import PARTS

SYSTEMS = {
    "jazzy_chain_cyclonedds": ("jazzy", "rmw_cyclonedds_cpp"),
    "jazzy_chain_fastrtps_async": ("jazzy", "rmw_fastrtps_cpp"),
    "jazzy_avp_cyclonedds": ("jazzy", "rmw_cyclonedds_cpp"),
    "humble_sync": ("humble", "rmw_fastrtps_cpp"),
    "galactic_caret_end_to_end": ("galactic", "rmw_cyclonedds_cpp"),
}
NO_LOSS = {"discarded_events": 0, "lost_packets": 0}


def truth(name: str) -> Any:
    return json.loads((reference_folder(name) / "truth.json").read_text())


def comparable(rows: list[dict[str, Any]]) -> list[Any]:
    """Callbacks without an order, and with means as the truth rounds them."""
    keys = ("node", "kind", "topic", "period_ns", "pid", "tids", "count")
    found = []
    for row in rows:
        times = row["response_ns"]
        response = (times["min"], round(times["mean"], 1), times["max"])
        found.append([*(row[key] for key in keys), response])
    return sorted(found, key=repr)


@pytest.mark.parametrize("name", TRACES)
def test_contents_callbacks_and_graph(name: str) -> None:
    trace, expected = reference_folder(name) / "trace", truth(name)
    found = json_of("info", trace)
    assert found["events"] == expected["events"]
    assert (found["distribution"], found["rmw"]) == SYSTEMS[name]
    assert found["lost"] == NO_LOSS
    assert found["clock_offset_ns"] == reference_trace(name).clock_offset_ns
    assert len(found["hosts"]) == 1
    ran = expected["callbacks"]
    assert {int(pid) for pid in found["processes"]} == {row["pid"] for row in ran}

    callbacks = json_of("callbacks", trace)
    assert comparable(callbacks) == comparable(ran)
    assert all(row["execution_ns"] is None for row in callbacks), "without sched_switch"

    graph = json_of("graph", trace)
    about = ("node", "kind", "topic", "period_ns")
    shown = {tuple(one[key] for key in about) for one in graph["callbacks"]}
    assert {tuple(row[key] for key in about) for row in ran} <= shown
    assert {node["name"] for node in graph["nodes"]} == {row["node"] for row in ran}
    services = sum(one["kind"] == "service" for one in graph["callbacks"])
    assert services == expected["events"]["ros2:rcl_service_init"]
    assert all(service["servers"] for service in graph["services"])
    assert all(one["symbol"] for one in graph["callbacks"]), "every callback has its function"


@pytest.mark.parametrize(("name", "chain"), CHAINS)
def test_latency_of_every_traversal_and_the_same_once_converted(
    name: str, chain: str, tmp_path: Path
) -> None:
    trace, expected = reference_folder(name) / "trace", truth(name)["chain"]
    options = ("--chain", chain, "--instances")
    found = json_of("latency", trace, *options)
    spans = [[one["start_ns"], one["end_ns"]] for one in found["instances"]]
    assert spans == expected["start_and_end_ns"]
    assert (found["count"], found["incomplete"]) == (expected["complete"], expected["incomplete"])
    times, mean = expected["latency_ns"], expected["latency_ns"]["mean"]
    assert [found[f"{key}_ns"] for key in ("min", "max")] == [times["min"], times["max"]]
    assert found["mean_ns"] == round(mean)
    assert found["lost"] == NO_LOSS
    assert (found["disturbed"], found["stalls_watched"]) == (0, False)
    shares = sum(found[f"{part}_share"] for part in PARTS)
    assert shares == pytest.approx(1.0), "the parts are the whole latency"
    parts = [hop[f"{part}_ns"] for hop in found["hops"] for part in PARTS]
    assert sum(part["mean"] for part in parts if part) == pytest.approx(mean, abs=1)

    recording = tmp_path / "recording"
    finished = called("convert", trace, "-o", recording)
    assert (finished.code, finished.out) == (0, f"{recording}\n")
    assert json_of("latency", recording, *options) == found
    for verb in ("callbacks", "chains", "graph", "info"):
        assert json_of(verb, recording) == json_of(verb, trace)


def test_chains_of_the_parking_application() -> None:
    trace = reference_folder("jazzy_avp_cyclonedds")
    found = json_of("chains", trace, "--from", "/points_throttler", "--to", "/points_fused")
    assert (found["count"], found["exact"], len(found["chains"])) == (2, True, 2)
    assert found["heaviest"]["topics"][0] == "/lidar_front/points_raw"
    assert len(json_of("chains", trace, "--limit", "1")["chains"]) == 1
    assert "of them listed" in called("chains", trace, "--limit", "1").out


def test_named_paths_of_a_caret_architecture_file(tmp_path: Path) -> None:
    trace, file = reference_folder("galactic_caret_end_to_end"), tmp_path / "architecture.yaml"
    path = """
- path_name: {name}
  node_chain:
  - {{node_name: /sensor_dummy_node, publish_topic_name: /topic1}}
  - {{node_name: /filter_node, publish_topic_name: /topic2, subscribe_topic_name: /topic1}}
  - {{node_name: /message_driven_node, subscribe_topic_name: /topic2}}
"""
    file.write_text("named_paths:" + path.format(name="to_driven"))
    found = json_of("latency", trace, "--chains", file)
    assert found["count"] == 75
    assert found == json_of("latency", trace, "--chains", file, "--chain", "to_driven")
    assert [hop["topic"] for hop in found["hops"]] == ["/topic1", "/topic2"]
    message = refused(2, "latency", trace, "--chains", file, "--chain", "unknown")
    assert "no path is named 'unknown'; its named_paths: to_driven" in message
    file.write_text("named_paths:" + path.format(name="one") + path.format(name="two"))
    message = refused(2, "latency", trace, "--chains", file)
    assert "choose one of its named_paths with --chain: one, two" in message


def test_named_paths_of_carets_files_for_galactic(tmp_path: Path) -> None:
    """They name the paths as callbacks; the file that CARET writes has none yet."""
    folder = reference_folder("galactic_caret_end_to_end")
    text, trace = (folder / "architecture.yaml").read_text(), folder / "trace"
    said = refused(2, "latency", trace, "--chains", folder / "architecture.yaml")
    assert "no path is named in it" in said
    path = """path_name_aliases:
- path_name: to_filter
  callbacks:
  - /sensor_dummy_node/timer_callback_0
  - /filter_node/subscription_callback_0
"""
    file = tmp_path / "architecture.yaml"
    file.write_text(text.replace("path_name_aliases: []", path))
    named = json_of("latency", trace, "--chains", file)
    assert named["count"] == 75
    assert [hop["topic"] for hop in named["hops"]] == ["/topic1", "/topic2"]
    written = "/sensor_dummy_node../topic1../filter_node../topic2"
    assert named["chain"] == written
    longer = path + "  - /message_driven_node/subscription_callback_0\n"
    file.write_text(text.replace("path_name_aliases: []", longer))
    assert json_of("latency", trace, "--chains", file)["chain"] == (
        f"{written}../message_driven_node../topic3"
    )
    file.write_text(text.replace("path_name_aliases: []", path.replace("callback_0", "callback_7")))
    said = refused(2, "latency", trace, "--chains", file)
    assert "names the callback /sensor_dummy_node/timer_callback_7" in said


def test_the_only_chain_of_a_trace_needs_not_to_be_named(tmp_path: Path) -> None:
    trace, page = write_chain(tmp_path / "trace", chain_tables()), tmp_path / "page.html"
    taken, spec = "no --chain was given", "/image../objects"
    found = json_of("latency", trace)
    assert (found["chain"], found["count"]) == (spec, 20)
    assert any(taken in note and spec in note for note in found["notes"])
    assert json_of("plan", trace)["warnings"][0].startswith(taken)
    commands: list[list[str | Path]] = [
        ["latency", trace],
        ["plan", trace, "-o", tmp_path / "plan.yaml"],
        ["report", trace, "-o", page],
        ["compare", trace, trace],
        ["budget", trace, "-o", tmp_path / "budget.yaml"],
    ]
    for words in commands:
        said = called(*words)
        assert said.code == 0, words
        (line,) = (line for line in said.err.splitlines() if taken in line)
        assert spec in line
    assert taken in page.read_text()
    assert called("check", trace, "--budget", tmp_path / "budget.yaml").code == 0
    exported = called("export", trace, "--perfetto", "-o", tmp_path / "trace.pftrace")
    assert exported.code == 0
    assert spec.encode() in (tmp_path / "trace.pftrace").read_bytes()
    named = called("latency", trace, "--chain", spec)
    assert taken not in named.err
    several = reference_folder("galactic_caret_end_to_end") / "trace"
    commands = [["latency", several], ["plan", several], ["compare", several, several]]
    for words in commands:
        assert "add --chain /topic4 or --chain /drive../topic3../topic4 or" in refused(2, *words)


def test_tables_are_for_people() -> None:
    trace = reference_folder("jazzy_avp_cyclonedds")
    lost, timers = "lost while recording: nothing", [f"every 100ms (Throttler λ{n})" for n in "12"]
    watched = "stalls of the machine not watched"
    for words, texts, absent in (
        # The machine was not watched, so nothing is called undisturbed.
        (("latency", "--chain", CHAINS[2][1]), ["hop by hop [ms]", lost, watched], "undisturbed"),
        (("callbacks",), [*timers, lost], "execution"),  # without sched_switch
        (("info",), ["jazzy"], "unknown"),
        (("graph",), ["Throttler λ1"], "parameter"),
        (("graph", "--all"), ["/parameter_events"], "Traceback"),
    ):
        shown = called(words[0], trace, *words[1:]).out
        assert [text for text in texts if text not in shown] == []
        assert absent not in shown
