"""How the engine is compiled: without reference counts, which would cost it half its speed.

They are for arrays that a function makes or keeps. These functions do neither: one array belongs
to the caller and outlives every call. Nor do they divide by zero, which is therefore not checked.

Numba's cache knows a function by its own file: who changes one that others call has to remove
`__pycache__/*.nb?` here.
"""

from typing import Any

import numba

__all__ = ["compiled"]

_OPTIONS: dict[str, Any] = {"_nrt": False}

compiled: Any = numba.njit(cache=True, nogil=True, error_model="numpy", **_OPTIONS)
