"""The commands of LITMUS^RT's own tools, in their own grammar.

`resctl` reads times as decimal milliseconds, turns them into a C double, multiplies it by a
million and drops what is behind the point. `1.001` becomes 1000999.99… and a nanosecond is lost.
So a text is chosen that survives this.

Intervals may be written closed, `[2,86]`, or half-open, `[2,86)`, which ends one nanosecond
earlier. Ours are half-open: `resctl` refuses a closed interval that ends with the major cycle, and
takes `[2,86] [86,87]` for overlapping. They must ascend, and the kernel wants two nanoseconds at
least and 1024 intervals at most. A table counts from time zero of CLOCK_MONOTONIC; another anchor
is reached by turning the slots, which may cut one in two at the end of the cycle.

Reservations cannot be deleted or listed one by one. They go when the plugin is changed, which the
kernel refuses while a thread is under SCHED_LITMUS. There is no command to detach a thread but to
give it another class.

Upstream: liblitmus, `bin/resctl.c`, `doc/howto-use-resctl.md`, `doc/table-driven-scheduling.md`;
LITMUS^RT, `litmus/reservations/alloc.c`.
"""

from collections.abc import Iterable, Mapping, Sequence

from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError

__all__ = [
    "Command",
    "attach_command",
    "create_command",
    "interval_text",
    "litmus_commands",
    "milliseconds_text",
    "plugin_command",
    "reservation_ids",
    "turned",
]

Command = tuple[str, ...]
MOST_INTERVALS = 1024
SHORTEST_NS = 2
PLUGIN = "P-RES"
NO_PLUGIN = "Linux"


def litmus_commands(
    table: ServerTable, members: Mapping[str, Sequence[int | str]], anchor_ns: int
) -> tuple[Command, ...]:
    """All commands that put a table in force, in order; ``members`` are thread ids by server.

    What stands for a thread that does not run yet may be a text.

    Raises:
        InputError: the table has what LITMUS^RT cannot do.
    """
    ids = reservation_ids(table)
    return (
        plugin_command(PLUGIN),
        *(
            create_command(ids[server.name], server, table.cycle_ns, anchor_ns)
            for server in table.servers
        ),
        *(
            attach_command(tid, ids[server.name], server.core)
            for server in table.servers
            for tid in members.get(server.name, ())
        ),
    )


def reservation_ids(table: ServerTable, generation: int = 0) -> dict[str, int]:
    """An id per server, different in every generation: a reservation is never changed or freed.

    Ids count for each core apart; `core x 1000 + index` is the documentation's proposal.
    """
    first = generation * len(table.servers) + 1
    return {s.name: s.core * 1000 + index for index, s in enumerate(table.servers, start=first)}


def plugin_command(plugin: str) -> Command:
    """Activate a scheduler plugin."""
    return ("setsched", plugin)


def create_command(
    number: int, server: ReservationServer, cycle_ns: int, anchor_ns: int
) -> Command:
    """Create the reservation of a server whose cycles start at ``anchor_ns`` (CLOCK_MONOTONIC).

    Raises:
        InputError: it has more slots, or a shorter one, than the kernel takes.
    """
    slots = turned(server.slots, cycle_ns, anchor_ns)
    if len(slots) > MOST_INTERVALS:
        raise InputError(
            f"server {server.name} has {len(slots)} slots, and LITMUS^RT takes {MOST_INTERVALS} "
            "in a reservation: use a shorter cycle, or another back end"
        )
    for start, end in server.slots:
        if end - start < SHORTEST_NS:
            raise InputError(
                f"server {server.name}: the slot at {format_duration(start)} is shorter than "
                f"{SHORTEST_NS} ns, the least that LITMUS^RT takes: make it longer"
            )
    return (
        *("resctl", "-n", str(number), "-t", "table-driven", "-c", str(server.core)),
        *("-m", milliseconds_text(cycle_ns), "-q", str(server.priority)),
        *(interval_text(start, end) for start, end in slots),
    )


def attach_command(tid: int | str, number: int, core: int) -> Command:
    """Move a running thread to the core, and into its reservation."""
    return ("resctl", "-a", str(tid), "-r", str(number), "-c", str(core))


def interval_text(start_ns: int, end_ns: int) -> str:
    """A half-open interval: ``[2,86.5)``."""
    return f"[{milliseconds_text(start_ns)},{milliseconds_text(end_ns)})"


def milliseconds_text(duration_ns: int) -> str:
    """The shortest decimal milliseconds that `resctl` turns into exactly this duration.

    >>> milliseconds_text(86_500_000)
    '86.5'
    """
    whole, fraction = divmod(duration_ns, 1_000_000)
    digits = f"{fraction:06d}".rstrip("0")
    text = f"{whole}.{digits}" if digits else str(whole)
    if int(float(text) * 1_000_000) != duration_ns:
        text = f"{whole}.{fraction:06d}5"  # half a nanosecond more, which is dropped
    return text


def turned(
    slots: Iterable[tuple[int, int]], cycle_ns: int, anchor_ns: int
) -> tuple[tuple[int, int], ...]:
    """Slots that count from an anchor, counted from time zero instead; ascending.

    A slot that then lies across the end of the cycle becomes two. A piece of one nanosecond,
    which the kernel would refuse, is left out.

        >>> turned([(10, 30)], cycle_ns=100, anchor_ns=1080)
        ((0, 10), (90, 100))
    """
    pieces = []
    for start, end in slots:
        first = (start + anchor_ns) % cycle_ns
        last = first + end - start
        pieces += [(first, min(last, cycle_ns)), (0, max(0, last - cycle_ns))]
    return tuple(sorted(piece for piece in pieces if piece[1] - piece[0] >= SHORTEST_NS))
