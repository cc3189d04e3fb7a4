"""``python -m chainshaper`` is the same as ``chainshaper``: it imports from no current folder."""

import signal

if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while modules load ends us at once

import contextlib
import os
import sys

with contextlib.suppress(OSError):  # that folder may be gone
    if sys.path[:1] == [os.getcwd()]:  # noqa: PTH109 - as `-m` has put it there
        del sys.path[0]

from chainshaper.cli import main

if __name__ == "__main__":
    main()
