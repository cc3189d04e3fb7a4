"""``python -m chainshaper`` is the same as ``chainshaper``: it imports from no current folder."""

import _signal  # type: ignore[import-not-found]  # `signal` loads other modules, during which Ctrl-C would end in a traceback

if _signal.getsignal(_signal.SIGINT) == _signal.default_int_handler:
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)  # Ctrl-C while modules load ends us at once

import contextlib
import os
import sys

with contextlib.suppress(OSError):  # that folder may be gone
    if sys.path[:1] == [os.getcwd()]:  # noqa: PTH109 - as `-m` has put it there
        del sys.path[0]

from chainshaper.vendored_packages import CALLED, use_vendored

use_vendored()

from chainshaper.cli import main  # noqa: E402 - it may need what is vendored

if __name__ == "__main__":
    main(name=os.environ.pop(CALLED, "chainshaper"))
