"""Two plans never govern the same core or node: the second is refused.

Slots of two plans on one core contradict each other, and a thread has one priority only. So a run
writes into its journal, before anything else, which cores and nodes it is for, and looks at what
the others claim. Both happen under a lock of the folder of all runs: of two runs that start at the
same instant, one is the first.

A claim ends with its journal. What a crashed run has claimed is given back by undoing the run.
"""

import contextlib
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from chainshaper.enforcement.runs.journal import (
    CLAIMS,
    Journal,
    find_journals,
    journals_folder,
    open_journal,
    read_claim,
)
from chainshaper.enforcement.runs.locking import holder_of, locked
from chainshaper.enforcement.runs.undoing import undo_run
from chainshaper.values.errors import OperationError, PlatformError

__all__ = ["claim_run"]

_PATIENCE_S = 20.0


def claim_run(
    cores: Collection[int],
    nodes: Collection[str],
    folder: Path | None = None,
    go_on: Callable[[], None] = lambda: None,
) -> Journal:
    """Begin a run that governs these cores and nodes: the journal for all that it changes.

    ``folder`` is where runs have their folders (default: :func:`.journals_folder`). While another
    run begins, ``go_on`` is called again and again, and may raise.

    Raises:
        OperationError: a living run governs one of them, a crashed one cannot be undone, or one
            that begins does not get on with it.
        PlatformError: nothing may be written to the folder.
    """
    base = journals_folder() if folder is None else folder
    with _locked(base, go_on):
        for other in find_journals(base):
            shared = _shared(other, cores, nodes)
            owner = other.owner
            if owner is None and (shared or not other.entries(CLAIMS)):
                _undo(other)
            elif shared:
                name = other.path.parent.name
                raise OperationError(
                    f"the run {name} of process {owner} governs {shared} already: end it first "
                    f"(`chainshaper release {name}`)"
                )
        journal = open_journal(base)
        journal.note(CLAIMS, cores=sorted(cores), nodes=sorted(nodes))
        return journal


def _shared(other: Journal, cores: Collection[int], nodes: Collection[str]) -> str:
    """What another run claims of these, in words; empty when nothing."""
    shared = [
        f"{kind} {', '.join(map(str, sorted(both)))}"
        for its_cores, its_nodes in other.read(CLAIMS, read_claim)
        for kind, both in (("core", set(cores) & its_cores), ("node", set(nodes) & its_nodes))
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
def _locked(base: Path, go_on: Callable[[], None]) -> Iterator[None]:
    def waiting(waited_s: float) -> None:
        go_on()
        if waited_s > _PATIENCE_S:
            holder = holder_of(base)
            raise OperationError(
                f"process {holder} begins a run, and has not got on with it for {_PATIENCE_S:g} s: "
                f"let it go on (`kill -CONT {holder}`), or end it (`kill -KILL {holder}`)"
            )

    with contextlib.ExitStack() as stack:
        try:
            base.mkdir(mode=0o755, parents=True, exist_ok=True)  # ours alone: it is believed
            stack.enter_context(locked(base, waiting))
        except OSError as error:
            raise PlatformError(
                f"{base}, where runs keep a journal of what they change, cannot be used "
                f"({error.strerror}): run as root, or set $XDG_RUNTIME_DIR to a folder of yours"
            ) from error
        yield
