"""`schema.hpp`: what nodes in C++ share with those in Python, as a header in C++.

The package's build makes it (`core/CMakeLists.txt`) by `python -m chainshaper.robot.schema_header
TEMPLATE HEADER`, before any package is installed: so only the standard library is imported here.
"""

import re
import sys
from collections.abc import Mapping
from dataclasses import MISSING, Field
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

from chainshaper.robot import handover
from chainshaper.robot.decision import DROPPED
from chainshaper.robot.gate import ANCHORS, INTO_OPEN_SLOT, LATE, MESSAGES, VALUES
from chainshaper.robot.gate_log import LOG_COLUMNS
from chainshaper.robot.node_parameters import PARAMETERS

_CPP_TYPES = {
    int: "std::int64_t",
    str: "std::string",
    list[int]: "std::vector<std::int64_t>",
    list[str]: "std::vector<std::string>",
}


ENUMERATIONS = {
    "Anchor": ANCHORS,
    "Policy": LATE,  # of which `overrun` has all but the last
    "Entry": INTO_OPEN_SLOT,
    "Messages": MESSAGES,
    "Dropped": DROPPED,
}
"""Types in C++ with the words that their values stand for, in their order."""


def schema_header(template: str) -> str:
    """Return the text of `schema.hpp`: that of `schema.hpp.in` with its places filled in."""
    values = _values()
    return re.sub("@([A-Z_]+)@", lambda place: values[place[1]], template)


def constants(numbers: Mapping[str, int]) -> str:
    """Return numbers as constants in C++, a line each."""
    return "\n".join(
        f"inline constexpr std::int64_t {name} = {value};" for name, value in numbers.items()
    )


def numbers_of(module: ModuleType) -> dict[str, int]:
    """Return the public constants of a module that are integers, by their names in C++."""
    return {
        name.lower(): value
        for name, value in vars(module).items()
        if name.isupper() and isinstance(value, int) and not name.startswith("_")
    }


def _values() -> dict[str, str]:
    """Return the text for each place of the template."""
    numbers = numbers_of(handover) | {"log_columns": len(LOG_COLUMNS)}
    members = [
        f"{_CPP_TYPES[type_]} {name}{{{_in_cpp(default)}}};"
        for name, (type_, default) in PARAMETERS.items()
    ]
    return {
        "CONSTANTS": constants(numbers),
        "LOG_HEADER": '"\n    "'.join(f"{n}," for n in LOG_COLUMNS).removesuffix(","),
        "FIELDS": ", ".join(handover.FIELDS),
        "PARAMETERS": "\n  ".join(members),
        "READS": "\n    ".join(f'read("{name}", {name});' for name in PARAMETERS),
        "GATE_VALUES": "\n    ".join(_gate_value_read(declared) for declared in VALUES),
    }


def enumeration_of(declared: "Field[Any]") -> str | None:
    """Return the type in C++ of a gate's value that is a word; None: it is a number."""
    words = get_args(declared.type)
    if not words:
        return None
    types = (name for name, listed in ENUMERATIONS.items() if listed[: len(words)] == words)
    return next(types, None)


def gate_values() -> str:
    """Return the members of `GateValues` in C++, a line each."""
    lines = []
    for declared in VALUES:
        default = 0 if declared.default is MISSING else declared.default
        if (kind := enumeration_of(declared)) is None:
            lines.append(f"std::int64_t {declared.name}{{{default}}};")
        else:
            lines.append(f"{kind} {declared.name}{{{kind}::{str(default).replace('-', '_')}}};")
    return "\n  ".join(lines)


def gate_value_visits() -> str:
    """Return the calls in C++ of `visit` with each member of `GateValues`, a line each."""
    lines = []
    for declared in VALUES:
        kind, member = enumeration_of(declared), f"&GateValues::{declared.name}"
        words = "" if kind is None else f", {kind.lower()}_names"
        lines.append(f'visit("{declared.name}", {member}{words});')
    return "\n  ".join(lines)


def _gate_value_read(declared: "Field[Any]") -> str:
    """Return the line in C++ that takes a value of a gate from the parameter of its name."""
    name, kind = declared.name, enumeration_of(declared)
    read = name if kind is None else f"word_named<{kind}>({kind.lower()}_names, {name})"
    return f"values.{name} = {read};"


def _in_cpp(value: str | int | list[Any]) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value).strip("[]")


if __name__ == "__main__":
    template, header = map(Path, sys.argv[1:])
    header.write_text(schema_header(template.read_text("utf-8")), "utf-8")
