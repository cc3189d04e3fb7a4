"""Reservation servers: slots, priorities, turns within a server, and who comes behind them."""

from pathlib import Path

import pytest
from schedules import application, callbacks, ran, simulated

from chainshaper.planning import Plan
from chainshaper.planning.plan import ChainOfPlan, Evidence, Margin, Prediction, Server, Thread
from chainshaper.values.errors import InputError

MS = 1_000_000


def plan(*servers: Server, cycle_ms: int = 20) -> Plan:
    """A plan that consists of servers only."""
    return Plan(
        chain=ChainOfPlan(spec="a", period_ns=cycle_ms * MS),
        evidence=Evidence(samples=1, min_latency_ns=1, mean_latency_ns=1, max_latency_ns=1 * MS),
        margin=Margin(epsilon_ns=0),
        policy="server-per-callback",
        cycle_ns=cycle_ms * MS,
        servers=servers,
        predicted=Prediction(mean_ns=1, max_ns=1, jitter_ns=0),
    )


def server(name: str, priority: int, *slots: tuple[float, float], nodes: str = "") -> Server:
    """A server on core 1 with slots in ms; ``nodes`` are those whose executors it holds."""
    return Server(
        name=name,
        core=1,
        priority=priority,
        slots=tuple((int(start * MS), int(end * MS)) for start, end in slots),
        threads=tuple(Thread(node=f"/{node}") for node in nodes.split()),
    )


def three(execution: str = "4ms", phase: str = "0ms") -> str:
    return f"""
    chain: a
    nodes:
      a: {{callbacks: [{{timer: 20ms, execution: {{constant: {execution}}}}}]}}
      b: {{callbacks: [{{timer: 20ms, phase: {phase}, execution: {{constant: 4ms}}}}]}}
      c: {{callbacks: [{{timer: 20ms, execution: {{constant: 2ms}}}}]}}
    """


def test_a_thread_runs_in_the_slots_of_its_server_only(tmp_path: Path) -> None:
    governed = plan(server("s", 1, (5, 8), (12, 14), nodes="a"))
    recording = simulated(tmp_path, application(three()), governed)
    own = [stretch for stretch in ran(recording) if stretch[0] == "a"]
    assert own == [("a", 5, 8), ("a", 12, 13)]


def test_work_that_fills_a_slot_exactly_is_done_at_its_end(tmp_path: Path) -> None:
    governed = plan(server("s", 1, (5, 9), nodes="a"))
    assert ("a", 5, 9) in callbacks(simulated(tmp_path, application(three()), governed))


def test_where_slots_overlap_the_better_server_runs(tmp_path: Path) -> None:
    governed = plan(server("wide", 2, (0, 10), nodes="a"), server("narrow", 1, (2, 6), nodes="b"))
    found = ran(simulated(tmp_path, application(three(phase="1ms")), governed))
    assert found == [("a", 0, 2), ("b", 2, 6), ("a", 6, 8), ("c", 8, 10)]


def test_others_run_behind_all_servers_but_whenever_no_server_needs_the_core(
    tmp_path: Path,
) -> None:
    text = three().replace("c: {", "c: {priority: 97, ")
    governed = plan(server("s", 1, (1, 4), (10, 20), nodes="a"))
    found = ran(simulated(tmp_path, application(text), governed))
    # Most urgent of all, c still yields to the server of a; b is below c.
    assert found == [("c", 0, 1), ("a", 1, 4), ("c", 4, 5), ("b", 5, 9), ("a", 10, 11)]


@pytest.mark.parametrize(
    ("quantum", "expected"),
    [
        ("1ms", [("a", 0, 1), ("b", 1, 2), ("a", 2, 3), ("b", 3, 4), ("a", 4, 5), ("b", 5, 6)]),
        ("3ms", [("a", 0, 3), ("b", 3, 6), ("a", 6, 7), ("b", 7, 8)]),
    ],
)
def test_threads_of_one_server_take_turns(
    tmp_path: Path, quantum: str, expected: list[tuple[str, float, float]]
) -> None:
    governed = plan(server("s", 1, (0, 20), nodes="a b"))
    found = ran(simulated(tmp_path, application(three(), quantum=quantum), governed))
    assert found[: len(expected)] == expected
    assert callbacks_end(found) == {"a": 7, "b": 8, "c": 10}


def callbacks_end(stretches: list[tuple[str, float, float]]) -> dict[str, float]:
    return {name: end for name, _, end in stretches}


def test_a_server_without_work_leaves_the_core_to_the_next(tmp_path: Path) -> None:
    governed = plan(server("idle", 1, (0, 20), nodes="b"), server("busy", 2, (0, 20), nodes="a"))
    found = ran(simulated(tmp_path, application(three(phase="2ms")), governed))
    assert found[:3] == [("a", 0, 2), ("b", 2, 6), ("a", 6, 8)]


def test_cycles_of_a_chain_with_an_offset_begin_later(tmp_path: Path) -> None:
    governed = plan(server("s", 1, (5, 9), nodes="a")).model_copy(update={"offset_ns": 3 * MS})
    assert ("a", 8, 12) in callbacks(simulated(tmp_path, application(three()), governed))


def test_a_server_for_a_thread_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'s' of the plan holds the executor of /nobody"):
        simulated(tmp_path, application(three()), plan(server("s", 1, (0, 5), nodes="nobody")))


def test_a_plan_for_another_period_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="period 30ms, but a of 'by hand' has 20ms"):
        simulated(tmp_path, application(three()), plan(server("s", 1, (0, 5)), cycle_ms=30))
