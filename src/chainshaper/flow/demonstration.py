"""The demonstration: an application is measured, planned for, shaped, measured again, compared.

Runs without and with the plan take turns, so that both meet the same machine: what it does to them
can be compared. Where it stands still often, they go on for longer.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

from chainshaper.flow.described import shape_application
from chainshaper.flow.plan import plan_recording
from chainshaper.planning import Plan, PlanRequest, save_plan
from chainshaper.reporting.latency import write_comparison_json
from chainshaper.reporting.page import write_report
from chainshaper.values.errors import ChainshaperError, OperationError
from chainshaper.values.files import folder_beside, write_whole
from chainshaper.values.progress import Progress
from chainshaper.values.recording import Recording, join_runs, refuse_existing
from chainshaper.verify.measure import Comparison, Measurement, compare_recordings, measure_latency
from chainshaper.workload.description import Application, load_application
from chainshaper.workload.live import run_application

BEFORE, AFTER = "measure as it is", "measure shaped"
_STANDARD = PlanRequest()
_MOST_DISTURBED = 1 / 3
"""Share of cycles; where stalls of the machine hit more, the demonstration goes on."""


@dataclass(frozen=True)
class Demonstration:
    """What a demonstration has shown; its files are in ``folder``.

    * ``before``: the application as it is, measured over all its turns.
    * ``comparison``: of ``before`` and ``after``; None: nothing could be planned.
    * ``unplanned``: why nothing could be planned; None: it could.
    * ``longer``: whether it went on for longer, since the machine stood still too often.
    """

    folder: Path
    before: Measurement
    comparison: Comparison | None
    unplanned: str | None = None
    longer: bool = False


def synthetic_chain() -> Path:
    """Return the description of the paper's synthetic chain (section 2.5)."""
    return Path(str(resources.files("chainshaper") / "examples" / "synthetic_chain.yaml"))


def run_demo(
    folder: str | Path,
    *,
    application: str | Path | None = None,
    cycles: int = 320,
    request: PlanRequest = _STANDARD,
    realtime: bool | None = None,
    command: Sequence[str] = (),
    planned: Callable[[Plan], None] = lambda _: None,
    progress: Progress = lambda *_: None,
) -> Demonstration:
    """Run an application, plan, then run it shaped, as it is, and shaped again; compare.

    ``cycles`` are measured before the plan, and as many with it, in two turns; half as many are
    measured without it between these. Where stalls of the machine hit more than a third, of the
    cycles with the plan or of those without, two more turns follow.

    The recordings `before` and `after` are in ``folder``, beside `application.yaml`, `plan.yaml`,
    `comparison.json` and `report.html`.

    Raises InputError: ``folder`` exists and is not empty, or the application is not right.
    PlatformError, OperationError: a step failed; complete recordings stay, without one nothing.
    """
    folder = refuse_existing(folder)
    path = synthetic_chain() if application is None else Path(application)
    description = load_application(path)
    is_new, copy = not folder.exists(), folder / "application.yaml"
    try:
        folder.mkdir(exist_ok=True)
        write_whole(copy, [path.read_bytes()])
        with folder_beside(folder / "turns") as place:
            turns = _Turns(
                description, cycles, Path(place), realtime, command, request, planned, progress
            )
            return _demonstrated(turns, folder)
    except OSError as error:
        raise OperationError(f"{folder}: cannot be written: {error}") from error
    finally:
        if folder.exists() and not (folder / "before").exists():  # nothing came to stand beside it
            copy.unlink(missing_ok=True)
            if is_new:
                folder.rmdir()


@dataclass
class _Turns:
    """The runs of a demonstration, in turns.

    * ``cycles``: how many are measured without a plan, and with one.
    * ``place``: a folder for the turns' recordings, until they are joined.
    """

    application: Application
    cycles: int
    place: Path
    realtime: bool | None
    command: Sequence[str]
    request: PlanRequest
    planned: Callable[[Plan], None]
    progress: Progress
    before: list[Recording] = field(default_factory=list)
    after: list[Recording] = field(default_factory=list)

    def as_it_is(self, cycles: int) -> None:
        """Measure the application without a plan, once more."""
        self.before.append(
            run_application(
                self.application,
                self.place / f"before{len(self.before)}",
                cycles=cycles,
                realtime=self.realtime,
                command=self.command,
                progress=self._report(f"1/3 {BEFORE}"),
            )
        )

    def shaped(self, plan: Plan, cycles: int) -> None:
        """Measure the application with the plan in force, once more."""
        self.after.append(
            shape_application(
                self.application,
                plan,
                self.place / f"after{len(self.after)}",
                cycles=cycles,
                realtime=self.realtime,
                command=self.command,
                progress=self._report(f"3/3 {AFTER}"),
            )
        )

    def _report(self, step: str) -> Progress:
        """Report a turn's progress as that of a step, of which there may be several turns."""
        return lambda done, doing: self.progress(done, f"{step}, {doing}")


def _demonstrated(turns: _Turns, folder: Path) -> Demonstration:
    """Measure and plan; then measure in turns, for longer where the machine stands still often."""
    half, longer = max(1, turns.cycles // 2), False
    turns.as_it_is(turns.cycles)
    plan = _plan(turns)
    if isinstance(plan, ChainshaperError):
        if not _often_disturbed(turns.before):
            join_runs(turns.before, folder / "before")
            raise plan
        longer = True
        turns.as_it_is(turns.cycles)
        plan = _plan(turns)
    if isinstance(plan, ChainshaperError):
        before = join_runs(turns.before, folder / "before")
        return Demonstration(folder, measure_latency(before), None, str(plan), longer)
    save_plan(plan, folder / "plan.yaml")
    turns.planned(plan)
    turns.shaped(plan, half)
    turns.as_it_is(half)
    turns.shaped(plan, turns.cycles - half)
    if _often_disturbed(turns.before) or _often_disturbed(turns.after):
        longer = True
        turns.as_it_is(half)
        turns.shaped(plan, turns.cycles)
    turns.progress(0.5, "comparing")
    joined = [
        join_runs(runs, folder / name)
        for name, runs in (("before", turns.before), ("after", turns.after))
    ]
    comparison = compare_recordings(joined)
    write_comparison_json(comparison, folder)
    write_report([comparison], folder / "report.html")
    return Demonstration(folder, comparison.measurements[0], comparison, None, longer)


def _plan(turns: _Turns) -> Plan | ChainshaperError:
    """Plan from what has been measured without a plan; return why it is not possible."""
    turns.progress(0.0, "2/3 plan")
    if len(turns.before) == 1:
        recording = turns.before[0]
    else:
        recording = join_runs(turns.before, turns.place / "planned_from")
    try:
        return plan_recording(recording, request=turns.request)
    except ChainshaperError as error:
        return error


def _often_disturbed(runs: Sequence[Recording]) -> bool:
    """Whether stalls of the machine hit too many cycles to go without them."""
    seen = [measure_latency(run).analysis.statistics for run in runs]
    cycles = sum(statistics.count for statistics in seen)
    disturbed = sum(statistics.disturbed for statistics in seen)
    return disturbed > _MOST_DISTURBED * cycles
