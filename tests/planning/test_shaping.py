"""Shaping and the paper's other schedules: their slots and predictions, worked out by hand."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bare_plans import MS, slots_ms
from hypothesis import given, settings
from hypothesis import strategies as st

from chainshaper.planning.bands import predict_bands, with_bands
from chainshaper.planning.overruns import open_until_done, plan_warnings
from chainshaper.planning.plan import (
    Plan,
    Thread,
    band_predictions,
    publish_slots,
    publishing_servers,
    server_of,
)
from chainshaper.planning.plan_file import dump_plan, plan_json
from chainshaper.planning.shaping import (
    CallbackTimes,
    let_per_callback,
    let_per_chain,
    over_cores,
    plan_shaping,
    server_per_callback,
    server_per_chain,
    with_first_node_apart,
    with_sink,
)
from chainshaper.values.errors import InputError, OperationError


def _plan(samples: int = 100, period_ns: int = 100 * MS, **options: Any) -> Plan:
    latencies = np.linspace(30 * MS, 60 * MS, samples).astype(np.int64)
    return plan_shaping(latencies, period_ns, **options)


def test_the_papers_synthetic_chain() -> None:
    # Section 5.2: the longest latency is 58.5 ms; with ε = 0.5 ms the slots are the paper's.
    latencies = np.array([25_500_000, 58_500_000, 40_000_000])
    given: dict[str, Any] = {"output": "/ns/t5", "publisher": "/n5", "nodes": ["/n1", "/n5"]}
    plan = plan_shaping(latencies, 100 * MS, epsilon_ns=MS // 2, **given)
    chain, output = plan.servers
    assert slots_ms(plan) == {"chain": [(0, 59)], "output": [(59, 60)]}
    assert chain.threads == (Thread(node="/n1"), Thread(node="/n5"))
    assert publish_slots(plan) == output.slots
    assert (output.core, output.priority, chain.core, chain.priority) == (1, 1, 1, 2)
    assert plan.shaping_node is not None
    assert plan.shaping_node.name == "chainshaper_ns_t5"
    assert plan.shaping_node.input == "/ns/t5_tmp"
    assert output.threads == (plan.shaping_node.thread,)
    assert plan.evidence.mean_latency_ns == 41_333_333
    assert plan.predicted.mean_ns == plan.predicted.max_ns == 60 * MS
    assert (plan.predicted.jitter_ns, plan.predicted.shares) == (MS, (1.0,))


def test_asynchronous_publication_gates_the_publishers_thread() -> None:
    plan = _plan(publication="asynchronous", output="/t5", publisher="/node5", nodes=["/node5"])
    assert plan.shaping_node is None
    assert plan.servers[1].threads == (Thread(node="/node5", role="publisher"),)
    with pytest.raises(InputError, match="name the node"):
        _plan(publication="asynchronous", output="/t5")
    bare = _plan()
    assert bare.shaping_node is None, "it can be studied"
    assert publish_slots(plan) == publish_slots(bare) == ((61 * MS, 62 * MS),)
    assert _plan(publication="asynchronous") == bare, "eq. 2 and eq. 4: the same slots"


def test_the_last_nanosecond_fits_and_the_next_does_not() -> None:
    assert publish_slots(_plan(period_ns=62 * MS)) == ((61 * MS, 62 * MS),)
    with pytest.raises(OperationError, match=r"cycle of 61\.999999 ms: 1 ns too long") as caught:
        _plan(period_ns=62 * MS - 1)
    assert "a margin of 999.999 us, or a publish slot of 999.999 us" in str(caught.value)
    assert "pipeline" not in str(caught.value)
    with pytest.raises(OperationError, match=r"12 ms too long.*a pipeline of stages"):
        _plan(period_ns=50 * MS)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"epsilon_ns": -1}, "longer than 0 ms"),
        ({"publish_slot_ns": 0}, "longer than 0 ms"),
        ({"period_ns": 0}, "longer than 0 ms"),
        ({"output": "t5"}, "output: 't5' is not a full ROS 2 name"),
        ({"output": "/t5", "fifo_priority": 99}, "fifo_priority: 99 should be less than"),
        ({"nodes": ["/a", "/a"]}, r"servers\[0\]\.threads\[1\]: .* already"),
    ],
)
def test_values_no_plan_may_have_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        _plan(**wrong)


def test_prediction_of_the_papers_three_bands() -> None:
    # Slots [62, 63], [77, 78], [86, 87]: the paper states a jitter of 25 ms.
    latencies = np.array([40, 63, 64, 78, 79, 79, 80, 86]) * MS
    predicted = predict_bands(latencies, [63 * MS, 78 * MS, 87 * MS], MS)
    assert (predicted.jitter_ns, predicted.max_ns) == (25 * MS, 87 * MS)
    assert predicted.shares == (0.25, 0.25, 0.5)
    assert predicted.mean_ns == (2 * 63 + 2 * 78 + 4 * 87) * MS // 8
    for ends in ([], [5, 5], [7, 5], [5, 9]):
        with pytest.raises(InputError):
            predict_bands(np.array([3, 10]), ends, 1)


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
    assert predicted.max_ns == ends[-1]


def test_each_band_has_a_share_and_a_jitter() -> None:
    latencies = np.array([40, 63, 64, 78, 79, 79, 80, 84]) * MS
    plan = with_bands(plan_shaping(latencies, 100 * MS), latencies, 3, grid_ns=MS)
    bands = band_predictions(plan)
    assert [(band.start_ns, band.end_ns) for band in bands] == list(publish_slots(plan))
    assert tuple(band.share for band in bands) == plan.predicted.shares
    assert [band.jitter_ns for band in bands] == [MS] * 3
    assert plan_json(plan)["predicted_bands"][2] == {
        **{"start_ns": 85 * MS, "end_ns": 86 * MS, "share": bands[2].share, "jitter_ns": MS}
    }
    assert band_predictions(server_per_chain(plan)) == ()


@pytest.mark.parametrize(
    ("doubtful", "words"),
    [
        ({"samples": 298}, "sample is small: 298 cycles .* Record 299 cycles"),
        ({"realtime": False}, "without real-time scheduling"),
        (
            {"disturbed": 3, "longest_stall_ns": 8 * MS},
            r"disturbed 3 of 103 cycles, longest stall 8.000 ms",
        ),
        ({"incomplete": 2}, "2 executions"),
        ({"lost_events": 7}, "7 events were lost"),
        ({"period_ns": 63 * MS}, "fills 98.4% of the cycle 63 ms"),
        ({"period_ns": 63 * MS}, "throttles"),
        ({"utilisation": 0.97}, "takes 97.0% of its core"),
    ],
)
def test_doubts_are_said(doubtful: dict[str, Any], words: str) -> None:
    assert any(re.search(words, warning) for warning in plan_warnings(_plan(**doubtful)))
    assert plan_warnings(_plan(samples=299, realtime=True)) == []


# The other schedules ---------------------------------------------------------------------------


def _avp() -> Plan:
    """The paper's chain (table 3): 32.9 … 84.7 ms, here with a margin that ends at 86 ms."""
    nodes = ("/throttler", "/rear_filter", "/fusion", "/voxel_grid", "/localizer")
    given: dict[str, Any] = {"output": "/pose", "publisher": "/localizer", "nodes": nodes}
    latencies = np.array([32_900_000, 67_400_000, 84_700_000])
    return plan_shaping(latencies, 100 * MS, epsilon_ns=1_300_000, **given)


def _callback(
    node: str, worst_us: int, core: int = 1, after: tuple[int, ...] = ()
) -> CallbackTimes:
    worst = worst_us * 1000
    return CallbackTimes(node, core, worst // 10, worst // 2, worst, after)


# Table 2; the throttler's two callbacks run one after the other, and the rear filter's slot is
# a millisecond longer in table 4 than its measured time asks for.
AVP_CALLBACKS = [
    _callback("/throttler", 1200),
    _callback("/rear_filter", 20_900, after=(0,)),
    _callback("/front_filter", 30_700, core=0, after=(0,)),
    _callback("/fusion", 3300, after=(1, 2)),
    _callback("/voxel_grid", 9200, after=(3,)),
    _callback("/localizer", 50_800, after=(4,)),
]


def test_table_4_row_1_waits_for_the_front_filter() -> None:
    plan = server_per_callback(_avp(), AVP_CALLBACKS)
    assert slots_ms(plan) == {
        "throttler": [(0, 2)],
        "rear_filter": [(2, 23)],
        "front_filter": [(2, 33)],
        "fusion": [(33, 37)],
        "voxel_grid": [(37, 47)],
        "localizer": [(47, 98)],
    }
    assert (plan.policy, plan.shaping_node) == ("server-per-callback", None)
    assert publish_slots(plan) == ()
    assert plan.predicted.max_ns == 97_800_000
    assert plan.predicted.jitter_ns == 50_800_000 * 9 // 10
    dump_plan(plan)


def test_section_2_5_gives_each_callback_a_millisecond_more() -> None:
    callbacks = [_callback("/n0", 15_000)]
    callbacks += [_callback(f"/n{number}", 15_000, after=(number - 1,)) for number in range(1, 5)]
    plan = server_per_callback(_avp(), callbacks, margin_ns=MS)
    assert list(slots_ms(plan).values()) == [[(16 * n, 16 * n + 16)] for n in range(5)]
    # What overran finishes behind its slot; what begins the chain waits for its own.
    enforced = open_until_done(plan, 2 * MS)
    longer = [[(0, 16)], *([(16 * n, 98)] for n in range(1, 5))]
    assert list(slots_ms(enforced).values()) == longer
    assert open_until_done(enforced, 2 * MS) == enforced


def test_callbacks_of_one_node_share_a_server() -> None:
    callbacks = [
        _callback("/a", 1000),
        _callback("/a", 2000, after=(0,)),
        _callback("/b", 500, after=(1,)),
        _callback("/a", 1000, after=(2,)),
    ]
    slots = {"a": [(0, 3), (4, 5)], "b": [(3, 4)]}
    assert slots_ms(server_per_callback(_avp(), callbacks)) == slots


@pytest.mark.parametrize(
    ("callbacks", "options", "words"),
    [
        ([_callback("/a", 1, after=(0,))], {}, "order them along the graph"),
        (
            [_callback("/a", 1), _callback("/a", 1, core=0)],
            {},
            r"/a runs on one core, not on \[0, 1\]",
        ),
        (AVP_CALLBACKS, {"margin_ns": -1}, "need callbacks"),
        ([], {}, "need callbacks"),
        ([_callback("a b", 1)], {}, "full ROS 2 name"),
    ],
)
def test_impossible_slots_per_callback_are_refused(
    callbacks: list[CallbackTimes], options: dict[str, int], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        server_per_callback(_avp(), callbacks, **options)
    longer = [*AVP_CALLBACKS[:5], replace(AVP_CALLBACKS[5], max_response_ns=70 * MS)]
    with pytest.raises(OperationError, match="takes 117 ms, the cycle is 100 ms"):
        server_per_callback(_avp(), longer)


def test_table_4_rows_2_and_3_hold_the_throttler_apart() -> None:
    shaped = with_first_node_apart(_avp(), "/throttler", 2 * MS)
    assert slots_ms(shaped) == {"first": [(0, 2)], "chain": [(2, 86)], "output": [(86, 87)]}
    bare = server_per_chain(shaped)
    assert slots_ms(bare) == {"first": [(0, 2)], "chain": [(2, 86)]}
    assert bare.policy == "server-per-chain"
    assert (bare.predicted.max_ns, bare.predicted.jitter_ns) == (84_700_000, 51_800_000)
    with pytest.raises(InputError, match="no node of the chain's server"):
        with_first_node_apart(_avp(), "/other", 2 * MS)
    for end in (0, 86 * MS):
        with pytest.raises(InputError, match="must end after 0 ms and before 86 ms"):
            with_first_node_apart(_avp(), "/throttler", end)
    with pytest.raises(InputError, match="overlaps"):
        let_per_chain(shaped)


def test_let_per_chain_takes_one_period() -> None:
    plan = let_per_chain(_avp())
    assert slots_ms(plan) == {"chain": [(0, 100)], "output": [(0, 1)]}
    assert (plan.predicted.max_ns, plan.predicted.jitter_ns) == (101 * MS, MS)
    assert plan.servers[1].priority < plan.servers[0].priority
    with pytest.raises(InputError, match="could leave in its own cycle"):
        let_per_chain(plan_shaping(np.array([MS, 2 * MS]), 100 * MS))
    with pytest.raises(InputError, match="one publish slot; this one has 0"):
        let_per_chain(server_per_chain(_avp()))


def test_let_per_callback_takes_as_many_periods_as_callbacks() -> None:
    topics = ["/t1", "/t2", "/t3", "/t4", "/pose"]
    plan = let_per_callback(_avp(), topics, [f"/n{number}" for number in range(len(topics))])
    # Table 5: 500 ms; ours counts to the end of the publish slot.
    assert plan.predicted.max_ns == 501 * MS
    assert plan.shaping_node is not None
    nodes = [*plan.further_shaping_nodes, plan.shaping_node]
    assert [node.output for node in nodes] == topics
    servers = [server_of(plan, node.thread) for node in nodes]
    starts = [server.slots[0][0] for server in servers if server is not None]
    assert starts == [4 * MS, 3 * MS, 2 * MS, MS, 0]  # never data through two callbacks a cycle
    assert publish_slots(plan) == ((0, MS),)
    assert slots_ms(plan)["chain"] == [(0, 100)]
    for wrong in ([], ["/t1"], ["/pose", "/t1"]):
        with pytest.raises(InputError, match="its output last"):
            let_per_callback(_avp(), wrong)
    with pytest.raises(InputError, match="two servers are named"):
        let_per_callback(_avp(), ["/t1", "/t1", "/pose"])
    with pytest.raises(OperationError, match="101 publish slots"):
        let_per_callback(_avp(), [f"/t{number}" for number in range(100)] + ["/pose"])


def test_let_per_callback_of_asynchronous_publishers_adds_no_nodes() -> None:
    given: dict[str, Any] = {"publication": "asynchronous", "overrun": "wait"}
    shaped = _plan(output="/t5", publisher="/n2", **given)
    plan = let_per_callback(shaped, ["/t1", "/t5"], ["/n1", "/n2"])
    assert (plan.shaping_node, plan.further_shaping_nodes) == (None, ())
    publishers = [Thread(node=name, role="publisher") for name in ("/n1", "/n2")]
    servers = [server_of(plan, thread) for thread in publishers]
    assert [server.slots for server in servers if server] == [((MS, 2 * MS),), ((0, MS),)]
    assert publish_slots(plan) == ((0, MS),)
    assert plan.predicted.max_ns == 201 * MS
    for wrong in ([], ["/n2", "/n1"]):
        with pytest.raises(InputError, match="publishes its output last"):
            let_per_callback(shaped, ["/t1", "/t5"], wrong)


# More of the graph -----------------------------------------------------------------------------


def _two_nodes(**options: Any) -> Plan:
    latencies = np.array([300, 450]) * MS
    return plan_shaping(latencies, 764 * MS, output="/v1", nodes=["/n0", "/n1"], **options)


def test_a_graph_on_two_cores_has_two_servers_and_one_output() -> None:
    # Section 5.4: 450 ms on two cores, output in [450, 451) on core 1.
    plan = over_cores(_two_nodes(epsilon_ns=0), {"/n0": 0, "/n1": 1, "/n2": 0})
    slots = {"chain_core0": [(0, 450)], "chain_core1": [(0, 450)], "output": [(450, 451)]}
    assert slots_ms(plan) == slots
    assert [thread.node for thread in plan.servers[0].threads] == ["/n0", "/n2"]
    with pytest.raises(InputError, match="no core is named for /n1"):
        over_cores(_two_nodes(), {"/n0": 0})
    assert over_cores(_two_nodes(), {"/n0": 1, "/n1": 1}) == _two_nodes()


def test_further_sinks_get_slots_of_their_own() -> None:
    plan = _two_nodes()  # chain [0, 451), output [451, 452)
    earlier = with_sink(plan, np.array([300, 400]) * MS, "/early", publisher="/n0")
    assert slots_ms(earlier)["output_chainshaper_early"] == [(401, 402)]
    assert slots_ms(earlier)["chain"] == [(0, 451)]
    close = with_sink(earlier, np.array([449_500_000, 450_500_000]), "/late")
    assert slots_ms(close)["output_chainshaper_late"] == [(452, 453)]
    assert slots_ms(close)["chain"] == [(0, 451.5)]
    further = [(node.output, node.publisher) for node in close.further_shaping_nodes]
    assert further == [("/early", "/n0"), ("/late", None)]
    with pytest.raises(OperationError, match="after the cycle of 764 ms"):
        with_sink(plan, np.array([1, 763]) * MS, "/late")
    for base, output, words in (
        (plan, "late", "full ROS 2 name"),
        (plan, "/v1", "shapes /v1 already"),
        (server_per_chain(plan), "/late", "shapes one output already"),
    ):
        with pytest.raises(InputError, match=words):
            with_sink(base, np.array([1, 2]) * MS, output)


def test_further_sinks_of_asynchronous_publishers_gate_their_threads() -> None:
    plan = _two_nodes(publisher="/n1", publication="asynchronous")
    latencies = np.array([300, 470]) * MS
    sinks = with_sink(plan, latencies, "/late", publisher="/n0")
    assert slots_ms(sinks) == {
        "chain": [(0, 471)],  # open until the slower sink is done
        "output": [(451, 452)],
        "output_n0": [(471, 472)],
    }
    assert sinks.servers[2].threads == (Thread(node="/n0", role="publisher"),)
    # While the executors may still run, a publisher's thread stays below them.
    assert [server.priority for server in sinks.servers] == [2, 3, 1]
    assert sinks.further_shaping_nodes == ()
    assert publishing_servers(sinks) == sinks.servers[1:]
    with pytest.raises(InputError, match="who publishes /late is not known"):
        with_sink(plan, latencies, "/late")
    with pytest.raises(InputError, match="already in server 'output'"):
        with_sink(plan, latencies, "/late", publisher="/n1")
