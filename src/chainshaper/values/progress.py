"""Functions that work calls to say how much of it is done."""

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[float, str], None]
"""Takes the share of the work that is done (0 to 1), and what is being done now, in words."""

ShareDone: TypeAlias = Callable[[float], None]
"""Takes the share of the work that is done (0 to 1)."""
