"""Plans that gate an asynchronous publisher's thread: what would be destructive is refused."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chainshaper.planning import (
    Plan,
    let_per_callback_asynchronous,
    let_per_chain,
    load_plan,
    plan_shaping,
    publish_slots,
    save_plan,
    with_bands,
    with_long_slot,
)
from chainshaper.planning.plan import messages_held, output_server, publisher_servers, revised
from chainshaper.values.errors import InputError

MS = 1_000_000
LATENCIES = np.array([26, 40, 50, 58]) * MS


def asynchronous(**changes: Any) -> Plan:
    """The paper's section 5.2: the chain in [0, 59) ms, its publisher in [59, 60) ms."""
    given: dict[str, Any] = {
        "output": "/t5",
        "publisher": "/n5",
        "nodes": ["/n1", "/n5"],
        "core": 0,
    }
    given |= {"overrun": "wait", **changes}
    return plan_shaping(LATENCIES, 100 * MS, publication="asynchronous", **given)


def _publishing(plan: Plan, **changes: object) -> tuple[object, ...]:
    """The plan's servers, with the publisher's changed."""
    (number, server, _), *_ = publisher_servers(plan)
    changed = server.model_copy(update=changes)
    return tuple(changed if n == number else other for n, other in enumerate(plan.servers))


def test_the_papers_configuration_is_right() -> None:
    plan = asynchronous()
    assert [server.slots for server in plan.servers] == [((0, 59 * MS),), ((59 * MS, 60 * MS),)]
    assert plan.overrun == "wait"


@pytest.mark.parametrize("length", [1, 250_000, MS - 1])
def test_a_slot_in_which_a_send_may_be_cut_off_is_refused(length: int) -> None:
    with pytest.raises(InputError, match=r"too short .* block the whole process; make it 1ms"):
        asynchronous(publish_slot_ns=length)


def test_sends_that_were_measured_count_four_times() -> None:
    assert asynchronous(longest_send_ns=250_000).evidence.longest_send_ns == 250_000
    with pytest.raises(InputError, match=r"the longest took 251us.*make it 1\.004ms or longer"):
        asynchronous(longest_send_ns=251_000)
    asynchronous(longest_send_ns=2_500_000, publish_slot_ns=10 * MS)


def test_a_publisher_that_out_ranks_its_executor_is_refused() -> None:
    plan = asynchronous()
    inside = {"slots": ((40 * MS, 41 * MS), (59 * MS, 60 * MS))}
    said = r"out-rank its executor.*'chain' runs at priority 2 .* \[40ms, 41ms\).*above 2"
    with pytest.raises(InputError, match=said):
        revised(plan, servers=_publishing(plan, **inside))
    revised(plan, servers=_publishing(plan, **inside, priority=3))
    revised(plan, servers=_publishing(plan, **inside, core=1))


def test_before_the_shortest_latency_nothing_is_handed_over() -> None:
    """L̲ is 26 ms: who out-ranks whom until then is of no consequence."""
    plan = asynchronous()
    revised(plan, servers=_publishing(plan, slots=((25 * MS, 26 * MS), (59 * MS, 60 * MS))))
    with pytest.raises(InputError, match="out-rank"):
        revised(plan, servers=_publishing(plan, slots=((25 * MS, 26 * MS + 1),)))


def test_another_nodes_executor_may_be_out_ranked() -> None:
    plan = asynchronous(nodes=["/n1"])
    revised(plan, servers=_publishing(plan, slots=((40 * MS, 41 * MS),)))


def test_bands_and_long_slots_put_the_publisher_below_its_executor() -> None:
    for plan in (
        with_bands(asynchronous(), LATENCIES, 2),
        with_long_slot(asynchronous(), LATENCIES, 40 * MS),
    ):
        server = output_server(plan)
        assert server is not None
        assert server.priority == 3
    (single,) = [s for s in with_bands(asynchronous(), LATENCIES, 1).servers if s.name == "output"]
    assert single.priority == 1, "behind its executor's slot there is nobody to be below"


def test_logical_execution_time_goes_with_asynchronous_publication() -> None:
    assert publish_slots(let_per_chain(asynchronous())) == ((0, MS),)
    assert publish_slots(let_per_callback_asynchronous(asynchronous(), ["/n1", "/n5"])) == (
        (0, MS),
    )


@pytest.mark.parametrize(
    ("slots", "held"),
    [
        (((59, 60),), 1),  # closed for 99 ms: one message
        (((30, 31), (59, 60)), 1),
        (((0, 100),), 1),  # never closed, but the model knows no less than one
    ],
)
def test_messages_held_in_one_stretch(slots: tuple[tuple[int, int], ...], held: int) -> None:
    plan = asynchronous()
    (_, server, _), *_ = publisher_servers(plan)
    in_ns = tuple((start * MS, end * MS) for start, end in slots)
    assert messages_held(plan, server.model_copy(update={"slots": in_ns})) == held


def test_a_history_that_is_too_shallow_is_refused() -> None:
    plan = asynchronous(output_depth=3)
    # One slot in three cycles: closed for 299 ms, so three messages may come in one stretch.
    (_, server, _), *_ = publisher_servers(revised(plan, cycle_ns=300 * MS))
    assert messages_held(revised(plan, cycle_ns=300 * MS), server) == 3
    shallow = plan.chain.model_copy(update={"output_depth": 2})
    with pytest.raises(InputError, match=r"history of 2 is too shallow.*3 messages.*depth of 4"):
        revised(plan, cycle_ns=300 * MS, chain=shallow)


def test_under_let_a_gated_thread_cannot_publish_at_once() -> None:
    assert asynchronous(overrun="publish").overrun == "publish"
    with pytest.raises(InputError, match="wait or discard, or plan with --publication synchronous"):
        let_per_chain(asynchronous(overrun="publish"))


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("59ms, 60ms", "59ms, 59.2ms", r"servers\[1\].slots\[0\]: the slot \[59ms, 59.2ms\)"),
        ("59ms, 60ms", "30ms, 60ms", r"servers\[1\].priority: the publisher thread of /n5"),
        ("overrun: wait", "overrun: drop", r"overrun: .*'wait', 'discard' or 'publish'"),
        ("output_depth: 10", "output_depth: 0", r"chain.output_depth: "),
    ],
)
def test_a_hand_edited_plan_is_refused_by_line_and_key(
    right: str, wrong: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "plan.yaml"
    save_plan(asynchronous(output_depth=10), path)
    text = path.read_text()
    assert text.count(right) == 1
    assert load_plan(path) == asynchronous(output_depth=10)
    path.write_text(text.replace(right, wrong))
    with pytest.raises(InputError) as refused:
        load_plan(path)
    assert re.search(said, str(refused.value)), str(refused.value)
    assert re.match(rf"{path}:\d+: ", str(refused.value))
