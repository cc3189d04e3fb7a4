"""Run all experiments of the paper, and render one page with pictures from their results.

    python experiments/render.py [--simulated]

Each experiment runs in a process of its own; one that fails does not stop the others, is named at
the end, and keeps the results that it had before. The page, `RESULTS.md`, is made from the files in
`results/` alone.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from results import COLUMNS, HERE, MARK, PICTURES, RESULTS, ROS, Value, cell

EXPERIMENTS = (
    "table_1",
    "table_2",
    "table_3",  # and figure 6
    "table_4",
    "figure_7",
    "figure_8",
    "table_5",
    "figure_9",
    "reference_system",  # not of the paper
)
PAGE = HERE / "RESULTS.md"
SHARED = ("table_2", "table_3")
"""They are about the same run under SCHED_FIFO."""

COUNTED = ("simulated", "live", "live_all", "ros_all", "fast_all")
NEAR_SHARE, NEAR = 0.05, 0.5
"""A value is near the paper's within this share of it, or this much of its unit."""

HEAD = f"""# The paper's evaluation, and ours

**What was reproduced?** {{reproduced}} Outputs leave when their slots open, so shaping, bands and
logical execution time come out as the paper has them; how long a chain computes does not.

**What differs, and why?** Where figures depend on execution times, ours differ: the paper's machine
(16 cores at 3.7 GHz) and the drive and localizer of its valet parking are not to be had, and its
times are not published; ours are drawn, or another localizer's. On a virtual machine with two cores
that others share, {{late}} outputs of configurations with slots were late: the tables have them,
and the maximum with them, in the columns of all cycles. What is not explained is
called so in the notes.

**What was never run?** LITMUS^RT's kernel, which the paper has: servers are in force here by
freezing threads on a stock kernel. sched_ext outside a virtual machine. And what has no value in
the columns `ROS 2`. Live are the same chains over Cyclone DDS, by nodes of our own; on ROS 2 they
are generated C++ nodes that `ros2 launch` starts and the one command shapes.

Written by `make experiments` from the files in `results/`, which also have the latencies of every
cycle that the numbers can be recomputed from; `docs/experiments.md` says how it is run, and what
the columns count:

* **simulated**, **live**, **ROS 2**: cycles that no stall of the machine disturbed and whose output
  was not late. **all cycles**, to the right of each: every cycle that came to an end, late and
  disturbed ones too. How many were disturbed or came to no end stands under each experiment's runs.
* In parentheses: 95 % of the values when cycles are drawn again (bootstrap). Runs that say
  `5 blocks` took turns with those that they are compared with; those of one block did not.
* {MARK} A value that is no evidence, because the paper's number went into ours or another
  application's slots are compared; a note says how. It does not count in the summary.

## Summary

A value counts as near the paper's if it is within 5 % of it, or within 0.5 ms.
"""


def run_all(arguments: Sequence[str], keep: Path) -> list[str]:
    """Run every experiment, with ``keep`` for what they share; those that failed, and why."""
    failed = []
    for name in EXPERIMENTS:
        print(f"== {name}", flush=True)
        own = ["--keep", str(keep)] if name in SHARED else []
        done = subprocess.run(
            [sys.executable, HERE / f"{name}.py", *arguments, *own],
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
    """The whole page, in Markdown, from the results in a folder."""
    found = {
        name: json.loads((folder / f"{name}.json").read_text())
        for name in EXPERIMENTS
        if (folder / f"{name}.json").exists()
    }
    parts = [HEAD.format(**_answers(found)), *_summary(found)]
    for name in EXPERIMENTS:
        parts += ["", *(_section(found[name]) if name in found else _absent(name))]
    return "\n".join(parts) + "\n"


def _answers(found: Mapping[str, dict[str, Any]]) -> dict[str, object]:
    """The numbers of the first screen."""
    lines = [line for document in found.values() for line in document["lines"]]
    said = sum(_number(line["paper"]) is not None for line in lines)
    near = {column: _near(lines, column) for column in COUNTED}
    counts = {column: f"{sum(pairs)} of {len(pairs)}" for column, pairs in near.items()}
    return {
        "reproduced": f"The paper states {said} numbers. Of those that ours are evidence for,"
        f" {counts['simulated']} simulated values are near, {counts['live']} live ones"
        f" ({counts['live_all']} over all cycles), {counts['ros_all']} on ROS 2 with Cyclone DDS"
        f" and {counts['fast_all']} with Fast DDS (all cycles).",
        "late": " and ".join(
            f"{late} of {outputs} {where}"
            for where, columns in (("live", ("live",)), ("on ROS 2", ROS))
            for late, outputs in [_late(found, columns)]
        ),
    }


def _late(found: Mapping[str, dict[str, Any]], columns: Sequence[str]) -> tuple[int, int]:
    """How many outputs of configurations with slots were late, and of how many."""
    late = outputs = 0
    for document in found.values():
        for line in document["lines"]:
            name, _, what = line["what"].rpartition(": ")
            own = [run for run in document["runs"] if run["name"] == name]
            for run in own if what == "late" else ():
                if run["column"] in columns:
                    late += line[f"{run['column']}_all"]
                    outputs += run["cycles"] - run["incomplete"]
    return late, outputs


def _summary(found: Mapping[str, dict[str, Any]]) -> Iterator[str]:
    near_in = " | ".join(
        f"near, {COLUMNS[column]}"
        if column in COLUMNS and not column.endswith("_all")
        else f"near, {COLUMNS[column.removesuffix('_all')]}, all cycles"
        for column in COUNTED
    )
    yield f"| | numbers | {near_in} | measured |"
    yield f"|---|---:|{'---:|' * len(COUNTED)}---|"
    for document in found.values():
        lines = [line for line in document["lines"] if _number(line["paper"]) is not None]
        own = (run["measured"] for run in document["runs"] if run["column"] != "simulated")
        days = sorted({*own, *(line["measured"] for line in document["lines"])} - {None})
        near = (_near(lines, column) for column in COUNTED)
        counts = " | ".join(f"{sum(one)} of {len(one)}" if one else "–" for one in near)
        yield f"| {document['title']} | {len(lines)} | {counts} | {'; '.join(days)} |"


def _near(lines: Sequence[dict[str, Any]], column: str) -> list[bool]:
    """Of each pair of numbers that is evidence, whether ours is near the paper's."""
    pairs = [
        (_number(line["paper"]), _number(line[column]))
        for line in lines
        if column.removesuffix("_all") not in line["no_evidence"]
    ]
    return [
        abs(ours - paper) <= max(NEAR, NEAR_SHARE * paper)
        for paper, ours in pairs
        if paper is not None and ours is not None
    ]


def _number(value: Value) -> float | None:
    """A number, also of a text such as "≈ 80" or "≈ 0.2 per band"."""
    if isinstance(value, str):
        try:
            return float(value.removeprefix("≈").removesuffix("per band"))
        except ValueError:
            return None
    return value


def _section(document: dict[str, Any]) -> Iterator[str]:
    yield f"## {document['title']}"
    yield ""
    yield f"| | unit | {' | '.join(COLUMNS.values())} | |"
    yield f"|---|---|{'---:|' * len(COLUMNS)}---|"
    reasons = list(dict.fromkeys(r for line in document["lines"] for r in _reasons(line)))
    for line in document["lines"]:
        values = " | ".join(cell(line, column) for column in COLUMNS)
        numbers = " ".join(f"({reasons.index(reason) + 1})" for reason in _reasons(line))
        yield f"| {line['what']} | {line['unit']} | {values} | {numbers} |"
    yield ""
    for number, reason in enumerate(reasons, 1):
        yield f"({number}) {reason[0].upper()}{reason[1:]}.  "
    if document["notes"]:
        yield f"\n{document['notes']}"
    for picture in document["pictures"]:
        kind = COLUMNS[picture.removesuffix(".png").rpartition("_")[2]]
        yield f"\n![{document['title']}, {kind}]({PICTURES.name}/{picture})"
    yield from _runs(document["runs"])


def _reasons(line: Mapping[str, Any]) -> list[str]:
    """Why a line's values differ, and why those that are marked are no evidence."""
    marked = [reason for of, reason in line["no_evidence"].items() if line[of] is not None]
    return [*filter(None, [line["why"]]), *(f"{MARK} {one}" for one in dict.fromkeys(marked))]


def _runs(runs: Sequence[dict[str, Any]]) -> Iterator[str]:
    if not runs:
        return
    yield "\n<details><summary>Runs</summary>\n"
    yield "| run | | cycles | blocks, repeated | disturbed | without an end | when and where |"
    yield "|---|---|---:|---:|---:|---:|---|"
    for run in runs:
        blocks = f"{run['blocks']}, {run['repeats']}" if run["column"] != "simulated" else "–"
        counts = f"{run['cycles']} | {blocks} | {run['disturbed']} | {run['incomplete']}"
        yield f"| {run['name']} | {COLUMNS[run['column']]} | {counts} | {run['measured']} |"
    yield "\n</details>"


def _absent(name: str) -> Iterator[str]:
    yield f"## {name.replace('_', ' ').capitalize()}\n\nNo results: `experiments/{name}.py` failed."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--simulated", action="store_true", help="nothing is run live")
    with tempfile.TemporaryDirectory() as keep:
        failed = run_all(["--simulated"] if parser.parse_args().simulated else [], Path(keep))
    PAGE.write_text(page())
    print(f"\n{PAGE}")
    if failed:
        sys.exit("failed, and kept what was there before:\n  " + "\n  ".join(failed))


if __name__ == "__main__":
    main()
