"""`ros2 launch … --shape plan.yaml`: a plan shapes the launch, whose files stay as they are.

`ros2 launch` takes options from the entry points ``ros2launch.option`` of all installed packages.
Upstream: launch_ros, `ros2launch/option/__init__.py`.
"""

import argparse
from typing import Any

__all__ = ["ShapeOption"]


class ShapeOption:
    """The options of `ros2 launch` that shape what is launched."""

    # Not derived from ros2launch's OptionExtension, which would be needed to import this file; it
    # adds nothing but a check for the version of the extension point, 0.1 in all distributions.
    NAME = "shape"
    EXTENSION_POINT_VERSION = "0.1"

    def add_arguments(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        """Add the options."""
        parser.add_argument(
            "--shape",
            metavar="PLAN",
            help="Shape the outputs of what is launched by this plan (chainshaper)",
        )
        parser.add_argument(
            "--shape-apply",
            metavar="BACKEND",
            help="With --shape: put the plan in force as well, until the launch ends: auto, or the "
            "name of a back end of `chainshaper apply`",
        )

    def prestart(self, args: argparse.Namespace) -> None:
        """Refuse options that make no sense, before anything is launched."""
        if args.shape_apply and not args.shape:
            raise RuntimeError("--shape-apply needs a plan: add --shape PLAN")

    def prelaunch(self, launch_description: Any, args: argparse.Namespace) -> tuple[Any]:
        """Return the launch with the plan's action before all else."""
        if not args.shape:
            return (launch_description,)
        from launch import LaunchDescription

        from chainshaper.launch_actions import Shape

        shape = Shape(plan=args.shape, apply=args.shape_apply)
        return (LaunchDescription([shape, *launch_description.entities]),)

    def postlaunch(self, launch_return_code: int, args: argparse.Namespace) -> None:
        """Leave all as it is: the shaping nodes end with the launch."""
