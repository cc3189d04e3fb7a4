"""The demonstration: the whole flow on a live application, everything in one folder.

DIR/application.yaml        what ran
DIR/before, DIR/after       the recordings of the unshaped and of the shaped run
DIR/plan.yaml               what was planned from the former
DIR/latency.png, …          latency of every cycle, and their distributions with the publish slot
DIR/comparison.json         every figure of the printed table
"""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import polars as pl

from chainshaper.analysis import callback_statistics, data_flow
from chainshaper.flow.plan import plan_recording, shape_application
from chainshaper.planning import Plan, PlanRequest, save_plan
from chainshaper.reporting.figures import write_comparison
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import refuse_existing
from chainshaper.verify.measure import Comparison, compare_recordings
from chainshaper.workload.description import load_application
from chainshaper.workload.live import Progress, run_application

_STANDARD = PlanRequest()


@dataclass(frozen=True)
class DemoResult:
    """What the demonstration found; all of it can be recomputed from ``folder``."""

    folder: Path
    callbacks: pl.DataFrame
    plan: Plan
    comparison: Comparison
    notes: tuple[str, ...]


def synthetic_chain() -> Path:
    """The description of the paper's synthetic chain (section 2.5)."""
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
) -> DemoResult:
    """Run an application, plan, shape, run again and compare.

    Raises InputError: ``folder`` exists and is not empty, or the application is not right.
    PlatformError, OperationError: a step failed; complete recordings stay, without one nothing.
    """
    folder = refuse_existing(folder)
    path = synthetic_chain() if application is None else Path(application)
    description = load_application(path)
    how: dict[str, Any] = {"cycles": cycles, "realtime": realtime, "command": command}

    def part(start: float, title: str) -> Progress:
        return lambda done, what: progress(start + 0.48 * done, f"{title}, {what}")

    made, copy = not folder.exists(), folder / "application.yaml"
    report = part(0.0, "unshaped run")
    try:
        folder.mkdir(exist_ok=True)
        shutil.copyfile(path, copy)
        before = run_application(description, folder / "before", progress=report, **how)
    except OSError as error:
        raise OperationError(f"{folder}: cannot be written: {error}") from error
    finally:
        if not (folder / "before").exists():  # nothing came to stand beside it
            copy.unlink(missing_ok=True)
            if made and folder.exists():
                folder.rmdir()
    progress(0.48, "planning")
    plan = plan_recording(before, request=request)
    save_plan(plan, folder / "plan.yaml")
    planned(plan)
    report = part(0.5, "shaped run")
    after = shape_application(description, plan, folder / "after", progress=report, **how)
    progress(0.98, "comparing")
    comparison = compare_recordings([before, after])
    write_comparison(comparison, folder)
    return DemoResult(
        folder=folder,
        callbacks=callback_statistics(data_flow(before.events, before.info.clock_offset_ns)),
        plan=plan,
        comparison=comparison,
        notes=tuple(dict.fromkeys([*before.info.notes, *after.info.notes])),
    )
