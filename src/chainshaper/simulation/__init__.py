"""An application run by a discrete-event simulation instead of by the machine.

The same description, the same execution times for the same seed, the same event tables:
a simulated recording differs from a live one in its `source` only. `arrays` and `layout` say what
runs, in words and in integers; `engine` and `callbacks` are compiled by Numba and run it.
"""

from chainshaper.simulation.simulating import simulate, simulate_latencies

__all__ = ["simulate", "simulate_latencies"]
