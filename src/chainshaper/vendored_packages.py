"""The packages that an installation for ROS 2 has inside, where no other program finds them.

The ROS package and the Debian package bring what distributions lack or have too old (`ros/`): it is
in the folder `vendored` of this package. Our own processes find it before the system's; the
process of `ros2`, which loads parts of us, does not. Installed by pip there is no such folder.
"""

import sys
from os.path import dirname, isdir, join  # `pathlib` takes longer to import than all of this

CALLED = "CHAINSHAPER_CALLED"  # environment variable: what help calls the command
FOLDER = join(dirname(__file__), "vendored")  # noqa: PTH118, PTH120


def has_vendored() -> bool:
    """Return whether this installation brings packages."""
    return isdir(FOLDER)  # noqa: PTH112


def use_vendored() -> None:
    """Have this process find the packages, before those of the system."""
    if has_vendored() and FOLDER not in sys.path:
        sys.path.insert(0, FOLDER)
