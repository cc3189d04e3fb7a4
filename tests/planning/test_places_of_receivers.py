"""Who receives an output: a place in every plan, and a promise of its own."""

from pathlib import Path

import pytest
from bare_plans import MS
from known import known
from small_chain import small_chain_plan

from chainshaper import load_application, simulate
from chainshaper.flow.plan import plan_recording, profile_chains
from chainshaper.planning import ChainPlan, Plan, PlanRequest, plan_application, plan_warnings
from chainshaper.planning.plan_file import dump_plan, load_plan, plan_json
from chainshaper.splicing.application import splice_application
from chainshaper.values.plan_choices import Policy
from chainshaper.verify.measure import measure_latency
from chainshaper.workload.description import Application

CHAIN = """\
name: an actuator on the chain's core
chain: /a../b
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  a: {callbacks: [{timer: 100ms, execution: {uniform: [20ms, 30ms]}, publishes: [/a]}]}
  b: {callbacks: [{subscription: /a, execution: {uniform: [30ms, 40ms]}, publishes: [/b]}]}
  actuator:
    core: CORE
    priority: 10
    callbacks: [{subscription: /b, execution: {constant: TIME}}]
"""


def described(folder: Path, core: int = 1, time: str = "1ms", text: str = CHAIN) -> Application:
    """An application whose actuator's callback takes this long, on this core."""
    (folder / "app.yaml").write_text(text.replace("CORE", str(core)).replace("TIME", time))
    return load_application(folder / "app.yaml")


def received(application: Application, plan: ChainPlan, folder: Path) -> tuple[float, float]:
    """When the receiver's callbacks start, at the latest, and how far they are apart (ms)."""
    analysis = measure_latency(simulate(application, folder, Plan.of(plan), cycles=300)).analysis
    subscriber = known(analysis.subscriber)
    return known(subscriber.max_ns) / MS, known(subscriber.jitter_ns) / MS


@pytest.mark.parametrize("policy", ["shaped", "let-per-chain", "let-per-callback"])
def test_receivers_are_not_behind_the_next_cycle(policy: Policy, tmp_path: Path) -> None:
    """Under LET outputs leave as the next cycle begins to compute, for 50 to 70 ms."""
    application = described(tmp_path)
    profile = simulate(application, tmp_path / "profile", cycles=300)
    plan = plan_recording(profile, request=PlanRequest(policy=policy)).chains[0]
    place = known(known(plan.shaping_node).receivers_at)
    assert (place.core, place.priority) == (1, 1), "behind the gates, above the chain"
    assert MS <= place.time_ns < 1.3 * MS
    promised = known(plan.predicted.receivers)
    latest, jitter = received(application, plan, tmp_path / "shaped")
    assert latest <= promised.max_ns / MS
    assert jitter <= promised.jitter_ns / MS
    assert jitter < 5, "and not as long as the chain takes"
    judged = known(measure_latency(tmp_path / "shaped").prediction)
    assert judged.broken == ()
    assert known(judged.receivers).count == 300
    (tmp_path / "plan.yaml").write_text(dump_plan(Plan.of(plan)))
    assert load_plan(tmp_path / "plan.yaml") == Plan.of(plan)
    values = plan_json(plan)
    assert values["predicted"]["receivers"]["max_ns"] == promised.max_ns
    assert values["shaping_node"]["receivers_at"]["core"] == 1


def test_receivers_stay_on_a_core_without_servers(tmp_path: Path) -> None:
    application = described(tmp_path, core=2, time="30ms")
    profile = simulate(application, tmp_path / "profile", cycles=100)
    plan = plan_recording(profile, request=PlanRequest(policy="let-per-chain")).chains[0]
    assert known(known(plan.shaping_node).receivers_at).core == 2
    latest, jitter = received(application, plan, tmp_path / "shaped")
    assert latest <= known(plan.predicted.receivers).max_ns / MS
    assert jitter == 0


def test_receivers_that_take_too_long_have_no_place_and_no_promise(tmp_path: Path) -> None:
    """45 ms of the actuator and 70 of the chain are more than a cycle of 100."""
    application = described(tmp_path, time="45ms")
    profile = simulate(application, tmp_path / "profile", cycles=100)
    plan = plan_recording(profile, request=PlanRequest(policy="let-per-chain")).chains[0]
    assert known(plan.shaping_node).receivers_at is None
    assert plan.predicted.receivers is None
    (said,) = (one for one in plan_warnings(plan) if "/actuator" in one)
    assert "below all servers, and when their callbacks start is not promised" in said
    shaped = measure_latency(simulate(application, tmp_path / "shaped", Plan.of(plan), cycles=300))
    assert known(shaped.prediction).broken == (), "the output itself is in time"
    given = plan_recording(profile, request=PlanRequest(with_receivers=False)).chains[0]
    assert not [one for one in plan_warnings(given) if "/actuator" in one]


TWO = """\
name: two chains and an actuator on one core
chain: /a../b
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  a: {callbacks: [{timer: 100ms, execution: {uniform: [10ms, 12ms]}, publishes: [/a]}]}
  b: {callbacks: [{subscription: /a, execution: {uniform: [10ms, 12ms]}, publishes: [/b]}]}
  c: {callbacks: [{timer: 50ms, execution: {uniform: [5ms, 6ms]}, publishes: [/c]}]}
  d: {callbacks: [{subscription: /c, execution: {uniform: [5ms, 8ms]}, publishes: [/d]}]}
  actuator:
    callbacks: [{subscription: /b, execution: {constant: TIME}}, {subscription: /d}]
"""


def test_what_receivers_take_is_what_other_chains_wait_for(tmp_path: Path) -> None:
    added = []
    for time in ("0ms", "3ms"):
        folder = tmp_path / time
        folder.mkdir()
        application = described(folder, time=time, text=TWO)
        profiles = profile_chains(
            simulate(application, folder / "rec", cycles=200), ("/a../b", "/c../d")
        )
        plan, _ = plan_application(profiles)
        added.append([known(one.evidence.interference_ns) / MS for one in plan.chains])
        assert all(known(one.shaping_node).receivers_at for one in plan.chains)
        shaped = simulate(application, folder / "shaped", plan, cycles=300)
        for chain in plan.chains:
            judged = known(measure_latency(shaped, chain.chain.spec).prediction)
            assert judged.broken == ()
            assert known(judged.receivers).behind == 0
    assert added[1][1] - added[0][1] == pytest.approx(3, abs=0.2), "/c../d waits for /b's receiver"


def test_live_nodes_that_receive_stand_between_the_chain_and_its_gate(tmp_path: Path) -> None:
    """80 for the chain, 85 for the shaping node."""
    application = described(tmp_path)
    plan = plan_recording(simulate(application, tmp_path / "profile", cycles=100)).chains[0]
    spliced = splice_application(application, Plan.of(plan))
    priorities = [spliced.scheduling_of(name).priority for name in ("b", "actuator")]
    gate = known(plan.shaping_node)
    assert [*priorities, gate.fifo_priority] == [80, 84, 85]
    assert spliced.scheduling_of("actuator").core == 1


THREE = """\
name: three chains on a core each, and one actuator for all
chain: /a
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  a: {core: 1, callbacks: [{timer: 100ms, execution: {constant: 5ms}, publishes: [/a]}]}
  b: {core: 2, callbacks: [{timer: 100ms, execution: {constant: 5ms}, publishes: [/b]}]}
  c: {core: 3, callbacks: [{timer: 100ms, execution: {constant: 5ms}, publishes: [/c]}]}
  actuator:
    core: 4
    callbacks:
      - {subscription: /a, execution: {constant: 3ms}}
      - {subscription: /b, execution: {constant: 2ms}}
      - {subscription: /c, execution: {constant: 1ms}}
"""


def test_outputs_of_several_chains_wait_for_each_other_at_their_receiver(tmp_path: Path) -> None:
    """Under LET they leave at one time: of 3, 2 and 1 ms the last has waited for 5 ms at most."""
    application = described(tmp_path, text=THREE)
    profiles = profile_chains(
        simulate(application, tmp_path / "rec", cycles=100), ("/a", "/b", "/c")
    )
    plan, _ = plan_application(profiles, PlanRequest(policy="let-per-chain"))
    shaped = simulate(application, tmp_path / "shaped", plan, cycles=300)
    waits = (3, 4, 5)  # of /a for the others' 2 and 1 ms, and so on
    for chain, wait_ms in zip(plan.chains, waits, strict=True):
        promised = known(chain.predicted.receivers)
        assert wait_ms * MS <= promised.jitter_ns - chain.predicted.jitter_ns < (wait_ms + 0.3) * MS
        judged = known(measure_latency(shaped, chain.chain.spec).prediction)
        assert judged.broken == ()
        assert known(judged.receivers).behind == 0


FORK = """\
name: two outputs of one graph
chain: /a../b
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  a: {callbacks: [{timer: 100ms, execution: {constant: 5ms}, publishes: [/a]}]}
  b: {callbacks: [{subscription: /a, execution: {constant: 10ms}, publishes: [/b]}]}
  d: {callbacks: [{subscription: /a, execution: {constant: 10ms}, publishes: [/d]}]}
  actuator: {callbacks: [{subscription: /b}]}
  display: {callbacks: [{subscription: /d}]}
"""


def test_of_further_sinks_receivers_have_no_place_and_the_plan_says_so(tmp_path: Path) -> None:
    application = described(tmp_path, text=FORK)
    recording = simulate(application, tmp_path / "profile", cycles=100)
    plan = plan_recording(recording, sinks=["/a../d"]).chains[0]
    (sink,) = plan.further_shaping_nodes
    assert (sink.receivers, sink.receivers_at) == (("/display",), None)
    (said,) = (one for one in plan_warnings(plan) if "/display" in one)
    assert "no place in the plan" in said and "/display run below all servers" in said
    assert "--chain instead of --sink" in said
    both, _ = plan_application(profile_chains(recording, ("/a../b", "/a../d")))
    assert all(known(one.shaping_node).receivers_at for one in both.chains), "as it says"
    assert not [one for one in plan_warnings(*both.chains) if "no place" in one]


def test_behind_an_asynchronous_publisher_receivers_have_no_promise() -> None:
    plan = small_chain_plan(10 * MS, 20 * MS, publication="asynchronous", overrun="wait")
    (said,) = (one for one in plan_warnings(plan) if "who receives /t3" in one)
    assert "--publication synchronous" in said
    assert not [one for one in plan_warnings(small_chain_plan(10 * MS, 20 * MS)) if "who" in one]
