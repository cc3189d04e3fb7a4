"""Substitutions of launch files: ``$(var x)``, ``$(find-pkg-share p)`` and so on.

They are parsed by the frontends' grammar (`launch/frontend/grammar.lark` of ros2/launch) and
resolved as far as that can be done without launching: launch configurations from the defaults
and values on the way, packages through the ament index, the environment as it is. What depends
on anything else (``$(eval …)``, ``$(command …)``) has no value here, which is None.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from chainshaper.splicing.launch.actions import Substitution, Template

__all__ = ["UNKNOWN", "Surroundings", "described", "package_share", "parse_template", "resolve"]

UNKNOWN: Template = (Substitution("unknown"),)

_MOST_SUBSTITUTIONS = 100
_LONGEST_TEXT = 64 << 10
_IDENTIFIER = re.compile(r"\$\(([A-Za-z][A-Za-z0-9_-]*)")


@dataclass(frozen=True)
class Surroundings:
    """Where a template stands: the configurations in force, and its launch file.

    A configuration whose value is not known is None.
    """

    configurations: Mapping[str, str | None]
    file: Path


def parse_template(text: str) -> Template:
    """The parts of a text as the XML and YAML frontends see them; UNKNOWN where it is malformed."""
    if text.count("$(") > _MOST_SUBSTITUTIONS:
        return UNKNOWN
    parts, end = _parts(text, 0, "")
    return parts if end == len(text) else UNKNOWN


def _parts(text: str, position: int, stops: str) -> tuple[Template, int]:
    """Parts up to one of the characters in ``stops``, and where that is."""
    parts: list[str | Substitution] = []
    literal = ""
    while position < len(text) and text[position] not in stops:
        if text.startswith("$(", position):
            found, position = _substitution(text, position)
            parts += [literal, found] if literal else [found]
            literal = ""
        elif text[position] == "\\" and position + 1 < len(text):
            literal += text[position + 1]
            position += 2
        else:
            literal += text[position]
            position += 1
    return (*parts, *([literal] if literal else [])), position


def _substitution(text: str, position: int) -> tuple[Substitution, int]:
    match = _IDENTIFIER.match(text, position)
    if match is None:
        return Substitution("unknown"), len(text) + 1
    arguments: list[Template] = []
    position = match.end()
    while position < len(text) and text[position] == " ":
        position += 1
        quote = text[position : position + 1]
        if quote and quote in "'\"":
            argument, position = _parts(text, position + 1, quote)
            position += 1
        else:
            argument, position = _parts(text, position, " )")
        if argument:
            arguments.append(argument)
    if text[position : position + 1] != ")":
        return Substitution("unknown"), len(text) + 1
    return Substitution(match[1], tuple(arguments)), position + 1


def resolve(template: Template, where: Surroundings) -> str | None:
    """The text that a template stands for, or None where only a launch would tell."""
    texts = [part if isinstance(part, str) else _value(part, where) for part in template]
    known = [text for text in texts if text is not None]
    if sum(map(len, known)) > _LONGEST_TEXT:  # configurations that repeat each other
        return None
    return "".join(known) if len(known) == len(texts) else None


def described(template: Template) -> str:
    """A template as a person would write it: ``$(find-pkg-share robot)/launch/x.launch.py``."""
    parts: list[str] = []
    for part in template:
        if isinstance(part, str):
            parts.append(part)
        elif part.name == "join":
            parts.append("/".join(described(argument) for argument in part.arguments))
        else:
            words = [part.name, *(described(argument) for argument in part.arguments)]
            parts.append(f"$({' '.join(words)})")
    return "".join(parts)


def _value(  # noqa: PLR0911 - one per substitution
    substitution: Substitution, where: Surroundings
) -> str | None:
    if substitution.name == "dirname":
        return str(where.file.parent)
    if substitution.name == "filename":
        return str(where.file)
    arguments = [resolve(argument, where) for argument in substitution.arguments]
    first, default = (*arguments, None, None)[:2]
    if first is None:
        return None
    if substitution.name == "var":
        return where.configurations.get(first, default)
    if substitution.name in ("env", "optenv"):
        missing = "" if substitution.name == "optenv" else None
        return os.environ.get(first, missing if default is None else default)
    if substitution.name == "find-pkg-share":
        return package_share(first)
    if substitution.name == "find-pkg-prefix":
        share = package_share(first)
        return None if share is None else str(Path(share).parents[1])
    if substitution.name == "join" and None not in arguments:
        return str(Path(*[argument or "" for argument in arguments]))
    return None


def package_share(package: str) -> str | None:
    """The share folder of a package in the environment, found as `ament_index` finds it."""
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        if (Path(prefix) / "share/ament_index/resource_index/packages" / package).is_file():
            return str(Path(prefix) / "share" / package)
    return None
