"""Recordings of several hosts, read as one: against recordings of one host split into two.

What every latency truly is stands in the recording before it was split.
"""

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from command_line import json_of, refused
from reference_traces import reference_folder
from split_hosts import HOUR, Clock, drifting, split, true_time

from chainshaper.analysis import analyse_latency, graph_of, recorded_flow
from chainshaper.simulation import simulate
from chainshaper.sources import open_source
from chainshaper.values.errors import InputError
from chainshaper.values.events import happened
from chainshaper.values.hosts import HOST_STRIDE, host_of
from chainshaper.values.recording import Recording, write_recording
from chainshaper.workload.description import load_application

ROOT = Path(__file__).parents[2]
SECOND = 1_000_000_000
CYCLES = 1000


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The synthetic chain: node1 and node2 are one host, node3 to node5 the other."""
    application = load_application(ROOT / "examples" / "synthetic_chain.yaml")
    return simulate(application, tmp_path_factory.mktemp("one") / "host", cycles=CYCLES)


def processes(recording: Recording, *nodes: str) -> set[int]:
    """The processes of these nodes."""
    named = recorded_flow(recording).objects.nodes
    return set(named.filter(pl.col("node").is_in(nodes))["pid"])


def second_host(recording: Recording) -> set[int]:
    return processes(recording, "/node3", "/node4", "/node5")


CLOCKS: dict[str, tuple[Clock, Clock]] = {
    "drift": (true_time, drifting(HOUR, 50.0)),
    "both drift": (drifting(-SECOND // 2, -30.0), drifting(7 * HOUR, 40.0)),
    "forwards": (true_time, drifting(HOUR, 20.0, [(50 * SECOND, 100_000_000)])),
    "back": (drifting(0, 0.0, [(50 * SECOND, 100_000_000)]), drifting(-SECOND // 2, -20.0)),
    "small": (true_time, drifting(HOUR, 20.0, [(40 * SECOND, 2_000_000)])),
}


@pytest.mark.parametrize("kind", CLOCKS)
def test_true_latencies_lie_in_their_intervals(
    recorded: Recording, kind: str, tmp_path: Path
) -> None:
    truth = analyse_latency(recorded, "/t1../t5")
    joint = open_source(*split(recorded, second_host(recorded), CLOCKS[kind], tmp_path / "two"))
    found = analyse_latency(joint, "/t1../t5")
    assert found.statistics.count == truth.statistics.count == CYCLES
    # By the clock of the first host, which a jump of its own changes as well.
    first, _ = CLOCKS[kind]
    ends = [first(truth.traversals[end].to_numpy()) for end in ("start", "end")]
    latency = ends[1] - ends[0]
    low, high = (found.traversals[f"latency_{side}_ns"].to_numpy() for side in ("low", "high"))
    inside = (low <= latency) & (latency <= high)
    assert inside.mean() >= 0.999
    between = found.hops.filter(hop=2)
    delay = truth.hops.filter(hop=2)["communication_ns"].to_numpy()
    width = (between["communication_high_ns"] - between["communication_low_ns"]).to_numpy()
    low, high = (between[f"communication_{side}_ns"].to_numpy() for side in ("low", "high"))
    assert ((low <= delay + 20) & (delay <= high + 20)).mean() >= 0.999
    # Converting rounds both ends, and the corridor has cells.
    assert (width <= 2 * delay + 10_000).mean() >= 0.99


def test_real_messages_of_a_trace_split_into_two_hosts(tmp_path: Path) -> None:
    real = open_source(reference_folder("jazzy_chain_cyclonedds") / "trace")
    truth = analyse_latency(real, "/t1../t5")
    begun = int(truth.traversals["start"][0])
    clock = drifting(HOUR, 50.0, since_ns=begun)
    joint = open_source(*split(real, second_host(real), (true_time, clock), tmp_path / "two"))
    found = analyse_latency(joint, "/t1../t5")
    assert found.statistics.count == truth.statistics.count
    latency = truth.traversals.filter("complete")["latency_ns"].to_numpy()
    complete = found.traversals.filter("complete")
    low, high = (complete[f"latency_{side}_ns"].to_numpy() for side in ("low", "high"))
    assert ((low <= latency) & (latency <= high)).mean() >= 0.999
    delays = truth.hops.filter(pl.col("hop") == 2)["communication_ns"]
    assert np.median(high - low) <= 2 * delays.median()  # type: ignore[operator]


def test_the_host_is_part_of_every_identity(recorded: Recording, tmp_path: Path) -> None:
    second = second_host(recorded)
    # On both hosts the same numbers of processes and threads, and so the same handles in them.
    others = sorted(processes(recorded, "/node1", "/node2", "/actuator"))
    like = dict(zip(sorted(second), others, strict=True))
    pid = pl.col("pid").replace(like)
    head, base = split(recorded, second, (true_time, drifting(HOUR, 50.0)), tmp_path / "two")
    moved = open_source(base)
    alike = {
        name: table.with_columns(pid=pid, tid=pl.col("tid") - pl.col("pid") + pid)
        for name, table in moved.events.items()
    }
    alike_path = write_recording(tmp_path / "alike", alike, moved.info).path
    joint = open_source(head, alike_path)
    for table in joint.events.values():
        pids = table["pid"].drop_nulls()
        assert set(host_of(pids).unique()) <= {0, 1}
        assert set((pids % HOST_STRIDE).unique()) <= set(like.values()) | {1060}
    graph = graph_of(recorded_flow(joint))
    assert [callback.node for callback in graph.callbacks] == [
        callback.node for callback in graph_of(recorded_flow(recorded)).callbacks
    ]
    assert analyse_latency(joint, "/t1../t5").statistics.count == CYCLES


def test_every_verb_reads_a_folder_of_recordings(recorded: Recording, tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    split(recorded, second_host(recorded), (true_time, drifting(HOUR, 50.0)), folder)
    (clock,) = json_of("info", folder)["clocks"][1:]
    assert clock["name"] == "base"
    assert clock["messages_there"] == clock["messages_back"] == CYCLES
    assert clock["drift_ppm"] == pytest.approx([50, 50], abs=0.5)
    assert clock["claim_is"] == "within"
    latency = json_of("latency", folder, "--chain", "/t1../t5")
    for name in ("min_ns", "mean_ns", "max_ns", "jitter_ns"):
        low, high = latency["bounds_ns"][name]
        assert low <= latency[name] <= high
    assert len(json_of("chains", folder)["chains"]) == 1
    assert {row["node"] for row in json_of("callbacks", folder)} >= {"/node1", "/node5"}
    plan = json_of("plan", folder, "--chain", "/t1../t5")
    assert plan["evidence"]["hosts"] == ["head", "base"]
    assert plan["evidence"]["max_latency_ns"] == latency["bounds_ns"]["max_ns"][1]


def test_a_plan_across_hosts_is_put_in_force_by_nothing(
    recorded: Recording, tmp_path: Path
) -> None:
    folder = tmp_path / "robot"
    split(recorded, second_host(recorded), (true_time, drifting(HOUR, 50.0)), folder)
    plan = tmp_path / "plan.yaml"
    json_of("plan", folder, "--chain", "/t1../t5", "-o", plan, "--json")
    said = refused(2, "apply", plan, "--dry-run")
    assert "goes over head, base" in said
    said = refused(2, "plan", folder, "--chain", "/t4../t5")
    assert "runs on base only: plan it from that host's own recording" in said


def test_a_joint_recording_can_be_written(recorded: Recording, tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    split(recorded, second_host(recorded), (true_time, drifting(HOUR, 50.0)), folder)
    joint = open_source(folder)
    written = write_recording(tmp_path / "joint", joint.events, joint.info)
    texts = [analyse_latency(each, "/t1../t5").statistics for each in (joint, written)]
    assert texts[0] == texts[1]
    with pytest.raises(InputError, match="has several hosts already"):
        open_source(folder / "0_head", written.path)


def test_wall_clocks_that_lie_are_named(recorded: Recording, tmp_path: Path) -> None:
    clocks = (true_time, drifting(HOUR, 0.0))
    folder = tmp_path / "robot"
    split(recorded, second_host(recorded), clocks, folder, wall_ns=(0, 12_000_000))
    joint = open_source(folder)
    assert joint.info.hosts[1].claim_is == "wrong"
    (lie,) = (note for note in joint.info.notes if "not synchronised as they claim" in note)
    assert "by messages they differ by +12." in lie
    truth, found = (analyse_latency(each, "/t1../t5").statistics for each in (recorded, joint))
    assert found.mean_ns == pytest.approx(truth.mean_ns, abs=250_000)


def one_way(recorded: Recording, folder: Path, wall_ns: int) -> tuple[Path, Path]:
    """Two hosts of which the second takes what the first sends, and sends nothing back."""
    last = processes(recorded, "/node3", "/node4", "/node5", "/actuator")
    clocks = (true_time, drifting(HOUR, 0.0))
    return split(recorded, last, clocks, folder, wall_ns=(0, wall_ns))


def test_of_messages_one_way_the_other_side_is_what_wall_clocks_claim(
    recorded: Recording, tmp_path: Path
) -> None:
    joint = open_source(*one_way(recorded, tmp_path / "true", 0))
    assert any("the wall clocks' own claim is taken" in note.lower() for note in joint.info.notes)
    assert joint.info.hosts[1].claim_is == "taken"
    truth = analyse_latency(recorded, "/t1../t5").statistics
    found = analyse_latency(joint, "/t1../t5")
    low, high = found.statistics.bounds_ns["max_ns"]  # type: ignore[attr-defined]
    assert truth.max_ns is not None
    assert low - 100 <= truth.max_ns <= high + 100
    with pytest.raises(InputError, match=r"go one way only, and by their.* before they were sent"):
        open_source(*one_way(recorded, tmp_path / "wrong", -5_000_000))


def test_recordings_that_cannot_be_joined(recorded: Recording, tmp_path: Path) -> None:
    second = second_host(recorded)
    clocks = (true_time, drifting(HOUR, 10.0))
    head, base = split(recorded, second, clocks, tmp_path / "two")
    with pytest.raises(InputError, match="are both of a host called head"):
        open_source(head, head)
    same, other = split(recorded, second, clocks, tmp_path / "boots")
    for path in (same, other):
        file = path / "recording.json"
        info = json.loads(file.read_text()) | {"boot": "d0", "host": "head"}
        file.write_text(json.dumps(info))
    with pytest.raises(InputError, match="are of the same host, head"):
        open_source(same, other)
    # Of the first quarter of one, and the last of the other.
    begun = SECOND
    parts = []
    for path, since, until in ((head, 0, 20), (base, 60, 90)):
        recording = open_source(path)
        start = begun - recording.info.clock_offset_ns
        tables = happened(recording.events, start + since * SECOND, start + until * SECOND)
        parts.append(write_recording(tmp_path / path.name, tables, recording.info).path)
    with pytest.raises(InputError, match=r"was recorded from .*give recordings of the same time"):
        open_source(*parts)
    alone = split(recorded, processes(recorded, "/interference"), clocks, tmp_path / "apart")
    with pytest.raises(InputError, match="no message went between base and head"):
        open_source(*alone)


def test_clocks_that_contradict_each_other_are_refused(recorded: Recording, tmp_path: Path) -> None:
    def shaking(times: "np.typing.NDArray[np.int64]") -> "np.typing.NDArray[np.int64]":
        return times + np.where(times // (SECOND // 2) % 2, 20_000_000, 0)

    folder = tmp_path / "two"
    split(recorded, second_host(recorded), (true_time, shaking), folder)
    with pytest.raises(InputError, match="the clocks of base and head contradict each other"):
        open_source(folder)
