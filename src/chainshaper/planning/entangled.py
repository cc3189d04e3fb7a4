"""Chains that cannot be planned together yet, because one's plan would move another's outputs.

A plan is made from latencies that were measured while nothing was shaped. Shaping a topic that
another chain's output waits for makes that one later than was measured, and its slot too early.
Nor can two plans have one thread. Such wishes are refused with what the chains have in common.
What is left is planned right: chains that share no more than cores, and sinks that fork off behind
the first callback.
"""

from collections.abc import Iterable, Sequence
from itertools import combinations, permutations
from typing import TYPE_CHECKING

from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Policy

if TYPE_CHECKING:
    from chainshaper.planning.plan import Plan
    from chainshaper.planning.request import Profile

__all__ = ["refuse_entangled", "refuse_shared_parts"]

_UNSHAPED = ("server-per-chain", "server-per-callback")


def refuse_entangled(profiles: "Sequence[Profile]", policy: Policy, *, sinks: bool = False) -> None:
    """Refuse chains of which one's plan would change what another was measured for.

    With ``sinks`` all are planned as one: the first chain, and further outputs of its graph.

    Raises:
        InputError: names the chains, what they have in common, and what to do instead.
    """
    for one, two in combinations(profiles, 2):
        if one.topics and one.topics[-1:] == two.topics[-1:]:
            raise InputError(_same_output(_name(one), _name(two), one.topics[-1]))
    for shaped, waiting in permutations(profiles, 2):
        if on_the_way := sorted(_delayed(shaped, policy) & waiting.upstream):
            raise InputError(_waits(_name(shaped), _name(waiting), on_the_way))
    for one, two in combinations(profiles, 2):
        if sinks:
            _refuse_another_beginning(one, two)
        elif shared := set(one.core_of) & set(two.core_of):
            raise InputError(_same_nodes(_name(one), _name(two), shared))


def refuse_shared_parts(plans: "Sequence[Plan]") -> None:
    """Refuse plans that were made one by one and govern the same threads, or the same output.

    Raises:
        InputError: names the plans' chains, what they share, and what to do instead.
    """
    for one, two in combinations(plans, 2):
        first, second = (plan.chain.spec or plan.chain.output or "a chain" for plan in (one, two))
        if one.chain.output is not None and one.chain.output == two.chain.output:
            raise InputError(_same_output(first, second, one.chain.output))
        if shared := _nodes(one) & _nodes(two):
            raise InputError(_same_nodes(first, second, shared))


def _delayed(profile: "Profile", policy: Policy) -> set[str]:
    """The topics that come later under a chain's plan than they were measured."""
    if policy in _UNSHAPED:
        return set()
    return set(profile.topics if policy == "let-per-callback" else profile.topics[-1:])


def _name(profile: "Profile") -> str:
    return profile.spec or "..".join(profile.topics)


def _nodes(plan: "Plan") -> set[str]:
    return {thread.node for server in plan.servers for thread in server.threads}


def _refuse_another_beginning(one: "Profile", two: "Profile") -> None:
    if one.begins is not None and two.begins is not None and one.begins != two.begins:
        raise InputError(
            f"{_name(two)} begins at {two.begins[1]}, {_name(one)} at another callback,"
            f" {one.begins[1]}: the slots of a sink count from the beginning of the chain. Name a"
            " sink behind the same first callback, or plan one of the two alone"
        )
    if one.period_ns != two.period_ns:
        raise InputError(
            f"{_name(two)} has the period {format_duration(two.period_ns)}, {_name(one)}"
            f" {format_duration(one.period_ns)}: a plan has one cycle. Plan one of the two alone"
        )


def _same_output(one: str, two: str, topic: str) -> str:
    return (
        f"{one} and {two} both publish {topic}, and one shaping node can hold it at one place"
        " only: name each output once, with the chain that takes longest"
    )


def _waits(shaped: str, waiting: str, topics: Sequence[str]) -> str:
    them = ", ".join(topics)
    return (
        f"{waiting} waits for {them}, which the plan for {shaped} publishes later than it was"
        f" measured: {waiting} would miss its own slot. Plan {waiting} alone, whose output is"
        f" constant then, or {shaped} alone"
    )


def _same_nodes(one: str, two: str, nodes: Iterable[str]) -> str:
    them = ", ".join(sorted(nodes))
    return (
        f"{one} and {two} share {them}: a thread runs in the servers of one plan. Plan one of the"
        " two alone or, where both begin at the same callback, the other as its --sink"
    )
