"""What a thread's name says about it: the names that DDS implementations give to their threads.

An unmodified process shows little more of a thread than its name. Cyclone DDS has always named
its threads, Fast DDS does from 2.13 on (ROS 2 Jazzy). Before that its threads carry the name of
their process, and nothing can be said of them from outside.

Names are cut to 15 bytes by the kernel, so what may be longer is compared by its beginning.

Upstream: Cyclone DDS, `check_thread_properties` in `ddsi_init.c`, and the names given to
`ddsi_create_thread`; Fast DDS documentation, "Concurrency and multithreading".
"""

from typing import Literal, TypeAlias

__all__ = ["DdsKind", "ThreadRole", "dds_kind", "role_of"]

ThreadRole: TypeAlias = Literal["executor", "publisher", "dds", "unknown"]
"""``publisher``: sends what executors hand over to it (asynchronous publication, section 2.2)."""

DdsKind: TypeAlias = Literal[
    "asynchronous publisher",
    "receive",
    "delivery",
    "transmit",
    "event",
    "discovery",
    "lease",
    "garbage collection",
    "connection",
    "housekeeping",
]

_NAMES: dict[str, DdsKind] = {
    # Cyclone DDS 0.10 and 11. `event`: heartbeats, retransmissions, discovery announcements.
    "recv": "receive",
    "recvUC": "receive",
    "recvMC": "receive",
    "tev": "event",
    "gc": "garbage collection",
    "lease": "lease",
    "dq.builtins": "discovery",
    "sendq": "transmit",
    "fsm": "connection",
    "debmon": "housekeeping",
    "threadmon": "housekeeping",
    # Fast DDS
    "dds.tcp_accept": "connection",
    "dds.tcp_keep": "connection",
    "dds.shm.wdog": "housekeeping",
    "dds.log": "housekeeping",
}
_PREFIXES: tuple[tuple[str, DdsKind], ...] = (
    # Cyclone DDS: per channel, `user` unless the configuration defines others.
    ("dq.", "delivery"),
    ("xmit.", "transmit"),
    ("tev.", "event"),
    # Fast DDS: per participant, port, reader.
    ("dds.asyn.", "asynchronous publisher"),
    ("dds.udp.", "receive"),
    ("dds.tcp.", "receive"),
    ("dds.shm.", "receive"),
    ("dds.dsha.", "receive"),
    ("dds.ev.", "event"),
    ("dds.ds_ev.", "discovery"),
    ("dds.tls.", "discovery"),
    ("dds.", "housekeeping"),
)


def dds_kind(comm: str) -> DdsKind | None:
    """What a DDS thread of this name does; None when it is no DDS thread's name."""
    if comm in _NAMES:
        return _NAMES[comm]
    return next((kind for prefix, kind in _PREFIXES if comm.startswith(prefix)), None)


def role_of(comm: str, is_main: bool) -> ThreadRole:
    """The role of a thread of a node's process, as far as its name tells.

    Executors spin on the main thread unless a program arranges it otherwise, and nobody renames
    the main thread to a DDS thread's name.
    """
    kind = dds_kind(comm)
    if is_main:
        return "executor"
    if kind == "asynchronous publisher":
        return "publisher"
    return "unknown" if kind is None else "dds"
