"""A gate at work, as in a shaping node, with the arguments and the log of `spin`.

    gate_process.py LOG CORE CYCLE ARRIVAL START SPIN

A message comes ARRIVAL ns into each cycle. LOG gets pairs of instants: release and publication.
"""

import os
import signal
import struct
import sys
import time
from pathlib import Path

sys.path.insert(0, "/src")
from chainshaper.robot.clocks import sleep_until
from chainshaper.robot.gate import Gate
from chainshaper.robot.shaper import Shaper

cycle, arrival, start, spin = map(int, sys.argv[3:])
shaper, seen = Shaper(Gate(((start, start + 1_000_000),), cycle, "cycle"), spin), []


def end(*_: object) -> None:
    Path(sys.argv[1]).write_bytes(b"".join(struct.pack("qq", *each) for each in seen))
    os._exit(0)


signal.signal(signal.SIGTERM, end)
os.write(1, b"ready\n")
while True:
    now = time.monotonic_ns()
    sleep_until(now + (arrival - now) % cycle)
    shaper.arrive(b"", time.monotonic_ns())
    if (outcome := shaper.hold()) is not None:
        seen.append((outcome.release.at_ns or 0, outcome.awake_ns))
