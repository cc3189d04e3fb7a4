"""The application graph as plain data, as a table and as DOT; pictures are written from here.

What every node has for itself (parameter services, /rosout, /parameter_events) says nothing about
an application and is left out of tables and pictures unless asked for; in JSON it is marked.
"""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from chainshaper.analysis.description import ApplicationDescription
from chainshaper.analysis.objects import INTERNAL_TOPICS
from chainshaper.reporting.tables import Column, ResultTable, words
from chainshaper.values.application import Callback
from chainshaper.values.durations import format_duration
from chainshaper.values.recording import lost_text
from chainshaper.values.safe_text import shown
from chainshaper.values.whole_file import new_file, write_whole

__all__ = [
    "ENDINGS",
    "application_dot",
    "application_json",
    "application_table",
    "is_internal",
    "short_symbol",
    "without_internals",
    "write_picture",
]

ENDINGS = (".svg", ".dot", ".json")
_CALLBACK_FIELDS = (
    *("id", "node", "pid", "kind", "topic", "period_ns", "symbol", "publishes", "passes_on"),
)
_OWN_TOPICS = INTERNAL_TOPICS - {"/clock"}
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


def without_internals(application: ApplicationDescription) -> ApplicationDescription:
    """The application without what every node has for itself."""
    graph = application.graph
    callbacks = [
        replace(one, publishes=tuple(t for t in one.publishes if not is_internal(t)))
        for one in graph.callbacks
        if not is_internal(one.topic)
    ]
    publishers = {t: nodes for t, nodes in graph.publishers.items() if not is_internal(t)}
    subscribers = {t: nodes for t, nodes in graph.subscribers.items() if not is_internal(t)}
    shown_graph = replace(
        graph, callbacks=tuple(callbacks), publishers=publishers, subscribers=subscribers
    )
    return replace(application, graph=shown_graph)


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
                **{name: getattr(callback, name) for name in _CALLBACK_FIELDS},
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


def application_table(application: ApplicationDescription) -> ResultTable:
    """One row per callback, by node."""
    names = [*words("node"), Column("process"), *words("callback", "publishes", "function")]
    table = ResultTable("Application", names)
    graph = application.graph
    nodes = {(node.name, node.pid) for node in graph.nodes}
    idle = nodes - {(callback.node, callback.pid) for callback in graph.callbacks}
    rows: list[tuple[str, int, str, str, str]] = [(name, pid, "", "", "") for name, pid in idle]
    for callback in graph.callbacks:
        publishes, function = ", ".join(callback.publishes), short_symbol(callback.symbol)
        rows.append((callback.node, callback.pid, callback_text(callback), publishes, function))
    for node, pid, *rest in sorted(rows, key=lambda row: row[:2]):
        table.add(node, str(pid), *rest)
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
    depth, outside = 0, []
    for character in text:
        if character in "<({":
            depth += 1
        if depth == 0:
            outside.append(character)
        if character in ">)}":
            depth -= 1
    return "".join(outside)


def application_dot(application: ApplicationDescription) -> str:
    """The graph in the language of Graphviz: a cluster per node, ellipses for topics."""
    graph = application.graph
    lines = ["digraph application {", "  rankdir=LR;", "  node [fontname=Helvetica, fontsize=11];"]
    if any(application.lost.values()):
        lines.append(f"  label={_quoted(lost_text(application.lost))};")
    number = {(node.name, node.pid): index for index, node in enumerate(graph.nodes)}
    for callback in graph.callbacks:
        number.setdefault((callback.node, callback.pid), len(number))
    for (name, pid), index in number.items():
        lines.append(f"  subgraph cluster_{index} {{")
        lines.append(f"    label={_quoted(f'{name} (process {pid})')};")
        lines.append(f'    node_{index} [shape=point, style=invis, label=""];')
        for callback in graph.callbacks:
            if (callback.node, callback.pid) == (name, pid):
                text = callback_text(callback) + "\n" + short_symbol(callback.symbol)
                label = _quoted(text.strip())
                lines.append(f"    callback_{callback.id} [shape=box, label={label}];")
        lines.append("  }")
    lines += [f"  {_quoted(topic)} [shape=ellipse];" for topic in graph.topics]
    for callback in graph.callbacks:
        vertex = f"callback_{callback.id}"
        if callback.kind == "subscription" and callback.topic is not None:
            lines.append(f"  {_quoted(callback.topic)} -> {vertex};")
        elif callback.kind in {"service", "client"} and callback.topic is not None:
            lines.append(f"  {_quoted(callback.topic)} [shape=cds];")
            lines.append(f"  {_quoted(callback.topic)} -> {vertex};")
        for topic in callback.publishes:
            style = " [style=dashed]" if topic in callback.passes_on else ""
            lines.append(f"  {vertex} -> {_quoted(topic)}{style};")
    return "\n".join([*lines, "}", ""])


def _quoted(text: str) -> str:
    escaped = shown(text, but="\n").replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'


def write_picture(
    application: ApplicationDescription, path: str | Path, *, everything: bool = False
) -> Path:
    """Write the graph as .svg, .dot or .json, by the ending of ``path``, whole or not at all.

    Raises:
        InputError: it exists, its folder does not, or its ending says no known format.
        OperationError: it cannot be written.
    """
    path = new_file(path, ENDINGS)
    drawn = application if everything else without_internals(application)
    if path.suffix == ".json":
        text = json.dumps(application_json(application), indent=2) + "\n"
    elif path.suffix == ".dot":
        text = application_dot(drawn)
    else:
        from chainshaper.reporting.graph_drawing import application_svg

        text = application_svg(drawn)
    return write_whole(path, [text.encode()])
