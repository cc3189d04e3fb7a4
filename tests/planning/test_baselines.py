"""The other schedules of the paper: its own slots, and what they predict."""

from dataclasses import replace

import numpy as np
import pytest

from chainshaper.planning.plan import (
    Plan,
    Thread,
    dump_plan,
    publish_slots,
    publishing_servers,
    server_of,
)
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

MS = 1_000_000
NODES = ("/throttler", "/rear_filter", "/fusion", "/voxel_grid", "/localizer")


def _avp() -> Plan:
    """The paper's chain (table 3): 32.9 … 84.7 ms, here with a margin that ends at 86 ms."""
    latencies = np.array([32_900_000, 67_400_000, 84_700_000])
    return plan_shaping(
        latencies,
        100 * MS,
        output="/pose",
        publisher="/localizer",
        nodes=NODES,
        epsilon_ns=1_300_000,
    )


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


def _slots_ms(plan: Plan) -> dict[str, list[tuple[float, float]]]:
    return {
        server.name: [(start / MS, end / MS) for start, end in server.slots]
        for server in plan.servers
    }


def test_table_4_row_1_waits_for_the_front_filter() -> None:
    plan = server_per_callback(_avp(), AVP_CALLBACKS)
    assert _slots_ms(plan) == {
        "throttler": [(0, 2)],
        "rear_filter": [(2, 23)],
        "front_filter": [(2, 33)],
        "fusion": [(33, 37)],
        "voxel_grid": [(37, 47)],
        "localizer": [(47, 98)],
    }
    assert plan.policy == "server-per-callback"
    assert plan.shaping_node is None
    assert publish_slots(plan) == ()
    assert plan.predicted.max_ns == 97_800_000
    assert plan.predicted.jitter_ns == 50_800_000 * 9 // 10
    dump_plan(plan)


def test_section_2_5_gives_each_callback_a_millisecond_more() -> None:
    callbacks = [_callback("/n1", 15_000)]
    for number in range(2, 6):
        callbacks.append(_callback(f"/n{number}", 15_000, after=(number - 2,)))
    plan = server_per_callback(_avp(), callbacks, margin_ns=MS)
    assert list(_slots_ms(plan).values()) == [
        [(0, 16)],
        [(16, 32)],
        [(32, 48)],
        [(48, 64)],
        [(64, 80)],
    ]


def test_callbacks_of_one_node_share_a_server() -> None:
    callbacks = [
        _callback("/a", 1000),
        _callback("/a", 2000, after=(0,)),
        _callback("/b", 500, after=(1,)),
        _callback("/a", 1000, after=(2,)),
    ]
    assert _slots_ms(server_per_callback(_avp(), callbacks)) == {
        "a": [(0, 3), (4, 5)],
        "b": [(3, 4)],
    }


def test_impossible_slots_per_callback_are_refused() -> None:
    with pytest.raises(OperationError, match="takes 117ms, the cycle is 100ms"):
        server_per_callback(
            _avp(), [*AVP_CALLBACKS[:5], replace(AVP_CALLBACKS[5], max_response_ns=70 * MS)]
        )
    with pytest.raises(InputError, match="order them along the graph"):
        server_per_callback(_avp(), [_callback("/a", 1, after=(0,))])
    with pytest.raises(InputError, match=r"/a runs on one core, not on \[0, 1\]"):
        server_per_callback(_avp(), [_callback("/a", 1), _callback("/a", 1, core=0)])
    for wrong in ({"margin_ns": -1}, {"boundary_ns": 0}):
        with pytest.raises(InputError, match="need callbacks"):
            server_per_callback(_avp(), AVP_CALLBACKS, **wrong)
    with pytest.raises(InputError, match="need callbacks"):
        server_per_callback(_avp(), [])
    with pytest.raises(InputError, match="full ROS 2 name"):
        server_per_callback(_avp(), [_callback("a b", 1)])


def test_table_4_rows_2_and_3_hold_the_throttler_apart() -> None:
    shaped = with_first_node_apart(_avp(), "/throttler", 2 * MS)
    assert _slots_ms(shaped) == {"first": [(0, 2)], "chain": [(2, 86)], "output": [(86, 87)]}
    bare = server_per_chain(shaped)
    assert _slots_ms(bare) == {"first": [(0, 2)], "chain": [(2, 86)]}
    assert bare.policy == "server-per-chain"
    assert (bare.predicted.max_ns, bare.predicted.jitter_ns) == (84_700_000, 51_800_000)
    with pytest.raises(InputError, match="no node of the chain's server"):
        with_first_node_apart(_avp(), "/other", 2 * MS)
    for end in (0, 86 * MS):
        with pytest.raises(InputError, match="must end after 0ms and before 86ms"):
            with_first_node_apart(_avp(), "/throttler", end)


def test_let_per_chain_takes_one_period() -> None:
    plan = let_per_chain(_avp())
    assert _slots_ms(plan) == {"chain": [(0, 100)], "output": [(0, 1)]}
    assert plan.predicted.max_ns == 101 * MS
    assert plan.predicted.jitter_ns == MS
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
    assert _slots_ms(plan)["chain"] == [(0, 100)]
    for wrong in ([], ["/t1"], ["/pose", "/t1"]):
        with pytest.raises(InputError, match="its output last"):
            let_per_callback(_avp(), wrong)
    with pytest.raises(InputError, match="two servers are named"):
        let_per_callback(_avp(), ["/t1", "/t1", "/pose"])
    with pytest.raises(OperationError, match="101 publish slots"):
        let_per_callback(_avp(), [f"/t{number}" for number in range(100)] + ["/pose"])


def test_let_per_callback_of_asynchronous_publishers_adds_no_nodes() -> None:
    latencies = np.array([30, 60]) * MS
    shaped = plan_shaping(
        latencies,
        100 * MS,
        output="/t5",
        publisher="/n2",
        publication="asynchronous",
        overrun="wait",
    )
    plan = let_per_callback(shaped, ["/t1", "/t5"], ["/n1", "/n2"])
    assert plan.shaping_node is None
    assert plan.further_shaping_nodes == ()
    publishers = [Thread(node=name, role="publisher") for name in ("/n1", "/n2")]
    servers = [server_of(plan, thread) for thread in publishers]
    assert [server.slots for server in servers if server] == [((MS, 2 * MS),), ((0, MS),)]
    assert publish_slots(plan) == ((0, MS),)
    assert plan.predicted.max_ns == 201 * MS
    for wrong in ([], ["/n2", "/n1"]):
        with pytest.raises(InputError, match="publishes its output last"):
            let_per_callback(shaped, ["/t1", "/t5"], wrong)


def test_a_first_node_apart_has_no_place_in_let() -> None:
    with pytest.raises(InputError, match="overlaps"):
        let_per_chain(with_first_node_apart(_avp(), "/throttler", 2 * MS))


def test_a_graph_on_two_cores_has_two_servers_and_one_output() -> None:
    # Section 5.4: 450 ms on two cores, output in [450, 451) on core 1.
    latencies = np.array([300, 450]) * MS
    plan = plan_shaping(latencies, 764 * MS, output="/v1", nodes=["/n0", "/n1"], epsilon_ns=0)
    plan = over_cores(plan, {"/n0": 0, "/n1": 1, "/n2": 0})
    assert _slots_ms(plan) == {
        "chain_core0": [(0, 450)],
        "chain_core1": [(0, 450)],
        "output": [(450, 451)],
    }
    assert [thread.node for thread in plan.servers[0].threads] == ["/n0", "/n2"]
    with pytest.raises(InputError, match="no core is named for /n1"):
        over_cores(_two_nodes(), {"/n0": 0})
    assert over_cores(_two_nodes(), {"/n0": 1, "/n1": 1}) == _two_nodes()


def test_further_sinks_get_slots_of_their_own() -> None:
    plan = _two_nodes()  # chain [0, 451), output [451, 452)
    earlier = with_sink(plan, np.array([300, 400]) * MS, "/early")
    assert _slots_ms(earlier)["output_chainshaper_early"] == [(401, 402)]
    assert _slots_ms(earlier)["chain"] == [(0, 451)]
    close = with_sink(earlier, np.array([449_500_000, 450_500_000]), "/late")
    assert _slots_ms(close)["output_chainshaper_late"] == [(452, 453)]
    assert _slots_ms(close)["chain"] == [(0, 451.5)]
    assert [node.output for node in close.further_shaping_nodes] == ["/early", "/late"]
    named = with_sink(plan, np.array([300, 400]) * MS, "/early", publisher="/n0")
    assert [node.publisher for node in named.further_shaping_nodes] == ["/n0"]
    with pytest.raises(OperationError, match="after the cycle of 764ms"):
        with_sink(plan, np.array([1, 763]) * MS, "/late")
    with pytest.raises(InputError, match="full ROS 2 name"):
        with_sink(plan, np.array([1, 2]) * MS, "late")
    with pytest.raises(InputError, match="shapes one output already"):
        with_sink(server_per_chain(plan), np.array([1, 2]) * MS, "/late")


def test_further_sinks_of_asynchronous_publishers_gate_their_threads() -> None:
    latencies = np.array([300, 450]) * MS
    plan = plan_shaping(
        *(latencies, 764 * MS),
        output="/v1",
        publisher="/n1",
        nodes=["/n0", "/n1"],
        publication="asynchronous",
    )
    sinks = with_sink(plan, np.array([300, 470]) * MS, "/late", publisher="/n0")
    assert _slots_ms(sinks) == {
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
    with pytest.raises(InputError, match="shapes /v1 already"):
        with_sink(_two_nodes(), latencies, "/v1")


def _two_nodes() -> Plan:
    latencies = np.array([300, 450]) * MS
    return plan_shaping(latencies, 764 * MS, output="/v1", nodes=["/n0", "/n1"])
