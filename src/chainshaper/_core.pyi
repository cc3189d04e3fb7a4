"""What must be fast: trace decoder, joins, band placement, simulator (C++, in core/)."""

import numpy as np
from numpy.typing import NDArray

UNREACHABLE: int
"""The cost of bands that no placement reaches."""

def add_band(
    *,
    ends_ns: NDArray[np.int64],
    counts: NDArray[np.int64],
    nearest: NDArray[np.int64],
    farthest: NDArray[np.int64],
    behind: NDArray[np.int64],
    costs: NDArray[np.int64],
    successors: NDArray[np.int32],
) -> None:
    """Add one band to a placement: fill `costs` and `successors` for every place.

    See `chainshaper.planning.bands`. Raises ValueError for arrays of different lengths,
    and for places or windows that do not ascend.
    """
