"""The demonstration, live: turns, what it leaves behind, and machines that it cannot plan for."""

import json
from pathlib import Path

import pytest

import chainshaper as cs
from chainshaper.flow import demonstration
from chainshaper.flow.demonstration import run_demo
from chainshaper.planning import ChainPlan, Plan, PlanRequest
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording, join_runs
from chainshaper.verify.promises import outputs_due

pytestmark = pytest.mark.timed
CYCLES = 40


def test_runs_take_turns_and_are_compared_as_two_recordings(
    application_file: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "demonstrated"
    steps: list[str] = []
    shown = run_demo(
        folder,
        application=application_file,
        cycles=CYCLES,
        progress=lambda _, step: steps.append(step.partition(",")[0]),
    )
    assert shown.comparison is not None
    assert {path.name for path in folder.iterdir()} == {
        "before", "after", "application.yaml", "plan.yaml", "comparison.json", "report.html"
    }  # fmt: skip
    turns = [
        step for step, next_step in zip(steps, [*steps[1:], ""], strict=True) if step != next_step
    ]
    as_it_is, shaped = "1/3 measure as it is", "3/3 measure shaped"
    assert turns[:5] == [as_it_is, "2/3 plan", shaped, as_it_is, shaped]
    before, after = shown.comparison.measurements
    assert before.recording.path.name == "before"
    assert len(before.recording.info.pauses_ns) == (2 if shown.longer else 1)
    assert before.analysis.traversals.height >= CYCLES + CYCLES // 2
    assert after.plan is not None
    due = outputs_due(after.analysis, after.plan)
    expected = 2 * CYCLES if shown.longer else CYCLES
    assert due.due <= expected + 3 * 2, "times between turns owe nothing"
    written = json.loads((folder / "comparison.json").read_text())
    recordings = [str(folder / name) for name in ("before", "after")]
    assert [recording["recording"] for recording in written["recordings"]] == recordings


def test_a_machine_too_busy_to_plan_for_gets_a_second_chance_and_then_an_answer(
    application_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned_from: list[int] = []

    def refuse(recording: Recording, **_: object) -> cs.Plan:
        planned_from.append(recording.events["callback_start"].height)
        raise InputError("the latencies do not fit into the cycle")

    monkeypatch.setattr(demonstration, "plan_recording", refuse)
    monkeypatch.setattr(demonstration, "_often_disturbed", lambda _: True)
    shown = run_demo(tmp_path / "busy", application=application_file, cycles=20)
    assert shown.comparison is None
    assert shown.unplanned == "the latencies do not fit into the cycle"
    assert shown.longer
    first, *_, both = planned_from
    assert both > 1.5 * first
    monkeypatch.setattr(demonstration, "_at_the_mercy_of_others", lambda _: False)
    with pytest.raises(InputError, match="do not fit"):
        run_demo(tmp_path / "calm", application=application_file, cycles=20)
    assert cs.measure_latency(tmp_path / "calm" / "before").analysis.statistics.count >= 15


@pytest.mark.parametrize(("fitting", "answered"), [(99, True), (90, False)])
def test_a_few_cycles_that_no_plan_fits_are_no_error(
    application_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    fitting: float,
    answered: bool,
) -> None:
    """One cycle in a hundred is left out, and it is said; of more nothing can be said."""
    application = cs.load_application(application_file)
    fits = cs.plan_recording(cs.simulate(application, tmp_path / "simulated", cycles=40))

    def refuse_all(_: Recording, request: PlanRequest) -> cs.Plan:
        if (request.percentile or 100) > fitting:
            raise InputError("they do not fit. What helps: --skip 2s")
        return fits

    monkeypatch.setattr(demonstration, "plan_recording", refuse_all)
    monkeypatch.setattr(demonstration, "_often_disturbed", lambda _: False)
    shown = run_demo(tmp_path / "busy", application=application_file, cycles=20)
    if answered:
        assert shown.percentile == 99
        assert shown.comparison is not None
        assert (shown.unplanned, shown.longer) == (None, False)
    else:
        assert (shown.comparison, shown.percentile) == (None, None)
        assert (shown.unplanned, shown.longer) == ("they do not fit", True)


def test_runs_are_joined_and_what_was_due_between_them_is_not(
    application_file: Path, plan: ChainPlan, tmp_path: Path
) -> None:
    application, planned = cs.load_application(application_file), Plan.of(plan)
    runs = [
        cs.shape_application(application, planned, tmp_path / f"run{number}", cycles=CYCLES)
        for number in range(2)
    ]
    joined = join_runs(runs, tmp_path / "joined")
    (pause,) = joined.info.pauses_ns
    assert pause[1] - pause[0] > 10 * plan.cycle_ns
    assert set(joined.info.processes) == {*runs[0].info.processes, *runs[1].info.processes}
    alone = [outputs_due(cs.measure_latency(run).analysis, plan) for run in runs]
    together = outputs_due(cs.measure_latency(joined).analysis, plan)
    assert abs(together.due - sum(outputs.due for outputs in alone)) <= 2
    assert together.absent.get("not begun", 0) <= sum(
        outputs.absent.get("not begun", 0) for outputs in alone
    )
