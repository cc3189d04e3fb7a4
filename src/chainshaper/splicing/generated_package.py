"""ROS 2 packages with a shaping node: one for all types, and one generated for a single type.

The generic package is shipped as it is. The typed one is the paper's (section 4.2): from the type
of the chain's output, ``pkg/msg/Type``, follow the package to link to, the header to include and
the class to declare, and with them `CMakeLists.txt`, `package.xml` and a header are filled in. Both
contain the same gate.
"""

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from chainshaper.analysis.chains import close_names
from chainshaper.values.errors import InputError, OperationError, PlatformError

__all__ = [
    "GENERIC_PACKAGE",
    "MessageType",
    "build_package",
    "check_build_tools",
    "generic_package",
    "message_type_named",
    "typed_package",
]

GENERIC_PACKAGE = "chainshaper_shaping"
_NODES = Path(__file__).parent / "nodes"
_TYPE = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")


@dataclass(frozen=True)
class MessageType:
    """A message type, such as ``sensor_msgs/msg/PointCloud2``."""

    package: str
    name: str

    @property
    def full_name(self) -> str:
        """As `ros2 topic type` prints it."""
        return f"{self.package}/msg/{self.name}"

    @property
    def snake_name(self) -> str:
        """As rosidl names the header: ``point_cloud2``.

        Upstream: `convert_camel_case_to_lower_case_underscore` of rosidl_pycommon.
        """
        words = re.sub(r"(.)([A-Z][a-z]+)", r"\1_\2", self.name)
        return re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", words).lower()

    @property
    def node_package(self) -> str:
        """The name of the package that is generated for this type."""
        return f"shaping_{self.package}_{self.snake_name}"


def message_type_named(text: str) -> MessageType:
    """The message type of this name.

    With a ROS 2 environment it must be installed there (``AMENT_PREFIX_PATH``); without one it
    only has to look like a type.

    Raises:
        InputError: it is no type's name, or not installed.
    """
    match = _TYPE.fullmatch(text)
    if match is None:
        raise InputError(
            f"{text!r} is not a message type: write PACKAGE/msg/TYPE, such as "
            "sensor_msgs/msg/PointCloud2, as `ros2 topic type TOPIC` prints it"
        )
    package, name = match.groups()
    prefixes = [
        Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if prefix
    ]
    if not prefixes:
        return MessageType(package, name)
    folders = [prefix / "share" / package / "msg" for prefix in prefixes]
    installed = sorted({path.stem for folder in folders for path in folder.glob("*.msg")})
    if not installed:
        raise InputError(
            f"{text}: no package {package} with messages in this ROS 2 environment: source the "
            "workspace that has it, or correct the name"
        )
    if name not in installed:
        near = ", ".join(close_names(name, installed)) or ", ".join(installed[:5])
        raise InputError(
            f"{text}: the package {package} has no message {name}: did you mean {near}?"
        )
    return MessageType(package, name)


def generic_package() -> dict[str, str]:
    """The files of the package for all types: paths inside it, and their text."""
    respawning = (_NODES / "python" / "respawning.py").read_text(encoding="utf-8")
    return {**_files_of(_NODES / "cpp"), "scripts/respawning": respawning}


def typed_package(message_type: MessageType) -> dict[str, str]:
    """The files of the package generated for one type: paths inside it, and their text."""
    parts = ("include/", "scripts/")
    shared = {path: text for path, text in generic_package().items() if path.startswith(parts)}
    # The modes of the system are named by a std_msgs/String.
    messages = sorted({"std_msgs", message_type.package})
    values = {
        "PROJECT": message_type.node_package,
        "TYPE": message_type.full_name,
        "HEADER": f"{message_type.package}/msg/{message_type.snake_name}.hpp",
        "CLASS": f"{message_type.package}::msg::{message_type.name}",
        "GUARD": f"{message_type.node_package.upper()}__MESSAGE_HPP_",
        "FIND_MESSAGES": "\n".join(f"find_package({name} REQUIRED)" for name in messages),
        "MESSAGE_TARGETS": " ".join(f"${{{name}_TARGETS}}" for name in messages),
        "DEPENDS": "\n".join(f"  <depend>{name}</depend>" for name in messages),
    }
    templates = _files_of(_NODES / "typed")
    return {
        **shared,
        "CMakeLists.txt": _filled(templates["CMakeLists.txt.in"], values),
        "package.xml": _filled(templates["package.xml.in"], values),
        "include/message.hpp": _filled(templates["message.hpp.in"], values),
        "src/shaping_node.cpp": templates["shaping_node.cpp"],
    }


def check_build_tools() -> None:
    """See that a package can be built, before anything is done for it.

    Raises:
        PlatformError: colcon, CMake, a compiler or the ROS 2 environment is missing.
    """
    compiler = os.environ.get("CXX", "c++").split()[0]
    for program, package in (
        ("colcon", "python3-colcon-common-extensions"),
        ("cmake", "cmake"),
        (compiler, "g++"),
    ):
        if shutil.which(program) is None:
            raise PlatformError(
                f"{program}, which building the shaping node needs, is not on the PATH: install it "
                f"(`apt install {package}`), or choose `--node python`, which needs no building"
            )
    if not os.environ.get("AMENT_PREFIX_PATH"):
        raise PlatformError(
            "building the shaping node needs a ROS 2 environment, and none is sourced: "
            "`source /opt/ros/DISTRIBUTION/setup.bash` first, or choose `--node python`"
        )


def build_package(folder: Path) -> Path:
    """Build the packages in a folder with colcon, into ``build`` and ``install`` beside them.

    Returns the file to source before the launch, ``install/setup.bash``.

    Raises:
        PlatformError: see :func:`check_build_tools`.
        OperationError: the build failed; the end of what it said is in the message.
    """
    check_build_tools()
    build = subprocess.run(
        ["colcon", "--log-base", "log", "build", "--base-paths", ".", "--merge-install"],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if build.returncode:
        end = "\n".join(build.stdout.splitlines()[-20:])
        raise OperationError(
            f"{folder}: `colcon build` failed with exit code {build.returncode}; all it said is in "
            f"{folder / 'log' / 'latest_build'}. It ended with:\n{end}"
        )
    return folder / "install" / "setup.bash"


def _files_of(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): path.read_text(encoding="utf-8")
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _filled(template: str, values: dict[str, str]) -> str:
    for name, value in values.items():
        template = template.replace(f"@{name}@", value)
    return template
