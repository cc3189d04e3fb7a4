"""What can go wrong, and the exit code it ends the command line with.

Every message names the thing (file, line, topic, thread), the reason and the remedy. A caller has
three ways to react: correct the input, look at what failed, or change the machine.
"""

import importlib
from typing import Any

__all__ = ["ChainshaperError", "InputError", "OperationError", "PlatformError", "extra_library"]


class ChainshaperError(Exception):
    """Any failure that chainshaper foresaw; its message is complete for a person."""

    exit_code = 1


class OperationError(ChainshaperError):
    """The operation failed although the request was valid: a node died, the disk is full."""

    exit_code = 1


class InputError(ChainshaperError):
    """The request is wrong: an unknown topic, a mistake in a YAML file, an impossible value."""

    exit_code = 2


class PlatformError(ChainshaperError):
    """This machine cannot do it: a missing core, a missing privilege, no CycloneDDS wheel."""

    exit_code = 3


def extra_library(name: str, purpose: str) -> Any:
    """Import a library that only some uses need, or one module of it.

    Raises PlatformError: it is not installed; says what it is needed for and how to get it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise PlatformError(
            f"{purpose} needs the Python package {package} ({error}): install it with"
            f" `pip install {package}`"
        ) from error
