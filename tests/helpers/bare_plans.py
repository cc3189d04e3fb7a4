"""Plans of servers alone, for what asks nothing else of them; and slots as people read them."""

from typing import Any

from chainshaper.planning.chain_plan import (
    ChainOfPlan,
    ChainPlan,
    Evidence,
    Margin,
    Prediction,
    Server,
)

MS = 1_000_000


def bare_plan(
    spec: str | None, cycle_ns: int, *servers: Server, output: str | None = None, **fields: Any
) -> ChainPlan:
    """A plan that shapes nothing, unless ``fields`` say so."""
    return ChainPlan(
        chain=ChainOfPlan(spec=spec, output=output, period_ns=cycle_ns),
        evidence=Evidence(samples=1000, min_latency_ns=0, mean_latency_ns=1, max_latency_ns=1),
        margin=Margin(epsilon_ns=0),
        cycle_ns=cycle_ns,
        servers=servers,
        predicted=Prediction(mean_ns=1, max_ns=1, jitter_ns=0),
        **{"policy": "server-per-chain", **fields},
    )


def slots_ms(plan: ChainPlan) -> dict[str, list[tuple[float, float]]]:
    """The slots of each server, in ms."""
    return {
        server.name: [(start / MS, end / MS) for start, end in server.slots]
        for server in plan.servers
    }
