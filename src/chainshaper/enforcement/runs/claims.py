"""Two plans never govern the same core or node: the second is refused.

Slots of two plans on one core contradict each other, and a thread has one priority only. So a run
writes into its journal, before anything else, which cores and nodes it is for, and looks at what
the others claim. Both happen under a lock of the folder of all runs: of two runs that start at the
same instant, one is the first.

A claim ends with its journal. What a crashed run has claimed is given back by undoing the run.
"""

import contextlib
import fcntl
import os
from collections.abc import Collection, Iterator
from pathlib import Path

from chainshaper.enforcement.runs.journal import (
    Journal,
    find_journals,
    journals_folder,
    open_journal,
)
from chainshaper.enforcement.runs.state import undo_run
from chainshaper.errors import OperationError, PlatformError

__all__ = ["claim_run"]

KIND = "claims"


def claim_run(
    cores: Collection[int], nodes: Collection[str], folder: Path | None = None
) -> Journal:
    """Begin a run that governs these cores and nodes: the journal for all that it changes.

    ``folder`` is where runs are kept (default: :func:`.journals_folder`).

    Raises:
        OperationError: a living run governs one of them, or a crashed one cannot be undone.
        PlatformError: nothing may be written to the folder.
    """
    base = journals_folder() if folder is None else folder
    with _locked(base):
        for other in find_journals(base):
            shared = _shared(other, cores, nodes)
            owner = other.owner
            if owner is None and (shared or not other.entries(KIND)):
                _undo(other)
            elif shared:
                name = other.path.parent.name
                raise OperationError(
                    f"the run {name} of process {owner} governs {shared} already: end it first "
                    f"(`chainshaper release {name}`)"
                )
        journal = open_journal(base)
        journal.note(KIND, cores=sorted(cores), nodes=sorted(nodes))
        return journal


def _shared(other: Journal, cores: Collection[int], nodes: Collection[str]) -> str:
    """What another run claims of these, in words; empty when nothing."""
    shared = [
        f"{kind} {', '.join(map(str, sorted(both)))}"
        for claim in other.entries(KIND)
        for kind, both in (
            ("core", set(cores) & set(claim["cores"])),
            ("node", set(nodes) & set(claim["nodes"])),
        )
        if both
    ]
    return " and ".join(shared)


def _undo(crashed: Journal) -> None:
    left = undo_run(crashed)
    if left:
        raise OperationError(
            f"the run {crashed.path.parent.name} has crashed, and not all of it can be undone: "
            f"{'; '.join(left)}"
        )


@contextlib.contextmanager
def _locked(base: Path) -> Iterator[None]:
    try:
        base.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(base, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise PlatformError(
            f"{base}, where runs keep a journal of what they change, cannot be used "
            f"({error.strerror}): run as root, or set $XDG_RUNTIME_DIR to a folder of yours"
        ) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
