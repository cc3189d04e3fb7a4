"""What chainshaper knows of each middleware (RMW implementation): one entry for each.

An entry says how its threads are called and what each does, by which libraries a process is known,
and where it behaves differently, with the reason at the line. A new middleware is one entry here
and one case in `tests/values/test_middleware.py`.

Upstream: Cyclone DDS, `ddsi_create_thread`; Fast DDS, "Concurrency and multithreading"; Zenoh,
`zenoh-runtime` and `zenoh-shm/src/watchdog`; RTI Connext, "Identifying Threads";
https://www.dds-foundation.org/dds-rtps-vendor-and-product-ids/.
"""

import functools
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

ThreadWork: TypeAlias = Literal[
    "receive",  # takes messages from the network or shared memory
    "delivery",  # hands messages to their readers
    "transmit",
    "resend",  # sends what synchronous writers could not send
    "asynchronous publisher",  # sends what executors hand over to it (paper, section 2.2)
    "event",  # heartbeats, retransmissions, discovery announcements
    "discovery",
    "lease",
    "connection",
    "garbage collection",
    "housekeeping",
]
"""What a thread of a middleware does."""

MiddlewareLimit: TypeAlias = Literal["connext", "iceoryx", "unnamed"]
"""What is limited on a middleware: a key of :data:`MIDDLEWARE_LIMITS`."""

_NEVER_RAN = "its threads are known by rules from its {}, and chainshaper never ran on it"
MIDDLEWARE_LIMITS: dict[MiddlewareLimit, str] = {
    "connext": f"RTI Connext: {_NEVER_RAN.format('manual')}",
    "iceoryx": f"Cyclone DDS with iceoryx: {_NEVER_RAN.format('sources')}; the thread that"
    " delivers has no name, and stays as it is",
    "unnamed": "the middleware's threads have no names (Fast DDS before 2.13, GurumDDS): Fast DDS's"
    " that receive are known by what they wait for; others stay as they are, and may wait for a"
    " chain on the same core",
}
"""Limit → what it means, in a line for users. A middleware without a limit was run."""


@dataclass(frozen=True)
class PublicationSettings:
    """How a user chooses between synchronous and asynchronous publication.

    * ``mode``: the variable that says "SYNCHRONOUS", "ASYNCHRONOUS", or "AUTO" for the profiles.
    * ``prefer_profiles``: the variable whose "1" lets profiles decide whatever ``mode`` says.
    * ``profile_variables``: variables that name a file of profiles.
    * ``profile_files``: files of profiles that are read from the working directory.
    """

    mode: str
    prefer_profiles: str
    profile_variables: tuple[str, ...]
    profile_files: tuple[str, ...]


@dataclass(frozen=True)
class Middleware:
    """One middleware.

    * ``rmw``: the name of its RMW implementation, as RMW_IMPLEMENTATION has it.
    * ``rmw_prefix``: what the names of all its RMW implementations begin with.
    * ``vendor``: the first two bytes of its gids (RTPS 2.5, 9.3.1.5: vendorId); None: it has none.
    * ``thread_names``: pattern of a whole name → what the thread does; the first that matches
      counts.
    * ``telling_threads``: a pattern that the beginning of some thread's name matches, and of no
      other middleware's thread; None: there is none.
    * ``runtimes``: short word → what threads named `<word>-<number>` do. Other programs may use
      such names, so a process has to have ``fewest_runtimes`` of the words.
    * ``nameless_libraries``: libraries with whose names in a process's map it takes part, although
      no thread's name tells.
    * ``receivers_wait_in``: the library whose receiving threads are known by what they wait for; ""
      where names tell, or nothing.
    * ``port_memory``: the beginning of the name of the shared memory that they wait at.
    * ``routers``: its routers, through which messages may pass, by their programs' names as nodes.
    * ``limit``: what is limited on it; None: nothing.
    * ``nameless_distributions``: ROS 2 distributions in which its threads have no names.
    * ``limiting_threads``: pattern of a thread's whole name → what is limited with it.
    * ``limiting_settings``: variable → pattern in its value, and what is limited with it.
    * ``has_publisher_threads``: whether a thread may publish for a publisher, and for nothing else
      than publishers, so that a slot could hold it.
    * ``undelivered_bytes``: distributions in which ``rmw`` does not deliver messages with a field
      ``uint8[]`` to who takes them serialized.
    """

    rmw: str
    rmw_prefix: str
    vendor: tuple[int, int] | None = None
    thread_names: tuple[tuple[str, ThreadWork], ...] = ()
    telling_threads: str | None = None
    runtimes: tuple[tuple[str, ThreadWork], ...] = ()
    fewest_runtimes: int = 0
    nameless_libraries: tuple[str, ...] = ()
    receivers_wait_in: str = ""
    port_memory: str = ""
    routers: tuple[str, ...] = ()
    limit: MiddlewareLimit | None = None
    nameless_distributions: tuple[str, ...] = ()
    limiting_threads: tuple[tuple[str, MiddlewareLimit], ...] = ()
    limiting_settings: tuple[tuple[str, str, MiddlewareLimit], ...] = ()
    has_publisher_threads: bool = True
    undelivered_bytes: tuple[str, ...] = ()


FAST_DDS_PUBLICATION = PublicationSettings(
    mode="RMW_FASTRTPS_PUBLICATION_MODE",
    prefer_profiles="RMW_FASTRTPS_USE_QOS_FROM_XML",
    profile_variables=("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"),
    profile_files=("DEFAULT_FASTRTPS_PROFILES.xml", "DEFAULT_FASTDDS_PROFILES.xml"),
)
"""Fast DDS's: no other middleware lets a user choose."""

CYCLONE_DDS = Middleware(
    rmw="rmw_cyclonedds_cpp",
    rmw_prefix="rmw_cyclonedds",
    vendor=(0x01, 0x10),
    thread_names=(  # 0.10 and 11; per channel, `user` unless the configuration defines others
        (r"recv(UC|MC)?", "receive"),
        (r"dq\.builtins", "discovery"),
        (r"dq\..*", "delivery"),
        (r"sendq|xmit\..*", "transmit"),
        (r"tev(\..*)?", "event"),
        (r"gc", "garbage collection"),
        (r"lease", "lease"),
        (r"fsm", "connection"),
        (r"debmon|threadmon", "housekeeping"),
    ),
    telling_threads=r"recvUC|recvMC|dq\.builtins|dq\.user|xmit\.user",
    # iceoryx, by a thread of its `posh_runtime_impl.cpp`; its `Listener` names no thread.
    limiting_threads=(("KeepAlive", "iceoryx"),),
    limiting_settings=(("CYCLONEDDS_URI", r"iox|<SharedMemory>", "iceoryx"),),
    has_publisher_threads=False,  # the thread that publishes sends
)

FAST_DDS = Middleware(
    rmw="rmw_fastrtps_cpp",
    rmw_prefix="rmw_fastrtps",
    vendor=(0x01, 0x0F),
    thread_names=(  # from 2.13 on (Jazzy); per participant, port or reader
        (r"dds\.asyn\.\d+\.0", "resend"),
        (r"dds\.asyn\..*", "asynchronous publisher"),
        (r"dds\.tcp_(accept|keep)", "connection"),
        (r"dds\.shm\.wdog", "housekeeping"),
        (r"dds\.(udp|tcp|shm|dsha)\..*", "receive"),
        (r"dds\.ev\..*", "event"),
        (r"dds\.(ds_ev|tls)\..*", "discovery"),
        (r"dds\..*", "housekeeping"),
    ),
    telling_threads=r"dds\.(asyn|ev|udp|shm|tcp)",
    nameless_libraries=("fastrtps", "fastdds"),
    # Before 2.13 threads have no names. From 3.0 on the library is called fastdds, and they have.
    receivers_wait_in="/libfastrtps.so",
    port_memory="/fastrtps_port",
    nameless_distributions=("humble", "iron"),
    # It has a reader of its own for such messages, at which `rmw_take_serialized_message` does not
    # look (rmw_fastrtps 9.4.7, `take_buffer_aware`).
    undelivered_bytes=("lyrical", "rolling"),
)

CONNEXT = Middleware(
    rmw="rmw_connextdds",
    rmw_prefix="rmw_connextdds",
    vendor=(0x01, 0x01),
    # Module, domain, participant, then a task that no manual lists completely.
    thread_names=((r"r(Co|Tr)\d{5}.*", "housekeeping"),),
    telling_threads=r"rCo\d{5}",
    nameless_libraries=("nddscore",),
    limit="connext",
    limiting_threads=((r"r(Co|Tr)\d{5}.*", "connext"),),
)

ZENOH = Middleware(
    rmw="rmw_zenoh_cpp",
    rmw_prefix="rmw_zenoh",
    thread_names=((r"Watchdog (Confir|Valida)\w*", "housekeeping"),),  # of its shared memory
    telling_threads=r"net-\d+$",
    runtimes=(
        ("rx", "receive"),  # takes messages from links, and runs what subscriptions registered
        ("tx", "transmit"),  # sends what publishers hand over, and what keeps a link alive
        ("acc", "connection"),
        ("net", "connection"),
        ("app", "event"),
    ),
    fewest_runtimes=3,  # the variable ZENOH_RUNTIME may join two of the five to others
    nameless_libraries=("rmw_zenoh_cpp",),
    routers=("/rmw_zenohd", "/zenohd"),
    has_publisher_threads=False,  # `tx` sends for all topics, and what keeps links alive
)

GURUM_DDS = Middleware(
    rmw="rmw_gurumdds_cpp",
    rmw_prefix="rmw_gurumdds",
    vendor=(0x01, 0x16),
    nameless_libraries=("gurumdds",),
    limit="unnamed",
)

MIDDLEWARES = (CYCLONE_DDS, FAST_DDS, CONNEXT, ZENOH, GURUM_DDS)
"""All middlewares, in the order in which a thread's name is looked for among their names."""

DEFAULT_MIDDLEWARE = FAST_DDS
"""The middleware that ROS 2 takes where RMW_IMPLEMENTATION is not set."""

ROUTERS = frozenset(router for middleware in MIDDLEWARES for router in middleware.routers)
"""The routers of all middlewares, by the names of their programs as nodes."""


def middleware_of(rmw: str | None) -> Middleware | None:
    """Return the middleware of an RMW implementation; None: it is not known.

    >>> middleware_of("rmw_fastrtps_dynamic_cpp").rmw
    'rmw_fastrtps_cpp'
    """
    for middleware in MIDDLEWARES:
        if rmw is not None and rmw.startswith(middleware.rmw_prefix):
            return middleware
    return None


@functools.lru_cache(maxsize=1024)
def thread_work(name: str) -> ThreadWork | None:
    """Return what a middleware's thread of this name does; None: none has such a name.

    >>> thread_work("recvUC"), thread_work("python3")
    ('receive', None)
    """
    for middleware in MIDDLEWARES:
        for pattern, work in middleware.thread_names:
            if re.fullmatch(pattern, name, re.DOTALL):
                return work
    return None


def runtime_work(names: Iterable[str]) -> dict[str, ThreadWork]:
    """Return what the threads of a process do whose names are a middleware's short words.

    The result is name → work (:attr:`Middleware.runtimes`); it is empty if the process has too few
    of the words.

    >>> runtime_work(["rx-0", "tx-0", "net-0", "main"])
    {'rx-0': 'receive', 'tx-0': 'transmit', 'net-0': 'connection'}
    """
    words = {name: name.rpartition("-")[0] for name in names if is_runtime_name(name)}
    work_by_name: dict[str, ThreadWork] = {}
    for middleware in MIDDLEWARES:
        works = dict(middleware.runtimes)
        known = {name: word for name, word in words.items() if word in works}
        if known and len(set(known.values())) >= middleware.fewest_runtimes:
            work_by_name |= {name: works[word] for name, word in known.items()}
    return work_by_name


def is_runtime_name(name: str) -> bool:
    """Whether a thread's name is a middleware's short word and a number."""
    return _RUNTIME_NAME.fullmatch(name) is not None


_WORDS = "|".join(word for middleware in MIDDLEWARES for word, _ in middleware.runtimes)
_RUNTIME_NAME = re.compile(rf"({_WORDS})-\d+")


def rmw_of_vendor(gid: Iterable[int]) -> str | None:
    """Return the RMW implementation whose endpoints' gids begin like this one; None: not known."""
    vendor = tuple(gid)[:2]
    for middleware in MIDDLEWARES:
        if middleware.vendor == vendor:
            return middleware.rmw
    return None


def rmw_of_threads(names: Iterable[str]) -> str | None:
    """Return the RMW implementation to which threads of these names belong; None: not known."""
    listed = list(names)
    for middleware in MIDDLEWARES:
        telling = middleware.telling_threads
        if telling is not None and any(re.match(telling, name) for name in listed):
            return middleware.rmw
    return None


def limit_by_thread(name: str) -> MiddlewareLimit | None:
    """Return what is limited in a process with a thread of this name; None: nothing."""
    for middleware in MIDDLEWARES:
        for pattern, limit in middleware.limiting_threads:
            if re.fullmatch(pattern, name, re.DOTALL):
                return limit
    return None


def limit_by_settings(
    middleware: Middleware, distribution: str | None, environment: Mapping[str, str]
) -> MiddlewareLimit | None:
    """Return what is limited on a middleware in a ROS 2 distribution and environment."""
    if distribution in middleware.nameless_distributions:
        return "unnamed"
    for variable, pattern, limit in middleware.limiting_settings:
        if re.search(pattern, environment.get(variable, "")):
            return limit
    return middleware.limit
