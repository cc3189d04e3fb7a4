"""Shaping and the paper's other schedules: their slots and predictions, worked out by hand."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from bare_plans import MS, slots_ms
from hypothesis import given, settings
from hypothesis import strategies as st

from chainshaper.planning.bands import predict_bands
from chainshaper.planning.chain_plan import (
    ChainPlan,
    Thread,
    band_predictions,
    publish_slots,
    publishing_servers,
    server_of,
    shaping_nodes,
)
from chainshaper.planning.overruns import open_until_done, plan_warnings
from chainshaper.planning.plan import Plan
from chainshaper.planning.plan_file import plan_json
from chainshaper.planning.shaping import (
    CallbackTimes,
    let_per_callback,
    let_per_chain,
    over_cores,
    plan_shaping,
    server_per_callback,
    server_per_chain,
    with_first_node_apart,
    with_gates_level,
    with_sink,
)
from chainshaper.values.errors import InputError, OperationError


def planned(samples: int = 100, period_ns: int = 100 * MS, **options: Any) -> ChainPlan:
    latencies = np.linspace(30 * MS, 60 * MS, samples).astype(np.int64)
    return plan_shaping(latencies, period_ns, **options)


def gated(**options: Any) -> ChainPlan:
    given = {"publication": "asynchronous", "overrun": "wait", "publisher": "/n2"}
    return planned(output="/t5", **{**given, **options})


def avp(**options: Any) -> ChainPlan:
    """The paper's chain (table 3): 32.9 … 84.7 ms, here with a margin that ends at 86 ms."""
    nodes = ("/throttler", "/rear_filter", "/fusion", "/voxel_grid", "/localizer")
    given: dict[str, Any] = {"output": "/pose", "publisher": "/localizer", "nodes": nodes}
    latencies = np.array([32_900_000, 67_400_000, 84_700_000])
    return plan_shaping(latencies, 100 * MS, epsilon_ns=1_300_000, **{**given, **options})


def two_nodes(**options: Any) -> ChainPlan:
    """Chain [0, 451), output [451, 452) ms."""
    latencies = np.array([300, 450]) * MS
    return plan_shaping(latencies, 764 * MS, output="/v1", nodes=["/n0", "/n1"], **options)


def callback(node: str, worst_us: int, core: int = 1, after: tuple[int, ...] = ()) -> CallbackTimes:
    worst = worst_us * 1000
    return CallbackTimes(node, core, worst // 10, worst // 2, worst, after)


# Table 2; the throttler's two callbacks run one after the other, and the rear filter's slot is
# a millisecond longer in table 4 than its measured time asks for.
AVP_CALLBACKS = [
    callback("/throttler", 1200),
    callback("/rear_filter", 20_900, after=(0,)),
    callback("/front_filter", 30_700, core=0, after=(0,)),
    callback("/fusion", 3300, after=(1, 2)),
    callback("/voxel_grid", 9200, after=(3,)),
    callback("/localizer", 50_800, after=(4,)),
]


def test_the_papers_synthetic_chain() -> None:
    # Section 5.2: the longest latency is 58.5 ms; with ε = 0.5 ms the slots are the paper's.
    latencies = np.array([25_500_000, 58_500_000, 40_000_000])
    given: dict[str, Any] = {"output": "/ns/t5", "publisher": "/n5", "nodes": ["/n1", "/n5"]}
    plan = plan_shaping(latencies, 100 * MS, epsilon_ns=MS // 2, **given)
    chain, output = plan.servers
    assert slots_ms(plan) == {"chain": [(0, 59)], "output": [(59, 60)]}
    assert chain.threads == (Thread(node="/n1"), Thread(node="/n5"))
    assert (output.core, output.priority, chain.core, chain.priority) == (1, 1, 1, 2)
    node = plan.shaping_node
    assert node is not None and output.threads == (node.thread,)
    assert (node.name, node.input) == ("chainshaper_ns_t5", "/ns/t5_tmp")
    assert plan.evidence.mean_latency_ns == 41_333_333
    assert plan.predicted.mean_ns == plan.predicted.max_ns == 60 * MS
    assert (plan.predicted.jitter_ns, plan.predicted.shares) == (MS, (1.0,))
    # An asynchronous publisher's own thread is gated, in the same slots (eq. 2 and eq. 4).
    assert gated().shaping_node is None
    assert gated().servers[1].threads == (Thread(node="/n2", role="publisher"),)
    bare = planned(overrun="wait")
    assert bare.shaping_node is None, "it can be studied"
    assert publish_slots(gated()) == publish_slots(bare) == ((61 * MS, 62 * MS),)
    assert planned(publication="asynchronous", overrun="wait") == bare


def test_the_last_nanosecond_fits_and_the_next_does_not() -> None:
    assert publish_slots(planned(period_ns=62 * MS)) == ((61 * MS, 62 * MS),)
    with pytest.raises(OperationError, match=r"cycle of 61\.999999 ms: 1 ns too long") as caught:
        planned(period_ns=62 * MS - 1)
    assert "a margin of 999.999 us, or a publish slot of 999.999 us" in str(caught.value)
    assert "pipeline" not in str(caught.value)


@settings(deadline=None, max_examples=50)
@given(
    st.lists(st.integers(0, 10**8), min_size=1, max_size=50),
    st.lists(st.integers(1, 10**8), max_size=5),
)
def test_prediction_is_what_publishing_one_by_one_gives(sample: list[int], cuts: list[int]) -> None:
    ends = sorted({*cuts, 10**8 + 1})
    published = [min(end for end in ends if latency <= end) for latency in sample]
    predicted = predict_bands(np.array(sample), ends, 1)
    assert predicted.mean_ns == round(sum(published) / len(published))
    assert predicted.shares == tuple(published.count(end) / len(published) for end in ends)
    assert (predicted.max_ns, predicted.jitter_ns) == (ends[-1], ends[-1] - ends[0] + 1)


def test_each_band_has_a_share_and_a_jitter() -> None:
    # Slots [62, 63], [77, 78], [86, 87]: the paper states a jitter of 25 ms.
    latencies, ends = np.array([40, 63, 64, 78, 79, 79, 80, 86]) * MS, [63 * MS, 78 * MS, 87 * MS]
    predicted = predict_bands(latencies, ends, MS)
    assert (predicted.jitter_ns, predicted.shares) == (25 * MS, (0.25, 0.25, 0.5))
    slots = tuple((end - MS, end) for end in ends)
    shaped = plan_shaping(latencies, 100 * MS, epsilon_ns=0)
    output = shaped.servers[1].model_copy(update={"slots": slots})
    plan = shaped.model_copy(update={"servers": (output,), "predicted": predicted})
    bands = [(one.start_ns, one.end_ns, one.share, one.jitter_ns) for one in band_predictions(plan)]
    assert bands == [
        (*slot, share, MS) for slot, share in zip(slots, predicted.shares, strict=True)
    ]
    assert list(plan_json(plan)["predicted_bands"][2].values()) == [86 * MS, 87 * MS, 0.5, MS]
    assert band_predictions(server_per_chain(shaped)) == ()


@pytest.mark.parametrize(
    ("doubtful", "words"),
    [
        ({"samples": 298}, "sample is small: 298 cycles .* Record 299 cycles"),
        ({"realtime": False}, "without real-time scheduling"),
        ({"disturbed": 3, "longest_stall_ns": 8 * MS}, r"3 of 103 cycles, longest stall 8.000 ms"),
        ({"incomplete": 2}, "2 executions"),
        ({"lost_events": 7}, "7 events were lost"),
        ({"period_ns": 63 * MS}, "fills 98.4% of the cycle 63 ms"),
        ({"period_ns": 63 * MS}, "throttles"),
        ({"utilisation": 0.97}, "takes 97.0% of its core"),
    ],
)
def test_doubts_are_said(doubtful: dict[str, Any], words: str) -> None:
    assert any(re.search(words, warning) for warning in plan_warnings(planned(**doubtful)))
    assert plan_warnings(planned(samples=299, realtime=True)) == []


# What shaping is compared with -----------------------------------------------------------------


def test_table_4_row_1_waits_for_the_front_filter() -> None:
    plan = server_per_callback(avp(), AVP_CALLBACKS)
    assert slots_ms(plan) == {
        "throttler": [(0, 2)],
        "rear_filter": [(2, 23)],
        "front_filter": [(2, 33)],
        "fusion": [(33, 37)],
        "voxel_grid": [(37, 47)],
        "localizer": [(47, 98)],
    }
    assert (plan.policy, plan.shaping_node, publish_slots(plan)) == (
        "server-per-callback",
        None,
        (),
    )
    assert plan.predicted.max_ns == 97_800_000
    assert plan.predicted.jitter_ns == 50_800_000 * 9 // 10
    # Callbacks of one node share a server.
    several = [("/a", 1000), ("/a", 2000), ("/b", 500), ("/a", 1000)]
    chain = [callback(*one, after=(k - 1,) if k else ()) for k, one in enumerate(several)]
    shared = {"a": [(0, 3), (4, 5)], "b": [(3, 4)]}
    assert slots_ms(server_per_callback(avp(), chain)) == shared


def test_section_2_5_gives_each_callback_a_millisecond_more() -> None:
    callbacks = [callback(f"/n{k}", 15_000, after=(k - 1,) if k else ()) for k in range(5)]
    plan = server_per_callback(avp(), callbacks, margin_ns=MS)
    assert list(slots_ms(plan).values()) == [[(16 * n, 16 * n + 16)] for n in range(5)]
    # What overran finishes behind its slot; what begins the chain waits for its own.
    enforced = open_until_done(plan, 2 * MS)
    longer = [[(0, 16)], *([(16 * n, 98)] for n in range(1, 5))]
    assert list(slots_ms(enforced).values()) == longer
    assert open_until_done(enforced, 2 * MS) == enforced


def test_table_4_rows_2_and_3_hold_the_throttler_apart() -> None:
    shaped = with_first_node_apart(avp(), "/throttler", 2 * MS)
    assert slots_ms(shaped) == {"first": [(0, 2)], "chain": [(2, 86)], "output": [(86, 87)]}
    bare = server_per_chain(shaped)
    assert slots_ms(bare) == {"first": [(0, 2)], "chain": [(2, 86)]}
    assert bare.policy == "server-per-chain"
    assert (bare.predicted.max_ns, bare.predicted.jitter_ns) == (84_700_000, 51_800_000)


def test_let_takes_one_period_for_the_chain_or_for_each_callback() -> None:
    chain = let_per_chain(avp())
    assert slots_ms(chain) == {"chain": [(0, 100)], "output": [(0, 1)]}
    assert (chain.predicted.max_ns, chain.predicted.jitter_ns) == (101 * MS, MS)
    assert chain.servers[1].priority < chain.servers[0].priority
    topics = ["/t1", "/t2", "/t3", "/t4", "/pose"]
    plan = let_per_callback(avp(), topics, [f"/n{number}" for number in range(len(topics))])
    assert plan.predicted.max_ns == 501 * MS, "table 5: 500 ms; ours to the end of the publish slot"
    assert plan.shaping_node is not None
    nodes = [*plan.further_shaping_nodes, plan.shaping_node]
    assert [node.output for node in nodes] == topics
    servers = [server_of(plan, node.thread) for node in nodes]
    starts = [server.slots[0][0] for server in servers if server is not None]
    assert starts == [4 * MS, 3 * MS, 2 * MS, MS, 0]  # never data through two callbacks a cycle
    assert (publish_slots(plan), slots_ms(plan)["chain"]) == (((0, MS),), [(0, 100)])
    # What is inside the chain has to be there in time, and need not be exact: no gate of it keeps
    # the output's from the core.
    assert [node.spin_ns for node in nodes] == [0, 0, 0, 0, MS]
    assert [node.fifo_priority for node in nodes] == [83, 83, 83, 83, 84]
    inner = {one.name for one in servers[:-1] if one is not None}
    assert Plan.of(plan).behind_outputs == inner
    assert Plan.of(chain).behind_outputs == set()
    # Where threads of asynchronous publishers are gated, there are no nodes.
    plan = let_per_callback(gated(), ["/t1", "/t5"], ["/n1", "/n2"])
    assert (plan.shaping_node, plan.further_shaping_nodes) == (None, ())
    found = [server_of(plan, Thread(node=name, role="publisher")) for name in ("/n1", "/n2")]
    assert [server.slots for server in found if server] == [((MS, 2 * MS),), ((0, MS),)]
    assert (publish_slots(plan), plan.predicted.max_ns) == (((0, MS),), 201 * MS)


def test_gates_of_several_chains_run_above_all_executors_of_the_application() -> None:
    """Executors at 80 and 60: a gate at 65 would wait for the first chain's callbacks."""
    topics, names = ["/t1", "/t2", "/t3", "/t4", "/pose"], [f"/n{number}" for number in range(5)]
    low = gated(publication="synchronous", fifo_priority=65)
    high = let_per_callback(avp(fifo_priority=85), topics, names)
    plans = with_gates_level([low, high])
    assert [[node.fifo_priority for node in shaping_nodes(one)] for one in plans] == [
        [85],
        [85, 84, 84, 84, 84],
    ]
    assert with_gates_level(plans) == plans
    assert with_gates_level([gated()]) == (gated(),), "there is no node"


# More of the graph -----------------------------------------------------------------------------


def test_a_graph_on_two_cores_has_two_servers_and_one_output() -> None:
    # Section 5.4: 450 ms on two cores, output in [450, 451) on core 1.
    plan = over_cores(two_nodes(epsilon_ns=0), {"/n0": 0, "/n1": 1, "/n2": 0})
    slots = {"chain_core0": [(0, 450)], "chain_core1": [(0, 450)], "output": [(450, 451)]}
    assert slots_ms(plan) == slots
    assert [thread.node for thread in plan.servers[0].threads] == ["/n0", "/n2"]
    assert over_cores(two_nodes(), {"/n0": 1, "/n1": 1}) == two_nodes()


def test_further_sinks_get_slots_of_their_own() -> None:
    earlier = with_sink(two_nodes(), np.array([300, 400]) * MS, "/early", publisher="/n0")
    assert slots_ms(earlier)["output_chainshaper_early"] == [(401, 402)]
    assert slots_ms(earlier)["chain"] == [(0, 451)]
    close = with_sink(earlier, np.array([449_500_000, 450_500_000]), "/late")
    assert slots_ms(close)["output_chainshaper_late"] == [(452, 453)]
    assert slots_ms(close)["chain"] == [(0, 451.5)]
    further = [(node.output, node.publisher) for node in close.further_shaping_nodes]
    assert further == [("/early", "/n0"), ("/late", None)]
    sinks = with_sink(gated_pair(), LATE, "/late", publisher="/n0")
    assert slots_ms(sinks) == {
        "chain": [(0, 471)],  # open until the slower sink is done
        "output": [(451, 452)],
        "output_n0": [(471, 472)],
    }
    assert sinks.servers[2].threads == (Thread(node="/n0", role="publisher"),)
    # While the executors may still run, a publisher's thread stays below them.
    assert [server.priority for server in sinks.servers] == [2, 3, 1]
    assert (sinks.further_shaping_nodes, publishing_servers(sinks)) == ((), sinks.servers[1:])


LATE = np.array([300, 470]) * MS


def gated_pair() -> ChainPlan:
    return two_nodes(publisher="/n1", publication="asynchronous")


def per_callback(*callbacks: CallbackTimes, margin_ns: int = 0) -> ChainPlan:
    return server_per_callback(avp(), callbacks, margin_ns=margin_ns)


@pytest.mark.parametrize(
    ("attempt", "words"),
    [
        (lambda: planned(epsilon_ns=-1), "longer than 0 ms"),
        (lambda: planned(publish_slot_ns=0), "longer than 0 ms"),
        (lambda: planned(period_ns=0), "longer than 0 ms"),
        (lambda: planned(period_ns=50 * MS), r"12 ms too long.*a pipeline of stages"),
        (lambda: planned(output="t5"), "output: 't5' is not a full ROS 2 name"),
        (lambda: planned(output="/t5", fifo_priority=99), "fifo_priority: 99 should be less than"),
        (lambda: planned(nodes=["/a", "/a"]), r"servers\[0\]\.threads\[1\]: .* already"),
        (lambda: gated(publisher=None), "name the node"),
        (lambda: predict_bands(np.array([3, 10]), [], 1), "must ascend"),
        (lambda: predict_bands(np.array([3, 10]), [7, 5], 1), "must ascend"),
        (lambda: predict_bands(np.array([3, 10]), [5, 9], 1), "before the longest"),
        (lambda: per_callback(callback("/a", 1, after=(0,))), "order them along the graph"),
        (lambda: per_callback(callback("/a", 1), callback("/a", 1, 0)), r"not on \[0, 1\]"),
        (lambda: per_callback(*AVP_CALLBACKS, margin_ns=-1), "need callbacks"),
        (per_callback, "need callbacks"),
        (lambda: per_callback(callback("a b", 1)), "full ROS 2 name"),
        (lambda: per_callback(*AVP_CALLBACKS, margin_ns=9 * MS), "takes 143 ms, the"),
        (lambda: with_first_node_apart(avp(), "/other", 2 * MS), "no node of the chain's server"),
        (lambda: with_first_node_apart(avp(), "/throttler", 0), "after 0 ms and before 86 ms"),
        (lambda: with_first_node_apart(avp(), "/throttler", 86 * MS), "and before 86 ms"),
        (lambda: let_per_chain(with_first_node_apart(avp(), "/throttler", 2 * MS)), "overlaps"),
        (lambda: let_per_chain(plan_shaping(LATE // 300, 100 * MS)), "leave in its own cycle"),
        (lambda: let_per_chain(server_per_chain(avp())), "one publish slot; this one has 0"),
        (lambda: let_per_callback(avp(), []), "its output last"),
        (lambda: let_per_callback(avp(), ["/pose", "/t1"]), "its output last"),
        (lambda: let_per_callback(avp(), ["/t1", "/t1", "/pose"]), "two servers are named"),
        (lambda: let_per_callback(avp(), [*"/" * 100, "/pose"]), "101 publish slots"),
        (lambda: let_per_callback(gated(), ["/t1", "/t5"], ["/n2", "/n1"]), "its output last"),
        (lambda: over_cores(two_nodes(), {"/n0": 0}), "no core is named for /n1"),
        (lambda: over_cores(server_per_callback(avp(), AVP_CALLBACKS), {}), "named 'chain'"),
        (lambda: with_sink(two_nodes(), np.array([1, 763]) * MS, "/l"), "cycle of 764 ms"),
        (lambda: with_sink(two_nodes(), LATE, "late"), "full ROS 2 name"),
        (lambda: with_sink(two_nodes(), LATE, "/v1"), "shapes /v1 already"),
        (lambda: with_sink(server_per_chain(two_nodes()), LATE, "/l"), "shapes one output already"),
        (lambda: with_sink(gated_pair(), LATE, "/late"), "who publishes /late is not known"),
        (lambda: with_sink(gated_pair(), LATE, "/l", publisher="/n1"), "already in"),
    ],
)
def test_what_cannot_be_planned_is_refused(attempt: Callable[[], object], words: str) -> None:
    with pytest.raises((InputError, OperationError), match=words):
        attempt()
