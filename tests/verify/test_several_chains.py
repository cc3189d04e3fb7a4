"""Whole applications: what reads them shows every chain, with its own gates' figures."""

from pathlib import Path
from typing import Any

import pytest
from command_line import called, json_of, refused

from chainshaper import compare_chains, load_application, measure_latency, simulate
from chainshaper.flow.plan import profile_chains
from chainshaper.planning import PlanRequest, plan_application, publish_slots
from chainshaper.planning.chain_plan import publishing_servers, revised, with_slots
from chainshaper.planning.plan import Plan
from chainshaper.planning.plan_file import save_plan
from chainshaper.verify.predictions import due_of
from chainshaper.workload.description import Application

MS = 1_000_000
CHAINS = 20
CORES = 8


def _application(folder: Path, count: int) -> Application:
    """Chains of two nodes: chain k has 50 or 100 ms, and core 1 + k % 8."""
    lines = [
        "name: many chains",
        "chain: /a0../b0",
        "scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}",
        "nodes:",
    ]
    for k in range(count):
        execution = "execution: {uniform: [500us, 2ms]}"
        for name, source, topic in (
            (f"first{k}", f"timer: {(50, 100)[k // CORES % 2]}ms", f"/a{k}"),
            (f"second{k}", f"subscription: /a{k}", f"/b{k}"),
        ):
            callback = f"{{{source}, {execution}, publishes: [{topic}]}}"
            lines.append(f"  {name}: {{core: {1 + k % CORES}, callbacks: [{callback}]}}")
    path = folder / "application.yaml"
    path.write_text("\n".join(lines))
    return load_application(path)


def _planned(folder: Path, count: int, **wishes: Any) -> tuple[Application, Plan]:
    application = _application(folder, count)
    recording = simulate(application, folder / "before", cycles=60)
    chains = [f"/a{k}../b{k}" for k in range(count)]
    request = PlanRequest(epsilon_ns=MS, **wishes)
    plan, remarks = plan_application(profile_chains(recording, chains), request)
    assert not remarks
    return application, plan


def test_twenty_chains_on_eight_cores(tmp_path: Path) -> None:
    """No overlap, no late output, the first chain where it is alone.

    With ``simulate_latencies`` of every chain, 5,000 hyper-periods each, it takes 12 s.
    """
    application, plan = _planned(tmp_path, CHAINS)
    assert len({server.core for server in plan.servers}) == CORES
    after = simulate(application, tmp_path / "after", plan, cycles=40, switches=True)
    alone = simulate(application, tmp_path / "alone", Plan.of(plan.chains[0]), cycles=40)
    comparisons = compare_chains([tmp_path / "before", after])
    assert [one.chain for one in comparisons] == [chain.chain.spec for chain in plan.chains]
    for chain, comparison in zip(plan.chains, comparisons, strict=True):
        measured = comparison.measurements[1]
        found = measured.analysis.statistics
        ((opens, _),) = publish_slots(chain)
        assert (found.min_ns, found.max_ns, found.late) == (opens, opens, 0)
        assert (measured.overruns, measured.dropped) == ({}, {})
    first = measure_latency(alone).analysis.statistics
    assert (first.min_ns, first.max_ns) == (publish_slots(plan.chains[0])[0][0],) * 2
    # No executor ran outside the slots of its server.
    servers = {thread.node: server for server in plan.servers for thread in server.threads}
    gates = {server.name for chain in plan.chains for server in publishing_servers(chain)}
    names = {thread.tid: thread.node for thread in after.info.threads}
    switches, begun, checked = after.events["sched_switch"].sort("cpu", "time"), 0, 0
    for time, before, following in switches.select("time", "prev_tid", "next_tid").iter_rows():
        server = servers.get(names.get(before, ""))
        if server is not None and server.name not in gates:
            start, end = begun % plan.cycle_ns, begun % plan.cycle_ns + time - begun
            assert any(a <= start and end <= b for a, b in server.slots), (names[before], start)
            checked += 1
        begun = time if following in names else 0
    assert checked > CHAINS * 40


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recordings before and after; one of the two chains is published too early."""
    folder = tmp_path_factory.mktemp("robot")
    application, plan = _planned(folder, 9, overrun="discard")
    early, other = plan.chains[8], plan.chains[0]
    (server,) = publishing_servers(early)
    slots = {server.name: [(2 * MS, 3 * MS)]}
    both = Plan.of(other, revised(early, servers=with_slots(early.servers, slots)))
    save_plan(both, folder / "plan.yaml")
    simulate(application, folder / "after", both, cycles=60)
    return folder


def test_each_chain_has_the_figures_of_its_own_gate(robot: Path) -> None:
    found = json_of("compare", robot / "before", robot / "after")
    assert [one["chain"] for one in found["chains"]] == ["/a0../b0", "/a8../b8"]
    other, early = (one["recordings"][1] for one in found["chains"])
    assert (other["overruns"], other["incomplete"], other["dropped"]) == (0, 0, 0)
    assert early["overruns_by_policy"] == {"discard": early["incomplete"]}
    assert early["dropped_by_reason"] == {"discarded": early["incomplete"]}
    assert early["incomplete"] > 0
    for one in (other, early):
        assert one["prediction"]["late_of_all"] == 0
    # With --chain, and what reads one chain, all is as ever.
    one = json_of("compare", robot / "before", robot / "after", "--chain", "/a8../b8")
    assert one == found["chains"][1]
    assert json_of("latency", robot / "after")["chain"] == "/a0../b0"
    text = called("compare", robot / "before", robot / "after").out
    assert text.index("At publication") < text.index("of /a0../b0") < text.index("of /a8../b8")


def test_the_report_has_an_overview_and_a_part_for_each_chain(robot: Path, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    found = json_of("report", robot / "before", robot / "after", "-o", page)
    assert [one["chain"] for one in found["chains"]] == ["/a0../b0", "/a8../b8"]
    text = page.read_text()
    assert "<h1>End-to-end latency of 2 chains</h1>" in text
    for place in ("figures", "over-time", "timeline", "slots-0", "overruns", "plan-0"):
        assert text.count(f'id="{place}"') == text.count(f'id="{place}-2"') == 1
    assert text.count('id="callbacks') == text.count('id="conditions') == 1
    assert "shaped, for /a0../b0\nshaped, for /a8../b8" in text


def test_places_count_from_the_chains_own_cycle(tmp_path: Path) -> None:
    """Chain 8 begins ``offset`` after chain 0, and the stamp of its gate's cycle says so."""
    application, plan = _planned(tmp_path, 9, anchor="cycle")
    after = simulate(application, tmp_path / "after", plan, cycles=40)
    last = plan.chains[8]
    assert last.offset_ns > 0
    (due,) = due_of(last)
    assert due.from_cycle
    measured = compare_chains([after], least=1)[8].measurements[0]
    ((opens, _),) = publish_slots(last)
    origins = measured.analysis.releases["origin"].unique() % last.cycle_ns
    assert origins.unique().to_list() == [last.offset_ns]
    assert measured.analysis.traversals["place_ns"].unique().to_list() == [opens]
    assert measured.prediction is not None
    assert (measured.prediction.counted_from, measured.prediction.outputs.late) == ("cycle", 0)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["sweep", "application.yaml", "plan.yaml", "--vary", "seed=1"], "that of one is wanted"),
        (["compare", "after"], "needs two recordings"),
        (["compare", "before", "after", "--figures", "f"], "--figures draws one chain"),
    ],
)
def test_what_cannot_be_done_is_refused(
    arguments: list[str], reason: str, robot: Path, tmp_path: Path
) -> None:
    words = [str(robot / one) if (robot / one).exists() else one for one in arguments]
    words += ["-o", str(tmp_path / "o")] if words[0] != "compare" else []
    assert reason in refused(2, *words)
