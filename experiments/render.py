"""Run all experiments of the paper, and render one page with pictures from their results.

    python experiments/render.py [--simulated | --page]

Each experiment runs in a process of its own; one that fails does not stop the others, is named at
the end, and keeps the results that it had before. The page, `RESULTS.md`, is made from the files in
`results/` alone: `--page` runs nothing and computes every number on it again.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from claim_pictures import draw_claims, pictures_of
from claims import CLAIMS, MARKS, Claim, Judged, Verdict, judged, verdict_of
from results import (
    COLUMNS,
    HERE,
    MARK,
    OURS,
    PICTURES,
    RESULTS,
    Column,
    Line,
    Run,
    Value,
    cell,
    earlier_runs,
    lines_from,
    machines_of,
    value_text,
)

EXPERIMENTS = (
    "table_1",
    "table_2",
    "table_3",  # and figure 6
    "table_4",
    "figure_7",
    "figure_8",
    "table_5",
    "figure_9",
    "strict_servers",  # not of the paper
    "reference_system",  # not of the paper
)
PAGE = HERE / "RESULTS.md"
SHARED = ("table_2", "table_3")
"""They are about the same run under SCHED_FIFO."""

NEAR_SHARE, SMALL, NEAR_SMALL = 0.05, 1.0, 0.05
"""A value is near the paper's within this share of it. What the paper has below 1 ms is a bound."""

WORDS: Mapping[Verdict, str] = {
    "holds": "holds",
    "partly": "partly",
    "not": "not",
    "taken over": "follows from what was taken from the paper",
}
COUNTED: Mapping[Verdict, str] = {
    "holds": "hold",
    "partly": "hold partly",
    "not": "do not",
    "taken over": "are not tested by what we have",
}

HEAD = """# The paper's evaluation, and ours

What the paper claims, and whether it holds here. Each claim is judged by its own ratio, within one
column, over **all cycles** that came to an end: late ones, and those that a stall of the machine
hit, are in every number of this table. {marks}.

{verdicts}
"""

ABOUT = f"""
* **simulated** has 2,000 to 10,000 cycles, **live** the same chains over Cyclone DDS, by nodes of
  our own, **ROS 2** generated C++ nodes that `ros2 launch` starts and the one command shapes.
* {MARK} follows from what was taken from the paper (its slots, or execution times that were fitted
  to its numbers): no evidence, and not part of the verdict. What does not come out as the paper's
  all the same, counts.
* **Machines** are virtual machines with two cores that others share; each row has values of one of
  them alone: {{machines}}. The paper's has 16 cores at 3.7 GHz; neither the drive and localizer of
  its valet parking nor its execution times are published: ours are another localizer (live) and
  drawn times (simulated and ROS 2).
* **Never run**: LITMUS^RT's kernel, which the paper has, and sched_ext outside a virtual machine.
  Servers are in force here by freezing threads on a stock kernel. In the runs of this table the
  chain's server R_m stays open until the chain is done, but for the one server of valet parking's
  chain; [closed where eq. 1 ends it](#both-servers-in-force-strictly), it has a table of its own.
* An effect holds if it is as large as the paper's less a tenth (half of it: partly); a price if it
  is no larger than the paper's and a tenth, at least half a percent point (twice: partly); constant
  is a jitter within the paper's, to its one digit (partly: 95 % of all outputs within it).

`python experiments/render.py --page` computes every number on this page again, from the latencies
of every cycle in `results/`; `docs/experiments.md` says how they are measured.
"""

TABLES = f"""
## The tables

A value is that of **all cycles**, in parentheses 95 % of the values when cycles are drawn again
(bootstrap); behind it, where it is another one, that of `calm` cycles, which no stall disturbed and
whose output was not late. `received` is until the callback of the output's receiver begins: what
was measured before 2026-11-28 did not keep it. {MARK} as above. A row has measured values of one
machine.
"""


def run_all(arguments: Sequence[str], keep: Path) -> list[str]:
    """Run every experiment, with ``keep`` for what they share; those that failed, and why."""
    failed = []
    for name in EXPERIMENTS:
        print(f"== {name}", flush=True)
        shared = ["--keep", str(keep)] if name in SHARED else []
        done = subprocess.run(
            [sys.executable, HERE / f"{name}.py", *arguments, *shared],
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
            failed.append(f"{name} (exit code {done.returncode}): {last}")
            print(done.stderr, file=sys.stderr)
    return failed


def page(folder: Path = RESULTS) -> str:
    """The whole page, in Markdown, from the latencies in a folder."""
    there = [name for name in EXPERIMENTS if (folder / f"{name}.json").exists()]
    about = {name: json.loads((folder / f"{name}.json").read_text()) for name in there}
    runs = {name: earlier_runs(name, *OURS, folder=folder) for name in there}
    lines = {name: lines_from(name, runs[name]) for name in there}
    letters = _letters(runs)
    parts = [*_head(runs, letters), TABLES, *_summary(about, lines)]
    for name in EXPERIMENTS:
        if name in there:
            parts += ["", *_section(about[name], lines[name], runs[name], letters)]
        else:
            parts += ["", f"**{name}**: no results, `experiments/{name}.py` failed."]
    return "\n".join(parts) + "\n"


def machine(measured: str) -> str:
    """Where a run was measured, without the day."""
    return measured.partition(", ")[2]


def _letters(runs: Mapping[str, Sequence[Run]]) -> dict[str, str]:
    """A letter for each machine, in the order in which they were used."""
    measured = set[str]()
    for of_experiment in runs.values():
        measured.update(machines_of(of_experiment).values())
        measured.update(run.measured for run in of_experiment if run.column != "simulated")
    places = dict.fromkeys(machine(text) for text in sorted(measured))
    return dict(zip(places, "ABCDEFGH", strict=False))


def _head(runs: Mapping[str, Sequence[Run]], letters: Mapping[str, str]) -> Iterator[str]:
    found = {
        claim.key: judged(claim, runs[claim.experiment])
        for claim in CLAIMS
        if claim.experiment in runs
    }
    verdicts = {key: _verdict(numbers) for key, numbers in found.items()}
    said = [*verdicts.values()]
    counts = ", ".join(f"{said.count(verdict)} {words}" for verdict, words in COUNTED.items())
    marks = ", ".join(f"{mark} {WORDS[verdict]}" for verdict, mark in MARKS.items())
    text = f"**Of {len(said)} claims {counts}.**"
    yield HEAD.format(marks=marks[0].upper() + marks[1:], verdicts=text)
    titles = " | ".join(COLUMNS[column] for column in OURS)
    yield f"| the paper's claim | paper | {titles} | on | holds? |"
    yield f"|---|---|{'---|' * len(OURS)}---|---|"
    for claim in CLAIMS:
        if claim.key in found:
            yield from _claim(claim, found[claim.key], runs[claim.experiment], letters)
    yield ABOUT.format(machines="; ".join(f"{letter} {of}" for of, letter in letters.items()))
    yield from _pictures()


def _verdict(found: Mapping[Column, Sequence[Judged]]) -> Verdict:
    return verdict_of([number for numbers in found.values() for number in numbers])


def _claim(
    claim: Claim,
    found: Mapping[Column, Sequence[Judged]],
    runs: Sequence[Run],
    letters: Mapping[str, str],
) -> Iterator[str]:
    """The rows of a claim: one for each machine that it was measured on."""
    verdict = _verdict(found)
    where = {of: text for of, text in machines_of(runs).items() if of in found}
    first = [f"**{claim.name}** ({claim.source})", claim.paper]
    last = f"{MARKS[verdict]} **{WORDS[verdict]}**: {claim.why}"
    for number, (letter, columns) in enumerate(_by_machine(where, letters)):
        shown = [*columns, "simulated"] if number == 0 else columns
        cells = [_numbers(found[of]) if of in found and of in shown else "" for of in OURS]
        ends = [*first, *cells, letter, last] if number == 0 else ["″", "", *cells, letter, "″"]
        yield f"| {' | '.join(ends)} |"


def _by_machine(
    where: Mapping[Column, str], letters: Mapping[str, str]
) -> list[tuple[str, list[Column]]]:
    """The columns that were measured on each machine; one row without any where none was."""
    grouped: dict[str, list[Column]] = {}
    for column, measured in where.items():
        grouped.setdefault(letters[machine(measured)], []).append(column)
    return sorted(grouped.items()) or [("–", [])]


def _numbers(numbers: Sequence[Judged]) -> str:
    marked = []
    for number in numbers:
        mark = f"{MARKS[number.verdict]} " if number.verdict else ""
        marked.append(mark + number.text)
    return "; ".join(marked)


def _pictures() -> Iterator[str]:
    yield "\n<details><summary>The claims' sentences and pictures: every cycle, before and after"
    yield "</summary>\n"
    for claim in CLAIMS:
        yield f"**{claim.name}**. “{claim.sentence}” ({claim.source})\n"
        for picture in pictures_of(claim):
            yield f"![{claim.name}]({PICTURES.name}/{picture})\n"
    yield "</details>"


def _summary(
    about: Mapping[str, dict[str, Any]], lines: Mapping[str, Sequence[Line]]
) -> Iterator[str]:
    yield "<details><summary>How many of the paper's numbers are near</summary>\n"
    yield (
        f"A value of all cycles is near the paper's within {NEAR_SHARE:.0%} of it. What the paper"
        f" has below 1 ms (≈ 0.2) is a bound, to its one digit. {MARK} does not count.\n"
    )
    yield f"| | numbers | {' | '.join(COLUMNS[column] for column in OURS)} |"
    yield f"|---|---:|{'---:|' * len(OURS)}"
    for name, made in lines.items():
        said = [line for line in made if _number(line.paper) is not None]
        near = (_near(said, column) for column in OURS)
        counts = " | ".join(f"{sum(pairs)} of {len(pairs)}" if pairs else "–" for pairs in near)
        if said:
            yield f"| {about[name]['title']} | {len(said)} | {counts} |"
    yield "\n</details>"


def _near(lines: Sequence[Line], column: Column) -> list[bool]:
    """Of each pair of numbers that is evidence, whether ours is near the paper's."""
    pairs = []
    for line in lines:
        paper, ours = _number(line.paper), _number(_of_all(line, column))
        if paper is not None and ours is not None and column not in line.no_evidence:
            pairs.append((paper, ours))
    return [
        ours <= paper + NEAR_SMALL if paper < SMALL else abs(ours - paper) <= NEAR_SHARE * paper
        for paper, ours in pairs
    ]


def _of_all(line: Line, column: Column) -> Value:
    every: Value = getattr(line, f"{column}_all")
    calm: Value = getattr(line, column)
    return calm if every is None else every


def _number(value: Value) -> float | None:
    """A number, also of a text such as "≈ 80" or "≈ 0.2 per band"."""
    if isinstance(value, str):
        try:
            return float(value.removeprefix("≈").removesuffix("per band"))
        except ValueError:
            return None
    return value


def _section(
    about: dict[str, Any], lines: Sequence[Line], runs: Sequence[Run], letters: Mapping[str, str]
) -> Iterator[str]:
    """The table of one experiment, folded, with its notes, pictures and runs."""
    yield f"### {about['title'].partition(':')[0]}\n"
    yield f"<details><summary>{about['title']}</summary>\n"
    yield f"| | unit | paper | {' | '.join(COLUMNS[column] for column in OURS)} | on | |"
    yield f"|---|---|---:|{'---:|' * len(OURS)}---|---|"
    reasons = list(dict.fromkeys(r for line in lines for r in _reasons(line)))
    for line in lines:
        yield from _rows(line, reasons, letters)
    yield ""
    for number, reason in enumerate(reasons, 1):
        yield f"({number}) {reason[0].upper()}{reason[1:]}.  "
    if about["notes"]:
        yield f"\n{about['notes']}"
    for picture in about["pictures"]:
        kind = COLUMNS[picture.removesuffix(".png").rpartition("_")[2]]
        yield f"\n![{about['title']}, {kind}]({PICTURES.name}/{picture})"
    yield from _runs(runs, letters)
    yield "\n</details>"


def _rows(line: Line, reasons: Sequence[str], letters: Mapping[str, str]) -> Iterator[str]:
    """The rows of a line: one for each machine."""
    numbers = " ".join(f"({reasons.index(reason) + 1})" for reason in _reasons(line))
    valued = {
        column: measured
        for column, measured in line.machines.items()
        if _of_all(line, column) is not None
    }
    for number, (letter, columns) in enumerate(_by_machine(valued, letters)):
        shown = [*columns, "simulated"] if number == 0 else columns
        cells = [cell(line, column) if column in shown else "" for column in OURS]
        first = [line.what, line.unit, value_text(line.paper)] if number == 0 else ["″", "", ""]
        last = [letter, numbers if number == 0 else ""]
        yield f"| {' | '.join([*first, *cells, *last])} |"


def _reasons(line: Line) -> list[str]:
    """Why a line's values differ, and why those that are marked are no evidence."""
    marked = [why for of, why in line.no_evidence.items() if _of_all(line, of) is not None]
    return [*filter(None, [line.why]), *(f"{MARK} {why}" for why in dict.fromkeys(marked))]


def _runs(runs: Sequence[Run], letters: Mapping[str, str]) -> Iterator[str]:
    if not runs:
        return
    yield "\n| run | | cycles | blocks, repeated | disturbed | without an end | when, and on |"
    yield "|---|---|---:|---:|---:|---|---|"
    for run in runs:
        measured = run.column != "simulated"
        blocks = f"{len(set(run.blocks.tolist()))}, {run.repeats}" if measured else "–"
        counts = f"{run.latency_ns.size} | {blocks} | {run.disturbed.sum()} | {without_end(run)}"
        place = f" {letters[machine(run.measured)]}" if measured else ""
        day = run.measured.partition(",")[0]
        yield f"| {run.name} | {COLUMNS[run.column]} | {counts} | {day}{place} |"
    if any("under way" in without_end(run) for run in runs):
        yield (
            "\nUnder way: all these cycles are the last of their block. A recording on ROS 2 ends"
            " by the clock, after 4 s for starting the nodes and as many periods as cycles are"
            " wanted: nodes that take longer to start leave fewer cycles, and what is under way as"
            " it ends comes to no end."
        )


def without_end(run: Run) -> str:
    """How many cycles came to no end, and whether all were under way as their block ended."""
    lost = run.latency_ns < 0
    if not lost.any():
        return "0"
    at_ends = 0
    for block in set(run.blocks.tolist()):
        ended = [not is_lost for is_lost in lost[run.blocks == block]]
        at_ends += next(
            (place for place, has_ended in enumerate(reversed(ended)) if has_ended), len(ended)
        )
    count = int(lost.sum())
    return f"{count}, {'' if at_ends == count else f'{at_ends} of them '}under way at the end"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--simulated", action="store_true", help="nothing is run live")
    parser.add_argument("--page", action="store_true", help="nothing is run: the page alone")
    given, failed = parser.parse_args(), list[str]()
    if not given.page:
        with tempfile.TemporaryDirectory() as keep:
            failed = run_all(["--simulated"] if given.simulated else [], Path(keep))
    draw_claims()
    PAGE.write_text(page())
    print(f"\n{PAGE}")
    if failed:
        sys.exit("failed, and kept what was there before:\n  " + "\n  ".join(failed))


if __name__ == "__main__":
    main()
