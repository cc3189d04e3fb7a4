"""What every experiment hands in: numbers beside the paper's, and the latencies they come from.

An experiment of the paper has up to three values for each number: the paper's, ours by simulation,
ours live. :class:`Line` is one such number, :class:`Run` the latencies of one run, simulated or
live. :func:`save` prints the lines of one table or figure and writes `results/NAME.json`, with the
cycles of every run and how many of them the machine disturbed, beside `results/NAME.parquet`, which
has the latencies that the numbers can be recomputed from.

Live values cost minutes and cannot be had on every machine. An experiment that was only simulated
therefore takes over the live values, runs and pictures (files named `…_live.png`) of the last time,
each with the day and the machine of its measurement.
"""

import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

__all__ = [
    "HERE",
    "MS",
    "PICTURES",
    "RESULTS",
    "Line",
    "Run",
    "Value",
    "lines_of",
    "save",
    "value_text",
]

MS = 1_000_000
HERE = Path(__file__).parent
RESULTS = HERE / "results"
PICTURES = HERE / "pictures"

Value: TypeAlias = float | str | None


@dataclass(frozen=True)
class Line:
    """One number of the paper, and ours. ``why`` says why they differ, where they do.

    ``what`` names the number and is unique within its table or figure. None stands for what there
    is not: a number that the paper does not give, a run that was not made.
    """

    what: str
    unit: str
    paper: Value
    simulated: Value
    live: Value
    why: str = ""


@dataclass(frozen=True)
class Run:
    """The end-to-end latencies of one configuration, in the order of time.

    ``latency_ns`` is −1 where a cycle came to no end (lost, discarded, merged with another);
    ``disturbed`` marks cycles that the machine disturbed, none of them in a simulation.
    """

    name: str
    live: bool
    latency_ns: NDArray[np.int64]
    disturbed: NDArray[np.bool_]

    @property
    def undisturbed_ns(self) -> NDArray[np.int64]:
        """The latencies of the complete cycles that the machine did not disturb."""
        return self.latency_ns[(self.latency_ns >= 0) & ~self.disturbed]

    @property
    def is_mostly_disturbed(self) -> bool:
        """Whether fewer than half of the complete cycles are undisturbed."""
        return bool(2 * self.undisturbed_ns.size < (self.latency_ns >= 0).sum())

    @property
    def counted_ns(self) -> NDArray[np.int64]:
        """What figures are over: the undisturbed cycles, or all if those are too few to tell.

        With all cycles a maximum or a jitter can only become larger.
        """
        complete = self.latency_ns[self.latency_ns >= 0]
        return complete if self.is_mostly_disturbed else self.undisturbed_ns


def lines_of(
    name: str,
    runs: Sequence[Run],
    paper: Mapping[str, Value],
    *,
    late_from_ns: int | None = None,
    why: str = "",
) -> list[Line]:
    """The lines of one configuration, simulated and live, whose runs are both called ``name``.

    ``paper`` has the paper's value for each line that is wanted: ``average``, ``maximum`` and
    ``jitter`` (maximum − minimum) in ms, ``late`` in cycles: those that took ``late_from_ns`` or
    longer, which missed the slot that they were due in. They are left out of the other figures.
    Where most cycles of a run were disturbed, ``why`` is extended by that.
    """
    found = {run.live: run.counted_ns for run in runs if run.name == name}
    for run in runs:
        if run.name == name and run.is_mostly_disturbed:
            why += (
                f"{'; ' if why else ''}live over all cycles, as {run.disturbed.sum()} of"
                f" {run.disturbed.size} are marked as disturbed"
            )

    def ours(what: str, live: bool) -> Value:
        if live not in found:
            return None
        late = found[live] >= (np.inf if late_from_ns is None else late_from_ns)
        in_time = found[live][~late] / MS
        if what == "late":
            return int(late.sum())
        if what == "jitter":
            return float(np.ptp(in_time))
        return float(in_time.max() if what == "maximum" else in_time.mean())

    return [
        Line(
            f"{name}: {what}",
            "cycles" if what == "late" else "ms",
            value,
            ours(what, False),
            ours(what, True),
            why,
        )
        for what, value in paper.items()
    ]


def save(
    name: str,
    title: str,
    lines: Sequence[Line],
    *,
    runs: Sequence[Run] = (),
    pictures: Sequence[Path] = (),
    notes: str = "",
    folder: Path = RESULTS,
) -> Path:
    """Print the lines, and write `NAME.json` and `NAME.parquet`; the path of the former.

    ``pictures`` are files in :data:`PICTURES`; those that show live latencies are called
    `…_live.png`. ``notes`` (Markdown) stand below the table; without any, the earlier ones do.
    """
    folder.mkdir(exist_ok=True)
    path, rows_path = folder / f"{name}.json", folder / f"{name}.parquet"
    earlier = json.loads(path.read_text()) if path.exists() else {}
    kept = [
        run
        for run in earlier.get("runs", [])
        if run["live"] and not any(one.live and one.name == run["name"] for one in runs)
    ]
    _write_beside(rows_path, _rows(runs, kept, rows_path).write_parquet)
    document = {
        "title": title,
        "notes": notes or earlier.get("notes", ""),
        "lines": _lines(lines, earlier.get("lines", [])),
        "runs": [_summary(run) for run in runs] + kept,
        "pictures": _pictures(pictures, earlier.get("pictures", [])),
    }
    text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    _write_beside(path, lambda beside: beside.write_text(text))
    _print(document)
    return path


def value_text(value: Value) -> str:
    """A value as it is printed: with two digits behind the point below ten, above with one."""
    if value is None:
        return "–"
    if isinstance(value, str | int):
        return str(value)
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def _rows(runs: Sequence[Run], kept: Sequence[dict[str, Any]], path: Path) -> pl.DataFrame:
    """One row per cycle: of these runs, and of the earlier ones that are kept."""
    types = {"run": pl.String, "live": pl.Boolean, "latency_ns": pl.Int64, "disturbed": pl.Boolean}
    frames = [pl.DataFrame(schema=types)]
    for run in runs:
        rows = pl.DataFrame({"latency_ns": run.latency_ns, "disturbed": run.disturbed})
        named = rows.with_columns(run=pl.lit(run.name), live=pl.lit(run.live))
        frames.append(named.select(*types))
    if kept:
        names = [run["name"] for run in kept]
        frames.append(pl.read_parquet(path).filter("live", pl.col("run").is_in(names)))
    return pl.concat(frames)


def _summary(run: Run) -> dict[str, Any]:
    return {
        "name": run.name,
        "live": run.live,
        "measured": _here_and_now(run.live),
        "cycles": int(run.latency_ns.size),
        "incomplete": int((run.latency_ns < 0).sum()),
        "disturbed": int(run.disturbed.sum()),
    }


def _lines(lines: Sequence[Line], earlier: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The lines as they are written; a live value that is missing is the earlier one."""
    before = {line["what"]: line for line in earlier}
    written = []
    for line in lines:
        if line.live is None and line.what in before:
            live, measured = before[line.what]["live"], before[line.what]["measured"]
        else:
            live, measured = line.live, _here_and_now(True) if line.live is not None else None
        written.append({**asdict(line), "live": live, "measured": measured})
    return written


def _pictures(pictures: Sequence[Path], earlier: Sequence[str]) -> list[str]:
    names = [path.name for path in pictures]
    kept = [name for name in earlier if name.endswith("_live.png") and name not in names]
    return sorted(names + kept)


def _here_and_now(live: bool) -> str:
    """The day; for what is live, also the kernel and the processors."""
    if not live:
        return f"{date.today()}"
    cpu = next(
        (
            line.partition(":")[2].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        ),
        platform.machine(),
    )
    return f"{date.today()}, Linux {platform.release()}, {os.cpu_count()} × {cpu}"


def _write_beside(path: Path, write: Callable[[Path], object]) -> None:
    beside = path.with_name(f".{path.name}.tmp")
    write(beside)
    beside.replace(path)


def _print(document: Mapping[str, Any]) -> None:
    table = Table(title=document["title"], title_justify="left")
    table.add_column("")
    for column in ("unit", "paper", "simulated", "live"):
        table.add_column(column, justify="right")
    for line in document["lines"]:
        values = (value_text(line[column]) for column in ("paper", "simulated", "live"))
        table.add_row(line["what"], line["unit"], *values)
    Console(width=120).print(table)
