"""Points of a sweep per second, with one and with several threads.

    python benchmarks/sweep.py [--cycles 100000] [--workers 1 2]

The five-node chain of examples/synthetic_chain.yaml in 20 plans (bands × ε), which share a profile,
and in 20 variants of the application, which do not.
"""

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from chainshaper import load_application, sweep

EXAMPLE = Path(__file__).parents[1] / "examples/synthetic_chain.yaml"
GRIDS: Mapping[str, Mapping[str, Sequence[Any]]] = {
    "plans": {"bands": range(1, 11), "epsilon": ["0ms", "1ms"]},
    "applications": {"seed": range(10), "interference": ["0ms", "20ms"]},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cycles", type=int, default=100_000)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    options = parser.parse_args()
    application = load_application(EXAMPLE)
    print(f"{'grid':<16}{'workers':>8}{'points/s':>10}{'ratio':>8}")
    for name, axes in GRIDS.items():
        alone = 0.0
        for workers in options.workers:
            with tempfile.TemporaryDirectory() as folder:
                began = time.perf_counter()
                frame = sweep(
                    *(application, axes, Path(folder) / "out.parquet"),
                    cycles=options.cycles,
                    workers=workers,
                )
                rate = frame.height / (time.perf_counter() - began)
            alone = alone or rate
            print(f"{name:<16}{workers:>8}{rate:>10.2f}{rate / alone:>8.2f}")


if __name__ == "__main__":
    main()
