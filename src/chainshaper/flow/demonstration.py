"""The demonstration: an application is measured, planned for, shaped, measured again, compared.

Runs without and with the plan take turns, so that both meet the same machine: what it does to them
can be compared. Where it stands still often, they go on for longer. As ROS 2 nodes the application
is shaped in two ways, each with a plan of its own.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from chainshaper.flow.described import shape_application
from chainshaper.flow.described_in_ros import check_ros, run_in_ros
from chainshaper.flow.plan import plan_recording
from chainshaper.planning import Plan, PlanRequest, save_plan
from chainshaper.reporting.latency import write_comparison_json
from chainshaper.reporting.page import write_report
from chainshaper.values.errors import ChainshaperError, OperationError
from chainshaper.values.files import folder_beside, write_whole
from chainshaper.values.progress import Progress
from chainshaper.values.recording import Recording, join_runs, open_recording, refuse_existing
from chainshaper.verify.measure import Comparison, Measurement, compare_recordings, measure_latency
from chainshaper.workload.description import Application, load_application
from chainshaper.workload.live import run_application

BEFORE = "measure as it is"
_STANDARD = PlanRequest()
_MOST_DISTURBED = 1 / 3
"""Share of cycles; where stalls of the machine hit more, the demonstration goes on."""
_MOST, _USUAL = 99.0, 50.0
"""Percentiles of the latencies: a few longer ones are not planned for where they fit into no cycle;
where not even half fit, the application is why, and no machine."""


@dataclass(frozen=True)
class Demonstration:
    """What a demonstration has shown; its files are in ``folder``.

    * ``before``: the application as it is, measured over all its turns.
    * ``comparison``: of ``before`` and of each way of shaping; None: nothing could be planned.
    * ``unplanned``: why nothing could be planned; None: it could.
    * ``longer``: whether it went on for longer, since the machine stood still too often, or was
      ``retried``: no plan fitted what was measured first.
    * ``shaped``: by the titles of the ways of shaping, each beside ``before`` alone.
    * ``plans``: of the ways.
    * ``percentile``: of the latencies without a plan, up to which was planned, since longer ones do
      not fit into a period; None: they do.
    """

    folder: Path
    before: Measurement
    comparison: Comparison | None
    unplanned: str | None = None
    longer: bool = False
    shaped: Mapping[str, Comparison] = field(default_factory=dict)
    plans: tuple[Plan, ...] = ()
    percentile: float | None = None
    retried: bool = False


def synthetic_chain() -> Path:
    """Return the description of the paper's synthetic chain (section 2.5)."""
    return Path(str(resources.files("chainshaper") / "examples" / "synthetic_chain.yaml"))


@dataclass(frozen=True)
class Way:
    """A way of shaping.

    * ``name``: of the recording of what is shaped so.
    * ``plan``: the name of the plan's file.
    * ``title``: what is done, in words.
    * ``request``: what is planned.
    """

    name: str
    plan: str
    title: str
    request: PlanRequest


def run_demo(
    folder: str | Path,
    *,
    application: str | Path | None = None,
    cycles: int = 320,
    request: PlanRequest = _STANDARD,
    realtime: bool | None = None,
    in_ros: bool = False,
    command: Sequence[str] = (),
    planned: Callable[[Plan], None] = lambda _: None,
    progress: Progress = lambda *_: None,
) -> Demonstration:
    """Run an application, plan, then run it shaped, as it is, and shaped again; compare.

    ``cycles`` are measured before the plan, and as many with it, in two turns; half as many are
    measured without it between these. Where stalls of the machine hit more than a third, of the
    cycles with the plan or of those without, two more turns follow.

    The recordings `before` and `after` are in ``folder``, beside `application.yaml`, `plan.yaml`,
    `comparison.json` and `report.html`. With ``in_ros`` the application runs as nodes of the ROS 2
    of this environment; it is shaped in the publisher's process (`in_process`) and by a shaping
    node (`by_node`), each by `plan_….yaml`.

    Raises InputError: ``folder`` exists and is not empty, or the application is not right.
    PlatformError, OperationError: a step failed; complete recordings stay, without one nothing.
    """
    folder = refuse_existing(folder)
    path = synthetic_chain() if application is None else Path(application)
    description = load_application(path)
    if in_ros:
        check_ros()
        ways = _ways_in_ros(request)
        run = partial(run_in_ros, description, realtime=realtime)
    else:
        ways = (Way("after", "plan.yaml", "shaped", request),)
        run = partial(_run_live, description, realtime=realtime, command=command)
    is_new, copy = not folder.exists(), folder / "application.yaml"
    try:
        folder.mkdir(exist_ok=True)
        write_whole(copy, [path.read_bytes()])
        with folder_beside(folder / "turns") as place:
            turns = _Turns(run, ways, cycles, Path(place), planned, progress)
            return _demonstrated(turns, folder)
    except OSError as error:
        raise OperationError(f"{folder}: cannot be written: {error}") from error
    finally:
        if folder.exists() and not (folder / "before").exists():  # nothing came to stand beside it
            copy.unlink(missing_ok=True)
            if is_new:
                folder.rmdir()


def _ways_in_ros(request: PlanRequest) -> tuple[Way, ...]:
    """Return the ways in which nodes of ROS 2 are shaped."""
    in_process = replace(request, publication="in-process")
    return (
        Way("in_process", "plan_in_process.yaml", "held in the publisher's process", in_process),
        Way("by_node", "plan_by_node.yaml", "held by a shaping node", request),
    )


def _run_live(
    application: Application, output: Path, *, plan: Plan | None, **options: Any
) -> Recording:
    """Run the live workload, with a plan or without."""
    if plan is None:
        return run_application(application, output, **options)
    return shape_application(application, plan, output, **options)


@dataclass
class _Turns:
    """The runs of a demonstration, in turns.

    * ``run``: runs the application with a ``plan`` or without, and records it.
    * ``cycles``: how many are measured without a plan, and with one.
    * ``place``: a folder for the turns' recordings, until they are joined.
    * ``after``: recordings of what is shaped, by the name of the way.
    """

    run: Callable[..., Recording]
    ways: tuple[Way, ...]
    cycles: int
    place: Path
    planned: Callable[[Plan], None]
    progress: Progress
    before: list[Recording] = field(default_factory=list)
    after: dict[str, list[Recording]] = field(default_factory=dict)

    def as_it_is(self, cycles: int) -> None:
        """Measure the application without a plan, once more."""
        output = self.place / f"before{len(self.before)}"
        report = self._report(f"1/3 {BEFORE}")
        self.before.append(self.run(output, plan=None, cycles=cycles, progress=report))

    def shaped(self, plans: Sequence[Plan], cycles: int) -> None:
        """Measure the application shaped in each way, once more."""
        for way, plan in zip(self.ways, plans, strict=True):
            runs = self.after.setdefault(way.name, [])
            step = f"3/3 measure {way.title}"
            output, report = self.place / f"{way.name}{len(runs)}", self._report(step)
            runs.append(self.run(output, plan=plan, cycles=cycles, progress=report))

    def recorded(self) -> Iterator[tuple[str, list[Recording]]]:
        """Yield the runs without a plan, and of each way, with the names of their recordings."""
        yield "before", self.before
        yield from self.after.items()

    def _report(self, step: str) -> Progress:
        """Report a turn's progress as that of a step, of which there may be several turns."""
        return lambda done, doing: self.progress(done, f"{step}, {doing}")


def _demonstrated(turns: _Turns, folder: Path) -> Demonstration:
    """Measure and plan; then measure in turns, for longer where the machine stands still often."""
    half, retried = max(1, turns.cycles // 2), False
    turns.as_it_is(turns.cycles)
    plans, percentile = _plans_of_most(turns)
    if isinstance(plans, ChainshaperError):
        usual = _plans(turns, _USUAL)
        if isinstance(usual, ChainshaperError) and not _at_the_mercy_of_others(turns.before):
            join_runs(turns.before, folder / "before")
            raise plans
        retried = True
        turns.as_it_is(turns.cycles)
        plans, percentile = _plans_of_most(turns)
    if isinstance(plans, ChainshaperError):
        before = join_runs(turns.before, folder / "before")
        reason = str(plans).partition(". What helps: ")[0]  # options of `plan`, which are not here
        return Demonstration(folder, measure_latency(before), None, reason, True, retried=True)
    for way, plan in zip(turns.ways, plans, strict=True):
        save_plan(plan, folder / way.plan)
        turns.planned(plan)
    turns.shaped(plans, half)
    turns.as_it_is(half)
    turns.shaped(plans, turns.cycles - half)
    if longer := any(_often_disturbed(runs) for _, runs in turns.recorded()):
        turns.as_it_is(half)
        turns.shaped(plans, turns.cycles)
    turns.progress(0.5, "comparing")
    comparison = compare_recordings(
        [join_runs(runs, folder / name) for name, runs in turns.recorded()]
    )
    write_comparison_json(comparison, folder)
    write_report([comparison], folder / "report.html")
    unshaped, *after = comparison.measurements
    shaped = {
        way.title: replace(comparison, measurements=(unshaped, measurement))
        for way, measurement in zip(turns.ways, after, strict=True)
    }
    return Demonstration(
        folder,
        unshaped,
        comparison,
        longer=longer or retried,
        shaped=shaped,
        plans=tuple(plans),
        percentile=percentile,
        retried=retried,
    )


def _plans_of_most(turns: _Turns) -> tuple[list[Plan] | ChainshaperError, float | None]:
    """Plan from all latencies without a plan; where these do not fit, from all but the longest few.

    Return the percentile up to which, None: all. A machine that stood still for longer than a
    period, or was slow to start the nodes, is in a few cycles, and no reason to shape nothing.
    """
    turns.progress(0.0, "2/3 plan")
    plans = _plans(turns)
    if isinstance(plans, ChainshaperError):
        of_most = _plans(turns, _MOST)
        if not isinstance(of_most, ChainshaperError):
            return of_most, _MOST
    return plans, None


def _plans(turns: _Turns, percentile: float | None = None) -> list[Plan] | ChainshaperError:
    """Plan each way from what has been measured without a plan; return why it is not possible.

    ``percentile``: of the latencies, up to which is planned; None: as the way says.
    """
    if len(turns.before) == 1:
        recording = turns.before[0]
    else:
        joined = turns.place / f"planned_from_{len(turns.before)}"
        recording = open_recording(joined) if joined.exists() else join_runs(turns.before, joined)
    requests = [way.request for way in turns.ways]
    if percentile is not None:
        requests = [replace(request, percentile=percentile) for request in requests]
    try:
        return [plan_recording(recording, request=request) for request in requests]
    except ChainshaperError as error:
        return error


def _at_the_mercy_of_others(runs: Sequence[Recording]) -> bool:
    """Whether what else the machine does may be why nothing can be planned."""
    return any(run.info.realtime is False for run in runs) or _often_disturbed(runs)


def _often_disturbed(runs: Sequence[Recording]) -> bool:
    """Whether stalls of the machine hit too many cycles to go without them."""
    seen = [measure_latency(run).analysis.statistics for run in runs]
    cycles = sum(statistics.count for statistics in seen)
    disturbed = sum(statistics.disturbed for statistics in seen)
    return disturbed > _MOST_DISTURBED * cycles
