"""Who records a governed application sees since when it is, and until when."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from applied_plans import needs_fifo
from gated import needs_cgroups
from small_chain import EXECUTOR_CORE, PERIOD_NS, small_chain_text

from chainshaper import measure_latency, open_recording, save_plan
from chainshaper.enforcement.servers import ServerCounters
from chainshaper.enforcement.undoing import (
    RunState,
    ServerState,
    find_runs,
    remove_run,
    save_run_state,
)
from chainshaper.linux.runs import Governed, Journal, governing, in_force_throughout, open_journal
from chainshaper.planning import Plan, plan_shaping

MS = 1_000_000


def _run(folder: Path, name: str, **facts: object) -> Journal:
    """A run that governs this very process."""
    journal = open_journal(folder, name)
    server = ServerState("chain", 0, 1, ((0, 1),), (os.getpid(),), "freezer", ServerCounters())
    state = RunState(
        **{  # type: ignore[arg-type]
            "run": name,
            "owner": os.getpid(),
            "plan": "plan.yaml",
            "command": (),
            "back_end": "freezer",
            "reason": "",
            "started_ns": 0,
            "cycle_ns": 10,
            "anchor_ns": 0,
            "phase_spread_ns": None,
            "drift_ns": None,
            "servers": (server,),
            "notes": (),
            "failure": None,
            **facts,
        }
    )
    save_run_state(journal.path.parent, state)
    return journal


def test_who_governs_a_process_is_seen_and_when_it_ended(tmp_path: Path) -> None:
    mine = {os.getpid()}
    assert governing(mine, 1, folder=tmp_path) == ()
    journal = _run(tmp_path, "one", in_force_ns=100)
    (journal.path.parent / "plan.json").write_text('{"chain": 1}')
    assert governing({1}, 150, folder=tmp_path) == (), "other processes are"
    seen = governing(mine, 150, folder=tmp_path)
    assert seen == (Governed("one", 100, 150, None, {"chain": 1}),)
    _run(tmp_path, "not yet", in_force_ns=None)
    assert len(governing(mine, 160, seen, tmp_path)) == 1
    # It says that it ends; or is gone without a word.
    ((_, state),) = [one for one in find_runs(tmp_path) if one[0].path == journal.path]
    assert state is not None
    save_run_state(journal.path.parent, replace(state, ended_ns=190))
    assert governing(mine, 200, seen, tmp_path)[0].until_ns == 190
    remove_run(journal)
    (gone,) = governing(mine, 300, seen, tmp_path)
    assert (gone.until_ns, gone.seen_ns) == (150, 150)


def test_of_several_plans_the_time_counts_in_which_all_were_in_force() -> None:
    early = Governed("a", 100, 500, 200, {"plan": "a"})
    whole = Governed("b", 150, 500, None, {"plan": "b"})
    later = Governed("c", 300, 500, 450, {"plan": "c"})
    assert in_force_throughout(()) is None
    for runs, expected in (
        ((early,), (100, 200, {"plan": "a"})),
        ((early, whole), (150, 200, None)),
        ((early, later), (300, 450, {"plan": "c"})),  # one after the other
        ((whole, later), (300, 450, None)),
    ):
        found = in_force_throughout(runs)
        assert found is not None
        assert (found.since_ns, found.until_ns, found.plan) == expected


@needs_fifo
@needs_cgroups
def test_applied_and_released_in_the_midst_of_a_recording(tmp_path: Path) -> None:
    """Cycles before and behind leave as they are ready, those between in the slot."""
    application, file = tmp_path / "app.yaml", tmp_path / "plan.yaml"
    application.write_text(small_chain_text(publication="asynchronous"))
    plan = _asynchronous_plan()
    save_plan(plan, file)
    command = [sys.executable, "-m", "chainshaper"]
    output = tmp_path / "rec"
    run = [*command, "run", str(application), "-o", str(output), "--cycles", "240"]
    recorder = subprocess.Popen(run, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    words = [*command, "apply", str(file), "--backend", "freezer", "--wait", "20s"]
    governor = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        assert governor.stderr is not None
        said: list[str] = []
        while not said or (said[-1] and not said[-1].startswith("in force with freezer")):
            said.append(governor.stderr.readline())
        assert said[-1], said
        time.sleep(4)
        governor.send_signal(signal.SIGINT)
        assert governor.wait(timeout=30) == 0
        _, problems = recorder.communicate(timeout=60)
        assert recorder.returncode == 0, problems
    finally:
        for process in (governor, recorder):
            process.kill()
            process.wait()
    recording = open_recording(output)
    spell = recording.info.in_force
    assert spell is not None
    assert spell.until_ns is not None
    assert recording.info.plan is not None
    assert recording.info.plan["chain"] == plan.model_dump(mode="json")["chain"]
    measured = measure_latency(recording)
    starts = measured.analysis.traversals["start"]
    assert 0 < len(starts) < 240
    assert (starts >= spell.since_ns).all()
    assert (starts < spell.until_ns).all()
    assert min(measured.left_out.before_ns, measured.left_out.after_ns) > 0
    # In force, no output leaves before the slot: that is 2 ms behind the timer at the earliest.
    shortest = measured.analysis.statistics.min_ns
    assert shortest is not None
    assert shortest > 25 * MS - 3 * MS
    unknown = recording.info.model_copy(update={"in_force": None})
    whole = measure_latency(replace(recording, info=unknown))
    assert (whole.analysis.statistics.min_ns or 0) < shortest
    assert measured.held is not None
    assert measured.held.mean.measured_ns is not None


def _asynchronous_plan() -> Plan:
    return plan_shaping(
        np.array([4, 24]) * MS,
        PERIOD_NS,
        spec="/t1../t3",
        output="/t3",
        publisher="/third",
        nodes=("/first", "/second", "/third"),
        publication="asynchronous",
        publish_slot_ns=10 * MS,
        core=EXECUTOR_CORE,
    )
