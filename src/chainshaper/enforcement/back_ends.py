"""Which back ends this machine offers; choosing and making one; the back end `fifo`.

* **scx** and **litmus** gate in the kernel, exactly to some microseconds.
* **freezer** gates by a dispatcher on any kernel, exactly to some tens of microseconds.
* **fifo** isolates threads, and leaves gating to the shaping node.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

from chainshaper.enforcement import litmus
from chainshaper.enforcement.freezer import Freezer
from chainshaper.enforcement.journal import Journal
from chainshaper.enforcement.scheduling_memory import release_threads
from chainshaper.enforcement.scx import back_end as scx
from chainshaper.enforcement.servers import BackEnd, ServerTable, server_named
from chainshaper.linux import cgroups
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.values.errors import InputError, PlatformError


@dataclass(frozen=True)
class Offer:
    """A back end, and whether it can be used here."""

    name: str
    strength: str  # what it does, in words
    missing: str | None  # why it cannot be used here; None: it can


@dataclass(frozen=True)
class Choice:
    """The back end that was chosen, and why."""

    name: str
    reason: str


def offered_back_ends() -> tuple[Offer, ...]:
    """Return all back ends, strongest first, with what is missing for them on this machine."""
    return tuple(Offer(name, strength, missing()) for name, (strength, missing) in _KNOWN.items())


def choose_back_end(name: str = "auto") -> Choice:
    """Choose the back end of this name; for ``auto`` the strongest that works here.

    Raises InputError: there is no such back end. PlatformError: it cannot be used here or, for
    ``auto``, none can.
    """
    if name not in ("auto", *_KNOWN):
        raise InputError(f"no back end {name!r}: choose one of auto, {', '.join(_KNOWN)}")
    if name != "auto":
        strength, missing = _KNOWN[name]
        if (reason := missing()) is not None:
            raise PlatformError(f"back end {name}: {reason}")
        return Choice(name, f"asked for; {strength}")
    passed: list[Offer] = []
    for offer in offered_back_ends():
        if offer.missing is None:
            reason = f"the strongest here: {offer.strength}"
            if passed:
                stronger = " or ".join(unusable.name for unusable in passed)
                reason += f"; not {stronger} (`chainshaper doctor` says why)"
            return Choice(offer.name, reason)
        passed.append(offer)
    reasons = "; ".join(f"{offer.name}: {offer.missing}" for offer in passed)
    raise PlatformError(f"no back end can be used here: {reasons}")


def gates(name: str) -> bool:
    """Whether a back end restricts threads to their slots, or only isolates them."""
    return name != "fifo"


def make_back_end(
    name: str, table: ServerTable, journal: Journal, go_on: Callable[[], None] = lambda: None
) -> BackEnd:
    """Make a back end for a table.

    ``go_on`` is called while processes start, and may raise an exception. Raises InputError: the
    back end cannot have such a table. And as the back end.
    """
    match name:
        case "scx":
            return scx.create(table)
        case "litmus":
            return litmus.Litmus(table, journal)
        case "freezer":
            return Freezer(table, journal, go_on)
        case _:
            return Fifo(table, journal)


class Fifo(BackEnd):
    """Servers as SCHED_FIFO priorities, without slots; see :class:`BackEnd`.

    Threads have core and priority already (:func:`.thread_scheduling.plan_scheduling`); a shaping
    node's gate does the rest.
    """

    def __init__(self, table: ServerTable, journal: Journal) -> None:
        super().__init__(table)
        self._journal = journal

    def assign(self, tid: int, server: str, place: int = 0) -> None:  # noqa: ARG002 - by priority
        server_named(self._table, server)

    def arm(self, anchor_ns: int) -> None:  # noqa: ARG002 - priorities know no cycle
        self._since_ns = time.monotonic_ns()

    def release(self) -> None:
        release_threads(self._journal)


def _missing_for_freezer() -> str | None:
    try:
        folder, our_group = cgroups.mount_point(), cgroups.cgroup_of(os.getpid())
    except PlatformError as error:
        return str(error)
    if not any(os.access(path, os.W_OK, effective_ids=True) for path in (folder, our_group)):
        return f"{folder} is not writable: run as root, with CAP_DAC_OVERRIDE, or Delegate=yes"
    return _missing_for_fifo()


def _missing_for_fifo() -> str | None:
    remedy = "run as root or with CAP_SYS_NICE, or give your user an rtprio limit of 98 in "
    refused = f"SCHED_FIFO is not permitted: {remedy}/etc/security/limits.conf"
    return None if may_use_fifo() else refused


_KNOWN: dict[str, tuple[str, Callable[[], str | None]]] = {
    "scx": ("the kernel itself keeps threads inside their slots (sched_ext)", scx.missing),
    "litmus": ("the kernel itself keeps threads inside their slots (LITMUS^RT)", litmus.missing),
    "freezer": (
        "unmodified threads run in their slots only: outside they are frozen (cgroup v2)",
        _missing_for_freezer,
    ),
    "fifo": (
        "threads are isolated by SCHED_FIFO priorities; between slots they run on",
        _missing_for_fifo,
    ),
}
"""Back ends, strongest first: what each does, and what says why it cannot be used here."""
