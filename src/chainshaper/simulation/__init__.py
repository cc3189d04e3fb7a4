"""An application run by a discrete-event simulation instead of by the machine.

The same description, the same execution times for the same seed, the same event tables:
everything downstream cannot tell a simulated recording from a live one, but for its `source`.
:func:`simulate` writes a recording, :func:`simulate_latencies` gives the chain's latencies only.

    arrays       what runs, in words, and the same in integers (layout: all in one array)
    engine       cores, executors, and the order of events      \\
    callbacks    what callbacks do, how messages travel          compiled by Numba
    gate_kernel  the gate's decision                            /
    tables       the engine's log as event tables
    samples      execution times and costs as a recording has them
"""

from chainshaper.simulation.simulating import simulate, simulate_latencies

__all__ = ["simulate", "simulate_latencies"]
