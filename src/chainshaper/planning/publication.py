"""Whether an application's publishers are what a plan for asynchronous publication takes them for.

The plan gates the thread that publishes the chain's output (section 3.2.1). Its own values are
checked wherever a plan is made or read (:mod:`chainshaper.planning.publisher_threads`); who
publishes what, and how, only the application itself can tell.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from chainshaper.planning.overruns import open_until_done, output_lifespan
from chainshaper.planning.plan import Plan
from chainshaper.planning.publisher_threads import messages_held, publisher_servers
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError

__all__ = ["Writer", "check_publication", "publication_warnings"]

ROOMY_SLOT_NS = 10_000_000
"""What is left of such a slot suffices for many sends where the machine stalls for 1 to 8 ms."""


@dataclass(frozen=True)
class Writer:
    """A writer of an application: node, topic, history (keep last), and who sends.

    ``asynchronous``: a publisher thread does. None is: not known.
    """

    node: str
    topic: str
    depth: int | None = None
    asynchronous: bool | None = None


def check_publication(plan: Plan, writers: Sequence[Writer]) -> list[str]:
    """Hold a plan that gates publishers' threads against the writers of the application.

    Returns what a person must know, one sentence each. Plans that gate no publisher's thread, or
    do not say which output they are for, have nothing to be checked.

    Raises:
        InputError: the output is published by another node, or synchronously, or its history is
            too shallow for what is handed over while the thread may not run.
    """
    warnings: list[str] = []
    for _, server, nodes in publisher_servers(plan):
        for node in nodes:
            own = [writer for writer in writers if writer.node == node]
            if node == plan.chain.publisher and plan.chain.output is not None:
                _check_output(plan.chain.output, node, own, messages_held(plan, server))
            delayed = sorted(
                writer.topic
                for writer in own
                if writer.asynchronous and writer.topic != plan.chain.output
            )
            if delayed:
                warnings.append(
                    f"{', '.join(delayed)} of {node} will be delayed as well, until the slots of"
                    f" server {server.name!r}: one thread sends for all asynchronous writers of a"
                    " process. Publish them synchronously, or from another process."
                )
    return warnings


def _check_output(topic: str, node: str, own: Sequence[Writer], held: int) -> None:
    writer = next((writer for writer in own if writer.topic == topic), None)
    if writer is None:
        raise InputError(
            f"the plan gates the thread by which {node} publishes {topic}, but {node} does not"
            " publish it: plan again from a recording of this application"
        )
    if writer.asynchronous is False:
        raise InputError(
            f"{node} publishes {topic} synchronously, so gating its publisher thread would hold"
            " nothing: publish it asynchronously, or plan with --publication synchronous"
        )
    if writer.depth is not None and writer.depth < held:
        raise InputError(
            f"{topic} has a history of {writer.depth}, but {held} messages are handed over while"
            f" the publisher thread of {node} may not run: give it a depth of {held + 1}"
        )


def publication_warnings(plan: Plan) -> list[str]:
    """What a plan for asynchronous publication asks of the application; one sentence each."""
    warnings = []
    for _, server, nodes in publisher_servers(open_until_done(plan)):
        names = ", ".join(nodes)
        warnings.append(
            f"only asynchronous publication can be shaped like this, and all of it is: whatever"
            f" else {names} publishes asynchronously, such as /rosout, waits for the slots of"
            f" server {server.name!r} too."
        )
        shortest = min(end - start for start, end in server.slots)
        if shortest < ROOMY_SLOT_NS:
            warnings.append(
                f"a slot of {format_duration(shortest)} that opens late may end while {names}"
                " sends, which blocks the whole process until the next one; it costs nothing to"
                f" give it {format_duration(ROOMY_SLOT_NS)} (--publish-slot), since outputs leave"
                " when it opens."
            )
        depth = plan.chain.output_depth
        held = messages_held(plan, server)
        if depth == held and plan.overrun == "wait" and plan.chain.publisher in nodes:
            warnings.append(
                f"a history of {depth} has no room for an output that overran: it will be"
                " overwritten by the next. A depth of one more would keep it."
            )
    if plan.overrun == "discard" and warnings:
        lifespan, topic = output_lifespan(plan), plan.chain.output or "their topic"
        warnings.append(
            "outputs that are due in a later cycle than their own cannot be told from overruns by"
            " their age: none will be discarded."
            if lifespan is None
            else f"outputs that overran are discarded by DDS if {topic} has a lifespan of"
            f" {format_duration(lifespan)}: give it one."
        )
    return warnings
