"""The machine's cores, which live runs need for themselves: one at a time, of all test processes.

Timed tests have them from beginning to end (`conftest.py`), tests of the documentation while a
command runs live.
"""

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PLACE = Path(tempfile.gettempdir())


@contextmanager
def cores() -> Iterator[None]:
    """Inside, this process has them. Who waits stands in a line: who comes later waits behind."""
    names = (f"chainshaper-tests-{os.getuid()}.{name}" for name in ("line", "cores"))
    line, lock = (os.open(_PLACE / name, os.O_CREAT | os.O_RDWR, 0o600) for name in names)
    try:
        fcntl.flock(line, fcntl.LOCK_EX)
        fcntl.flock(lock, fcntl.LOCK_EX)
        fcntl.flock(line, fcntl.LOCK_UN)
        yield
    finally:
        fcntl.flock(lock, fcntl.LOCK_UN)  # children that were forked meanwhile have it open, too
        os.close(lock)
        os.close(line)
