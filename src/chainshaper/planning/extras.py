"""Libraries that only some plans need: loaded when asked for, named when absent."""

import importlib
from typing import Any

from chainshaper.values.errors import PlatformError

__all__ = ["extra_library"]


def extra_library(name: str, purpose: str) -> Any:
    """Import a library, or one module of it.

    Raises:
        PlatformError: it is not installed; the message says what it is needed for and how to
            get it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise PlatformError(
            f"{purpose} needs the Python package {package} ({error}): install it with"
            f" `pip install {package}`"
        ) from error
