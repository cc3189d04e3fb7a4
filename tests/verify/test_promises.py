"""What counts for a plan's promise: every output that was due, whether it came late or never."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import called, json_of
from known import known
from known_run import PERIOD_NS as KNOWN_PERIOD_NS
from known_run import known_run
from small_chain import small_chain, small_chain_text, with_times

from chainshaper import (
    compare_recordings,
    load_application,
    measure_latency,
    plan_recording,
    save_plan,
    simulate,
    sweep,
)
from chainshaper.planning import Plan, PlanRequest
from chainshaper.planning.chain_plan import Margin, revised
from chainshaper.planning.margins import OVERRUN_PROBABILITY
from chainshaper.reporting.latency import comparison_table, verdict
from chainshaper.values import events
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import Measurement
from chainshaper.verify.promises import OutputsDue, outputs_due
from chainshaper.workload.description import Application, ExecutionTime

pytestmark = pytest.mark.timed

MS = 1_000_000


def _slower(application: Application) -> Application:
    """The second node takes 20 ms longer than it was planned for, three times in four."""
    times = (2 * MS, 32 * MS, 32 * MS, 32 * MS)
    return with_times(application, {"second": ExecutionTime(samples_ns=times, block=1)})


def _text(measurement: Measurement) -> str:
    met, said = verdict(measurement)
    assert met is not None
    return said


def test_discarded_outputs_break_the_promise(tmp_path: Path) -> None:
    application = small_chain(tmp_path)
    plan = plan_recording(
        simulate(application, tmp_path / "profile", cycles=400),
        request=PlanRequest(overrun="discard"),
    ).chains[0]
    recording = simulate(_slower(application), tmp_path / "shaped", Plan.of(plan), cycles=400)
    gone = recording.events["gate_release"]["release"].null_count()
    assert 200 < gone < 400
    measured = measure_latency(recording)
    outputs = known(measured.prediction).outputs
    assert (outputs.due, outputs.late, outputs.absent) == (400, 0, {"discarded": gone})
    assert (outputs.missed, outputs.kept) == (gone, False)
    assert verdict(measured)[0] is False
    assert f"{gone} of 400 outputs missed ({gone} discarded), " in _text(measured)
    # It is judged so wherever a verdict is given.
    before, after = tmp_path / "profile", tmp_path / "shaped"
    compared = called("compare", before, after, "--strict")
    assert compared.code == 1
    assert f"promise broken: {gone} of 400 outputs missed" in compared.out
    said = json_of("compare", before, after)["recordings"][1]["prediction"]
    assert (said["missed"], said["due"], said["kept"]) == (gone, 400, False)
    save_plan(Plan.of(plan), tmp_path / "plan.yaml")
    simulated = called(
        "simulate", tmp_path / "small_chain.yaml", tmp_path / "plan.yaml", "-o", tmp_path / "again"
    )
    assert "promise met" in simulated.err
    assert simulated.out == f"{tmp_path / 'again'}\n"


def test_a_sweep_judges_what_did_not_come_as_well(tmp_path: Path) -> None:
    application = small_chain(tmp_path)
    recording = simulate(application, tmp_path / "profile", cycles=400)
    plan = plan_recording(recording, request=PlanRequest(overrun="discard")).chains[0]
    axes = {"seed": (1,)}
    frames = [
        sweep(one, axes, tmp_path / f"{name}.parquet", Plan.of(plan), cycles=400)
        for name, one in (("kept", application), ("broken", _slower(application)))
    ]
    kept, broken = (frame.row(0, named=True) for frame in frames)
    assert (kept["kept"], kept["missed"]) == (True, 0)
    assert (broken["kept"], broken["late"]) == (False, 0)
    assert broken["missed"] == broken["incomplete"] > 200 > broken["most_missed"]


def test_outputs_of_a_chain_whose_last_node_died_are_missed(tmp_path: Path) -> None:
    """The second node takes nothing from the 31st cycle on; the last of 60 cycles is under way."""
    measured = measure_latency(known_run(tmp_path / "rec", 60, untaken=tuple(range(30, 60))))
    outputs = outputs_due(measured.analysis, measured.plan)
    assert (outputs.due, outputs.absent) == (59, {"not taken": 29})
    assert verdict(measured)[0] is False
    whole = measure_latency(known_run(tmp_path / "whole", 60))
    assert (known(whole.prediction).outputs.missed, verdict(whole)[0]) == (0, True)


def _without(recording: Recording, first: int, last: int) -> Recording:
    """The recording as if nothing had happened in so many cycles."""
    since, until = first * KNOWN_PERIOD_NS, (last + 1) * KNOWN_PERIOD_NS
    before = events.happened(recording.events, 0, since)
    after = events.happened(recording.events, until)
    both = {name: before[name].vstack(after[name]) for name in before.keys() & after.keys()}
    apart = {**before, **after}
    tables = {n: recording.events[n] if n in events.CREATION else t for n, t in apart.items()}
    tables |= {n: t for n, t in both.items() if n not in events.CREATION}
    return replace(recording, events=tables)


def test_cycles_in_which_a_chain_did_not_begin_are_missed(tmp_path: Path) -> None:
    """The first node stands still for ten cycles of 60; nothing is under way then."""
    recording = _without(known_run(tmp_path / "rec", 60), 20, 29)
    measured = measure_latency(recording)
    outputs = outputs_due(measured.analysis, measured.plan)
    assert (outputs.due, outputs.late, outputs.absent) == (60, 0, {"not begun": 10})
    assert "10 of 60 outputs missed (10 not begun), 2 at most expected" in _text(measured)
    assert outputs_due(measured.analysis).share == pytest.approx(10 / 60)


def test_what_the_application_did_not_publish_before_either_is_no_broken_promise() -> None:
    """A promise of 1 % with a fifth of the cycles unpublished when it was planned."""
    outputs = OutputsDue(1_000, 3, {"not published": 210}, usual=205, promised=0.01)
    assert (outputs.missed, outputs.kept) == (8, True)
    assert outputs.text == (
        "8 of 1000 outputs missed (3 late, 210 not published, 205 of these as before the plan)"
    )
    assert OutputsDue(1_000, 20, promised=0.01).kept is False
    assert OutputsDue(1_000, 19, promised=0.01).kept is True
    assert OutputsDue(0, None, promised=0.01).kept is None
    assert OutputsDue(10, 4).kept is None


def test_recordings_of_other_periods_are_said_to_be_of_other_applications(tmp_path: Path) -> None:
    text, application = small_chain_text(), small_chain(tmp_path)
    slower = tmp_path / "slower.yaml"
    slower.write_text(re.sub(r"timer: \d+ms", "timer: 125ms", text))
    one = simulate(application, tmp_path / "one", cycles=40)
    two = simulate(load_application(slower), tmp_path / "two", cycles=40)
    compared = compare_recordings([one, two])
    assert known(compared.remark).startswith("/t1../t3 starts every ")
    assert "every 125 ms in two: these are different applications" in known(compared.remark)
    assert known(compared.remark) in known(comparison_table(compared).caption)
    assert compare_recordings([one, one]).remark is None
    plan = plan_recording(one).chains[0]
    with pytest.raises(InputError, match=r"starts every 125 ms there, and the plan's cycle is"):
        compare_recordings([one, two], plan=Plan.of(plan))


def test_the_verdict_has_the_bound_that_it_judges_by(tmp_path: Path) -> None:
    recording = simulate(small_chain(tmp_path), tmp_path / "profile", cycles=400)
    plans = [
        plan_recording(recording, request=PlanRequest(bands=bands)).chains[0] for bands in (1, 3)
    ]
    said = []
    for number, plan in enumerate(plans):
        shaped = simulate(
            small_chain(tmp_path), tmp_path / f"shaped{number}", Plan.of(plan), cycles=400
        )
        said.append(_text(measure_latency(shaped)))
    assert "promise met: jitter 0.000 ms, at most 1.000 ms; 0 of 400 outputs late" in said[0]
    assert re.search(
        r"promise met: jitter within bands [01]\.\d+, [01]\.\d+, 0\.000 ms, at most 1\.100 ms; ",
        said[1],
    )


def test_a_margin_that_names_no_share_allows_the_default_one(tmp_path: Path) -> None:
    recording = known_run(tmp_path / "rec", 60, overran=(7,))
    measured = measure_latency(recording)
    plan = revised(known(measured.plan), margin=Margin(epsilon_ns=MS))
    outputs = outputs_due(measured.analysis, plan)
    assert (outputs.late, outputs.promised) == (1, OVERRUN_PROBABILITY)
    assert (outputs.most_missed, outputs.kept) == (2, True)
