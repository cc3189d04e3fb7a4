"""Which back ends this machine offers, the strongest of them, and making one.

Strongest first: **scx** and **litmus** gate in the kernel, to the microsecond; **freezer** gates
with a dispatcher on any kernel, to some tens of microseconds; **fifo** isolates, and leaves gating
to the shaping node.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass

from chainshaper.enforcement import fifo
from chainshaper.enforcement.freezer import back_end as freezer
from chainshaper.enforcement.litmus import back_end as litmus
from chainshaper.enforcement.runs.journal import Journal
from chainshaper.enforcement.scx import back_end as scx
from chainshaper.enforcement.servers import BackEnd, ServerTable
from chainshaper.linux import cgroups
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.values.errors import InputError, PlatformError

__all__ = [
    "BACK_ENDS",
    "Choice",
    "Offer",
    "choose_back_end",
    "gates",
    "make_back_end",
    "offered_back_ends",
]


@dataclass(frozen=True)
class Offer:
    """A back end and why it cannot be used here; ``missing`` is None where it can."""

    name: str
    strength: str
    missing: str | None


@dataclass(frozen=True)
class Choice:
    """The back end that was chosen, and why."""

    name: str
    reason: str


def offered_back_ends() -> tuple[Offer, ...]:
    """All back ends, strongest first, with what is missing for them on this machine."""
    return tuple(Offer(name, strength, missing()) for name, (strength, missing) in _KNOWN.items())


def choose_back_end(name: str = "auto") -> Choice:
    """The back end of this name; for ``auto`` the strongest that works here.

    Raises:
        InputError: there is no such back end.
        PlatformError: it, or any, cannot be used here.
    """
    if name not in ("auto", *BACK_ENDS):
        raise InputError(f"no back end {name!r}: choose one of auto, {', '.join(BACK_ENDS)}")
    offers = offered_back_ends()
    if name != "auto":
        offer = next(offer for offer in offers if offer.name == name)
        if offer.missing is not None:
            raise PlatformError(f"back end {name}: {offer.missing}")
        return Choice(name, f"asked for; {offer.strength}")
    passed: list[str] = []
    for offer in offers:
        if offer.missing is None:
            without = f"; not {' or '.join(passed)} (`chainshaper doctor` says why)" * bool(passed)
            return Choice(offer.name, f"the strongest here: {offer.strength}{without}")
        passed.append(offer.name)
    raise PlatformError(
        "no back end can be used here: "
        + "; ".join(f"{offer.name}: {offer.missing}" for offer in offers)
    )


def gates(name: str) -> bool:
    """Whether a back end keeps threads inside their slots, or only isolates them."""
    return name != "fifo"


def make_back_end(
    name: str, table: ServerTable, journal: Journal, go_on: Callable[[], None] = lambda: None
) -> BackEnd:
    """Make a back end for a table; no application notices anything yet.

    ``journal`` remembers what was there before. Where processes have to start, ``go_on`` is called
    again and again meanwhile, and may raise.

    Raises:
        InputError: the table is not one, or more than the back end can do.
        OperationError, PlatformError: see the ``create`` of the back end's module.
    """
    match name:
        case "scx":
            return scx.create(table)
        case "litmus":
            return litmus.create(table, journal)
        case "freezer":
            return freezer.create(table, journal, go_on)
        case _:
            return fifo.create(table, journal)


def _missing_for_litmus() -> str | None:
    if litmus.PROC.is_dir():
        return None
    return "this kernel is not LITMUS^RT: boot one (https://litmus-rt.org)"


def _missing_for_freezer() -> str | None:
    try:
        folder, own = cgroups.mount_point(), cgroups.cgroup_of(os.getpid())
    except PlatformError as error:
        return str(error)
    if not any(os.access(one, os.W_OK, effective_ids=True) for one in (folder, own)):
        return (
            f"{folder} is not writable: run as root, with CAP_DAC_OVERRIDE, or in a unit with "
            "Delegate=yes"
        )
    return _missing_for_fifo()


def _missing_for_fifo() -> str | None:
    if may_use_fifo():
        return None
    return (
        "SCHED_FIFO is not permitted: run as root or with CAP_SYS_NICE, or give your user an "
        "rtprio limit of 98 in /etc/security/limits.conf"
    )


_KNOWN: dict[str, tuple[str, Callable[[], str | None]]] = {
    "scx": ("the kernel itself keeps threads inside their slots (sched_ext)", scx.missing),
    "litmus": (
        "the kernel itself keeps threads inside their slots (LITMUS^RT)",
        _missing_for_litmus,
    ),
    "freezer": (
        "unmodified threads are kept inside their slots by freezing them (cgroup v2)",
        _missing_for_freezer,
    ),
    "fifo": (
        "threads are isolated by SCHED_FIFO priorities; nothing is held back between slots",
        _missing_for_fifo,
    ),
}
"""Back ends, strongest first: what each does, and what says why it cannot be used here."""
BACK_ENDS = tuple(_KNOWN)
