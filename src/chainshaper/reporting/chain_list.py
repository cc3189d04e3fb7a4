"""The chains that were found, as a table and as plain data."""

from typing import Any

from rich.table import Table

from chainshaper.analysis import ChainEnumeration
from chainshaper.reporting.cells import terminal_table
from chainshaper.values.application import ApplicationGraph, Chain
from chainshaper.values.durations import milliseconds

__all__ = ["chain_table", "chains_json", "count_text"]


def chains_json(graph: ApplicationGraph, found: ChainEnumeration) -> dict[str, Any]:
    """``count`` chains (a lower bound unless ``exact``), those listed, and the heaviest."""
    heaviest = None
    if found.heaviest is not None:
        heaviest = {**_chain(graph, found.heaviest), "response_ns": found.heaviest_ns}
    return {
        "count": found.count,
        "exact": found.exact,
        "complete": found.complete,
        "heaviest": heaviest,
        "chains": [_chain(graph, chain) for chain in found.chains],
    }


def _chain(graph: ApplicationGraph, chain: Chain) -> dict[str, Any]:
    callbacks = {callback.id: callback for callback in graph.callbacks}
    path = [callbacks[number] for number in chain.callbacks]
    return {
        "chain": chain.spec,
        "nodes": [callback.node for callback in path],
        "callbacks": [callback.label for callback in path],
        "topics": list(chain.topics),
    }


def count_text(found: ChainEnumeration) -> str:
    """How many chains there are, and how many of them are listed."""
    count = f"{found.count:,} chains" if found.exact else f"at least {found.count:,} chains"
    return count if found.complete else f"{count}, {len(found.chains)} of them listed"


def chain_table(graph: ApplicationGraph, found: ChainEnumeration) -> Table:
    """One row per chain: where it starts, which topics it passes; the heaviest is marked."""
    heaviest = "heaviest [ms]"
    table = terminal_table("Computation chains", ("starts at", "topics"), [heaviest])
    shown = list(found.chains)
    if found.heaviest is not None and found.heaviest not in shown:
        shown.append(found.heaviest)
    for chain in shown:
        weight = found.heaviest_ns if chain == found.heaviest else None
        row = _chain(graph, chain)
        table.add_row(
            row["callbacks"][0],
            " → ".join(row["topics"]),
            "" if weight is None else milliseconds(weight),
        )
    return table
