"""`schema.hpp`: what nodes in C++ share with those in Python, as a header in C++.

The package's build makes it (`core/CMakeLists.txt`) by `python -m chainshaper.robot.schema_header
TEMPLATE HEADER`, before any package is installed: so only the standard library is imported here.
"""

import re
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from chainshaper.robot import handover
from chainshaper.robot.gate_log import LOG_COLUMNS
from chainshaper.robot.node_parameters import NodeParameters

_CPP_TYPES = {
    int: "std::int64_t",
    str: "std::string",
    list[int]: "std::vector<std::int64_t>",
    list[str]: "std::vector<std::string>",
}


def schema_header(template: str) -> str:
    """The text of `schema.hpp`: the text of `schema.hpp.in` with its places filled in."""
    values = _values()
    return re.sub("@([A-Z_]+)@", lambda place: values[place[1]], template)


def constants(numbers: Mapping[str, int]) -> str:
    """Numbers as constants in C++, a line each."""
    return "\n".join(
        f"inline constexpr std::int64_t {name} = {value};" for name, value in numbers.items()
    )


def numbers_of(module: ModuleType) -> dict[str, int]:
    """The public constants of a module that are integers, by their names in C++."""
    return {
        name.lower(): value
        for name, value in vars(module).items()
        if name.isupper() and isinstance(value, int) and not name.startswith("_")
    }


def _values() -> dict[str, str]:
    """What stands in each place of the template."""
    numbers = numbers_of(handover) | {"log_columns": len(LOG_COLUMNS)}
    usual = vars(NodeParameters())
    types = {name: _CPP_TYPES[kind] for name, kind in NodeParameters.__annotations__.items()}
    return {
        "CONSTANTS": constants(numbers),
        "LOG_HEADER": '"\n    "'.join(f"{n}," for n in LOG_COLUMNS).removesuffix(","),
        "FIELDS": ", ".join(handover.FIELDS),
        "PARAMETERS": "\n  ".join(f"{types[n]} {n}{{{_in_cpp(usual[n])}}};" for n in types),
        "READS": "\n    ".join(f'read("{name}", {name});' for name in types),
    }


def _in_cpp(value: str | int | list[Any]) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value).strip("[]")


if __name__ == "__main__":
    made_from, made = map(Path, sys.argv[1:])
    made.write_text(schema_header(made_from.read_text("utf-8")), "utf-8")
