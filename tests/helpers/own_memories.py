"""A watch of this test's own processes alone.

`watch` follows all processes of its users, and others of ours may run the same chain: another
checkout's tests, of the same user on the same machine.
"""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import chainshaper.monitor.watch as watch_module


def _born_of(pid: int, ancestor: int) -> bool:
    """Whether a process is a child of ``ancestor``, or of a child of it, and so on."""
    with suppress(OSError):
        while pid not in (0, ancestor):
            status = Path(f"/proc/{pid}/stat").read_bytes()
            pid = int(status.rpartition(b")")[2].split()[1])
    return pid == ancestor


def follow_only_children_of(ancestor: int) -> None:
    """From now on watches in this process follow these alone."""
    every = vars(watch_module)["memories"]

    def of_children(*given: Any) -> Iterator[tuple[int, Any]]:
        return (memory for memory in every(*given) if _born_of(memory[0], ancestor))

    setattr(watch_module, "memories", of_children)  # noqa: B010 - a name that it imports


def program(code: str = "from chainshaper.cli import main; main()") -> str:
    """The code, or the command line, as a program whose watches follow our own processes."""
    first = f"import sys; sys.path.append({str(Path(__file__).parent)!r})"
    then = f"from own_memories import follow_only_children_of as only; only({os.getpid()})"
    return f"{first}\n{then}\n{code}"
