"""The application graph as plain data and as a table.

What every node has for itself (parameter services, /rosout, /parameter_events) says nothing about
an application and is left out of tables and pictures unless asked for; in JSON it is marked.
"""

import re
from dataclasses import replace
from typing import Any

from chainshaper.analysis.graph import ApplicationDescription
from chainshaper.reporting.tables import Column, ResultTable, words
from chainshaper.values.application import INTERNAL_TOPICS, Callback
from chainshaper.values.durations import format_duration

__all__ = [
    "application_json",
    "application_table",
    "is_internal",
    "short_symbol",
    "without_internals",
]

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
