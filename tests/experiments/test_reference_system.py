"""The reference system's experiment: what it computes from texts and lines, without ROS 2."""

import numpy as np
import pytest
import reference_system
import results
from reference_system import Block, Configuration, limit_for, lines, notes, runs_of
from results import MS, Run


def test_the_limit_is_found_between_those_of_the_fastest_runs() -> None:
    """The cost is a power of the limit between two of them, and slow runs do not count."""
    said = "maximum_number     run time\n 1024   2ms\n 2048   8.0ms\n"
    slow = " 1024   3ms\n 2048   1.2e+01ms\n"
    assert limit_for(said + slow, 2.0) == 1024
    assert limit_for(slow + said, 4.0) == pytest.approx(1024 * 2**0.5, abs=1)


def test_a_node_computes_so_long_that_half_a_core_is_enough() -> None:
    assert pytest.approx(190) == reference_system.CALLS
    assert pytest.approx(2.1, abs=0.01) == reference_system.CRUNCH_MS


def a_run(name: str, *latencies_ms: float) -> Run:
    latency = (np.array(latencies_ms) * MS).astype(np.int64)
    return Run(name, "ros", latency, np.zeros(latency.size, np.bool_))


def a_block(one: Configuration, *latencies_ms: float, drops: int = 0) -> Block:
    printed = {
        what: a_run(f"{one.name}, printed {what}", 9, 10) for what in reference_system.PRINTED
    }
    return Block(a_run(one.name, *latencies_ms), printed, drops, 2.1 * MS)


def test_the_notes_have_all_configurations_and_say_whether_the_goal_is_met(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(results, "RESAMPLES", 50)  # how sure the figures are is not looked at
    *others, shaped = reference_system.CONFIGURATIONS
    found = {one.name: ([a_block(one, 15, 20, 18)] * 2, 0) for one in others}
    found[shaped.name] = ([a_block(shaped, 20.3, 20.31, 20.32)] * 2, 0)
    runs = runs_of(found)
    assert len(runs) == 18 and all(run.blocks.max() == 1 for run in runs)
    text = notes(lines(runs), found[shaped.name][0], 30)
    assert "| single-threaded | 20.0 | 5.00" in text
    assert "of the single blocks: 0.02, 0.02 ms" in text
    assert "p0.5–p99.5 0.02 ms, goal 0.1 ms: met; no more drops" in text
    assert "maximum 101.6% of the best other's, goal 102%: met" in text
    found[shaped.name] = ([a_block(shaped, 21, 20, -1e-6, drops=1)], 0)
    again = notes(lines(runs_of(found)), found[shaped.name][0], 30)
    assert again.count("**not met**") == 3
