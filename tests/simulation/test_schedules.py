"""The simulator against schedules that were worked out by hand (`schedules.yaml`, and here)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bare_plans import bare_plan
from schedules import MS, application, begin_of, callbacks, ran, simulated

from chainshaper.analysis import data_flow
from chainshaper.planning import ChainPlan
from chainshaper.planning.chain_plan import Server, Thread
from chainshaper.values import events
from chainshaper.values.durations import parse_duration
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording

CASES = yaml.safe_load(Path(__file__).with_name("schedules.yaml").read_text())


def plan(
    *servers: Server, chain: str = "a", cycle_ms: int = 20, offset_ms: int = 0, **more: Any
) -> ChainPlan:
    """A plan that consists of servers only."""
    return bare_plan(chain, cycle_ms * MS, *servers, offset_ns=offset_ms * MS, **more)


def server(priority: int, nodes: list[str], slots: list[list[int]]) -> Server:
    """A server on core 1 with the executors of these nodes, and slots in ms."""
    return Server(
        name=f"s{priority}",
        core=1,
        priority=priority,
        slots=tuple((start * MS, end * MS) for start, end in slots),
        threads=tuple(Thread(node=f"/{node}") for node in nodes),
    )


def order(recording: Recording) -> list[str]:
    """What the node `node` executed, by topic (or `timer`), in order."""
    flow = data_flow(recording.events)
    own = flow.objects.callbacks.filter(node="/node").select("callback_id", "topic").unique()
    named = flow.instances.join(own, on="callback_id").sort("start", "instance")
    return [(topic or "timer").strip("/") for topic in named["topic"]]


def taken(recording: Recording) -> list[float]:
    """When the messages that were taken had been published (ms)."""
    table = events.table(recording.events, "rmw_take").filter(taken=1)
    return [(stamp - begin_of(recording)) / MS for stamp in table["source_timestamp"]]


def described(case: dict[str, Any]) -> Any:
    parts = {"chain": next(iter(case["nodes"])), "topics": {}, **case}
    text = yaml.safe_dump({part: parts[part] for part in ("chain", "topics", "nodes")})
    return application(text, **case.get("simulation", {}))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["name"])
def test_a_schedule_is_the_one_worked_out_by_hand(tmp_path: Path, case: dict[str, Any]) -> None:
    governed = None
    if "servers" in case:
        servers = [server(*each) for each in case["servers"]]
        turns = case.get("equal_priorities", "apart")
        offset_ms = case.get("offset_ms", 0)
        chain = case.get("chain", next(iter(case["nodes"])))
        governed = plan(
            *servers,
            chain=chain,
            cycle_ms=parse_duration(case["nodes"][chain]["callbacks"][0]["timer"]) // MS,
            offset_ms=offset_ms,
            equal_priorities=turns,
            policy=case.get("policy", "server-per-chain"),
            slot_ends=case.get("slot_ends", "open-until-done"),
        )
    recording = simulated(tmp_path, described(case), governed, case.get("cycles", 1))
    if "callbacks" in case:
        assert callbacks(recording) == [tuple(each) for each in case["callbacks"]]
    if "ran" in case:
        assert ran(recording)[: len(case["ran"])] == [tuple(each) for each in case["ran"]]
    if "order" in case:
        assert order(recording) == case["order"]
    if "taken" in case:
        assert taken(recording) == case["taken"]


@pytest.mark.parametrize(
    ("governed", "reason"),
    [
        (plan(server(1, ["nobody"], [[0, 5]])), "'s1' of the plan .* the executor of /nobody"),
        (plan(server(1, [], [[0, 5]]), cycle_ms=30), "period 30 ms, but a of 'by hand' has 20 ms"),
    ],
)
def test_a_plan_for_another_application_is_refused(
    tmp_path: Path, governed: ChainPlan, reason: str
) -> None:
    with pytest.raises(InputError, match=reason):
        simulated(
            tmp_path, application("{chain: a, nodes: {a: {callbacks: [{timer: 20ms}]}}}"), governed
        )


TURNS = next(case for case in CASES if "equal_priorities" in case)


def test_servers_of_one_priority_take_turns_where_the_plan_says_so(tmp_path: Path) -> None:
    one, other = (server(1, [node], [[0, 20]]) for node in "ab")
    other = other.model_copy(update={"name": "other"})
    recording = simulated(
        tmp_path, described(TURNS), plan(one, other, equal_priorities="round-robin")
    )
    assert ran(recording)[: len(TURNS["ran"])] == [tuple(each) for each in TURNS["ran"]]


def test_best_effort_servers_come_behind_all_real_time_threads(tmp_path: Path) -> None:
    """In its server b yields to c, which is in none; its slots hold nevertheless."""
    last = server(2, ["b"], [[0, 8]]).model_copy(update={"best_effort": True})
    recording = simulated(tmp_path, described(TURNS), plan(server(1, ["a"], [[0, 20]]), last))
    assert ran(recording)[:3] == [("a", 0, 4), ("c", 4, 6), ("b", 6, 8)]


def test_costs_of_waking_taking_and_publishing_are_the_threads_own(tmp_path: Path) -> None:
    text = """
    chain: /a../b
    nodes:
      one: {callbacks: [{timer: 100ms, execution: {constant: 20ms}, publishes: [/a]}]}
      two: {callbacks: [{subscription: /a, execution: {constant: 20ms}, publishes: [/b]}]}
    """
    costs = {"wake_up": "1ms", "take": "2ms", "publish": "4ms", "delivery": "10ms"}
    each = {name: {"constant": cost} for name, cost in costs.items()}
    recording = simulated(tmp_path, application(text, **each))
    # one: wakes 0–1, computes to 21, publishes, ends at 25. The message is there at 31;
    # two: wakes to 32, takes to 34, computes to 54.
    assert [start for _, start, _ in callbacks(recording)] == [1, 34]
    published = recording.events["rmw_publish"]["time"] - begin_of(recording)
    assert published.to_list() == [21 * MS, 54 * MS]
    used = recording.events["callback_end"]["thread_time"] // MS
    assert list(used) == [6 * 25, 6 * 27]  # the sixth cycle: five warmed up


def test_messages_of_one_publisher_do_not_overtake_each_other(tmp_path: Path) -> None:
    text = """
    chain: source
    nodes:
      source: {core: 2, callbacks: [{timer: 10ms, publishes: [/a]}]}
      node: {callbacks: [{subscription: /a}]}
    """
    described = application(text, delivery={"uniform": ["0ms", "35ms"]})
    table = simulated(tmp_path, described, cycles=500).events["rmw_take"]
    stamps, times = table["source_timestamp"].to_numpy(), table["time"].to_numpy()
    assert (np.diff(stamps) > 0).all()
    assert (times - stamps).max() <= 35 * MS
    assert len(np.unique(times)) < len(stamps)  # queued


ASYNCHRONOUS = """
chain: node../a
topics: {/a: {publication: asynchronous, QOS}}
nodes:
  node:
    callbacks:
      - {timer: 100ms, execution: {constant: 5ms}, publishes: [/a]}
      - {timer: 100ms, phase: 1ms, execution: {constant: 5ms}}
  reader: {core: 2, callbacks: [{subscription: /a}]}
"""


@pytest.mark.parametrize(
    ("qos", "outcome", "arrived"), [("depth: 2", "sent", [5]), ("lifespan: 4ms", "expired", [])]
)
def test_a_publisher_thread_sends_when_the_executor_leaves_it_the_core(
    tmp_path: Path, qos: str, outcome: str, arrived: list[int]
) -> None:
    """It ranks one below: handed over at 5 ms, the message leaves behind the next callback."""
    text = ASYNCHRONOUS.replace("QOS", qos)
    recording = simulated(tmp_path, application(text, publish={"constant": "1ms"}))
    (send,) = recording.events["asynchronous_send"].to_dicts()
    (handed_over,) = recording.events["rmw_publish"]["time"]
    assert handed_over - begin_of(recording) == 5 * MS
    assert send["time"] - begin_of(recording) == 11 * MS  # 5 + 1 handing over + 5
    assert (send["outcome"], send["timestamp"]) == (outcome, handed_over)
    assert send["duration"] == (1 * MS if arrived else 0)
    assert taken(recording) == arrived


def test_a_writers_history_overwrites_what_its_thread_could_not_send(tmp_path: Path) -> None:
    """From 105 ms on a hog of the publisher thread's priority runs for 30 ms, up to 143 ms.

    Meanwhile the executor hands over /a at 110, 120, 130 and 140, and /b a millisecond later. Of
    /a the writer has the last two, which move up to the places of those that are gone.
    """
    text = """
    chain: node../a
    topics: {/a: {publication: asynchronous, depth: 2}, /b: {publication: asynchronous}}
    nodes:
      node: {callbacks: [{timer: 10ms, publishes: [/a, /b]}]}
      hog: {priority: 79, callbacks: [{timer: 100ms, phase: 5ms, execution: {constant: 30ms}}]}
      reader: {core: 2, callbacks: [{subscription: /a}, {subscription: /b}]}
    """
    described = application(text, publish={"constant": "1ms"})
    table = simulated(tmp_path, described, cycles=10).events["asynchronous_send"]
    sends = [
        (round(time / MS) - 1100, round(stamp / MS) - 1100, outcome)
        for time, stamp, outcome in table.select("time", "timestamp", "outcome").iter_rows()
        if 1_110 * MS <= time < 1_149 * MS
    ]
    sent = [(43, 30), (44, 11), (45, 40), (46, 21), (47, 31), (48, 41)]
    lost = [(30, 10, "overwritten"), (40, 20, "overwritten")]
    assert sends == [*lost, *((time, stamp, "sent") for time, stamp in sent)]


def test_a_synchroniser_pairs_the_oldest_messages_and_forgets_what_no_history_has(
    tmp_path: Path,
) -> None:
    text = """
    chain: rear../fused
    topics: {/front: {depth: 2}}
    nodes:
      front:
        core: 2
        callbacks:
          - {timer: 100ms, publishes: [/front]}
          - {timer: 100ms, phase: 1ms, publishes: [/front]}
          - {timer: 100ms, phase: 2ms, publishes: [/front]}
      rear: {core: 3, callbacks: [{timer: 100ms, phase: 7ms, publishes: [/rear]}]}
      fusion: {callbacks: [{synchronises: [/front, /rear], publishes: [/fused]}]}
      gate:
        callbacks:
          - {subscription: /fused, publishes: [/o], gate: {slots: [[50ms, 60ms]], cycle: 100ms}}
    """
    recording = simulated(tmp_path, application(text))
    # The stamp is that of the front message of 1 ms: the first was forgotten when the third came.
    # (The one of 2 ms, left over, is older than those of the next cycle: it is first there.)
    origins = recording.events["gate_release"]["origin"] - begin_of(recording)
    assert {origin / MS for origin in origins} <= {1.0, 2.0 - 100}
