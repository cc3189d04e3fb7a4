"""Real traces through the command line, against ground truth that was computed independently."""

import json
from pathlib import Path
from typing import Any

import pytest
from command_line import called, chainshaper, json_of, refused
from reference_traces import CHAINS, TRACES, reference_folder, reference_trace

SYSTEMS = {
    "jazzy_chain_cyclonedds": ("jazzy", "rmw_cyclonedds_cpp"),
    "jazzy_chain_fastrtps_async": ("jazzy", "rmw_fastrtps_cpp"),
    "jazzy_avp_cyclonedds": ("jazzy", "rmw_cyclonedds_cpp"),
    "humble_sync": ("humble", "rmw_fastrtps_cpp"),
    "galactic_caret_end_to_end": ("galactic", "rmw_cyclonedds_cpp"),
}


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
def test_info(name: str) -> None:
    found = json_of("info", reference_folder(name) / "trace")
    assert found["events"] == truth(name)["events"]
    assert (found["distribution"], found["rmw"]) == SYSTEMS[name]
    assert found["lost"] == {"discarded_events": 0, "lost_packets": 0}
    assert found["clock_offset_ns"] == reference_trace(name).clock_offset_ns
    assert len(found["hosts"]) == 1
    assert {int(pid) for pid in found["processes"]} == {
        row["pid"] for row in truth(name)["callbacks"]
    }


@pytest.mark.parametrize("name", TRACES)
def test_callbacks(name: str) -> None:
    found = json_of("callbacks", reference_folder(name) / "trace")
    assert comparable(found) == comparable(truth(name)["callbacks"])
    assert all(row["execution_ns"] is None for row in found), "without sched_switch"


@pytest.mark.parametrize(("name", "chain"), CHAINS)
def test_latency_of_every_traversal(name: str, chain: str) -> None:
    expected = truth(name)["chain"]
    found = json_of("latency", reference_folder(name) / "trace", "--chain", chain, "--instances")
    spans = [[one["start_ns"], one["end_ns"]] for one in found["instances"]]
    assert spans == expected["start_and_end_ns"]
    assert (found["count"], found["incomplete"]) == (expected["complete"], expected["incomplete"])
    assert found["min_ns"] == expected["latency_ns"]["min"]
    assert found["max_ns"] == expected["latency_ns"]["max"]
    assert found["mean_ns"] == round(expected["latency_ns"]["mean"])
    assert found["lost"] == {"discarded_events": 0, "lost_packets": 0}
    assert (found["disturbed"], found["stalls_watched"]) == (0, False)
    shares = found["communication_share"] + found["computation_share"]
    assert shares == pytest.approx(1.0), "communication and computation are the whole latency"
    means = [
        hop[f"{part}_ns"]["mean"]
        for hop in found["hops"]
        for part in ("communication", "computation")
        if hop[f"{part}_ns"] is not None
    ]
    assert sum(means) == pytest.approx(expected["latency_ns"]["mean"], abs=1)


@pytest.mark.parametrize(("name", "chain"), CHAINS)
def test_converted_it_gives_the_same_figures(name: str, chain: str, tmp_path: Path) -> None:
    trace, recording = reference_folder(name) / "trace", tmp_path / "recording"
    finished = called("convert", trace, "-o", recording)
    assert (finished.code, finished.out) == (0, f"{recording}\n")
    options = ("--chain", chain, "--instances")
    assert json_of("latency", recording, *options) == json_of("latency", trace, *options)
    for verb in ("callbacks", "chains", "graph"):
        assert json_of(verb, recording) == json_of(verb, trace)
    assert json_of("info", recording) == json_of("info", trace)


@pytest.mark.parametrize("name", TRACES)
def test_graph(name: str) -> None:
    found = json_of("graph", reference_folder(name) / "trace")
    expected = truth(name)
    ran = {
        (row["node"], row["kind"], row["topic"], row["period_ns"]) for row in expected["callbacks"]
    }
    shown = {(c["node"], c["kind"], c["topic"], c["period_ns"]) for c in found["callbacks"]}
    assert ran <= shown
    assert {node["name"] for node in found["nodes"]} == {
        row["node"] for row in expected["callbacks"]
    }
    services = sum(c["kind"] == "service" for c in found["callbacks"])
    assert services == expected["events"]["ros2:rcl_service_init"]
    assert all(service["servers"] for service in found["services"])
    assert all(c["symbol"] for c in found["callbacks"]), "every callback has its function"


def test_chains_of_the_parking_application() -> None:
    trace = reference_folder("jazzy_avp_cyclonedds")
    found = json_of("chains", trace, "--from", "/points_throttler", "--to", "/points_fused")
    assert (found["count"], found["exact"], len(found["chains"])) == (2, True, 2)
    assert found["heaviest"]["topics"][0] == "/lidar_front/points_raw"
    limited = json_of("chains", trace, "--limit", "1")
    assert len(limited["chains"]) == 1
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
    said = refused(2, "latency", trace, "--chains", file, "--chain", "nobody")
    assert "no path is named 'nobody'; its named_paths: to_driven" in said
    file.write_text("named_paths:" + path.format(name="one") + path.format(name="two"))
    said = refused(2, "latency", trace, "--chains", file)
    assert "choose one of its named_paths with --chain: one, two" in said


def test_tables_are_for_people() -> None:
    trace = reference_folder("jazzy_avp_cyclonedds")
    latency = called("latency", trace, "--chain", CHAINS[2][1])
    for text in ("Where it goes, hop by hop [ms]", "together", "lost while recording: nothing"):
        assert text in latency.out
    assert "stalls of the machine not watched" in latency.out
    assert "undisturbed" not in latency.out, "nobody watched, so nobody can say so"
    callbacks = called("callbacks", trace).out
    assert "timer every 100ms (Throttler λ1)" in callbacks
    assert "timer every 100ms (Throttler λ2)" in callbacks
    assert "execution" not in callbacks, "without sched_switch there are no such columns"
    assert "jazzy" in called("info", trace).out
    graph = called("graph", trace).out
    assert "Throttler λ1" in graph
    assert "parameter" not in graph
    assert "/parameter_events" in called("graph", trace, "--all").out
    assert "lost while recording: nothing" in called("callbacks", trace).out


def test_a_process_reads_a_trace_and_prints_nothing_else() -> None:
    finished = chainshaper("latency", reference_folder("humble_sync"), "--chain",
                           "/topic_a../topic_b", "--json")  # fmt: skip
    assert finished.code == 0
    assert json.loads(finished.out)["incomplete_by_reason"] == {"lost": 5, "not taken": 40}
