"""The named paths of CARET's architecture files, as chains."""

from pathlib import Path

from pydantic import BaseModel, Field, ValidationError

from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import PlainData, compose, read_text


class _PathNode(BaseModel):
    node_name: str
    publish_topic_name: str | None = None


class _NamedPath(BaseModel):
    path_name: str
    node_chain: tuple[_PathNode, ...] = Field(min_length=1)


class _Publishes(BaseModel):
    topic_name: str
    callback_name: str | None = None
    callback_names: tuple[str, ...] = ()


class _Callback(BaseModel):
    callback_name: str
    topic_name: str | None = None


class _Node(BaseModel):
    node_name: str
    callbacks: tuple[_Callback, ...] = ()
    publishes: tuple[_Publishes, ...] = ()


class _PathAlias(BaseModel):
    path_name: str
    callbacks: tuple[str, ...] = Field(min_length=1)


class _Architecture(BaseModel):
    named_paths: tuple[_NamedPath, ...]


class _ArchitectureOfGalactic(BaseModel):
    path_name_aliases: tuple[_PathAlias, ...]
    nodes: tuple[_Node, ...] = ()


def load_named_paths(file: str | Path) -> dict[str, str]:
    """Read the named paths of a CARET architecture file: path name → text of the chain.

    Each node of a path becomes a way point together with the topic it publishes. A last node that
    publishes nothing ends the chain with the topic it subscribes to. Galactic's files name the
    paths ``path_name_aliases``, as callbacks.

    Raises InputError: not readable, not YAML, no named paths, a path without nodes, or with
    callbacks that the file does not have.
    """
    path = Path(file)
    root = compose(read_text(path, "CARET's architecture file"), path)
    plain = PlainData(path, ours=False)
    values = None if root is None else plain.of(root)
    if isinstance(values, dict) and "named_paths" not in values and "path_name_aliases" in values:
        try:
            return _paths_of_callbacks(path, _ArchitectureOfGalactic.model_validate(values))
        except ValidationError as error:
            raise InputError(plain.problems(error, _ArchitectureOfGalactic)) from error
    try:
        architecture = _Architecture.model_validate(values)
    except ValidationError as error:
        raise InputError(
            f"{plain.problems(error, _Architecture)}; chains are read from the `named_paths` of a"
            " CARET architecture file, each with its `path_name` and `node_chain`"
        ) from error
    chains = {}
    for named in architecture.named_paths:
        points: list[str | None] = []
        for node in named.node_chain:
            topic = node.publish_topic_name
            points += [node.node_name, None if topic == "UNDEFINED" else topic]
        if points[-1] is None:
            points.pop(-2)
        chains[named.path_name] = "..".join(point for point in points if point is not None)
    return chains


def _paths_of_callbacks(file: Path, architecture: _ArchitectureOfGalactic) -> dict[str, str]:
    """Return the chains of paths that name their callbacks, as ``/node/subscription_callback_0``.

    A message leads from a callback to the next node's, so its topic is a way point. Between two
    callbacks of one node there is a variable: the node is the way point.
    """
    nodes = {node.node_name: node for node in architecture.nodes}
    chains = {}
    for alias in architecture.path_name_aliases:
        points: list[str] = []
        for number, unique_name in enumerate(alias.callbacks):
            node_name, _, callback_name = unique_name.rpartition("/")
            callbacks = nodes[node_name].callbacks if node_name in nodes else ()
            callback = next((c for c in callbacks if c.callback_name == callback_name), None)
            if callback is None:
                where = f"{file}: path {alias.path_name!r}"
                raise InputError(
                    f"{where} names the callback {unique_name}, which no node in it has: correct"
                    " one of the two"
                )
            if number and callback.topic_name is not None and node_name not in points:
                points.append(callback.topic_name)
            points.append(node_name)
        published = _published(nodes[points[-1]], alias.callbacks[-1].rpartition("/")[2])
        if published is not None:
            points.append(published)
        elif len(points) > 1 and not nodes[points[-1]].publishes:
            points.pop()
        chains[alias.path_name] = "..".join(dict.fromkeys(points))
    return chains


def _published(node: _Node, callback_name: str) -> str | None:
    """Return the topic that a callback publishes; None: the file does not say."""
    of_callback = [
        publication.topic_name
        for publication in node.publishes
        if callback_name in {publication.callback_name, *publication.callback_names}
    ]
    topics = of_callback or [publication.topic_name for publication in node.publishes]
    return topics[0] if len(topics) == 1 else None
