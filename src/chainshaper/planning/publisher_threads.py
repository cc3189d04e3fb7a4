"""What a server may not do to the thread of an asynchronous publisher (design 1, section 3.2.1).

It stops a thread which shares locks with the rest of its process. With Fast DDS 2.14, three things
turned out to be destructive:

* *a slot that is hardly longer than a send*: stopped in the midst of one, the thread holds what
  every publisher and the executor need, until the slot opens again. 0.25 ms did that; the bound
  is four times as much, and four times the longest send where sends were measured.
* *a thread that out-ranks its executor*: the executor hands a message over under the writer's
  lock, for which the publisher thread spins. Above the executor on the same core, it never lets
  it give that lock back. Before the shortest latency measured nothing is handed over, so what
  happens until then is not looked at.
* *a history that is too shallow*: what is handed over while the thread may not run has to fit in.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

from chainshaper.planning.plan_parts import Server, slot_text
from chainshaper.values.durations import format_duration
from chainshaper.values.yaml_file import wrong_value

if TYPE_CHECKING:
    from chainshaper.planning.plan import Plan

__all__ = ["below_executors", "check_publisher_threads", "messages_held", "publisher_servers"]

SHORTEST_SLOT_NS = 1_000_000
SENDS_PER_SLOT = 4


def check_publisher_threads(plan: "Plan") -> None:
    """Refuse a gated asynchronous publisher that would stop, or be stopped by, its process."""
    for number, server, nodes in publisher_servers(plan):
        _check_slots(plan, number, server)
        for node in nodes:
            _check_rank(plan, number, server, node)
        if plan.overrun == "publish" and plan.policy not in ("shaped", "one-long-slot"):
            raise wrong_value(
                f"under {plan.policy} an output of an asynchronous publisher that comes in its own"
                " cycle cannot be told from an overrun of the one before: write wait or discard, or"
                " plan with --publication synchronous",
                "overrun",
            )
        depth = plan.chain.output_depth
        if depth is not None and plan.chain.publisher in nodes:
            held = messages_held(plan, server)
            if depth < held:
                raise wrong_value(
                    f"a history of {depth} is too shallow: while the publisher's thread may not"
                    f" run, {held} messages are handed over, and the oldest would be lost; give"
                    f" {plan.chain.output or 'the output'} a depth of {held + 1}, or the server"
                    f" {server.name!r} more slots",
                    *("chain", "output_depth"),
                )


def below_executors(servers: Sequence[Server]) -> tuple[Server, ...]:
    """The servers, with those of publishers' threads ranked below what may run at the same time."""
    publishing = [
        server for server in servers if any(t.role == "publisher" for t in server.threads)
    ]
    ranked = []
    for server in servers:
        below = [
            other.priority + 1
            for other in servers
            if server in publishing and other not in publishing
            if other.core == server.core and other.slots[-1][1] > server.slots[0][0]
        ]
        priority = max([server.priority, *below])
        ranked.append(server.model_copy(update={"priority": priority}))
    return tuple(ranked)


def publisher_servers(plan: "Plan") -> Iterator[tuple[int, Server, list[str]]]:
    """Servers that hold publishers' threads: place in the plan, server, nodes of these threads."""
    for number, server in enumerate(plan.servers):
        nodes = [thread.node for thread in server.threads if thread.role == "publisher"]
        if nodes:
            yield number, server, nodes


def messages_held(plan: "Plan", server: Server) -> int:
    """How many messages of the chain may be handed over while a server is closed, in one stretch.

    One per period of the chain, and one more for where the stretch begins.
    """
    (first, _), (_, last) = server.slots[0], server.slots[-1]
    closed = [after[0] - before[1] for before, after in pairwise(server.slots)]
    longest = max([*closed, plan.cycle_ns + first - last])
    return longest // plan.chain.period_ns + 1


def _check_slots(plan: "Plan", number: int, server: Server) -> None:
    measured = plan.evidence.longest_send_ns
    shortest = max(SHORTEST_SLOT_NS, SENDS_PER_SLOT * (measured or 0))
    for slot_number, slot in enumerate(server.slots):
        if slot[1] - slot[0] < shortest:
            sends = "" if measured is None else f" (the longest took {format_duration(measured)})"
            raise wrong_value(
                f"the slot {slot_text(slot)} is too short for an asynchronous publisher: stopped"
                f" in the midst of a send{sends}, its thread would block the whole process; make"
                f" it {format_duration(shortest)} or longer (--publish-slot)",
                *("servers", number, "slots", slot_number),
            )


def _check_rank(plan: "Plan", number: int, server: Server, node: str) -> None:
    """Nowhere may the thread run at a better priority than its node's executor could then."""
    for other in plan.servers:
        executes = any(t.node == node and t.role == "executor" for t in other.threads)
        if not executes or other.core != server.core or other.priority <= server.priority:
            continue
        for slot in server.slots:
            since = max(slot[0], plan.evidence.min_latency_ns)
            if any(max(since, start) < min(slot[1], end) for start, end in other.slots):
                raise wrong_value(
                    f"the publisher thread of {node} would out-rank its executor, which server"
                    f" {other.name!r} runs at priority {other.priority} on the same core in"
                    f" {slot_text(slot)}: spinning for a lock that the executor holds, it would"
                    f" never let it go on; write a number above {other.priority}, or move the slot"
                    " behind the executor's",
                    *("servers", number, "priority"),
                )
