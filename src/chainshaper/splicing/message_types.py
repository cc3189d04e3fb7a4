"""Message types of ROS 2: their names, and what is installed of them in this environment."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

from chainshaper.values.close_names import close_names
from chainshaper.values.errors import InputError, text_of

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
        """As rosidl_pycommon's `convert_camel_case_to_lower_case_underscore`: ``point_cloud2``."""
        words = re.sub(r"(.)([A-Z][a-z]+)", r"\1_\2", self.name)
        return re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", words).lower()

    @property
    def node_package(self) -> str:
        """The name of the package that is generated for this type."""
        return f"shaping_{self.package}_{self.snake_name}"


def message_type_named(text: str) -> MessageType:
    """Return the message type of this name.

    Raises InputError: it is no type's name, or not installed where there is a ROS 2 environment.
    """
    match = _TYPE.fullmatch(text)
    if match is None:
        raise InputError(
            f"{text!r} is not a message type: write PACKAGE/msg/TYPE, such as "
            "sensor_msgs/msg/PointCloud2, as `ros2 topic type TOPIC` prints it"
        )
    package, name = match.groups()
    folders = _message_folders(package)
    installed = sorted({path.stem for folder in folders for path in folder.glob("*.msg")})
    if folders and not installed:
        raise InputError(
            f"{text}: no package {package} with messages in this ROS 2 environment: source the "
            "workspace that has it, or correct the name"
        )
    if folders and name not in installed:
        near = ", ".join(close_names(name, installed)) or ", ".join(installed[:5])
        raise InputError(
            f"{text}: the package {package} has no message {name}: did you mean {near}?"
        )
    return MessageType(package, name)


def has_bytes(message_type: str) -> bool:
    """Return whether a message type of the ROS 2 environment has a field ``uint8[]``."""
    package, _, name = message_type.partition("/msg/")
    definitions = (folder / f"{name}.msg" for folder in _message_folders(package))
    texts = (text_of(path.read_bytes()) for path in definitions if path.is_file())
    return re.search(r"^\s*(uint8|char)\[\]", next(texts, ""), re.MULTILINE) is not None


def headers_installed(message_type: str) -> bool | None:
    """Return whether the type can be compiled in this ROS 2 environment; None: there is none."""
    if not (prefixes := ros_prefixes()):
        return None
    package, _, name = message_type.partition("/msg/")
    header = f"msg/{MessageType(package, name).snake_name}.hpp"
    # From Humble on a package's headers are in a folder of their own below the common one.
    return any(
        (prefix / "include" / folder / header).is_file()
        for prefix in prefixes
        for folder in (package, f"{package}/{package}")
    )


def ros_prefixes() -> list[Path]:
    """Return the folders of the ROS 2 environment, the last sourced first."""
    words = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [Path(word) for word in words if word]


def _message_folders(package: str) -> list[Path]:
    return [prefix / "share" / package / "msg" for prefix in ros_prefixes()]
