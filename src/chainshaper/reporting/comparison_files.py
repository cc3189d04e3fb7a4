"""A comparison as files beside its recordings: the figures as JSON, and drawn."""

import json
from pathlib import Path

from chainshaper.reporting.figures import draw_comparison
from chainshaper.reporting.tables import comparison_json
from chainshaper.values.whole_file import write_whole
from chainshaper.verify.measure import Comparison

__all__ = ["write_comparison"]


def write_comparison(comparison: Comparison, folder: Path) -> None:
    """Write `comparison.json`, `latency.png` and `distribution.png` into a folder.

    Raises:
        OperationError: they cannot be written.
    """
    draw_comparison(comparison.measurements, folder)
    text = json.dumps(comparison_json(comparison), indent=2) + "\n"
    write_whole(folder / "comparison.json", [text.encode()])
