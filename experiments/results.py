"""What every experiment hands in: latencies of runs, and the numbers that follow from them.

An experiment of the paper has a value for each number in up to five columns: the paper's, and ours
by simulation, live, and on ROS 2 over two middlewares. :class:`Run` is the latencies of one run,
:class:`Line` one number. Every experiment has a function ``lines``, which makes its lines from its
runs and from nothing else. :func:`save` writes the runs: `results/NAME.parquet` has every cycle,
`results/NAME.json` what else is known of each run, and the lines for who reads them elsewhere. The
page is made from the runs alone (:func:`lines_from`).

Measured values cost minutes and cannot be had on every machine. An experiment that was only
simulated therefore takes the measured runs of the last time from its files (:func:`earlier_runs`),
and the pictures (files that end in the column, such as `_live.png`), with day and machine.
"""

import json
import os
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

__all__ = [
    "COLUMNS",
    "HERE",
    "MARK",
    "MS",
    "OURS",
    "PICTURES",
    "RESULTS",
    "ROS",
    "Column",
    "Line",
    "Run",
    "Value",
    "cell",
    "earlier_runs",
    "figure",
    "figures_of",
    "lines_from",
    "lines_of",
    "machines_of",
    "save",
    "value_text",
]

MS = 1_000_000
HERE = Path(__file__).parent
RESULTS = HERE / "results"
PICTURES = HERE / "pictures"

Value: TypeAlias = float | str | None
Figure: TypeAlias = Callable[[NDArray[np.int64]], Value]
Column: TypeAlias = Literal["simulated", "live", "ros", "fast"]
"""Where a run's latencies come from; the last two are ROS 2 on Cyclone DDS, and on Fast DDS."""

ROS: tuple[Column, ...] = ("ros", "fast")
OURS: tuple[Column, ...] = ("simulated", "live", *ROS)

COLUMNS = {
    "paper": "paper",
    "simulated": "simulated",
    "live": "live",
    "ros": "ROS 2, Cyclone DDS",
    "fast": "ROS 2, Fast DDS",
}
"""The columns of values."""

MARK = "○"
"""Stands behind a value that says nothing about how near ours is to the paper's."""

AT_RECEIVER = "jitter, received"
"""The jitter until the callback of the output's receiver begins."""

RESAMPLES, STRETCH = 2_000, 10
"""Bootstrap: how often drawn again, and how many consecutive cycles are drawn together."""


@dataclass(frozen=True)
class Line:
    """One number of the paper, and ours. ``why`` says why they differ, where they do.

    ``what`` names the number and is unique within its table or figure. None stands for what there
    is not: a number that the paper does not give, a run that was not made. ``simulated``,
    ``live``, ``ros`` and ``fast`` are over undisturbed cycles in time; the values with ``_all``
    over all that came to an end, late ones too. ``intervals`` hold 95 % of the measured values of
    a column that are drawn again. ``no_evidence`` says of a column why its value does not count as
    one that is near. ``machines`` says of a measured column when and where it was measured.
    """

    what: str
    unit: str
    paper: Value
    simulated: Value
    live: Value
    why: str = ""
    simulated_all: Value = None
    live_all: Value = None
    ros: Value = None
    ros_all: Value = None
    fast: Value = None
    fast_all: Value = None
    machines: Mapping[Column, str] = field(default_factory=dict)
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    no_evidence: Mapping[Column, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Run:
    """The end-to-end latencies of one configuration, in the order of time.

    ``latency_ns`` is −1 where a cycle came to no end (lost, discarded, merged with another);
    ``disturbed`` marks cycles that the machine disturbed, none of them in a simulation. ``block``
    counts the stretches in which a configuration took turns with others; ``repeats`` of these were
    measured again, because the machine stood still. ``measured`` is when and where: as it is saved.
    ``reception_ns`` is the latency until the callback of the output's receiver begins, −1 where
    none did; None if nobody received, or it was not kept. ``facts`` are numbers of the run that are
    no figures of its cycles, and its slots.
    """

    name: str
    column: Column
    latency_ns: NDArray[np.int64]
    disturbed: NDArray[np.bool_]
    block: NDArray[np.int64] | None = None
    repeats: int = 0
    measured: str = ""
    reception_ns: NDArray[np.int64] | None = None
    facts: Mapping[str, Value] = field(default_factory=dict)

    @property
    def undisturbed_ns(self) -> NDArray[np.int64]:
        """The latencies of the complete cycles that the machine did not disturb."""
        return self.latency_ns[(self.latency_ns >= 0) & ~self.disturbed]

    @property
    def blocks(self) -> NDArray[np.int64]:
        """The block of each cycle; one where none took turns."""
        return np.zeros(self.latency_ns.size, np.int64) if self.block is None else self.block


def figure(what: str, latency_ns: NDArray[np.int64], late_from_ns: float = np.inf) -> Value:
    """One figure of latencies, in ms; of those in time, but for ``late``, which counts the others.

    None where there is nothing that it could be of.
    """
    late = latency_ns >= late_from_ns
    if what == "late":
        return int(late.sum())
    in_time = latency_ns[~late] / MS
    if not in_time.size:
        return None
    if what.startswith("jitter"):
        return float(np.ptp(in_time))
    return float(in_time.max() if what == "maximum" else in_time.mean())


def drawn_again(run: Run, of: Figure, counted: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Between which values 95 % of a run's figure lie, when its cycles are drawn again.

    Stretches of ten consecutive cycles are drawn with replacement, as many of every block as it
    has: what belongs together in time stays together (moving-block bootstrap, Künsch 1989). ``of``
    gets the latencies of those that are ``counted``. Of a maximum it shows how much hangs on few
    cycles, not how much larger another run's may be.
    """
    random, drawn = np.random.default_rng(1), list[NDArray[np.int64]]()
    for block in np.unique(run.blocks):
        own = np.flatnonzero(run.blocks == block)
        length = min(STRETCH, own.size)
        starts = random.integers(0, own.size - length + 1, (RESAMPLES, -(-own.size // length)))
        places = (starts[:, :, None] + np.arange(length)).reshape(RESAMPLES, -1)[:, : own.size]
        drawn.append(own[places])
    again = (of(run.latency_ns[row[counted[row]]]) for row in np.concatenate(drawn, axis=1))
    values = [value for value in again if isinstance(value, float | int)]
    if not values:
        return None
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)


def figures_of(
    run: Run, calm: Figure, every: Figure
) -> tuple[dict[str, Any], dict[str, tuple[float, float]]]:
    """A figure of the undisturbed cycles, and one of all that came to an end, by a line's columns.

    And the intervals of those that were measured.
    """
    values, intervals = dict[str, Any](), dict[str, tuple[float, float]]()
    ended = run.latency_ns >= 0
    for suffix, of, counted in (("", calm, ended & ~run.disturbed), ("_all", every, ended)):
        column = run.column + suffix
        values[column] = of(run.latency_ns[counted])
        again = None if run.column == "simulated" else drawn_again(run, of, counted)
        if again is not None:
            intervals[column] = again
    return values, intervals


def lines_of(
    name: str,
    runs: Sequence[Run],
    paper: Mapping[str, Value],
    *,
    late_from_ns: int | Mapping[Column, int] | None = None,
    why: str = "",
    no_evidence: Mapping[Column, str] | None = None,
) -> list[Line]:
    """The lines of one configuration, simulated and live, whose runs are both called ``name``.

    ``paper`` has the paper's value for each line that is wanted: ``average``, ``maximum`` and
    ``jitter`` (maximum − minimum) in ms, ``late`` in cycles: those that took ``late_from_ns`` (of
    their column) or longer, which missed the slot that they were due in. Figures of undisturbed
    cycles leave the late ones out, figures of all cycles leave out nothing. Beside a jitter stands
    that at the receiver, where a run has it.
    """
    published = {run.column: run for run in runs if run.name == name}
    received = {
        column: replace(run, latency_ns=run.reception_ns)
        for column, run in published.items()
        if run.reception_ns is not None
    }
    limits = late_from_ns if isinstance(late_from_ns, Mapping) else {}
    anywhere = late_from_ns if isinstance(late_from_ns, int) else np.inf

    def line(what: str, value: Value) -> Line:
        values: dict[str, Any] = dict.fromkeys(("simulated", "live"))
        intervals: dict[str, tuple[float, float]] = {}
        of_all = partial(figure, what)
        for column, run in (received if what == AT_RECEIVER else published).items():
            limit = limits.get(column, anywhere)
            in_time = partial(figure, what, late_from_ns=limit)
            own, between = figures_of(run, in_time, in_time if what == "late" else of_all)
            values |= own
            intervals |= between
        unit = "cycles" if what == "late" else "ms"
        values |= {"intervals": intervals, "no_evidence": no_evidence or {}}
        values |= {"machines": machines_of(published.values())}
        return Line(f"{name}: {what}", unit, value, why=why, **values)

    wanted = dict(paper)
    if "jitter" in paper and received:
        wanted[AT_RECEIVER] = None
    return [line(what, value) for what, value in wanted.items()]


def machines_of(runs: Iterable[Run]) -> dict[Column, str]:
    """When and where the runs of each column were measured; nothing of what was simulated."""
    return {run.column: run.measured for run in runs if run.column != "simulated"}


def earlier_runs(name: str, *columns: Column, folder: Path = RESULTS) -> list[Run]:
    """The runs of these columns that an experiment had the last time; none without its files."""
    path = folder / f"{name}.json"
    if not path.exists():
        return []
    rows, runs = pl.read_parquet(path.with_suffix(".parquet")), []
    for about in json.loads(path.read_text())["runs"]:
        if about["column"] in columns:
            cycles = rows.filter(
                pl.col("column") == about["column"], pl.col("run") == about["name"]
            )
            latency, disturbed, block = (
                cycles[key].to_numpy() for key in ("latency_ns", "disturbed", "block")
            )
            reception = cycles["reception_ns"]
            run = Run(
                *(about["name"], about["column"], latency, disturbed, block),
                repeats=about["repeats"],
                measured=about["measured"],
                reception_ns=None if reception.null_count() else reception.to_numpy(),
                facts=about["facts"],
            )
            runs.append(run)
    return runs


def lines_from(name: str, runs: Sequence[Run]) -> list[Line]:
    """The lines of an experiment, computed from its runs."""
    lines: list[Line] = import_module(name).lines(runs)
    return lines


def save(
    name: str,
    title: str,
    lines: Callable[[Sequence[Run]], list[Line]],
    *,
    runs: Sequence[Run],
    pictures: Sequence[Path] = (),
    notes: str = "",
    folder: Path = RESULTS,
) -> Path:
    """Print the lines of runs, and write `NAME.json` and `NAME.parquet`; the path of the former.

    ``pictures`` are files in :data:`PICTURES`, called `…_COLUMN.png`. ``notes`` (Markdown) stand
    below the table; without any, the earlier ones do.
    """
    folder.mkdir(exist_ok=True)
    runs = [replace(run, measured=run.measured or _here_and_now(run)) for run in runs]
    made = lines(runs)
    path, rows_path = folder / f"{name}.json", folder / f"{name}.parquet"
    earlier = json.loads(path.read_text()) if path.exists() else {}
    _write_beside(rows_path, _rows(runs).write_parquet)
    document = {
        "title": title,
        "notes": notes or earlier.get("notes", ""),
        "lines": [asdict(line) for line in made],
        "runs": [_summary(run) for run in runs],
        "pictures": _pictures(pictures, earlier.get("pictures", [])),
    }
    text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    _write_beside(path, lambda beside: beside.write_text(text))
    _print(title, made)
    return path


def value_text(value: Value) -> str:
    """A value as it is printed: with two digits behind the point below ten, above with one."""
    if value is None:
        return "–"
    if isinstance(value, str | int):
        return str(value)
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def cell(line: Line, column: Column) -> str:
    """The value of all cycles as it is printed, with its interval and its mark.

    Behind it, where it is another one, that of undisturbed cycles in time.
    """
    calm, every = (getattr(line, key) for key in (column, f"{column}_all"))
    if every is None:
        every = calm
    text = value_text(every)
    interval = line.intervals.get(f"{column}_all")
    if interval is not None and every is not None:
        low, high = (round(end) if line.unit == "cycles" else end for end in interval)
        text += f" ({value_text(low)}–{value_text(high)})"
    if calm is not None and value_text(calm) != value_text(every):
        text += f", calm {value_text(calm)}"
    return f"{text} {MARK}" if column in line.no_evidence and every is not None else text


def _rows(runs: Sequence[Run]) -> pl.DataFrame:
    """One row per cycle."""
    types: dict[str, type[pl.DataType]] = {
        **{"run": pl.String, "column": pl.String, "latency_ns": pl.Int64},
        **{"disturbed": pl.Boolean, "block": pl.Int64, "reception_ns": pl.Int64},
    }
    frames = [pl.DataFrame(schema=types)]
    for run in runs:
        rows = pl.DataFrame(
            {"latency_ns": run.latency_ns, "disturbed": run.disturbed, "block": run.blocks}
        )
        reception = pl.lit(None, pl.Int64)
        if run.reception_ns is not None:
            reception = pl.lit(pl.Series(run.reception_ns))
        named = rows.with_columns(
            run=pl.lit(run.name), column=pl.lit(run.column), reception_ns=reception
        )
        frames.append(named.select(*types))
    return pl.concat(frames)


def _summary(run: Run) -> dict[str, Any]:
    return {
        "name": run.name,
        "column": run.column,
        "measured": run.measured,
        "cycles": int(run.latency_ns.size),
        "blocks": int(np.unique(run.blocks).size),
        "repeats": run.repeats,
        "incomplete": int((run.latency_ns < 0).sum()),
        "disturbed": int(run.disturbed.sum()),
        "facts": dict(run.facts),
    }


def _pictures(pictures: Sequence[Path], earlier: Sequence[str]) -> list[str]:
    names = [path.name for path in pictures]
    ends = tuple(f"_{column}.png" for column in OURS if column != "simulated")
    measured = [name for name in earlier if name.endswith(ends)]
    return sorted({*names, *measured})


def _here_and_now(run: Run) -> str:
    """The day; for a run that was measured, also the kernel and the processors."""
    if run.column == "simulated":
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


def _print(title: str, lines: Sequence[Line]) -> None:
    table = Table(title=title, title_justify="left")
    for heading in ("", "unit", *COLUMNS.values()):
        table.add_column(heading, justify="right" if heading else "left")
    for line in lines:
        cells = (cell(line, column) for column in OURS)
        table.add_row(line.what, line.unit, value_text(line.paper), *cells)
    Console(width=160).print(table)
