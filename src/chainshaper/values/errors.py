"""What people are shown: what went wrong, with the exit code it ends in, and text of others.

Every message names the thing (file, line, topic, thread), the reason and the remedy.

Characters in text of others (traces, names of hosts, topics, files) rewrite a terminal, answer in
the user's place, turn the direction of reading around, are not seen, or end an XML file. They are
shown as Python writes them (``\\x1b``). Whatever shows text passes it through here, all of it and
last; JSON escapes by itself.

Names that the kernel gives (of programs, files, mount points, cgroups, arguments) are bytes, and
need not be UTF-8. What is opened again keeps them exactly (`os.fsdecode`); what is only shown or
stored is :func:`text_of` them, which is Unicode always.
"""

import html
import importlib
import re
from typing import Any


class ChainshaperError(Exception):
    """Any failure that chainshaper foresaw; its message is complete for a person."""

    exit_code = 1


class OperationError(ChainshaperError):
    """The operation failed although the request was valid: a node died, the disk is full."""


class InputError(ChainshaperError):
    """The request is wrong: an unknown topic, a mistake in a YAML file, an impossible value."""

    exit_code = 2


class PlatformError(ChainshaperError):
    """This machine cannot do it: a missing core, a missing privilege, no CycloneDDS wheel."""

    exit_code = 3


def extra_library(name: str, purpose: str, extra: str | None = None) -> Any:
    """Import a library, or one module of it, that only some uses need and an ``extra`` installs.

    Raises PlatformError: it is not installed; says what it is needed for and how to get it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        wanted = package if extra is None else f"'chainshaper[{extra}]'"
        what = f"{purpose} needs the Python package {package} ({error})"
        raise PlatformError(f"{what}: install it with `pip install {wanted}`") from error


_UNSAFE = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # control characters: with ESC and CSI begin all sequences of terminals
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # bidirectional marks, overrides, isolates
    "\u2028\u2029"  # separators of lines and paragraphs
    "\u200b\u2060-\u2064\ufeff\ufff9-\ufffb\U000e0000-\U000e007f"  # not seen
    "\ud800-\udfff\ufffe\uffff]"  # no characters: lone surrogates are bytes that are no UTF-8
)


_NO_CHARACTER = re.compile("[\ud800-\udfff]")


def shown(text: str, but: str = "") -> str:
    """The text with every character escaped that does more than be seen, ``but`` these."""
    return _UNSAFE.sub(lambda found: found[0] if found[0] in but else _escaped(found[0]), text)


def _escaped(character: str) -> str:
    byte = ord(character) - 0xDC00  # as `os.fsdecode` keeps a byte that is no UTF-8
    return f"\\x{byte:02x}" if 0x80 <= byte <= 0xFF else ascii(character)[1:-1]


def text_of(content: bytes) -> str:
    """Bytes of others as text, to be shown or stored: what is no UTF-8 is escaped (``\\xfc``)."""
    return content.decode(errors="backslashreplace")


def storable(value: Any) -> Any:
    """Plain data with every text escaped that no file in UTF-8 can hold, as :func:`text_of` has it:
    arguments and paths that `os.fsdecode` made, names in JSON of others.
    """
    if isinstance(value, str):
        return _NO_CHARACTER.sub(lambda found: _escaped(found[0]), value)
    if isinstance(value, dict):
        return {storable(key): storable(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [storable(entry) for entry in value]
    return value


def escape(text: str) -> str:
    """The same for HTML and SVG, in elements and attributes; lines stay lines."""
    return html.escape(shown(text, but="\n"))
