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
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from results import HERE, PICTURES, RESULTS, Value, value_text

EXPERIMENTS = (
    "table_1",
    "table_2",
    "table_3",  # and figure 6
    "table_4",
    "figure_7",
    "figure_8",
    "table_5",
    "figure_9",
)
PAGE = HERE / "RESULTS.md"

NEAR_SHARE, NEAR = 0.05, 0.5
"""A value is near the paper's within this share of it, or this much of its unit."""

HEAD = """# The paper's evaluation, and ours

Every number that the paper states in its evaluation, beside ours: by simulation, and live where
that was possible. Written by `make experiments` from the files in `results/`, which also have the
latencies that the numbers can be recomputed from. `docs/experiments.md` says how it is run.

Live values are over the cycles that no stall of the machine disturbed; how many it did stands under
each experiment's runs. Where those are more than half, values are over all cycles, and a note says
so. Why a value differs from the paper's, the numbered notes under each table say. The paper ran on
16 cores at 3.7 GHz and a kernel with LITMUS^RT, which we did not: times that slots make compare,
execution times compare where they are drawn.

## Summary

A value counts as near the paper's if it is within 5 % of it, or within 0.5 ms.
"""


def run_all(arguments: Sequence[str]) -> list[str]:
    """Run every experiment; the names of those that failed, and why."""
    failed = []
    for name in EXPERIMENTS:
        print(f"== {name}", flush=True)
        done = subprocess.run(
            [sys.executable, HERE / f"{name}.py", *arguments],
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
    parts = [HEAD, *_summary(found)]
    for name in EXPERIMENTS:
        parts += ["", *(_section(found[name]) if name in found else _absent(name))]
    return "\n".join(parts) + "\n"


def _summary(found: Mapping[str, dict[str, Any]]) -> Iterator[str]:
    yield "| | numbers | near, simulated | near, live | live values of |"
    yield "|---|---:|---:|---:|---|"
    for document in found.values():
        lines = [line for line in document["lines"] if _number(line["paper"]) is not None]
        days = sorted({line["measured"] for line in document["lines"] if line["measured"]})
        near = [_near_text(lines, column) for column in ("simulated", "live")]
        yield f"| {document['title']} | {len(lines)} | {' | '.join(near)} | {'; '.join(days)} |"


def _near_text(lines: Sequence[dict[str, Any]], column: str) -> str:
    pairs = [(_number(line["paper"]), _number(line[column])) for line in lines]
    both = [(paper, ours) for paper, ours in pairs if paper is not None and ours is not None]
    near = sum(abs(ours - paper) <= max(NEAR, NEAR_SHARE * paper) for paper, ours in both)
    return f"{near} of {len(both)}" if both else "–"


def _number(value: Value) -> float | None:
    """A number, also of a text such as "≈ 80"."""
    if isinstance(value, str):
        try:
            return float(value.removeprefix("≈"))
        except ValueError:
            return None
    return value


def _section(document: dict[str, Any]) -> Iterator[str]:
    yield f"## {document['title']}"
    yield ""
    yield "| | unit | paper | simulated | live | |"
    yield "|---|---|---:|---:|---:|---|"
    reasons = list(dict.fromkeys(line["why"] for line in document["lines"] if line["why"]))
    for line in document["lines"]:
        values = " | ".join(value_text(line[of]) for of in ("paper", "simulated", "live"))
        reason = f"({reasons.index(line['why']) + 1})" if line["why"] else ""
        yield f"| {line['what']} | {line['unit']} | {values} | {reason} |"
    yield ""
    for number, reason in enumerate(reasons, 1):
        yield f"({number}) {reason[0].upper()}{reason[1:]}.  "
    if document["notes"]:
        yield f"\n{document['notes']}"
    for picture in document["pictures"]:
        kind = "live" if picture.endswith("_live.png") else "simulated"
        yield f"\n![{document['title']}, {kind}]({PICTURES.name}/{picture})"
    yield from _runs(document["runs"])


def _runs(runs: Sequence[dict[str, Any]]) -> Iterator[str]:
    if not runs:
        return
    yield "\n<details><summary>Runs</summary>\n"
    yield "| run | | cycles | disturbed | without an end | when and where |"
    yield "|---|---|---:|---:|---:|---|"
    for run in runs:
        kind = "live" if run["live"] else "simulated"
        counts = f"{run['cycles']} | {run['disturbed']} | {run['incomplete']}"
        yield f"| {run['name']} | {kind} | {counts} | {run['measured']} |"
    yield "\n</details>"


def _absent(name: str) -> Iterator[str]:
    yield f"## {name.replace('_', ' ').capitalize()}\n\nNo results: `experiments/{name}.py` failed."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--simulated", action="store_true", help="nothing is run live")
    failed = run_all(["--simulated"] if parser.parse_args().simulated else [])
    PAGE.write_text(page())
    print(f"\n{PAGE}")
    if failed:
        sys.exit("failed, and kept what was there before:\n  " + "\n  ".join(failed))


if __name__ == "__main__":
    main()
