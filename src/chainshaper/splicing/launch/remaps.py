"""Names in ROS 2: how a node's topics get their full names, and which remap rule decides.

Rules are tried in order and the first that matches counts; the result is not matched again
(`rcl_remap_first_match` in rcl). A rule may begin with a node's name, ``ndt:/t5:=/t5_tmp``: then
it counts for nodes of this name only. That is what makes a rule safe where many nodes hear it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from chainshaper.splicing.launch.actions import RemapRule, SetRemap

__all__ = ["FullName", "PlacedRule", "expanded", "joined", "rules_in_force"]


@dataclass(frozen=True)
class FullName:
    """A node's name without and with its namespace: ``ndt`` in ``/localization``."""

    base: str
    namespace: str

    @classmethod
    def of(cls, text: str) -> "FullName":
        namespace, _, base = text.rpartition("/")
        return cls(base, namespace or "/")

    def __str__(self) -> str:
        return joined(self.namespace, self.base)


@dataclass(frozen=True)
class PlacedRule:
    """A rule that a node hears: its texts, None where unknown, and where it was written.

    ``scope`` is the action and the launch file's number that set it for a whole scope.
    """

    match: str | None
    target: str | None
    rule: RemapRule
    scope: tuple[int, SetRemap] | None = None
    from_arguments: bool = False


def joined(namespace: str, name: str) -> str:
    """A name below a namespace, unless it is absolute already."""
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"


def expanded(name: str, node: FullName) -> str:
    """The full name of what a node calls ``name``: absolute, relative, or private (``~/…``)."""
    name = name.removeprefix("rostopic://")
    if name == "~" or name.startswith("~/"):
        return str(node) + name[1:]
    return joined(node.namespace, name)


def rules_in_force(rules: Sequence[PlacedRule], node: FullName) -> list[PlacedRule]:
    """The rules that a node of this name would follow, with full names, in order.

    Left out are those for nodes of other names, and those that come after one with the same
    match. What is unknown stays unknown.
    """
    found: list[PlacedRule] = []
    matches: set[str] = set()
    for rule in rules:
        match = rule.match
        if match is not None:
            owner, colon, rest = match.partition(":")
            if colon and not match.startswith("rostopic:") and owner != node.base:
                continue
            bare = rest if colon and not match.startswith("rostopic:") else match
            match = expanded(bare, node)
            if match in matches or bare.startswith("__"):
                continue
            matches.add(match)
        target = None if rule.target is None else expanded(rule.target, node)
        found.append(replace(rule, match=match, target=target))
    return found
