"""Chains longer than their period: the shortest cut, against brute force and by hand; plans."""

import random
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from bare_plans import MS, slots_ms
from hypothesis import given, settings
from hypothesis import strategies as st

from chainshaper.enforcement.slot_dispatcher import boundaries_of
from chainshaper.planning import CallbackTimes, ChainPlan, PlanRequest, Profile, plan_chain
from chainshaper.planning.chain_plan import publish_slots
from chainshaper.planning.overruns import (
    cycles_until_output,
    in_cycle,
    open_until_done,
    plan_warnings,
)
from chainshaper.planning.pipeline import Work, finished, opened_early, shortest_cut, work_of
from chainshaper.planning.plan import Plan
from chainshaper.planning.plan import open_until_done as joint_until_done
from chainshaper.planning.plan_file import dump_plan, load_plan
from chainshaper.planning.request import cores_for
from chainshaper.values.errors import InputError, OperationError


def apart(slots: Sequence[tuple[int, int]], cycle: int) -> bool:
    """Whether slots of the latency axis overlap at no instant of the cycle: by counting."""
    taken = [instant % cycle for start, end in slots for instant in range(start, end)]
    return len(taken) == len(set(taken))


def partitions(count: int) -> Iterator[list[list[int]]]:
    """All ways to put so many units into stages."""
    if not count:
        yield []
        return
    for smaller in partitions(count - 1):
        for k in range(len(smaller)):
            yield [[*own, count - 1] if k == number else own for number, own in enumerate(smaller)]
        yield [*smaller, [count - 1]]


def in_order(stages: Sequence[Sequence[int]], after: Sequence[Sequence[int]]) -> list[int] | None:
    """Stages, each behind those that it waits for; None: one waits for what waits for it."""
    needs = [
        {k for unit in own for b in after[unit] for k, o in enumerate(stages) if b in o} - {number}
        for number, own in enumerate(stages)
    ]
    order: list[int] = []
    while len(order) < len(stages):
        ready = [k for k in range(len(stages)) if k not in order and needs[k] <= {*order}]
        if not ready:
            return None
        order.append(ready[0])
    return order


def brute_force(work: Work, margin: int, cycle: int, places: int) -> tuple[int, int, int] | None:
    """The least (end, stages, cores): all stages, every core of each, every start."""
    best = None
    for stages in partitions(len(work.after)):
        order = in_order(stages, work.after)
        if order is None:
            continue
        lengths = [
            max(sum(row[u] for u in own) for row in work.steps_ns.tolist()) for own in stages
        ]
        for core_of in product(range(places), repeat=len(stages)):
            for waits in product(range(cycle), repeat=len(stages)):
                starts = [0] * len(stages)
                for k in order:
                    before = [
                        starts[n] + lengths[n]
                        for n, own in enumerate(stages)
                        if n != k and any(b in own for unit in stages[k] for b in work.after[unit])
                    ]
                    begins = [work.begins_ns[unit] for unit in stages[k]]
                    starts[k] = max([*before, *begins]) + waits[k]
                first = next(k for k, own in enumerate(stages) if work.first in own)
                end = max(s + length for s, length in zip(starts, lengths, strict=True))
                found = end, len(stages), len(set(core_of))
                if starts[first] or (best is not None and best <= found):
                    continue
                slots = [(s, s + w + margin) for s, w in zip(starts, lengths, strict=True)]
                of_core = [
                    [slot for slot, own in zip(slots, core_of, strict=True) if own == core]
                    for core in range(places)
                ]
                if all(apart(own, cycle) for own in of_core):
                    best = found
    return best


Problem = tuple[Work, int, int, int]


@st.composite
def problems(draw: st.DrawFn) -> Problem:
    """A chain, or a graph whose branches fork from it or begin by themselves, and join it."""
    count = draw(st.integers(1, 4))
    step = st.integers(1, 4)
    rows = draw(st.lists(st.lists(step, min_size=count, max_size=count), min_size=1, max_size=3))
    after: list[set[int]] = [{k - 1} if k else set() for k in range(count)]
    if draw(st.booleans()):
        after = [
            draw(st.sets(st.integers(0, k - 1), max_size=2)) if k else set() for k in range(count)
        ]
    waited_for = set().union(*after)
    after[-1] |= {k for k in range(count - 1) if k not in waited_for}  # the last waits for all
    begins = [draw(st.integers(0, 2)) if k and not own else 0 for k, own in enumerate(after)]
    nodes = [str(draw(st.sampled_from([k, k, k, max(0, k - 1)]))) for k in range(count)]
    waits = [tuple(sorted(own)) for own in after]
    work = work_of(nodes, waits, np.array(rows), begins)
    cycle, places = draw(st.integers(3, 6)), draw(st.integers(1, 3))
    return work, draw(st.integers(0, 1)), cycle, places


@settings(max_examples=300, deadline=None)
@given(problems())
def test_the_cut_is_the_shortest_there_is(problem: Problem) -> None:
    work, margin, cycle, places = problem
    stages = shortest_cut(work, margin, cycle, places)
    shortest = brute_force(work, margin, cycle, places)
    if stages is None:
        assert shortest is None
        return
    used = len({stage.place for stage in stages})
    ends = max(stage.closes_ns for stage in stages)
    assert (ends - margin, len(stages), used) == shortest
    assert sorted(unit for stage in stages for unit in stage.members) == [*range(len(work.after))]
    home = {unit: stage for stage in stages for unit in stage.members}
    assert home[work.first].opens_ns == 0
    for unit, before in enumerate(work.after):
        assert home[unit].opens_ns >= work.begins_ns[unit]
        for one in before:
            if home[one] is not home[unit]:
                assert home[one].closes_ns - margin <= home[unit].opens_ns

    opened = opened_early(stages, work, margin, cycle)
    closed = max(stage.closes_ns for stage in opened)
    assert int(work.finished_ns[0, -1]) + margin <= closed <= ends
    for row in work.steps_ns:  # every instance is through each stage before its slot closes, but ε
        over: dict[int, int] = {}
        for number in in_order([one.members for one in opened], work.after) or ():
            stage = opened[number]
            inputs = [over.get(one, 0) for u in stage.members for one in work.after[u]] + [
                work.begins_ns[u] for u in stage.members
            ]
            now = max(stage.opens_ns, *inputs) + sum(int(row[unit]) for unit in stage.members)
            assert now <= stage.closes_ns - margin
            over |= dict.fromkeys(stage.members, now)
    for place, some in product(range(places), (stages, opened)):
        own = [s for s in some if s.place == place]
        slots = [slot for s in own for slot in in_cycle(s.opens_ns, s.closes_ns, cycle)]
        assert all(0 <= start < end <= cycle for start, end in slots)
        assert apart(slots, cycle)


# Plans -----------------------------------------------------------------------------------------


def profile(
    rows: Sequence[Sequence[int]], nodes: Sequence[str] | None = None, **values: object
) -> Profile:
    """A chain with these times (ms) of its callbacks, which was recorded on core 1."""
    steps = np.array([*rows, *rows]) * MS
    names = [f"/n{number}" for number in range(1, steps.shape[1] + 1)] if nodes is None else nodes
    given = {
        "nodes": tuple(names),
        "topics": tuple(f"/t{number}" for number in range(1, len(names) + 1)),
        "core_of": dict.fromkeys(names, 1),
        "callbacks": tuple(CallbackTimes(node, 1, MS, MS, MS) for node in names),
        "steps_ns": steps,
        "every_step_ns": steps,
    }
    return Profile(steps.sum(axis=1), 100 * MS, **{**given, **values})  # type: ignore[arg-type]


def planned(
    rows: Sequence[Sequence[int]], nodes: Sequence[str] | None = None, **wishes: object
) -> ChainPlan:
    request = {"policy": "pipelined", "cores": (0, 1), "epsilon_ns": MS, **wishes}
    return plan_chain(profile(rows, nodes), PlanRequest(**request))  # type: ignore[arg-type]


ROWS = [[30, 40, 50, 40], [20, 30, 40, 30], [40, 40, 30, 20]]
"""The longest instance takes 160 ms; from 50 to 80 ms in its first half, from 50 to 90 behind."""


def test_a_pipeline_by_hand(tmp_path: Path) -> None:
    plan = planned(ROWS)
    assert (plan.evidence.max_latency_ns, plan.margin.epsilon_ns) == (160 * MS, MS)
    # L̄ + ε is 161 ms. The second stage may begin at 50 ms, but its slot leaves 3 ms for Δ and the
    # pause behind the publication: it begins at 64 ms, which is no later than the data of any.
    second = [(0, 61), (64, 100)]
    assert slots_ms(plan) == {"stage1": [(0, 81)], "stage2": second, "output": [(61, 62)]}
    assert [s.core for s in plan.servers] == [1, 0, 0], "the first stage stays on its core"
    nodes = [[t.node for t in s.threads] for s in plan.servers[:2]]
    assert nodes == [["/n1", "/n2"], ["/n3", "/n4"]]
    assert (plan.predicted.mean_ns, plan.predicted.jitter_ns) == (162 * MS, MS)
    assert cycles_until_output(plan) == 1
    across = boundaries_of(plan.cycle_ns, tuple(server.slots for server in plan.servers[:2]))
    assert [1 in boundary.open for boundary in across] == [True, False, True, True], "not at 0"
    (tmp_path / "plan.yaml").write_text(dump_plan(Plan.of(plan)))
    assert load_plan(tmp_path / "plan.yaml") == Plan.of(plan)
    note = plan_warnings(plan)[0]
    assert "160.000 ms, 1.60 times its cycle, and has 2 stages: /n1, /n2 on core 1" in note
    assert "leave at 161.000 ms, once a cycle." in note
    enforced = slots_ms(open_until_done(plan))
    assert (enforced["stage1"], enforced["stage2"]) == ([(0, 100)], second), "overruns may finish"
    slots = {one.name: one.slots for one in joint_until_done(Plan.of(plan), [2 * MS]).servers}
    assert slots["stage1"] == ((0, 97 * MS),), "its timer waits: all slots count from one instant"


def test_a_stage_that_overran_goes_on_while_the_next_one_of_its_core_waits_for_it() -> None:
    """The third stage has the second's core, and the better priority: what is older goes first."""
    plan = planned([[49, 69, 48]])
    assert {server.name: (server.core, server.priority) for server in plan.servers} == {
        "stage1": (1, 2), "stage2": (0, 2), "stage3": (1, 2), "output": (1, 1)
    }  # fmt: skip
    opened = open_until_done(plan)
    assert {server.name: server.priority for server in opened.servers} == {
        "stage1": 3, "stage2": 2, "stage3": 2, "output": 1
    }  # fmt: skip
    enforced = slots_ms(opened)
    assert enforced["stage1"] == [(0, 99)], "through the third stage's slot, [50, 99)"
    assert enforced["stage2"] == [(0, 49), (49, 100)], "nothing else has its core"
    assert enforced["stage3"] == [(50, 99)], "then the output leaves"
    besides = {server.name: server.slots for server in open_until_done(plan, 0, {1}).servers}
    assert besides["stage1"] == ((0, 50 * MS),), "where other chains have the core, as planned"
    waiting = {server.name: server.slots for server in open_until_done(plan, 2 * MS).servers}
    assert waiting["stage1"] == ((0, 98 * MS),), "its timer waits"


def test_a_pipeline_is_measured_on_the_cores_of_its_stages() -> None:
    """By the medians, of which no half is longer than a cycle; and where no cut fits, evenly."""
    request = PlanRequest(policy="pipelined")
    noisy = profile([*ROWS, [30, 40, 300, 40]])
    assert cores_for([noisy], (1, 0), request) == {"/n1": 1, "/n2": 1, "/n3": 0, "/n4": 0}
    assert cores_for([profile([[90, 90, 90, 90]])], (1, 0), request)["/n3"] == 0


def test_a_gate_that_publishes_during_a_stage_has_its_time_beside_it() -> None:
    """Stages of 50 ms each fill the core: the output leaves at 0, while the first one has it."""
    with pytest.raises(OperationError, match=r"takes 167 ms, 1.67 .* and a stage 2.4 ms more"):
        planned([[49, 69, 49]])
    plan = planned([[47, 69, 47]], publish_slot_ns=5 * MS)
    slots = slots_ms(plan)
    assert slots["output"] == [(0, 5)], "behind the third stage there is no room for it"
    # 47 ms, 1 ms for ε, and 1.4 ms for the gate, which watches the clock for 1 ms of these.
    assert (slots["stage1"], slots["stage3"]) == ([(0, 49.4)], [(49.4, 98.8)])


def test_stages_wait_for_their_turn_or_share_a_core_that_is_named_twice() -> None:
    plan = planned([[49, 69, 48]])
    assert slots_ms(plan) == {
        "stage1": [(0, 50)],
        "stage2": [(0, 19), (49, 100)],
        "stage3": [(50, 99)],
        "output": [(99, 100)],
    }
    assert (plan.predicted.max_ns, cycles_until_output(plan)) == (200 * MS, 1)
    assert "32.000 ms of it for stages that wait for their turn" in plan_warnings(plan)[0]
    plan = planned([[80, 80, 80]], cores=(0, 1, 1))
    assert publish_slots(plan) == ((41 * MS, 42 * MS),)
    assert [(s.core, s.priority) for s in plan.servers[:3]] == [(1, 2), (1, 3), (0, 2)]
    assert "stage1 and stage2 have core 1 at the same time" in plan_warnings(plan)[1]
    plan = planned([[80, 80, 38]], cores=(0, 1, 2), publish_slot_ns=2 * MS)
    assert publish_slots(plan) == ((0, 2 * MS),), "a publish slot does not wrap"


@pytest.mark.parametrize(
    ("rows", "nodes", "wishes", "words"),
    [
        ([[30, 120, 30]], None, {}, r"work of /n2 takes up to 120 ms.*21 ms longer.*of 121 ms"),
        ([[60, 20, 60]], ["/a", "/b", "/a"], {}, "work of /a, /b together, which one thread"),
        ([[60, 60, 60]], None, {}, r"on the cores 0,1: it takes 180 ms, 1.80 .* 3 cores "),
        ([[60, 60, 60]], None, {"cores": None}, "on the cores 1: it takes 180 ms.* 3 cores"),
        ([[80, 80]], None, {"cores": (-1, 0)}, "core: .* greater than or equal to 0"),
        ([[80, 80]], None, {"anchor": "cycle"}, "anchor: an output of a pipeline is whole cycles"),
        ([[80, 80]], None, {"publication": "asynchronous"}, "needs a shaping node"),
        ([[80, 80]], None, {"policy": "shaped", "cores": None}, "or a pipeline of stages"),
    ],
)
def test_what_no_cut_can_do_is_refused(
    rows: list[list[int]], nodes: list[str] | None, wishes: dict[str, object], words: str
) -> None:
    with pytest.raises((InputError, OperationError), match=words):
        planned(rows, nodes, **wishes)


def test_only_a_single_path_that_was_recorded_is_cut() -> None:
    request = PlanRequest(policy="pipelined")
    with pytest.raises(InputError, match="plan from a recording"):
        plan_chain(Profile(np.array([80, 90]) * MS, 100 * MS), request)
    beside = [CallbackTimes(node, 1, 1, 1, 1) for node in ("/n1", "/rear", "/n2")]
    with pytest.raises(InputError, match="joins data of /rear, whose times are not known"):
        plan_chain(profile([[80, 80]], callbacks=tuple(beside)), request)


@st.composite
def graphs_on_cores(draw: st.DrawFn) -> tuple[list[tuple[int, ...]], list[int], list[int]]:
    """A graph whose last step waits for all others, how long each takes, and its core."""
    count = draw(st.integers(1, 7))
    after = [
        tuple(sorted(draw(st.sets(st.integers(0, step - 1), max_size=2)))) if step else ()
        for step in range(count)
    ]
    ends = set(range(count)).difference(*after)
    steps_ns = [draw(st.integers(1, 9)) for _ in range(count + 1)]
    cores = [draw(st.integers(0, 2)) for _ in range(count + 1)]
    return [*after, tuple(sorted(ends))], steps_ns, cores


def run_in_order(
    after: list[tuple[int, ...]], steps_ns: list[int], cores: list[int], urgent: list[int]
) -> int:
    """When the last step is over, if each core always runs the most urgent that is ready."""
    done: dict[int, int] = {}
    left = dict(enumerate(steps_ns))
    now = 0
    while left:
        running: dict[int, int] = {}
        for step in sorted(left, key=urgent.__getitem__):
            if all(before in done for before in after[step]):
                running.setdefault(cores[step], step)
        shortest = min(left[step] for step in running.values())
        now += shortest
        for step in running.values():
            left[step] -= shortest
            if not left[step]:
                del left[step]
                done[step] = now
    return now


@given(graphs_on_cores(), st.randoms(use_true_random=False))
def test_no_order_on_the_cores_ends_a_graph_later(
    graph: tuple[list[tuple[int, ...]], list[int], list[int]], generator: random.Random
) -> None:
    after, steps_ns, cores = graph
    row = np.array([steps_ns], dtype=np.int64)
    latest = int(finished(after, row, [0] * len(after), cores)[0, -1])
    for _ in range(5):
        urgent = generator.sample(range(len(after)), len(after))
        assert run_in_order(after, steps_ns, cores, urgent) <= latest
    on_one = int(finished(after, row, [0] * len(after), [0] * len(after))[0, -1])
    assert on_one == sum(steps_ns), "one core runs all that the last step waits for"
    apart = int(finished(after, row, [0] * len(after), range(len(after)))[0, -1])
    assert apart == int(finished(after, row, [0] * len(after))[0, -1]), "the longest way"
