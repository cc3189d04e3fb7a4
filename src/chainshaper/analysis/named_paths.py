"""CARET's ``named_paths``: chains as its architecture files write them.

Upstream: tier4/caret_analyze, `architecture.yaml`. Only the paths are read; nodes, executors and
variable passings of that file are CARET's, ours come from the recording.
"""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import PlainData, compose, read_text

__all__ = ["load_named_paths"]

UNDEFINED = {None, "UNDEFINED"}


class _PathNode(BaseModel):
    model_config = ConfigDict(frozen=True)

    node_name: str
    publish_topic_name: str | None = None


class _NamedPath(BaseModel):
    model_config = ConfigDict(frozen=True)

    path_name: str
    node_chain: tuple[_PathNode, ...] = Field(min_length=1)


class _Architecture(BaseModel):
    model_config = ConfigDict(frozen=True)

    named_paths: tuple[_NamedPath, ...]


def load_named_paths(file: str | Path) -> dict[str, str]:
    """The named paths of a CARET architecture file: path name → chain as we write it.

    Each node of a path becomes a way point together with the topic it publishes. A last node
    that publishes nothing ends the chain with the topic it subscribes to, which is what the node
    before it publishes.

    Raises:
        InputError: not readable, not YAML, no ``named_paths``, a path without nodes.
    """
    path = Path(file)
    root = compose(read_text(path, "CARET's architecture file"), path)
    plain = PlainData(path, ours=False)
    try:
        architecture = _Architecture.model_validate(None if root is None else plain.of(root))
    except ValidationError as error:
        raise InputError(
            f"{plain.problems(error, _Architecture)}; chains are read from the `named_paths` of a"
            " CARET architecture file, each with its `path_name` and `node_chain`"
        ) from error
    return {path.path_name: _chain(path) for path in architecture.named_paths}


def _chain(path: _NamedPath) -> str:
    waypoints: list[str] = []
    for place, node in enumerate(path.node_chain):
        if node.publish_topic_name not in UNDEFINED:
            waypoints += [node.node_name, str(node.publish_topic_name)]
        elif place < len(path.node_chain) - 1:
            waypoints.append(node.node_name)
    return "..".join(waypoints)
