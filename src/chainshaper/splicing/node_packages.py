"""Packages of shaping nodes in C++: their files, and building them with colcon."""

import os
import re
import shutil
import subprocess
from pathlib import Path

from chainshaper.robot.schema_header import schema_header
from chainshaper.sources.preload import native_library
from chainshaper.splicing.message_types import MessageType, ros_prefixes
from chainshaper.splicing.python_node import NODES, RESPAWNING
from chainshaper.values.errors import OperationError, PlatformError, text_of
from chainshaper.values.licence import package_values, with_licence

GENERIC_PACKAGE = "chainshaper_shaping"
_CORE = native_library("core")  # the headers that the library was built from


def cpp_package(shaped: MessageType | None = None, *, component: bool = False) -> dict[str, str]:
    """Return the text of the package's files by their paths in it, for one type or for all."""
    # The modes of the system are a std_msgs/String.
    messages = sorted({"std_msgs"} if shaped is None else {"std_msgs", shaped.package})
    depends = [*messages, "rclcpp_components"] if component else messages
    values = {
        **package_values(),
        "PROJECT": GENERIC_PACKAGE,
        "FOR": "topics of any type",
        "NODES": "shaping_node throttler",
        "COMPONENT": str(component).upper(),
        "FIND_MESSAGES": "\n".join(f"find_package({name} REQUIRED)" for name in messages),
        "MESSAGE_TARGETS": " ".join(f"${{{name}_TARGETS}}" for name in messages),
        "DEPENDS": "\n".join(f"  <depend>{name}</depend>" for name in depends),
    }
    left_out = "include/message.hpp"
    if shaped is not None:
        left_out = "src/throttler.cpp"
        values |= {
            "PROJECT": shaped.node_package,
            "FOR": shaped.full_name,
            "NODES": "" if component else "shaping_node",
            "TYPE": shaped.full_name,
            "HEADER": f"{shaped.package}/msg/{shaped.snake_name}.hpp",
            "CLASS": f"{shaped.package}::msg::{shaped.name}",
        }
    files = {"scripts/respawning": RESPAWNING.read_text(encoding="utf-8")}
    for path in sorted((NODES / "cpp").rglob("*.*")):
        text = path.read_text(encoding="utf-8")
        if path.name == "schema.hpp.in":
            text = schema_header(text)
        elif path.suffix == ".in":
            text = re.sub("@([A-Z_]+)@", lambda place: values.get(place[1], place[0]), text)
        files[str(path.relative_to(NODES / "cpp")).removesuffix(".in")] = text
    for path in sorted((_CORE / "gate").glob("*.hpp")):
        files[f"include/gate/{path.name}"] = path.read_text(encoding="utf-8")
    del files[left_out]
    return with_licence(files)


def missing_build_tool() -> tuple[str, str] | None:
    """Return what building a node in C++ lacks here, and the remedy; None: nothing."""
    compiler = os.environ.get("CXX", "c++").split()[0]
    packages = {"colcon": "python3-colcon-common-extensions", "cmake": "cmake", compiler: "g++"}
    for program, package in packages.items():
        if shutil.which(program) is None:
            missing = f"{program}, which building the shaping node needs, is not on the PATH"
            return missing, f"install it (`apt install {package}`)"
    if not (prefixes := ros_prefixes()):
        missing = "building the shaping node needs a ROS 2 environment, and none is sourced"
        return missing, "`source /opt/ros/DISTRIBUTION/setup.bash` first"
    if not any((prefix / "share/rclcpp").is_dir() for prefix in prefixes):
        missing = "the ROS 2 environment that is sourced has no rclcpp"
        return missing, "install it (`apt install ros-$ROS_DISTRO-rclcpp`)"
    return None


def check_build_tools() -> None:
    """Raise PlatformError if colcon, CMake, a compiler or the ROS 2 environment is missing."""
    if (lacks := missing_build_tool()) is not None:
        missing, remedy = lacks
        raise PlatformError(
            f"{missing}: {remedy}, or choose `--node python`, which needs no building"
        )


SETUP = Path("install", "setup.bash")  # in the folder where packages are built: what to source


def build_package(folder: Path) -> Path:
    """Build the packages in a folder with colcon; return the file to source.

    Raises PlatformError: see :func:`check_build_tools`. OperationError: the build failed.
    """
    check_build_tools()
    build = subprocess.run(
        [
            *("colcon", "--log-base", "log", "build", "--base-paths", ".", "--merge-install"),
            *("--cmake-args", "-DBUILD_TESTING=OFF"),
        ],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
    )
    if build.returncode:
        end = "\n".join(text_of(build.stdout).splitlines()[-20:])
        raise OperationError(
            f"{folder}: `colcon build` failed with exit code {build.returncode}; all it said is in "
            f"{folder / 'log' / 'latest_build'}. Correct that, or choose"
            f" `--node python`, which needs no building. It ended with:\n{end}"
        )
    return folder / SETUP
