"""Made-up applications of many nodes: their size, and that they are simulated, planned, shaped."""

from collections import Counter
from pathlib import Path

import pytest
import yaml

import chainshaper as cs
from chainshaper.analysis import recorded_flow
from chainshaper.planning import PlanRequest, plan_application
from chainshaper.values.errors import InputError
from chainshaper.workload.description import application_as_written, load_application
from chainshaper.workload.large_application import large_application


def test_three_hundred_nodes_in_twenty_containers(tmp_path: Path) -> None:
    application, chains = large_application()
    assert len(application.nodes) == 300
    assert len(set(chains)) == 12
    homes = {(node.container, node.core) for node in application.nodes.values()}
    assert len(homes) == 20  # so that each container is on one core
    assert {core for _, core in homes} == {*range(8)}
    assert max(Counter(node.container for node in application.nodes.values()).values()) < 25
    assert large_application() == large_application(seed=1) != large_application(seed=2)
    file = tmp_path / "large.yaml"
    file.write_text(yaml.safe_dump(application_as_written(application)))
    assert load_application(file) == application


@pytest.mark.parametrize(
    ("wished", "reason"),
    [
        ({"nodes": 107}, "12 chains of 8 nodes, each with an actuator, need 108"),
        ({"containers": 7}, "each core has a container of its own"),
        ({"nodes": 108, "containers": 109}, "each container a node"),
        ({"chains": 0}, "0 chains: ask for 1 at least"),
        ({"cores": 0}, "0 cores: ask for 1 at least"),
    ],
)
def test_what_cannot_be_described_is_refused(wished: dict[str, int], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        large_application(**wished)


def test_chains_in_containers_are_simulated_planned_and_shaped(tmp_path: Path) -> None:
    """Nodes of a container have one process id; all handles in it, and threads, are different."""
    application, chains = large_application(nodes=45, containers=5, chains=4, cores=2)
    recording = cs.simulate(application, tmp_path / "before", cycles=160)
    flow = recorded_flow(recording)
    nodes = flow.objects.nodes
    assert nodes["node"].n_unique() == 45
    assert nodes["pid"].n_unique() == 5
    assert {*recording.info.processes.values()} == {f"container_{n}" for n in range(1, 6)}
    assert nodes.select("pid", "handle").is_unique().all()
    threads = [(thread.pid, thread.tid) for thread in recording.info.threads]
    assert len({*threads}) == len(threads) == 45
    for chain in chains:
        statistics = cs.analyse_latency(recording, chain).statistics
        assert statistics.count >= 40  # of 160 cycles of 50 ms, one in four at least

    profiles = cs.profile_chains(recording, chains)
    plan, _ = plan_application(profiles, PlanRequest(cores=(0, 1)))
    assert len(plan.chains) == 4
    shaped = cs.simulate(application, tmp_path / "after", plan, cycles=160)
    for chain in chains:
        measured = cs.measure_latency(shaped, chain)
        assert measured.prediction is not None
        assert measured.analysis.statistics.jitter_ns == 0
        assert measured.overruns == {} or not sum((measured.overruns or {}).values())
