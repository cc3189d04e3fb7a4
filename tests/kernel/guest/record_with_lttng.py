"""A recording of LTTng with the kernel's part, for `tracing_kernel.py` to look at.

Two programs share a core, so each one's callbacks are interrupted by the other's.
"""

import os
import shutil
import subprocess
from pathlib import Path

from lttng_node import required_node

from chainshaper.sources.lttng import LttngSession

RESULTS = Path("/results")
CALLBACKS = 10


def test_lttng_records_the_kernels_switches_beside_the_programs_events(tmp_path: Path) -> None:
    node = required_node()
    outputs = [RESULTS / "1", RESULTS / "2"]
    first, second = (f"{node} busy {CALLBACKS} > {output}" for output in outputs)
    session = LttngSession(tmp_path, ["x"], ())
    try:
        environment = {**os.environ, **session.start()}
        both = ["taskset", "--cpu-list", "0", "sh", "-c", f"{first} & {second}; wait"]
        subprocess.run(both, env=environment, check=True)
        assert session.failure() is None
        session.stop()
    finally:
        session.remove()
    assert list(tmp_path.rglob("kernel/metadata")), session._notes
    shutil.copytree(tmp_path, RESULTS / "trace")
