"""Events → application graph, callback instances, end-to-end latencies, statistics.

    tables ─► objects ─► messages ─► flow ─► graph ─► chains
                                       └──► traversals ─► disturbance ─► latency

Nothing here knows where the events came from: LTTng, eBPF, the live workload and the simulator
write the same tables (:mod:`chainshaper.values.events`). :func:`analyse_latency` does all of it for
one chain; every step is a function of its own.
"""

from chainshaper.analysis.chains import (
    ChainEnumeration,
    SeveralPathsError,
    enumerate_chains,
    find_chain,
    load_named_paths,
)
from chainshaper.analysis.disturbance import disturbed
from chainshaper.analysis.flow import DataFlow, callback_instances, data_flow, with_restarts
from chainshaper.analysis.graph import application_graph, graph_of
from chainshaper.analysis.latency import (
    LatencyAnalysis,
    LatencyStatistics,
    analyse_latency,
    callback_statistics,
    executors,
    latency_statistics,
)
from chainshaper.analysis.objects import resolve_objects
from chainshaper.analysis.traversals import REASONS, traverse

__all__ = ["REASONS", "ChainEnumeration", "DataFlow", "LatencyAnalysis", "LatencyStatistics"]
__all__ += [
    "SeveralPathsError",
    "analyse_latency",
    "application_graph",
    "callback_instances",
    "callback_statistics",
]
__all__ += ["data_flow", "disturbed", "enumerate_chains", "executors", "find_chain", "graph_of"]
__all__ += ["latency_statistics", "load_named_paths", "resolve_objects", "traverse"]
__all__ += ["with_restarts"]
