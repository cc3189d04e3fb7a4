"""Compiled loops over bytes and columns, ready to run without their compiler.

Numba makes machine code of loops that are written in Python; importing and setting it up takes
half a second, which is as long as reading ten million events. Loops that every trace needs are
therefore written for addresses and counts only (:mod:`~chainshaper.values.compiled.memory`): what
Numba makes of those needs nothing of Python, so it is kept as an object file and loaded in some
tens of milliseconds (:mod:`~chainshaper.values.compiled.loading`).
"""

from chainshaper.values.compiled.loading import kernel

__all__ = ["kernel"]
