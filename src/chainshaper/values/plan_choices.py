"""What a plan can be asked for, in words that the planner and the command line share.

The planner takes a while to import, and `chainshaper plan --help` should not.
"""

from typing import Literal, TypeAlias

__all__ = ["Fallback", "Goal", "Policy", "Publication", "Solver"]

Policy: TypeAlias = Literal[
    "shaped",
    "one-long-slot",
    "server-per-callback",
    "server-per-chain",
    "let-per-callback",
    "let-per-chain",
]
"""How the chain is scheduled: the paper's way, or one of those that it compares (section 2.5)."""

Fallback: TypeAlias = Literal["bypass", "silence"]
"""What becomes of an output while its shaping node is not there."""

Publication: TypeAlias = Literal["synchronous", "asynchronous"]
"""By a shaping node, or by the publisher's own thread (section 3.2)."""

Solver: TypeAlias = Literal["exact", "pso", "random"]
"""What places latency bands; the paper uses particle swarm optimisation (section 3.3)."""

Goal: TypeAlias = Literal["mean", "jitter", "gap"]
"""What latency bands make small: the average, the jitter, or the distance between bands (LV)."""
