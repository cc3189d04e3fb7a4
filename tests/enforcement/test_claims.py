"""Two plans never govern the same core or node."""

import signal
from pathlib import Path

import pytest
from applied_plans import (
    FREEZER,
    MODULES,
    applied,
    ended,
    leftovers,
    needs_fifo,
    node_to_govern,
    one_server_plan,
    plan_for,
    processes_of,
    running_node,
    scheduling,
    server,
    started,
    wait_until_in_force,
)
from gated import OTHER_CORE, kill, needs_cgroups
from processes import wait_for

pytestmark = [needs_fifo, needs_cgroups]


def test_of_two_runs_for_one_core_the_second_is_refused_and_changes_nothing(
    tmp_path: Path,
) -> None:
    other = plan_for(server("second", "other", (40, 70)))
    (tmp_path / "second").mkdir()
    with node_to_govern(tmp_path) as governed, running_node("other", tmp_path / "other") as beside:
        before = scheduling(beside.pid)
        with applied(one_server_plan(), tmp_path, *FREEZER) as first:
            with started(other, tmp_path / "second", *FREEZER) as second:
                said = ended(second)
            assert second.returncode == 1
            assert f"of process {first.pid} governs core" in said
            assert "chainshaper release" in said
            assert scheduling(beside.pid) == before
            first.send_signal(signal.SIGINT)
            assert first.wait(timeout=20) == 0
        governed.check_as_before()


def test_of_two_runs_for_one_node_the_second_is_refused(tmp_path: Path) -> None:
    elsewhere = plan_for(server("second", "origin", (40, 70), core=OTHER_CORE))
    (tmp_path / "second").mkdir()
    with node_to_govern(tmp_path) as governed:
        with applied(one_server_plan(), tmp_path, *FREEZER) as first:
            with started(elsewhere, tmp_path / "second", "--backend", "fifo") as second:
                said = ended(second)
            assert second.returncode == 1
            assert "governs" in said
            assert "node /origin already" in said
            first.send_signal(signal.SIGINT)
            assert first.wait(timeout=20) == 0
        governed.check_as_before()


@pytest.mark.skipif(
    one_server_plan().servers[0].core == OTHER_CORE, reason="there is one core only"
)
def test_runs_for_different_cores_and_nodes_do_not_mind_each_other(tmp_path: Path) -> None:
    elsewhere = plan_for(server("second", "other", (40, 70), core=OTHER_CORE))
    (tmp_path / "second").mkdir()
    with node_to_govern(tmp_path) as governed, node_to_govern(tmp_path, "other") as other:
        with (
            applied(one_server_plan(), tmp_path, *FREEZER) as first,
            applied(elsewhere, tmp_path / "second", *FREEZER) as second,
        ):
            for run in (first, second):
                run.send_signal(signal.SIGINT)
                assert run.wait(timeout=20) == 0
        governed.check_as_before()
        other.check_as_before()


def test_of_runs_that_start_at_the_same_instant_exactly_one_is_in_force(tmp_path: Path) -> None:
    with node_to_govern(tmp_path) as governed:
        for _ in range(3):
            with (
                started(one_server_plan(), tmp_path, *FREEZER) as one,
                started(one_server_plan(), tmp_path, *FREEZER) as other,
            ):
                wait_for(
                    lambda: one.poll() is not None or other.poll() is not None,
                    "one of them to be refused",
                )
                winner, loser = (one, other) if other.poll() is not None else (other, one)
                assert loser.returncode == 1
                assert f"of process {winner.pid} governs" in ended(loser)
                wait_until_in_force(winner)
                winner.send_signal(signal.SIGINT)
                assert winner.wait(timeout=20) == 0
            governed.check_as_before()


def test_a_run_takes_over_from_one_that_was_killed_with_all_its_processes(tmp_path: Path) -> None:
    with node_to_govern(tmp_path) as governed:
        with applied(one_server_plan(), tmp_path, *FREEZER) as first:
            ours = [pid for name in MODULES for pid in processes_of(first, name)] + [first.pid]
            for pid in ours:  # nobody sees the others die
                kill(pid, signal.SIGSTOP)
            for pid in ours:
                kill(pid)
            first.wait()
        assert leftovers()
        with applied(one_server_plan(), tmp_path, *FREEZER) as second:
            second.send_signal(signal.SIGINT)
            assert second.wait(timeout=20) == 0
        governed.check_as_before()
