"""An application run by a discrete-event simulation instead of by the machine.

The same description, the same execution times for the same seed, the same event tables:
everything downstream cannot tell a simulated recording from a live one, but for its `source`.
:func:`simulate` writes a recording, :func:`simulate_latencies` gives the chain's latencies only.

    system       what runs, in words: processes, threads, entities, publishers
    arrays       the same in integers (layout: their columns, memory: all in one array)
    streams      execution times, costs and delays, drawn in blocks
    engine       cores and the order of events        \\
    executor     ROS 2's executors, step by step        compiled by Numba
    callbacks    what callbacks do                      (gate_kernel: the gate's decision,
    messages     how messages travel                  /  queues: what all is kept in)
    tables       the engine's log as event tables
"""

from chainshaper.simulation.simulating import simulate, simulate_latencies

__all__ = ["simulate", "simulate_latencies"]
