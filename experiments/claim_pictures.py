"""A picture for each claim: the latencies of all cycles before and after, one panel a column."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from claims import CLAIMS, Claim, ended
from results import COLUMNS, MS, OURS, PICTURES, Run, earlier_runs

MOST = 400
"""Cycles of a run that are drawn; the longest of all others is drawn as well."""

COLOURS = ("#d95f02", "#1b6ca8")


def pictures_of(claim: Claim) -> list[str]:
    """The files of a claim's pictures in :data:`PICTURES`."""
    return list(claim.pictures) if claim.pictures else [f"claim_{claim.key}.png"]


def draw_claims(folder: Path = PICTURES) -> list[Path]:
    """Draw all claims that have runs, from the results."""
    return [
        draw_claim(claim, earlier_runs(claim.experiment, *OURS), folder / pictures_of(claim)[0])
        for claim in CLAIMS
        if claim.runs
    ]


def draw_claim(claim: Claim, runs: Sequence[Run], path: Path) -> Path:
    """Small multiples: one panel for each column, the run before in orange, that after in blue."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, len(OURS), figsize=(11, 2.1), layout="constrained")
    for column, axes in zip(OURS, panels, strict=True):
        axes.set_title(COLUMNS[column], loc="left", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
        drawn = {run.name: run for run in runs if run.column == column and run.name in claim.runs}
        for name, colour in zip(claim.runs, COLOURS[-len(claim.runs) :], strict=False):
            if name not in drawn:
                continue
            latency = ended(drawn[name]) / MS
            chosen = np.unique([*range(min(MOST, latency.size)), int(latency.argmax())])
            cycles = np.minimum(chosen, MOST)
            axes.plot(cycles, latency[chosen], ".", markersize=2.5, color=colour, label=name)
        if not drawn:
            axes.text(0.5, 0.5, "not measured", ha="center", va="center", fontsize=8)
            axes.set_axis_off()
        else:
            axes.set_ylim(bottom=0)
    panels[0].set_ylabel("latency [ms]", fontsize=8)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=2, fontsize=7, markerscale=3)
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=80, metadata={"Software": None})
    plt.close(figure)
    return path
