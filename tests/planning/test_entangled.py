"""Which chains are planned together: right, as the simulator shows, or refused with the reason."""

from pathlib import Path

import pytest

from chainshaper import measure_latency, simulate
from chainshaper.flow.plan import plan_recording, profile_chains
from chainshaper.planning import PlanRequest, place_chains, plan_application, publish_slots
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application, load_application

MS = 1_000_000
REQUEST = PlanRequest(epsilon_ns=2 * MS)

TEXT = """\
name: chains in one graph
chain: /t1../t3
scheduling:
  executors: {core: 1, priority: 80}
  dds: {core: 0, priority: 90}
nodes:
  first: {callbacks: [{timer: 100ms, execution: {uniform: [1ms, 3ms]}, publishes: [/t1]}]}
  second:
    callbacks:
      - {subscription: /t1, execution: {uniform: [2ms, 9ms]}, publishes: [/t2, /twin]}
  third: {callbacks: [{subscription: /t2, execution: {uniform: [2ms, 9ms]}, publishes: [/t3]}]}
  fork: {callbacks: [{subscription: /t1, execution: {uniform: [1ms, 4ms]}, publishes: [/forked]}]}
  behind: {callbacks: [{subscription: /t3, execution: {uniform: [1ms, 2ms]}, publishes: [/end]}]}
  meeting:
    callbacks:
      - {synchronises: [/t3, /forked], execution: {uniform: [1ms, 2ms]}, publishes: [/met]}
  other:
    core: 0
    callbacks:
      - {timer: 100ms, execution: {uniform: [1ms, 3ms]}, publishes: [/o1]}
      - {timer: 200ms, execution: {constant: 1ms}, publishes: [/slow]}
  other2:
    core: 0
    callbacks:
      - {subscription: /o1, execution: {uniform: [2ms, 9ms]}, publishes: [/o2]}
  beside: {callbacks: [{timer: 100ms, execution: {uniform: [1ms, 3ms]}, publishes: [/b1]}]}
  beside2: {callbacks: [{subscription: /b1, execution: {uniform: [2ms, 9ms]}, publishes: [/b2]}]}
  beside3: {callbacks: [{subscription: /b1, execution: {uniform: [1ms, 2ms]}, publishes: [/b3]}]}
  listener:
    callbacks: [{subscription: /o2}, {subscription: /b2}, {subscription: /end},
                {subscription: /met}, {subscription: /forked}, {subscription: /twin},
                {subscription: /slow}]
"""


@pytest.fixture(scope="module")
def application(tmp_path_factory: pytest.TempPathFactory) -> Application:
    path = tmp_path_factory.mktemp("graph") / "graph.yaml"
    path.write_text(TEXT)
    return load_application(path)


@pytest.fixture(scope="module")
def recording(application: Application, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    pytest.importorskip("numba")
    return simulate(application, tmp_path_factory.mktemp("unshaped") / "rec", cycles=200)


@pytest.mark.parametrize("sink", ["/t1../forked", "/t1../twin"])
def test_a_sink_that_forks_off_is_planned_right(
    sink: str, application: Application, recording: Recording, tmp_path: Path
) -> None:
    """In force, both outputs come in their slots."""
    plan = plan_recording(recording, "/t1../t3", REQUEST, sinks=[sink])
    for server, chain in zip(plan.servers[-2:], ("/t1../t3", sink), strict=True):
        of_chain = application.model_copy(update={"chain": plan.chain.spec})
        shaped = simulate(of_chain, tmp_path / chain.replace("/", "_"), plan, cycles=200)
        found = measure_latency(shaped, chain).analysis.statistics
        assert (found.count, found.late) == (200, 0)
        ((opens, closes),) = server.slots
        assert opens <= (found.min_ns or 0) <= (found.max_ns or 0) < closes
    assert plan.predicted.jitter_ns == MS
    (node,) = plan.further_shaping_nodes
    receivers = ("/listener", "/meeting") if sink == "/t1../forked" else ("/listener",)
    assert (node.output, node.receivers) == (sink.rpartition("..")[2], receivers)


@pytest.mark.parametrize(
    ("others", "apart"),
    [
        (["/o1../o2"], False),  # on a core of its own
        (["/b1../b2"], True),  # takes turns with the first
        (["/t1../forked", "/t1../twin"], False),  # sinks of one graph, in slots apart
        (["/b1../b2", "/t1../forked", "/o1../o2"], True),
        (["/b1../b2", "/t1../forked", "/b1../b3"], True),  # two pairs of branches
    ],
)
def test_chains_are_planned_together(
    others: list[str], apart: bool, application: Application, recording: Recording, tmp_path: Path
) -> None:
    """All at once in force, every output comes in its slot, at the same place in every cycle."""
    chains = ["/t1../t3", *others]
    plan, remarks = plan_application(profile_chains(recording, chains), REQUEST)
    assert not remarks
    assert any(one.offset_ns for one in plan.chains) == apart
    together = simulate(application, tmp_path / "together", plan, cycles=200)
    for one, chain in zip(plan.chains, chains, strict=True):
        ((opens, closes),) = publish_slots(one)
        found = measure_latency(together, chain).analysis.statistics
        assert (found.count, found.late, found.jitter_ns) == (200, 0, 0)
        assert opens <= (found.min_ns or 0) < closes


@pytest.mark.parametrize(
    ("chains", "words"),
    [
        (("/t1../t3", "/t1../t2"), "/t1../t3 waits for /t2, which the plan for /t1../t2"),
        (("/t1../t2", "/t1../t3"), "/t1../t3 waits for /t2, which the plan for /t1../t2"),
        (("/t1../t2../t3../end", "/t1../t3"), "waits for /t3, which"),
        (("/t1../t3", "/t1../t3"), "the chain /t1../t3 is given twice"),
        (("/t1../t3", "second../t3"), "both publish /t3"),
        # What a synchronising callback waits for is on a branch of the chain to it.
        (("/t1../t2../t3../met", "/t1../forked"), "waits for /forked, which"),
    ],
)
@pytest.mark.parametrize("as_sink", [False, True])
def test_a_chain_that_waits_for_what_another_has_shaped_is_refused(
    chains: tuple[str, str], words: str, as_sink: bool, recording: Recording
) -> None:
    with pytest.raises(InputError) as refused:
        if as_sink:
            plan_recording(recording, chains[0], period_ns=100 * MS, sinks=chains[1:])
        else:
            plan_application(profile_chains(recording, chains, period_ns=100 * MS))
    assert words in str(refused.value)
    assert all(chain in str(refused.value) for chain in chains)


def test_what_else_has_no_plan_together_is_refused(recording: Recording) -> None:
    one_by_one = [plan_recording(recording, chain) for chain in ("/t1../t3", "/t1../forked")]
    with pytest.raises(InputError, match="begin at the same callback: plan them together"):
        place_chains(one_by_one)
    with pytest.raises(InputError, match="both publish /t3"):
        place_chains(one_by_one[:1] * 2)
    with pytest.raises(InputError, match=r"/o1\.\./o2 begins at /other every 100ms"):
        plan_recording(recording, "/t1../t3", sinks=["/o1../o2"])
    for chains, words in (
        (("/t1../t3", "behind../end"), r"behind\.\./end waits for /t3, which"),
        # These begin at subscriptions that one timer triggers: no offset moves them apart.
        (("second../t3", "fork../forked"), r"begins at .* both need /t1: neither's cycles"),
        (("/t1../forked", "second../t3"), r"begins at .* both need /t1: neither's cycles"),
    ):
        with pytest.raises(InputError, match=words):
            plan_application(profile_chains(recording, chains, period_ns=100 * MS))
    # LET of every callback shapes what lies on the way, too.
    forked = profile_chains(recording, ("/t1../t3", "/t1../forked"))
    with pytest.raises(InputError, match=r"/t1\.\./forked waits for /t1, which the plan for"):
        plan_application(forked, PlanRequest(policy="let-per-callback"))
