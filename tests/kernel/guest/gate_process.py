"""A gate at work, as in a shaping node: takes a message a cycle, and publishes it in its slot.

    python gate_process.py CYCLE SLOT_START SPIN LOG

Messages are bytes on standard input. On SIGTERM the log gets a line each: release and publication,
ns of CLOCK_MONOTONIC.
"""

import os
import signal
import sys
import time
from pathlib import Path

from chainshaper.gate.decision import Gate, Shaper
from chainshaper.linux.scheduling import stop_garbage_collection

cycle, start, spin = map(int, sys.argv[1:4])
gate = Gate(cycle_ns=cycle, slots=((start, start + 1_000_000),), anchor="cycle")
shaper, seen = Shaper(gate, spin), []


def end(*_: object) -> None:
    Path(sys.argv[4]).write_text("".join(f"{at} {awake}\n" for at, awake in seen))
    os._exit(0)


signal.signal(signal.SIGTERM, end)
stop_garbage_collection()
sys.stdout.write("ready\n")
sys.stdout.flush()
while os.read(0, 1):
    shaper.arrive(b"", time.monotonic_ns())
    outcome = shaper.hold()
    if outcome is not None:
        seen.append((outcome.release.at_ns, outcome.awake_ns))
