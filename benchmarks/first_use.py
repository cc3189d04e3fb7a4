"""How long each verb takes in a home where chainshaper was never used, and the second time.

    python benchmarks/first_use.py [ROUNDS]

Each round makes a fresh home and runs every verb in it (those of `tests/helpers/every_verb.py`,
but the live ones, which last as long as they are told), and then all again in the same home.
Medians are printed (ms of wall time, and of the CPU time of all its processes, which a busy machine
changes less). The first use is no slower than the second where nothing is compiled or cached at it.
"""

import importlib.util
import os
import resource
import shutil
import statistics
import sys
import tempfile
from pathlib import Path

VERBS = Path(__file__).parents[1] / "tests/helpers/every_verb.py"
TIMES = ("first", "second")


def main() -> None:
    """Measure, and print a line for each command."""
    specification = importlib.util.spec_from_file_location("every_verb", VERBS)
    assert specification is not None  # noqa: S101 - it is a file of ours
    assert specification.loader is not None  # noqa: S101
    verbs = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(verbs)
    taken: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for _ in range(int(sys.argv[1]) if len(sys.argv) > 1 else 3):
        with tempfile.TemporaryDirectory() as home:
            for time in TIMES:
                folder = Path(home, "work")
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                environment = {**os.environ, "HOME": home}
                environment.pop("XDG_CACHE_HOME", None)
                for _, command in verbs.COMMANDS:
                    before = _cpu_s()
                    wall_s = verbs.run(command, folder, environment)[2]
                    taken.setdefault((command, time), []).append((wall_s, _cpu_s() - before))
    print(f"{'wall (CPU), ms':<62}{'first use':>16}{'second':>16}")
    for _, command in verbs.COMMANDS:
        cells = []
        for time in TIMES:
            wall_s, cpu_s = map(statistics.median, zip(*taken[command, time], strict=True))
            cells.append(f"{wall_s * 1e3:.0f} ({cpu_s * 1e3:.0f})")
        print(f"{command[:60]:<62}{cells[0]:>16}{cells[1]:>16}")


def _cpu_s() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return children.ru_utime + children.ru_stime


if __name__ == "__main__":
    main()
