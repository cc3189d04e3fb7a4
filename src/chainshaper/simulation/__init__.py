"""An application run by a discrete-event simulation instead of by the machine.

The same description, the same execution times for the same seed, the same event tables:
a simulated recording differs from a live one in its `source` only. `system` and `machine` say what
runs, in words and as the engine has it, which is in C++ (core/simulation).
"""

from chainshaper.simulation.simulating import simulate, simulate_latencies

__all__ = ["simulate", "simulate_latencies"]
