"""Which node of the launch files has a topic, and what gives it another in its place.

The node is known by its full name. Where it is found, its rule that leads to the topic changes
its target, or a rule is added. Where it could only be one of several, because the executable
gives the name or the file cannot be read so far, the rule begins with the node's name
(``ndt:/t5``), so that ROS 2 itself applies it to the right one and no other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Literal

from chainshaper.splicing.launch.remaps import FullName, PlacedRule, rules_in_force
from chainshaper.splicing.launch.substitutions import described
from chainshaper.splicing.launch.walk import PlacedNode, Walk
from chainshaper.values.errors import InputError, OperationError

__all__ = ["Remedy", "Wanted", "heard_by_owner", "notes_of_bound_rule", "remedies_for"]

_SHOWN = 12


@dataclass(frozen=True)
class Wanted:
    """A node, by its full name, is to publish or subscribe ``target`` where it has ``topic``."""

    node: str
    does: Literal["publishes", "subscribes to"]
    topic: str
    target: str


class Sure(Enum):
    """How well it is known that a node is the one that is wanted."""

    YES = "its name says so"
    IF_NAMED_SO = "the launch file gives it no name, and there is no other"
    NO = "it is one of several, or its name is known at launch only"


@dataclass(frozen=True)
class Remedy:
    """One change to one instance of a launch file: what ``match`` names becomes what is wanted.

    Either the target of ``rule`` is replaced, or a rule is added before it where it holds for a
    scope, or before ``node``'s own. With neither it is for the whole of the launch file.
    """

    wanted: Wanted
    instance: int
    match: str
    node: PlacedNode | None = None
    rule: PlacedRule | None = None
    certainty: Sure = Sure.NO

    @property
    def owner(self) -> str:
        """The name of the node that a rule must be bound to wherever others hear it."""
        return FullName.of(self.wanted.node).base

    @property
    def sure(self) -> bool:
        """Whether the node is known to be the one that is wanted."""
        return self.certainty is Sure.YES

    @property
    def near(self) -> bool:
        """Whether a rule belongs to the node itself, instead of the beginning of the file."""
        return self.certainty is not Sure.NO

    @property
    def bound(self) -> tuple[str, str]:
        """The rule as it may be heard by all nodes."""
        return f"{self.owner}:{self.match}", self.wanted.target


def remedies_for(walk: Walk, wanted: Wanted) -> tuple[list[Remedy], list[str]]:
    """The changes that give a node the topic that is wanted, and notes.

    Where the node runs under conditions only, another node may be it when they do not hold.

    Raises:
        InputError: no such node, or several; it is remapped already, or elsewhere.
    """
    name, notes = FullName.of(wanted.node), []
    found = _named(walk, name)
    _refuse_several(walk, found, wanted)
    remedies = [remedy for node in found for remedy in _remedies(walk, node, wanted, Sure.YES)]
    if all(node.conditions for node in found):
        possible = [node for node in walk.nodes if _possible(node, name, found)]
        alone = len(possible) == 1 and not walk.unreadable and possible[0].action.name is None
        sure = Sure.IF_NAMED_SO if alone else Sure.NO
        for node in possible:
            remedies += _remedies(walk, node, wanted, sure)
        if possible:
            places = ", ".join(_place(walk, node) for node in possible)
            notes.append(
                f"{places}: what nobody named in the launch file may be {name}, so the remap"
                f" is bound to the name {name.base}"
            )
        for number, action in walk.unreadable:
            remedies.append(Remedy(wanted, number, wanted.topic))
            notes.append(
                f"{walk.instances[number].file.path}:{action.line}: not known before launch, may"
                f" start {name}: {action.reason}"
            )
    if not remedies:
        raise InputError(_nobody(walk, wanted))
    return remedies, notes


def _named(walk: Walk, name: FullName) -> list[PlacedNode]:
    return [
        node
        for node in walk.nodes
        if node.name == name.base and (node.namespace or "/") == name.namespace
        if node.namespace is not None
    ]


def _possible(node: PlacedNode, name: FullName, known: Sequence[PlacedNode]) -> bool:
    """Whether a node without a known name or namespace may turn out to be this one."""
    namespaces = (None, "", name.namespace)
    named_so = node.name in (None, name.base) and node.namespace in namespaces
    return named_so and node not in known


def _place(walk: Walk, node: PlacedNode) -> str:
    return f"{walk.instances[node.instance].file.path}:{node.action.line}"


def _refuse_several(walk: Walk, found: Sequence[PlacedNode], wanted: Wanted) -> None:
    """Several are fine where conditions keep them apart: then one runs without the other."""
    for number, one in enumerate(found):
        for other in found[number + 1 :]:
            together = one.conditions <= other.conditions or other.conditions <= one.conditions
            if together:
                raise InputError(
                    f"the name {wanted.node} matches twice: {_place(walk, one)} and"
                    f" {_place(walk, other)}. ROS 2 wants it once: rename one, or give the launch"
                    " file of one alone"
                )


def _remedies(walk: Walk, node: PlacedNode, wanted: Wanted, certainty: Sure) -> list[Remedy]:
    sure, name = certainty is Sure.YES, FullName.of(wanted.node)
    rules = rules_in_force(node.rules, name)
    for rule in rules:
        if rule.target == wanted.target:
            raise InputError(
                f"{_place(walk, node)}: {name} is remapped to {wanted.target} already, which is for"
                " the node that is to be added: give the launch file as it was before"
            )
    leading = [rule for rule in rules if rule.target == wanted.topic]
    elsewhere = [rule for rule in rules if rule.match == wanted.topic and rule not in leading]
    if sure and not leading and elsewhere:
        raise InputError(
            f"{_place(walk, node)}: {name} has {elsewhere[0].target or 'another topic'} in place of"
            f" {wanted.topic}, so it is not the one that {wanted.does} it: give a recording of this"
            " application, or a plan made from one"
        )
    direct = Remedy(wanted, node.instance, wanted.topic, node, certainty=certainty)
    found = [
        replace(
            direct,
            instance=rule.scope[0] if rule.scope else node.instance,
            match=rule.match or wanted.topic,
            rule=rule,
        )
        for rule in leading
    ]
    if sure and found:
        return found
    return [*found, *([] if elsewhere else [direct])]


def _nobody(walk: Walk, wanted: Wanted) -> str:
    names = sorted({node.full_name for node in walk.nodes if node.name})
    shown = ", ".join(names[:_SHOWN]) + (", …" if len(names) > _SHOWN else "")
    message = (
        f"nobody {wanted.does} {wanted.topic}: the launch files start no node {wanted.node}, only"
        f" {shown or 'none with a name'}"
    )
    unresolved = [
        f"{walk.instances[number].file.path}:{include.line} ({described(include.path)})"
        for number, include in walk.not_followed
    ]
    if unresolved:
        return (
            f"{message}. Not found were the files included at {', '.join(unresolved)}: source the"
            " workspace they are in, or give them as well"
        )
    if wanted.does == "publishes":
        return f"{message}: give the launch file that starts it, or correct `chain.publisher`"
    return (
        f"{message}: give the launch file that starts it, or name those that are meant, each with"
        f" --throttle NODE:{wanted.topic}=PERIOD"
    )


def heard_by_owner(walk: Walk, remedy: Remedy) -> None:
    """Make sure that a rule for all of a launch file would reach its node.

    Raises:
        OperationError: it would not; the rule has to be changed by hand.
    """
    node, rule = remedy.node, remedy.rule
    if node is None:
        return
    if rule is not None and rule.from_arguments:
        raise OperationError(
            f"{_place(walk, node)}: the command line of {node.action.label} remaps {remedy.match}"
            f" and precedes every other rule: make it {remedy.wanted.target} by hand, in a copy"
        )
    if node.sheltered:
        raise OperationError(
            f"{_place(walk, node)}: a group around it forwards nothing from outside, and its place"
            f" cannot be edited: remap {remedy.match} to {remedy.wanted.target} by hand, in a copy"
        )


def notes_of_bound_rule(walk: Walk, remedy: Remedy) -> list[str]:
    """What to know of a rule for all of a launch file: why it is there, and who else hears it."""
    notes: list[str] = []
    if remedy.node is not None and remedy.sure:
        notes.append(
            f"{_place(walk, remedy.node)}: not edited there, because it is carried out more than"
            " once, or cannot be changed alone, or is certain at launch only"
        )
    namesakes = {
        node.full_name
        for node in walk.nodes
        if node.name == remedy.owner and remedy.node is not None
        if node.namespace is not None and node.namespace != remedy.node.namespace
    }
    if namesakes:
        notes.append(
            f"{', '.join(sorted(namesakes))}: named {remedy.owner} too, so that the remap of"
            f" {remedy.match} would hold there as well, if that is used there"
        )
    return notes
