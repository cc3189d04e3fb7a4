"""The application graph as plain data, as a table and as DOT; pictures are written from here.

What every node has for itself (parameter services, /rosout, /parameter_events) says nothing about
an application and is left out of tables and pictures unless asked for; in JSON it is marked.
"""

import json
import os
import re
import tempfile
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from chainshaper.app import Callback
from chainshaper.durations import format_duration
from chainshaper.errors import InputError, OperationError
from chainshaper.exploration import ApplicationDescription, lost_text

__all__ = [
    "application_dot",
    "application_json",
    "application_table",
    "check_picture",
    "is_internal",
    "short_symbol",
    "write_picture",
]

_OWN_TOPICS = frozenset(("/rosout", "/parameter_events"))
_OWN_SERVICES = frozenset(
    (
        "describe_parameters",
        "get_parameter_types",
        "get_parameters",
        "get_type_description",
        "list_parameters",
        "set_parameters",
        "set_parameters_atomically",
    )
)


def is_internal(name: str | None) -> bool:
    """Whether a topic or service is one that every node has for itself."""
    return name is not None and (name in _OWN_TOPICS or name.rpartition("/")[2] in _OWN_SERVICES)


def application_json(application: ApplicationDescription) -> dict[str, Any]:
    """Nodes, callbacks, topics and services as plain data."""
    graph = application.graph
    offered: dict[str, dict[str, list[str]]] = {}
    for name, role, node, _ in application.services.iter_rows():
        ends = offered.setdefault(name, {"server": [], "client": []})
        ends[role].append(node or "")
    return {
        "nodes": [{"name": node.name, "pid": node.pid} for node in graph.nodes],
        "callbacks": [
            {
                "id": callback.id,
                "node": callback.node,
                "pid": callback.pid,
                "kind": callback.kind,
                "topic": callback.topic,
                "period_ns": callback.period_ns,
                "symbol": callback.symbol,
                "publishes": list(callback.publishes),
                "passes_on": list(callback.passes_on),
                "internal": is_internal(callback.topic),
            }
            for callback in graph.callbacks
        ],
        "topics": [
            {
                "name": topic,
                "publishers": list(graph.publishers.get(topic, ())),
                "subscribers": list(graph.subscribers.get(topic, ())),
                "internal": is_internal(topic),
            }
            for topic in graph.topics
        ],
        "services": [
            {
                "name": name,
                "servers": ends["server"],
                "clients": ends["client"],
                "internal": is_internal(name),
            }
            for name, ends in sorted(offered.items())
        ],
        "lost": application.lost,
        "notes": list(application.notes),
    }


def application_table(application: ApplicationDescription, *, everything: bool = False) -> Table:
    """One row per callback, by node."""
    table = Table(title="Application", title_justify="left")
    for name in ("node", "process", "callback", "publishes", "function"):
        table.add_column(name, overflow="fold", justify="right" if name == "process" else "left")
    graph = application.graph
    nodes = {(node.name, node.pid) for node in graph.nodes}
    shown = [c for c in graph.callbacks if everything or not is_internal(c.topic)]
    idle = nodes - {(callback.node, callback.pid) for callback in shown}
    rows: list[tuple[str, int, str, str, str]] = [(name, pid, "", "", "") for name, pid in idle]
    for callback in shown:
        publishes = [t for t in callback.publishes if everything or not is_internal(t)]
        function = short_symbol(callback.symbol)
        what = callback_text(callback)
        rows.append((callback.node, callback.pid, what, ", ".join(publishes), function))
    for node, pid, *rest in sorted(rows, key=lambda row: row[:2]):
        table.add_row(escape(node), str(pid), *map(escape, rest))
    return table


def callback_text(callback: Callback) -> str:
    """What triggers a callback, in few words."""
    if callback.kind == "timer":
        return f"timer {format_duration(callback.period_ns or 0)}"
    if callback.kind == "unknown":
        return "not known" if callback.handle else "outside callbacks"
    return f"{callback.kind} {callback.topic or ''}".rstrip()


_LAMBDA = re.compile(r"\{lambda\(.*?\)#(\d+)\}$")
_BIND = re.compile(r"std::_Bind<.*?\((\w[\w:]*)::\*")


def short_symbol(symbol: str | None) -> str:
    """The name of a registered function without its arguments: ``Filter λ1``."""
    if not symbol:
        return ""
    bound = _BIND.match(symbol)
    if bound is not None:
        return f"{bound[1]}::…"
    ending = _LAMBDA.search(symbol)
    text = _without_brackets(symbol[: ending.start()] if ending else symbol)
    text = re.sub(r"^(void|.* )(?=\S+$)", "", text).removesuffix("::")
    text = re.sub(r"(\w+)::\1$", r"\1", text)  # a constructor
    return f"{text} λ{ending[1]}" if ending else text


def _without_brackets(text: str) -> str:
    """The text outside all <…>, (…) and {…}."""
    depth, kept = 0, []
    for character in text:
        if character in "<({":
            depth += 1
        if depth == 0:
            kept.append(character)
        if character in ">)}":
            depth -= 1
    return "".join(kept)


def application_dot(application: ApplicationDescription, *, everything: bool = False) -> str:
    """The graph in the language of Graphviz: a cluster per node, ellipses for topics."""
    graph = application.graph
    lines = ["digraph application {", "  rankdir=LR;", "  node [fontname=Helvetica, fontsize=11];"]
    if any(application.lost.values()):
        lines.append(f"  label={_quoted(lost_text(application.lost))};")
    shown = [c for c in graph.callbacks if everything or not is_internal(c.topic)]
    number = {(node.name, node.pid): index for index, node in enumerate(graph.nodes)}
    for callback in shown:
        number.setdefault((callback.node, callback.pid), len(number))
    for (name, pid), index in number.items():
        lines.append(f"  subgraph cluster_{index} {{")
        lines.append(f"    label={_quoted(f'{name} (process {pid})')};")
        lines.append(f'    node_{index} [shape=point, style=invis, label=""];')
        for callback in shown:
            if (callback.node, callback.pid) == (name, pid):
                text = callback_text(callback) + "\n" + short_symbol(callback.symbol)
                label = _quoted(text.strip())
                lines.append(f"    callback_{callback.id} [shape=box, label={label}];")
        lines.append("  }")
    for topic in graph.topics:
        if everything or not is_internal(topic):
            lines.append(f"  {_quoted(topic)} [shape=ellipse];")
    for callback in shown:
        vertex = f"callback_{callback.id}"
        if callback.kind == "subscription" and callback.topic is not None:
            lines.append(f"  {_quoted(callback.topic)} -> {vertex};")
        elif callback.kind in {"service", "client"} and callback.topic is not None:
            lines.append(f"  {_quoted(callback.topic)} [shape=cds];")
            lines.append(f"  {_quoted(callback.topic)} -> {vertex};")
        for topic in callback.publishes:
            if everything or not is_internal(topic):
                style = " [style=dashed]" if topic in callback.passes_on else ""
                lines.append(f"  {vertex} -> {_quoted(topic)}{style};")
    return "\n".join([*lines, "}", ""])


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'


def check_picture(path: str | Path) -> Path:
    """The path, once it is sure that it can be written and what to write there.

    Raises:
        InputError: it exists, its folder does not, or its ending says no known format.
    """
    path = Path(path)
    if path.suffix not in {".svg", ".dot", ".json"}:
        raise InputError(f"{path}: write to a file that ends in .svg, .dot or .json")
    if path.exists():
        raise InputError(
            f"{path} exists already and is not overwritten: name another, or remove it"
        )
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path.absolute().parent}: no such folder to write {path.name} into")
    return path


def write_picture(
    application: ApplicationDescription, path: str | Path, *, everything: bool = False
) -> Path:
    """Write the graph as .svg, .dot or .json, by the ending of ``path``, whole or not at all.

    Raises:
        InputError: see :func:`check_picture`.
        OperationError: it cannot be written.
    """
    path = check_picture(path)
    if path.suffix == ".json":
        text = json.dumps(application_json(application), indent=2) + "\n"
    elif path.suffix == ".dot":
        text = application_dot(application, everything=everything)
    else:
        from chainshaper.reporting.graph_drawing import application_svg

        text = application_svg(application, everything=everything)
    partial: Path | None = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.absolute().parent)
        partial = Path(name)
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
        partial.chmod(0o644)
        partial.rename(path)
    except OSError as error:
        if partial is not None:
            partial.unlink(missing_ok=True)
        raise OperationError(f"{path}: the graph cannot be written: {error}") from error
    return path
