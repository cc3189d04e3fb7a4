"""Libraries of ours in front of ROS 2: where they are, and the variables that put them there."""

import os
import re
from pathlib import Path

from chainshaper import _core
from chainshaper.values.errors import PlatformError

VARIABLE = "CHAINSHAPER_TRACE"
"""The variable that names the socket on which the tracing library sends its memory."""


def native_library(name: str) -> Path:
    """Return a library that was built or installed beside `chainshaper._core`."""
    return Path(_core.__file__).with_name(name)


def installed_library() -> Path:
    """Return the library that traces from the front of ROS 2."""
    return native_library("libchainshaper_trace.so")


def preloading(library: Path) -> str:
    """Return `LD_PRELOAD` with the library in front of what it names already.

    Raises PlatformError: the variable cannot name the library.
    """
    path = str(library)
    if re.search(r"[\s:]", path):
        raise PlatformError(
            f"{path!r} has a space or a colon in it, so LD_PRELOAD cannot name it: install"
            " chainshaper in a folder whose path has neither"
        )
    named = os.environ.get("LD_PRELOAD", "").split(":")
    return ":".join([path, *(before for before in named if before not in ("", path))])


SANITIZER, ANY_ORDER = "ASAN_OPTIONS", "verify_asan_link_order=0"
"""A node built with AddressSanitizer refuses to start behind any library in `LD_PRELOAD`, unless
this variable tells it not to look at the order of libraries. The last word of it counts."""


def in_front(library: Path) -> dict[str, str]:
    """Return the variables that put a library in front of ROS 2 in all that is started with them.

    Raises PlatformError: as :func:`preloading`.
    """
    options = filter(None, [os.environ.get(SANITIZER, ""), ANY_ORDER])
    return {"LD_PRELOAD": preloading(library), SANITIZER: ":".join(options)}
