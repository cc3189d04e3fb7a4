"""An application as a recording shows it: its graph, its services, and how complete both are."""

from dataclasses import dataclass

import polars as pl

from chainshaper.analysis.matching import latest_before
from chainshaper.analysis.objects import named_nodes
from chainshaper.values import events
from chainshaper.values.application import ApplicationGraph

__all__ = ["ApplicationDescription", "services"]


@dataclass(frozen=True)
class ApplicationDescription:
    """Everything that a picture of an application shows.

    ``services`` is the frame of :func:`services`; ``lost`` and ``notes`` are what a reader must
    know about how complete it is.
    """

    graph: ApplicationGraph
    services: pl.DataFrame
    lost: dict[str, int]
    notes: tuple[str, ...]


def services(tables: events.EventTables) -> pl.DataFrame:
    """All services: ``service, role, node, pid``, one row per server and client."""
    nodes = named_nodes(tables).rename({"handle": "node_handle", "valid_from": "created"})
    found = []
    for role, name in (("server", "rcl_service_init"), ("client", "rcl_client_init")):
        ends = events.table(tables, name).select(
            "time", "pid", "node_handle", service="service_name", role=pl.lit(role)
        )
        joined = latest_before(ends, nodes, ["pid", "node_handle"], "time", "created")
        found.append(joined.select("service", "role", "node", "pid"))
    return pl.concat(found).unique().sort("service", "role", "node", "pid")
