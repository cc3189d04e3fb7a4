"""Synchronising callbacks of the live workload: alone, and in a run beside its simulation."""

from pathlib import Path

from calm_runs import calm_run
from small_chain import DDS_CORE, EXECUTOR_CORE

from chainshaper import run_application, simulate
from chainshaper.analysis import analyse_latency
from chainshaper.workload.description import load_application
from chainshaper.workload.executor import Synchroniser

TEXT = f"""\
name: fusion
chain: /front../fused
scheduling:
  executors: {{core: {EXECUTOR_CORE}, priority: 80}}
  dds: {{core: {DDS_CORE}, priority: 90}}
nodes:
  front:
    callbacks: [{{timer: 50ms, publishes: [/front]}}]
  rear:
    callbacks: [{{timer: 50ms, phase: 10ms, publishes: [/rear]}}]
  fusion:
    callbacks:
      - {{synchronises: [/front, /rear], execution: {{constant: 2ms}}, publishes: [/fused]}}
  sink:
    callbacks: [{{subscription: /fused}}]
"""


def test_a_set_is_the_oldest_message_of_every_input() -> None:
    synchroniser = Synchroniser[str]([2, 2])
    assert [synchroniser.add(0, message) for message in ("a1", "a2", "a3")] == [(), (), ()]
    assert synchroniser.add(1, "b1") == ("a2", "b1")  # a1 was more than the history keeps
    assert synchroniser.add(1, "b2") == ("a3", "b2")
    assert synchroniser.add(1, "b3") == ()


def test_a_live_fusion_computes_once_per_set_as_its_simulation_does(tmp_path: Path) -> None:
    (tmp_path / "fusion.yaml").write_text(TEXT)
    application = load_application(tmp_path / "fusion.yaml")
    # A machine that stands still for 10 ms may make /rear come before /front.
    live = calm_run(
        lambda place: run_application(application, place / "live", cycles=10),
        tmp_path,
        longest_stall_ns=5_000_000,
    )
    simulated = simulate(application, tmp_path / "simulated", cycles=10)
    for recording in (live, simulated):
        analysis = analyse_latency(recording, application.chain)
        assert analysis.statistics.count >= 9
        # The chain waits for the other input, 10 ms, and then computes for 2.
        assert (analysis.statistics.min_ns or 0) >= 11_000_000
