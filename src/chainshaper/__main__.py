"""``python -m chainshaper`` is the same as ``chainshaper``: it imports from no current folder."""

import contextlib
import os
import sys

with contextlib.suppress(OSError):  # that folder may be gone
    if sys.path[:1] == [os.getcwd()]:  # noqa: PTH109 - as `-m` has put it there
        del sys.path[0]

from chainshaper.cli import main

if __name__ == "__main__":
    main()
