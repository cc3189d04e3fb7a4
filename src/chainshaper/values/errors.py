"""Errors with their exit codes, and how text of others is shown safely.

Every message names the thing (file, line, topic, thread), the reason and the remedy.

Text of others (traces, names of hosts, topics, files) may have characters that rewrite a terminal,
answer in the user's place, reverse the direction of reading, are invisible, or end an XML file.
Such characters are shown as Python writes them (``\\x1b``). All text passes through :func:`shown`
or :func:`escape` as the last step before people see it; JSON escapes by itself.

Names that the kernel gives (of programs, files, mount points, cgroups, arguments) are bytes, and
need not be UTF-8. Names by which something is opened again are kept exactly (`os.fsdecode`); those
that are only shown or stored go through :func:`text_of`, so that they are Unicode.
"""

import html
import importlib
import re
from typing import Any

from chainshaper.vendored_packages import has_vendored


class ChainshaperError(Exception):
    """A failure that chainshaper expects to happen; its message says all that a person needs."""

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
    """Import a library, or a module of it, that only some uses need.

    ``extra`` is the extra of chainshaper that installs it; None: none does. Raises PlatformError:
    it is not installed, with the ``purpose`` that needs it and how to get it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        wanted = package if extra is None else f"'chainshaper[{extra}]'"
        lacks = f"{purpose} needs the Python package {package} ({error})"
        raise PlatformError(f"{lacks}: {installing(wanted)}") from error


def installing(wanted: str) -> str:
    """Return how packages are added to this installation, as pip names them."""
    if has_vendored():
        return (
            "the package for ROS 2 or Debian does not bring it: install chainshaper with pip, into"
            f" a virtual environment, and there {wanted}"
        )
    return f"install it with `pip install {wanted}`"


_UNSAFE = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # control characters: with ESC and CSI begin all sequences of terminals
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # bidirectional marks, overrides, isolates
    "\u2028\u2029"  # separators of lines and paragraphs
    "\u200b\u2060-\u2064\ufeff\ufff9-\ufffb\U000e0000-\U000e007f"  # not seen
    "\ud800-\udfff\ufffe\uffff]"  # no characters: lone surrogates are bytes that are no UTF-8
)


_NO_CHARACTER = re.compile("[\ud800-\udfff]")


def shown(text: str, but: str = "") -> str:
    """Escape every character that does more than be seen, ``but`` these."""
    return _UNSAFE.sub(lambda match: match[0] if match[0] in but else _escaped(match[0]), text)


def _escaped(character: str) -> str:
    """Return a character as Python writes it; a byte that is no UTF-8 as ``\\xfc``."""
    byte = ord(character) - 0xDC00  # as `os.fsdecode` keeps a byte that is no UTF-8
    return f"\\x{byte:02x}" if 0x80 <= byte <= 0xFF else ascii(character)[1:-1]


def text_of(content: bytes) -> str:
    """Make text of bytes, to be shown or stored; what is no UTF-8 is escaped (``\\xfc``)."""
    return content.decode(errors="backslashreplace")


def storable(value: Any) -> Any:
    """Escape in plain data, as :func:`text_of` does, what no file in UTF-8 can hold.

    That may be in arguments and paths that `os.fsdecode` made, and in JSON of others.
    """
    if isinstance(value, str):
        return _NO_CHARACTER.sub(lambda match: _escaped(match[0]), value)
    if isinstance(value, dict):
        return {storable(key): storable(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [storable(entry) for entry in value]
    return value


def escape(text: str) -> str:
    """Escape text for elements and attributes of HTML and SVG; line feeds stay."""
    return html.escape(shown(text, but="\n"))
