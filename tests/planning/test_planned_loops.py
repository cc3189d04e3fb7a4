"""Plans of chains into a loop, from measured latencies and a measured loop: where slots are put."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from known import known

from chainshaper.planning import (
    ChainPlan,
    Plan,
    Profile,
    plan_application,
    plan_chain,
    plan_warnings,
    publish_slots,
)
from chainshaper.planning.chain_plan import PlannedLoop, loop_common_ns
from chainshaper.planning.loop_ages import LoopTimes, straddles
from chainshaper.planning.overruns import why_not_followed
from chainshaper.planning.profile import Reception, RecordedLoop
from chainshaper.planning.request import PlanRequest
from chainshaper.planning.shaping import CallbackTimes
from chainshaper.values.errors import InputError, OperationError

MS, US = 1_000_000, 1_000
LOOP = RecordedLoop(
    chain="/scan../command",
    node="/controller",
    topic="/out",
    samples=500,
    stored_ns=(100 * US, 400 * US, 2 * MS),
    period_ns=10 * MS,
    phase_ns=4 * MS,
    jitter_ns=50 * US,
    core=1,
    time_ns=200 * US,
    once_ns=100 * US,
)
"""Starts 4 to 4.05 ms behind a cycle, and 10 ms later; its lead is 500 us."""


def profile(
    loop: RecordedLoop | None = LOOP,
    *,
    spec: str = "/scan../out",
    first: str = "/scan",
    output: str = "/out",
    node: str = "/sensor",
    period: int = 20 * MS,
    longest: int = 8 * MS,
) -> Profile:
    """Of a chain that takes 5 to 8 ms, on core 0; the receiver's executor has none of servers."""
    latencies = np.linspace(longest - 3 * MS, longest, 400).astype(np.int64)
    return Profile(
        latencies,
        period,
        spec=spec,
        nodes=(node,),
        topics=(output,),
        begins=(hash(first) % 1000, node),
        upstream=frozenset((output,)),
        core_of={node: 0},
        cores={node: 0},
        every_node=(node, "/controller"),
        receivers=("/controller",),
        reception=Reception(1, 100 * US, 200 * US, 400 * US, 50 * US),
        callbacks=(CallbackTimes(node, 0, longest, longest, longest, publishes=output),),
        loop=loop,
    )


def planned(loop: RecordedLoop = LOOP, **wishes: Any) -> tuple[ChainPlan, PlannedLoop]:
    plan = plan_chain(profile(loop), PlanRequest(**{"epsilon_ns": MS, **wishes}))
    return plan, known(plan.loop)


def test_a_plan_states_how_old_the_data_of_its_loop_are() -> None:
    """The slot starts at 9 ms, messages are stored by 9.5 ms, and the loop starts at 14 ms."""
    plan, loop = planned()
    assert publish_slots(plan) == ((9 * MS, 10 * MS),)
    assert (loop.chain, loop.lead_ns, loop.moved_ns) == ("/scan../command", 500 * US, 0)
    assert loop.age.first_ns == (14 * MS, 14 * MS + 50 * US)
    assert loop.age.every_ns == (14 * MS, 24 * MS + 50 * US)
    assert (loop.age.uses, loop.age.constant) == ((2, 2), True)
    whichever = known(loop.age_at_any_phase)
    assert whichever.first_ns == (9_100_001, 19_549_999)
    assert not whichever.constant
    runs_at = known(loop.runs_at)
    assert (runs_at.core, runs_at.priority, runs_at.time_ns) == (1, 1, 200 * US)
    (note,) = (line for line in plan_warnings(plan) if "--in-step" in line)
    assert "lies between 9.100 and 19.550 ms" in note


def test_a_loop_that_is_real_time_by_itself_is_left_as_it_is() -> None:
    _, loop = planned(replace(LOOP, realtime_priority=50))
    assert loop.runs_at is None
    assert loop.realtime_priority == 50
    plan = plan_chain(replace(profile(), reception=None), PlanRequest(epsilon_ns=MS))
    assert known(plan.loop).runs_at is None
    assert any("the plan no place for it beside receivers" in line for line in plan_warnings(plan))


@pytest.mark.parametrize(
    ("phase", "start"),
    # Stored from 9.1 ms to 9.5 ms: the loop may start at 9.1 ms, or from 9.5 ms on.
    [(9_000_000, 9_000_000), (9_100_000, 9_050_000), (9_499_999, 9_449_999), (9_500_000, 9 * MS)],
)
def test_a_slot_is_moved_behind_the_loop_that_would_start_meanwhile(phase: int, start: int) -> None:
    plan, loop = planned(replace(LOOP, phase_ns=phase))
    ((begins, ends),) = publish_slots(plan)
    assert (begins, ends - begins) == (start, MS)
    assert loop.moved_ns == start - 9 * MS
    assert loop.age.constant
    assert plan.predicted.max_ns == ends
    chain, _ = plan.servers
    assert chain.slots == ((0, start),), "the chain has its core until then"


@settings(deadline=None, max_examples=60)
@given(
    st.sampled_from([1, 2, 5, 10, 15, 20, 30, 40]),
    st.integers(0, 40_000),
    st.integers(0, 400),
    st.integers(0, 400),
)
def test_no_slot_straddles_and_each_is_the_nearest(
    period: int, phase_us: int, jitter_us: int, delivery_us: int
) -> None:
    """Tried out at every microsecond from the place of the shortest latency on."""
    shortest = 50 * US
    delivery = (shortest, shortest + delivery_us * US, shortest + delivery_us * US)
    recorded = replace(
        LOOP,
        period_ns=period * MS,
        phase_ns=phase_us * US % (period * MS),
        jitter_ns=jitter_us * US,
        stored_ns=delivery,
    )

    def is_clear(start: int, loop: RecordedLoop = recorded) -> bool:
        lead = delivery[1] + max(100 * US, -(-delivery[1] // 4))
        stored = (start + shortest, start + lead - 1)
        return not straddles(
            LoopTimes(20 * MS, stored, loop.period_ns or 0, loop.phase_ns, loop.jitter_ns)
        )

    clear = (start for start in range(9 * MS, 19 * MS + 1, US) if is_clear(start))
    nearest = next(clear, None)
    try:
        plan, _ = planned(recorded)
    except OperationError as error:
        assert nearest is None, str(error)
        return
    ((start, _),) = publish_slots(plan)
    assert is_clear(start)
    assert start == nearest


def test_a_plan_without_a_clear_place_is_refused_with_the_numbers() -> None:
    """It would be clear at 19.45 ms, but the cycle ends."""
    late = replace(profile(replace(LOOP, period_ns=20 * MS, phase_ns=19_300_000), longest=17 * MS))
    with pytest.raises(OperationError) as caught:
        plan_chain(late, PlanRequest(epsilon_ns=1_900 * US))
    message = str(caught.value)
    for words in (
        "between 19 ms and 19.399999 ms",
        "every 20 ms",
        "jitter of 50 us",
        "--move-loop",
    ):
        assert words in message.replace("µs", "us"), message
    assert "--chain /scan../out" in message


@pytest.mark.parametrize(
    ("period", "phase", "start"),
    [
        (10, 4.0, 13.5),  # the loop starts at 14 ms
        (20, 4.0, 23.5),  # at 24 ms: the slot ends with the cycle, and the message waits
        (40, 12.0, 11.5),  # at 12 ms, modulo 20
        (1, 0.25, 9.75),  # at 10.25 ms
    ],
)
def test_in_step_the_slot_lies_the_lead_before_the_loop(
    period: int, phase: float, start: float
) -> None:
    recorded = replace(LOOP, period_ns=period * MS, phase_ns=round(phase * MS))
    plan, loop = planned(recorded, in_step=True)
    ((begins, _),) = publish_slots(plan)
    gate = known(plan.shaping_node)
    latest = 20 * MS - max(MS, gate.pause_ns + 400 * US)
    assert begins == min(round(start * MS), latest)
    assert loop.starts_ns == (9 * MS, latest)
    assert loop.in_step == "output"
    common = loop_common_ns(plan)
    low, high = loop.age.first_ns
    assert (low - round(phase * MS)) % common == 0
    assert high - low == loop.jitter_ns
    assert loop.age.constant
    whichever = known(loop.age_at_any_phase)
    assert whichever.first_ns == (9_500_000, 9_500_000 + common - 1 + 50 * US)
    chain, _ = plan.servers
    assert chain.slots == ((0, 9 * MS),), "the chain is done then"


def test_slots_in_step_do_not_follow_latencies() -> None:
    assert why_not_followed(planned()[0]) is None
    reason = "they are in step with the loop of /controller"
    assert why_not_followed(planned(in_step=True)[0]) == reason


def test_a_loop_is_moved_behind_the_slot() -> None:
    plan, loop = planned(move_loop=True)
    assert publish_slots(plan) == ((9 * MS, 10 * MS),)
    assert (loop.in_step, loop.move_ns) == ("loop", 5_500_000), "from 4 to 9.5 ms"
    assert loop.age.first_ns == (9_500_000, 9_550_000)
    assert loop.age_at_any_phase == loop.age
    assert any("5.500 ms later than it was" in line for line in plan_warnings(plan))


IRREGULAR = replace(LOOP, period_ns=None, intervals_ns=(5 * MS, 10 * MS, 40 * MS))
WRONG = [
    (IRREGULAR, {}, InputError, r"sleeps irregularly: 10 ms .* from 5 ms \(p5\) to 40 ms"),
    (replace(LOOP, period_ns=15 * MS), {}, InputError, "are 5 ms apart, over 10 ms"),
    (replace(LOOP, inferred=True), {}, InputError, "no events of the sleeps of"),
    (LOOP, {"bands": 2}, InputError, "one band"),
    (LOOP, {"policy": "let-per-chain"}, InputError, "of the policy shaped"),
    (LOOP, {"publication": "asynchronous"}, InputError, "not a publisher's thread"),
    (
        replace(LOOP, period_ns=MS, phase_ns=0, jitter_ns=700 * US),
        {},
        InputError,
        "within 400 us .* a jitter of 700 us: together no shorter than the 1 ms",
    ),
]


@pytest.mark.parametrize("option", ["in_step", "move_loop"])
@pytest.mark.parametrize("case", WRONG, ids=lambda case: case[3])
def test_what_cannot_be_in_step_is_refused(case: tuple[Any, ...], option: str) -> None:
    recorded, wishes, kind, words = case
    with pytest.raises(kind, match=words.replace("us", "[uµ]s")) as caught:
        planned(recorded, **wishes, **{option: True})
    assert str(caught.value).startswith(f"--{option.replace('_', '-')}: ")


def test_a_chain_without_a_loop_is_in_step_with_none() -> None:
    with pytest.raises(InputError, match=r"--in-step: /scan../out goes through no loop"):
        plan_chain(profile(None), PlanRequest(in_step=True))
    with pytest.raises(InputError, match="give one of the two"):
        planned(in_step=True, move_loop=True)
    assert plan_chain(profile(None)).loop is None


def test_an_output_that_comes_too_soon_for_the_loop_before_is_refused() -> None:
    """A chain that takes 18 ms: before an instance at 27 ms the slot ends at 20 ms."""
    recorded = replace(LOOP, period_ns=2 * MS, phase_ns=0)
    with pytest.raises(OperationError, match=r"too soon for it. Move the loop instead"):
        plan_chain(
            profile(recorded, longest=17 * MS), PlanRequest(epsilon_ns=1_500 * US, in_step=True)
        )
    plan = plan_chain(
        profile(recorded, longest=17 * MS), PlanRequest(epsilon_ns=1_500 * US, move_loop=True)
    )
    assert known(plan.loop).age.constant


def test_irregular_and_drifting_loops_have_ages_at_any_phase() -> None:
    plan, loop = planned(IRREGULAR)
    assert loop.age.first_ns == (9_100_001, 29_499_999), "the newest message is used, in any case"
    assert not loop.age.constant
    assert any("sleeps irregularly" in line for line in plan_warnings(plan))
    plan, loop = planned(replace(LOOP, drift_ppm=50.0, phase_ns=9_200_000))
    assert loop.moved_ns == 0, "the phase comes round"
    assert loop.age == loop.age_at_any_phase
    assert any("180.0 ms in an hour" in line for line in plan_warnings(plan))
    plan, _ = planned(replace(LOOP, inferred=True))
    assert any("it reads its data sooner" in line for line in plan_warnings(plan))
    _, loop = planned(replace(LOOP, drift_ppm=50.0), in_step=True)
    assert loop.age.constant


def test_ages_under_other_policies_are_stated() -> None:
    """Where nothing is shaped, messages are stored for as long as latencies are apart."""
    _, loop = planned(policy="server-per-chain")
    assert loop.age.first_ns == (14 * MS, 14 * MS + 50 * US)
    plan, loop = planned(replace(LOOP, phase_ns=7 * MS), policy="server-per-chain")
    assert loop.age.first_ns == (7 * MS, 17 * MS + 50 * US)
    assert not loop.age.constant
    assert any("chance decides" in line for line in plan_warnings(plan))
    plan, loop = planned(bands=2)
    assert len(publish_slots(plan)) == 2
    assert loop.age.first_ns == (14 * MS, 14 * MS + 50 * US), "of both bands"
    fast = replace(LOOP, period_ns=MS, phase_ns=0)
    with pytest.raises(OperationError, match="No later slot helps"):
        planned(fast, bands=2)  # outputs leave at any time of the first band's slot
    plan, loop = planned(fast, bands=2, into_open_slot="next-slot")
    assert loop.age.first_ns[1] - loop.age.first_ns[0] > MS
    assert not loop.age.constant


def test_a_message_that_the_loop_takes_itself_was_there_when_it_was_taken_soonest() -> None:
    _, loop = planned(replace(LOOP, takes_itself=True, stored_ns=(0, 300 * US, 300 * US)))
    assert loop.delivery_ns == (0, 300 * US, 300 * US)
    _, loop = planned(replace(LOOP, storing_ns=30 * US), delivery_ns=500 * US)
    assert loop.delivery_ns == (500 * US, 530 * US, 530 * US), "it is handed over then"


def test_several_chains_into_a_loop_leave_for_it_one_before_another() -> None:
    """Branches of one timer, and chains of different ones."""
    second = replace(LOOP, topic="/other", chain="/scan../other..command")
    short = profile(longest=4 * MS)
    branch = profile(second, spec="/scan../other", output="/other", longest=4 * MS)
    request = PlanRequest(epsilon_ns=MS, in_step=True)
    plan, _ = plan_application([short, branch], request)
    slots = [publish_slots(chain)[0] for chain in plan.chains]
    assert slots == [(13_500_000, 14_500_000), (12_500_000, 13_500_000)]
    assert [known(chain.loop).age.first_ns[0] for chain in plan.chains] == [14 * MS, 14 * MS]
    with pytest.raises(InputError, match="both go into the loop of /controller"):
        plan_application([short, branch], PlanRequest(epsilon_ns=MS, move_loop=True))
    alone, _ = plan_application(
        [short, profile(None, spec="/scan../other", output="/other", longest=4 * MS)], request
    )
    assert [chain.loop is None for chain in alone.chains] == [False, True]
    apart = profile(
        second, spec="/b../other", first="/b", output="/other", node="/b", longest=4 * MS
    )
    plan, _ = plan_application([short, apart], PlanRequest(epsilon_ns=MS))
    assert isinstance(plan, Plan)
    for chain in plan.chains:  # their offsets are not those of the recording
        loop = known(chain.loop)
        assert loop.age == loop.age_at_any_phase
