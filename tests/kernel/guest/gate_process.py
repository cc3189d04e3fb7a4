"""A gate at work, as in a shaping node: `gate_process.py CYCLE SLOT_START SPIN LOG`.

A message is a byte on standard input. On SIGTERM the log gets releases and publications, ns of
CLOCK_MONOTONIC.
"""

import os
import signal
import sys
import time
from pathlib import Path

from chainshaper.gate.decision import Gate, Shaper

cycle, start, spin = map(int, sys.argv[1:4])
gate = Gate(cycle_ns=cycle, slots=((start, start + 1_000_000),), anchor="cycle")
shaper, seen = Shaper(gate, spin), []


def end(*_: object) -> None:
    Path(sys.argv[4]).write_text("".join(f"{at} {awake}\n" for at, awake in seen))
    os._exit(0)


signal.signal(signal.SIGTERM, end)
os.write(1, b"ready\n")
while os.read(0, 1):
    shaper.arrive(b"", time.monotonic_ns())
    if (outcome := shaper.hold()) is not None:
        seen.append((outcome.release.at_ns, outcome.awake_ns))
