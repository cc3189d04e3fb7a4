"""Several chains: how long others can have a chain's core, and which are planned together."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bare_plans import MS, slots_ms
from hypothesis import given
from hypothesis import strategies as st
from known import known

from chainshaper import load_application, measure_latency, simulate
from chainshaper.flow.plan import plan_recording, profile_chains
from chainshaper.planning import (
    CallbackTimes,
    PlanRequest,
    band_choice,
    place_chains,
    plan_application,
    plan_chain,
    plan_warnings,
    publish_slots,
)
from chainshaper.planning.chain_plan import with_slots
from chainshaper.planning.overruns import expected
from chainshaper.planning.plan import Plan, open_until_done
from chainshaper.planning.profile import Profile, Rival, alone, interference, with_interference
from chainshaper.reporting.latency import expected_text
from chainshaper.values.durations import milliseconds
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Policy
from chainshaper.values.recording import Recording
from chainshaper.verify.promises import outputs_due
from chainshaper.workload.description import Application


def _response(own: int, rivals: list[Rival], phases: list[int]) -> int:
    """What a job of the worst priority takes that arrives at 0, in whole steps of time."""
    left = [0] * len(rivals)
    now = done = 0
    while done < own:
        for place, (one, phase) in enumerate(zip(rivals, phases, strict=True)):
            left[place] += one.cost_ns * (now >= phase and (now - phase) % one.period_ns == 0)
        first = next((place for place, rest in enumerate(left) if rest), None)
        if first is None:
            done += 1
        else:
            left[first] -= 1
        now += 1
    return now


_RIVAL = st.builds(Rival, st.integers(8, 30), st.integers(1, 3), st.just(0))


@given(st.integers(1, 20), st.lists(st.tuples(_RIVAL, st.integers(0, 30)), max_size=2))
def test_no_phase_delays_more_and_one_delays_as_much(
    own: int, drawn: list[tuple[Rival, int]]
) -> None:
    rivals, phases = [one for one, _ in drawn], [phase for _, phase in drawn]
    longest = own + interference(own, rivals, 10_000)
    assert _response(own, rivals, phases) <= longest
    assert _response(own, rivals, [0] * len(rivals)) == longest  # all arrive at once


def test_what_waits_elsewhere_may_come_twice() -> None:
    # 6 + 2 of 20 while no instance is late; one that comes 15 later meets the next one's window.
    assert interference(6, [Rival(20, 2)], 100) == 2
    assert interference(6, [Rival(20, 2, 15)], 100) == 4
    assert interference(50, [Rival(10, 10)], 100) >= 50  # never ends: the limit does


GRAPH = """
name: a fork
chain: /in../left
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  source: {callbacks: [{timer: 100ms, execution: {constant: 2ms}, publishes: [/in]}]}
  left: {callbacks: [{subscription: /in, execution: {constant: 5ms}, publishes: [/left]}]}
  right: {callbacks: [{subscription: /in, execution: {constant: 7ms}, publishes: [/right]}]}
  first: {callbacks: [{timer: PERIOD, execution: {constant: 1ms}, publishes: [/first]}]}
  other: {callbacks: [{subscription: /first, execution: {constant: 2ms}, publishes: [/other]}]}
  sink:
    core: 0
    callbacks: [{subscription: /left}, {subscription: /right}, {subscription: /other}]
"""


def recorded(
    text: str, chains: Sequence[str], folder: Path, cycles: int
) -> tuple[Application, tuple[Profile, ...]]:
    """A described application, and what a simulation of it says of its chains."""
    (folder / "app.yaml").write_text(text)
    application = load_application(folder / "app.yaml")
    recording = simulate(application, folder / "rec", cycles=cycles)
    return application, profile_chains(recording, chains)


@pytest.mark.parametrize(("period", "before"), [("50ms", 0), ("40ms", 3)])
def test_branches_and_a_better_chain_by_hand(period: str, before: int, tmp_path: Path) -> None:
    chains = ("/in../left", "/in../right", "/first../other")
    _, profiles = recorded(GRAPH.replace("PERIOD", period), chains, tmp_path, cycles=40)
    alone = [int(one.every_step_ns.sum(axis=1).max()) / MS for one in profiles]
    # Dispatching and messages take some of a millisecond; the branch that came second, 5 ms later,
    # has not waited here.
    assert all(own <= found < own + 0.8 for own, found in zip([7, 9, 3], alone, strict=True))
    plan, remarks = plan_application(profiles, PlanRequest(epsilon_ns=0))
    sent = [(one.longest_publication_ns or MS) / MS for one in profiles]
    added = [(one.evidence.interference_ns or 0) / MS for one in plan.chains]
    # A branch waits for the other one, and for two gates, each 1 ms, a publication, and 0.4 ms for
    # taking a message; `other` for two gates. With 40 ms there is no room for turns: `other` runs
    # first, its callbacks 3 ms long.
    assert len(remarks) == (before > 0)
    behind = [7 + 2.8 + sent[1] + sent[2] + before, 5 + 2.8 + sent[0] + sent[2] + before]
    assert added == pytest.approx([*behind, 2.8 + sent[0] + sent[1]], abs=0.5)  # dispatching


def test_bands_are_where_outputs_come_and_the_last_is_behind_all_that_may_delay(
    tmp_path: Path,
) -> None:
    varied = GRAPH.replace("{constant: 5ms}", "{uniform: [2ms, 10ms]}").replace("PERIOD", "100ms")
    chains = ("/in../left", "/in../right")
    application, profiles = recorded(varied, chains, tmp_path, cycles=500)
    plan, _ = plan_application(profiles, PlanRequest(bands=3, publish_slot_ns=200_000))
    shaped = simulate(application, tmp_path / "shaped", plan, cycles=500)
    for profile, chain in zip(profiles, plan.chains, strict=True):
        seen, evidence = known(expected(chain)), chain.evidence
        assert evidence.min_latency_ns <= int(profile.latencies_ns.min())
        assert seen.leave_ns[-1] >= evidence.max_latency_ns + chain.margin.epsilon_ns
        assert f" to {milliseconds(chain.predicted.mean_ns)}" in expected_text(chain)
        said = known(measure_latency(shaped, chain.chain.spec).prediction)
        assert not said.broken
        for band in said.bands:  # the gate of the other output may be in the way
            assert band.share == pytest.approx(band.predicted_share, abs=0.15)


def _profile(name: str, latency_ms: int, stalls_ms: int = 0, last: str | None = None) -> Profile:
    """A chain of two callbacks on core 1; the machine stalled in nine of 300 cycles."""
    half = np.full(300, latency_ms * MS // 2)
    second = half.copy()
    second[:9] += stalls_ms * MS
    topics = (f"/{name}1", f"/{name}2")
    nodes, took = (topics[0], last or topics[1]), int(half[0])
    return Profile(
        2 * half,
        100 * MS,
        every_latency_ns=half + second,
        spec="..".join(topics),
        nodes=nodes,
        topics=topics,
        begins=(ord(name), name),
        core_of=dict.fromkeys(nodes, 1),
        callbacks=tuple(CallbackTimes(n, 1, MS, took, took, (0,) * k) for k, n in enumerate(nodes)),
        steps_ns=np.stack([half, half], axis=1),
        every_step_ns=np.stack([half, second], axis=1),
    )


def test_cycles_that_do_not_fit_into_the_period_do_not_hide_what_delays_the_others() -> None:
    """40 ms behind 20 of the other, and the other way round, with or without stalls of 80 ms."""
    wishes = PlanRequest(publication="asynchronous")  # no gates
    for groups, at_once, added_ms in (([[0, 1]], False, [20, 40]), ([[0], [1]], True, [0, 40])):
        for stalls_ms in (0, 80):
            both = [_profile("a", 40, stalls_ms), _profile("b", 20)]
            delayed = with_interference(both, groups, wishes, at_once=at_once)
            assert [(one.interference_ns or 0) / MS for one in delayed] == added_ms


def test_the_curve_of_bands_is_from_what_the_plan_is_made_from() -> None:
    """70 ms were measured, 40 of them the chain's own, which has 20 of the sink before it."""
    chain = replace(_profile("a", 40), latencies_ns=np.full(300, 70 * MS))
    sink, request = replace(_profile("b", 20), begins=chain.begins), PlanRequest(bands="auto")
    plan = plan_chain(chain, request, [sink])
    assert plan.evidence.max_latency_ns < 70 * MS
    chosen = band_choice(plan, chain, request, [sink]).chosen
    assert chosen.slot_ends_ns == tuple(end for _, end in publish_slots(plan))


def test_chains_that_do_not_fit_are_named_with_what_fits() -> None:
    # At once, /a takes 60 ms and, behind /b, 62.4 more; 24.4 ms too much with margin and slot.
    with pytest.raises(OperationError, match=r"24.4 ms too long") as refused:
        plan_application([_profile("a", 60), _profile("b", 60)])
    assert "core 1, 62.4 ms behind /a1../a2" in str(refused.value)
    assert "What helps: a longer period, or a shorter chain. It fits with --cores 1,2" in str(
        refused.value
    )
    # What passes one node has to take turns, for which stalls of 20 ms leave no room.
    both = [_profile(name, 40, 20, last="/filter") for name in "ab"]
    with pytest.raises(OperationError, match=r"does not stall \(--ideal-machine\)") as refused:
        plan_application(both)
    assert "They share the executor of /filter, and so have to take turns" in str(refused.value)
    assert "core for" not in str(refused.value)


def test_chains_of_which_only_latencies_are_known_take_turns() -> None:
    bare = Profile(np.array([20, 30]) * MS, 100 * MS)
    plan, _ = plan_application([bare, bare], PlanRequest(epsilon_ns=0))
    assert 30 * MS <= plan.chains[1].offset_ns - plan.chains[0].offset_ns <= 70 * MS


def test_chains_of_two_timers_of_one_node_take_turns() -> None:
    """Written by nodes, both begin with one name; their servers differ in nothing but time."""
    nodes, both = ("/source", "/filter"), []
    for one in (_profile("a", 30), _profile("b", 30)):
        stages = zip(one.callbacks, nodes, one.topics, strict=True)
        callbacks = tuple(replace(own, node=n, publishes=topic) for own, n, topic in stages)
        spec, cores = f"/source..{one.topics[-1]}", dict.fromkeys(nodes, 1)
        both.append(replace(one, spec=spec, nodes=nodes, core_of=cores, callbacks=callbacks))
    plan, _ = plan_application(both)
    (running, _), (other, _) = (chain.servers for chain in plan.chains)
    assert (running.name, other.name) == ("chain", "chain_2")
    assert (running.threads, running.slots) == (other.threads, other.slots)
    assert plan.chains[1].offset_ns >= running.slots[0][1]


def test_asynchronous_publishers_stay_behind_their_executors_at_priorities_of_their_own() -> None:
    """41 ms every 100 and 17 every 50 ms cannot take turns; each publishes in two bands."""
    both = []
    for one, period_ms in ((_profile("a", 40), 100), (_profile("b", 16), 50)):
        steps = one.steps_ns.copy()
        steps[::2, 1] -= 6 * MS
        varied = {"latencies_ns": steps.sum(axis=1), "steps_ns": steps, "every_step_ns": steps}
        both.append(replace(one, period_ns=period_ms * MS, every_latency_ns=None, **varied))
    request = PlanRequest(publication="asynchronous", bands=2, overrun="wait")
    plan, remarks = plan_application(both, request)
    assert len(remarks) == 1
    for carried_out in (plan, open_until_done(plan)):
        priorities = [[one.priority for one in chain.servers] for chain in carried_out.chains]
        assert priorities == [[4, 5], [2, 3]]
        assert all(one.slots for chain in carried_out.chains for one in chain.servers)


def test_a_smaller_margin_that_is_proposed_was_planned() -> None:
    both = [_profile("a", 41), _profile("b", 41)]
    with pytest.raises(OperationError, match="too long") as refused:
        plan_application(both, PlanRequest(epsilon_ns=55 * MS))
    margin = re.search(r"--epsilon ([\d.]+)ms$", str(refused.value))
    assert margin and "a margin of" not in str(refused.value)
    most = round(float(margin[1]) * MS)
    plan_application(both, PlanRequest(epsilon_ns=most))
    with pytest.raises(OperationError):
        plan_application(both, PlanRequest(epsilon_ns=most + MS // 10))


def test_chains_that_collide_get_a_named_core_that_is_idle() -> None:
    """The longest executions fit beside each other, but not with the machine's stalls."""
    both = [_profile(name, 30, 20) for name in "ab"]
    _, remarks = plan_application(both, PlanRequest(cores=(1,)))
    assert ["run at the same time" in one for one in remarks] == [True]
    plan, remarks = plan_application(both, PlanRequest(cores=(1, 2)))
    assert [one.servers[0].core for one in plan.chains] == [2, 1]
    assert not remarks


OVERRUNNING = """
name: two chains in turns
chain: /a1../a2
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  a1: {callbacks: [{timer: 100ms, execution: {constant: 5ms}, publishes: [/a1]}]}
  a2:
    callbacks: [{subscription: /a1, execution: {uniform: [5ms, 20ms]}, publishes: [/a2]}]
  b1: {callbacks: [{timer: 50ms, execution: {constant: 2ms}, publishes: [/b1]}]}
  b2: {callbacks: [{subscription: /b1, execution: {constant: 6ms}, publishes: [/b2]}]}
  sink: {core: 0, callbacks: [{subscription: /a2}, {subscription: /b2}]}
"""


TURNS = ("/a1../a2", "/b1../b2")


def test_an_overrun_goes_on_behind_the_next_chain_and_does_not_hit_it(tmp_path: Path) -> None:
    """The first chain's slot ends after 20 of up to 26 ms, and the second's follows at once."""
    application, profiles = recorded(OVERRUNNING, TURNS, tmp_path, cycles=100)
    first, second = plan_application(profiles)[0].chains
    earlier = {"chain": [(0, 20 * MS)], "output": [(20 * MS, 21 * MS)]}
    tight = [
        first.model_copy(update={"servers": with_slots(first.servers, earlier)}),
        second.model_copy(update={"offset_ns": 20 * MS}),
    ]
    shaped = simulate(application, tmp_path / "shaped", Plan.of(*tight), cycles=300)
    late, other = (measure_latency(shaped, chain).analysis.statistics for chain in TURNS)
    assert (other.late, other.jitter_ns) == (0, 0)
    # It had 6 ms to go at most, behind a slot of the second chain that lasts for 10 to 13.
    assert 60 < (late.late or 0) < 180
    assert 30 * MS < (late.max_ns or 0) < 41 * MS


@pytest.mark.parametrize("policy", ["pipelined", "server-per-callback", "let-per-callback"])
def test_chains_with_slots_per_callback_only_take_turns(policy: Policy, tmp_path: Path) -> None:
    """30 ms every 40 and 26 every 100 do not."""
    text = OVERRUNNING.replace("50ms", "40ms").replace("constant: 6ms", "constant: 22ms")
    _, profiles = recorded(text, TURNS, tmp_path, cycles=40)
    with pytest.raises(OperationError, match=f"core 1 .*Planned as {policy}, .* take turns"):
        plan_application(profiles, PlanRequest(policy=policy))


def test_simulated_servers_of_callbacks_begin_at_their_chains_offsets(tmp_path: Path) -> None:
    """A timer whose phase is late in its slot would be stopped, and cost a cycle."""
    text = OVERRUNNING.replace("50ms", "100ms, phase: 33ms")
    application, profiles = recorded(text, TURNS, tmp_path, cycles=100)
    plan, _ = plan_application(profiles, PlanRequest(policy="server-per-callback"))
    shaped = simulate(application, tmp_path / "shaped", plan, cycles=100)
    for chain, one in zip(TURNS, plan.chains, strict=True):
        found = measure_latency(shaped, chain)
        assert (found.analysis.statistics.max_ns or 0) < one.servers[-1].slots[-1][1]
        starts = found.analysis.traversals["start"] % (100 * MS)
        assert abs(starts - one.offset_ns).max() < MS


KNOWN = replace(_profile("a", 40), every_node=("/a1", "/a2", "/b1"))


@pytest.mark.parametrize(
    ("wishes", "said"),
    [
        ({"policy": "pipelined", "first_slot_ns": MS}, "the policy pipelined cuts the whole chain"),
        ({"policy": "server-per-callback", "first_slot_ns": MS}, "--first-slot gives the first"),
        ({"policy": "pipelined", "publish_slot_ns": 99 * MS}, "slot 99 ms leave nothing of the"),
        ({"best_effort": ("/b3",)}, "--best-effort /b3: no node of the recording, name /b1"),
        ({"best_effort": ("/nothere",)}, "no node of the recording, name /a1 or /a2 or /b1"),
    ],
)
def test_wishes_that_cannot_be_are_refused(wishes: dict[str, Any], said: str) -> None:
    with pytest.raises((InputError, OperationError), match=said):
        plan_chain(KNOWN, PlanRequest(**wishes))


def test_the_first_node_has_its_slot_on_its_own_core_and_best_effort_is_no_stage() -> None:
    """Timer on core 0, the rest on core 1: [0, 2) there, and [2, 41) ms here."""
    apart = replace(_profile("a", 40), core_of={"/a1": 0, "/a2": 1})
    plan = plan_chain(apart, PlanRequest(first_slot_ns=2 * MS))
    assert slots_ms(plan) == {"first": [(0, 2)], "chain": [(2, 41)], "output": [(41, 42)]}
    assert {one.name: one.core for one in plan.servers} == {"first": 0, "chain": 1, "output": 1}
    plan = plan_chain(KNOWN, PlanRequest(policy="pipelined", best_effort=("/b1",)))
    (stages,) = (one for one in plan_warnings(plan) if "stages:" in one)
    assert "/b1" not in stages
    with pytest.raises(InputError, match="plan with `plan_application`"):
        plan_recording("absent", ["/a1../a2", "/b1../b2"]).chains[0]  # type: ignore[arg-type]


# Chains of one graph ----------------------------------------------------------------------------


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
    return simulate(application, tmp_path_factory.mktemp("unshaped") / "rec", cycles=200)


@pytest.mark.parametrize("sink", ["/t1../forked", "/t1../twin"])
def test_a_sink_that_forks_off_is_planned_right(
    sink: str, application: Application, recording: Recording, tmp_path: Path
) -> None:
    """In force, both outputs come in their slots."""
    plan = plan_recording(recording, "/t1../t3", REQUEST, sinks=[sink]).chains[0]
    for server, chain in zip(plan.servers[-2:], ("/t1../t3", sink), strict=True):
        of_chain = application.model_copy(update={"chain": plan.chain.spec})
        shaped = simulate(of_chain, tmp_path / chain.replace("/", "_"), Plan.of(plan), cycles=200)
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
            plan_recording(recording, chains[0], period_ns=100 * MS, sinks=chains[1:]).chains[0]
        else:
            plan_application(profile_chains(recording, chains, period_ns=100 * MS))
    assert words in str(refused.value)
    assert all(chain in str(refused.value) for chain in chains)


def test_what_else_has_no_plan_together_is_refused(recording: Recording) -> None:
    one_by_one = [
        plan_recording(recording, chain).chains[0] for chain in ("/t1../t3", "/t1../forked")
    ]
    with pytest.raises(InputError, match="begin at the same callback: plan them together"):
        place_chains(one_by_one)
    with pytest.raises(InputError, match="both publish /t3"):
        place_chains(one_by_one[:1] * 2)
    with pytest.raises(InputError, match=r"/o1\.\./o2 begins at /other every 100ms"):
        plan_recording(recording, "/t1../t3", sinks=["/o1../o2"]).chains[0]
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


JOINING = """\
name: a chain that waits for a branch on another core, while another chain has its own
chain: /a../b../c
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  a: {callbacks: [{timer: 100ms, execution: {constant: 8ms}, publishes: [/a]}]}
  side: {core: 2, callbacks: [{subscription: /a, execution: {constant: 7ms}, publishes: [/side]}]}
  b: {callbacks: [{subscription: /a, execution: {constant: 2ms}, publishes: [/b]}]}
  c: {callbacks: [{synchronises: [/b, /side], execution: {constant: 3ms}, publishes: [/c]}]}
  d: {callbacks: [{timer: 100ms, phase: 4ms, execution: {constant: 5ms}, publishes: [/d]}]}
"""


def test_others_cost_nothing_while_a_chain_waits_for_its_branch(tmp_path: Path) -> None:
    """d runs from 8 to 13 ms and b behind it, to 15, when the branch is over too: the chain takes
    18 ms with d and without it, and not 5 ms less.
    """
    (tmp_path / "app.yaml").write_text(JOINING)
    recorded = simulate(load_application(tmp_path / "app.yaml"), tmp_path / "rec", cycles=50)
    joining, beside = profile_chains(recorded, ("/a../b../c", "/d"))
    assert 18 * MS <= min(joining.latencies_ns) <= max(joining.latencies_ns) < 19.5 * MS
    assert 18 * MS <= min(alone(joining).latencies_ns) < 19.5 * MS
    assert max(alone(beside).latencies_ns) < 5.5 * MS, "d waited for a"


ON_ONE_CORE = """\
name: a chain whose branches share its core, and another chain on that core
chain: /a../b../c
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  a: {callbacks: [{timer: 100ms, execution: {constant: 8ms}, publishes: [/a]}]}
  side: {callbacks: [{subscription: /a, execution: {constant: 7ms}, publishes: [/side]}]}
  b: {callbacks: [{subscription: /a, execution: {constant: 2ms}, publishes: [/b]}]}
  c: {callbacks: [{synchronises: [/b, /side], execution: {constant: 3ms}, publishes: [/c]}]}
  d: {callbacks: [{timer: 100ms, phase: 50ms, execution: {constant: 5ms}, publishes: [/d]}]}
"""


def test_branches_on_one_core_run_one_behind_the_other(tmp_path: Path) -> None:
    """a, both branches and c take 8 + 7 + 2 + 3 = 20 ms on their core, not the longest way's 18."""
    (tmp_path / "app.yaml").write_text(ON_ONE_CORE)
    application = load_application(tmp_path / "app.yaml")
    recorded = simulate(application, tmp_path / "rec", cycles=50)
    profiles = profile_chains(recorded, ("/a../b../c", "/d"))
    assert 20 * MS <= min(alone(profiles[0]).latencies_ns) < 21.5 * MS
    request = PlanRequest(anchor="cycle", ideal_machine=True)
    plan, remarks = plan_application(profiles, request)
    assert not remarks, "they take turns"
    shaped = simulate(application, tmp_path / "shaped", plan, cycles=50)
    measured = measure_latency(shaped, plan.chains[0].chain.spec)
    assert outputs_due(measured.analysis, plan.chains[0]).missed == 0
