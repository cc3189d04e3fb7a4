"""`ros2 chain VERB …` is `chainshaper VERB …`, where ROS 2's command line finds this package.

`ros2` takes its commands from the entry points ``ros2cli.command`` of all installed packages, and
parses them with argparse. Everything behind `ros2 chain` is handed on as it is, so both command
lines are the same, help included. Upstream: ros2cli, `ros2cli/command/__init__.py`.
"""

import argparse
from typing import Any

from chainshaper.values.errors import PlatformError

__all__ = ["ChainCommand"]


class ChainCommand:
    """Constant end-to-end latency for computation chains (chainshaper)."""

    # Not derived from ros2cli's CommandExtension, which would be needed to import this file; it
    # adds nothing but a check for the version of the extension point, 0.1 in all distributions.
    NAME = "chain"
    EXTENSION_POINT_VERSION = "0.1"

    def add_arguments(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        """Leave all that follows `ros2 chain` to us."""
        parser.add_argument("arguments", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
        parser.print_help = lambda *_: _run(["--help"])  # type: ignore[assignment,method-assign]

    def main(self, *, args: argparse.Namespace, **_: Any) -> int:
        """Run the verb; return the exit code for `ros2`."""
        return _run(args.arguments or ["--help"])


def _run(arguments: list[str]) -> int:
    from chainshaper.cli import main
    from chainshaper.cli.output import say

    try:
        main(arguments, "ros2 chain")
    except ModuleNotFoundError as error:  # built with colcon, which installs no dependencies
        say(  # the last line of a failed command
            f"error: ros2 chain needs the Python package {error.name}: install it into a virtual "
            "environment that sees the system's packages, and start `python $(which ros2) chain` "
            "there (docs/install.md)"
        )
        return PlatformError.exit_code
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    return 0
