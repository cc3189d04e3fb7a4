"""How the engine is compiled: without reference counts, which would cost it half its speed.

They are for arrays that a function makes or keeps. These functions do neither: one array belongs
to the caller and outlives every call. Nor do they divide by zero, which is therefore not checked.

Numba caches each function by the date of its own file, although it contains the functions that it
calls and the columns of :mod:`.layout` as they were. So what is older than any file here goes.
"""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numba

__all__ = ["compiled", "forget_stale"]

_OPTIONS: dict[str, Any] = {"_nrt": False}

compiled: Any = numba.njit(cache=True, nogil=True, error_model="numpy", **_OPTIONS)


def forget_stale(folder: Path) -> None:
    """Remove cached functions that are older than the newest source file of ``folder``.

    Numba keeps its cache elsewhere where that folder may not be written.
    """
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    for cached in (folder / "__pycache__").glob("*.nb?"):
        with suppress(OSError):  # gone at this moment, or a read-only installation
            if cached.stat().st_mtime < newest:
                cached.unlink()


forget_stale(Path(__file__).parent)
