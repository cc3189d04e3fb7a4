"""Text of others made safe to show: names in a trace, of processes, hosts, topics, files.

Control characters rewrite a terminal or answer in the user's place; others turn the direction of
reading around, are not seen, or end an XML file. All of these are shown as Python writes them
(``\\x1b``). Whatever shows text passes it through here, all of it and last; JSON escapes by itself.
"""

import html
import re

__all__ = ["escape", "shown"]

_UNSAFE = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # control characters: with ESC and CSI begin all sequences of terminals
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # bidirectional marks, overrides, isolates
    "\u2028\u2029"  # separators of lines and paragraphs
    "\u200b\u2060-\u2064\ufeff\ufff9-\ufffb\U000e0000-\U000e007f"  # not seen
    "\ud800-\udfff\ufffe\uffff]"  # no characters: lone surrogates are bytes that are no UTF-8
)


def shown(text: str, but: str = "") -> str:
    """The text with every character escaped that does more than be seen, ``but`` these."""
    return _UNSAFE.sub(lambda found: found[0] if found[0] in but else ascii(found[0])[1:-1], text)


def escape(text: str) -> str:
    """The same for HTML and SVG, in elements and attributes; lines stay lines."""
    return html.escape(shown(text, but="\n"))
