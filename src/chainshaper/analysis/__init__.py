"""Events → application graph, callback instances, end-to-end latencies, statistics.

    tables ─► objects ─► messages ─► flow ─► graph ─► chains
                                       └──► traversals ─► disturbance ─► latency

Nothing here knows where the events came from: LTTng, eBPF, the live workload and the simulator
write the same tables (:mod:`chainshaper.values.events`). :func:`analyse_latency` does all of it for
one chain; every step is a function of its own.
"""

from chainshaper.analysis.caret_paths import load_named_paths as load_named_paths
from chainshaper.analysis.chains import ChainEnumeration as ChainEnumeration
from chainshaper.analysis.chains import SeveralPathsError as SeveralPathsError
from chainshaper.analysis.chains import enumerate_chains as enumerate_chains
from chainshaper.analysis.chains import find_chain as find_chain
from chainshaper.analysis.disturbance import disturbed as disturbed
from chainshaper.analysis.flow import DataFlow as DataFlow
from chainshaper.analysis.flow import callback_instances as callback_instances
from chainshaper.analysis.flow import data_flow as data_flow
from chainshaper.analysis.flow import recorded_flow as recorded_flow
from chainshaper.analysis.graph import application_graph as application_graph
from chainshaper.analysis.graph import graph_of as graph_of
from chainshaper.analysis.latency import LatencyAnalysis as LatencyAnalysis
from chainshaper.analysis.latency import analyse_latency as analyse_latency
from chainshaper.analysis.latency import callback_statistics as callback_statistics
from chainshaper.analysis.latency import executors as executors
from chainshaper.analysis.objects import resolve_objects as resolve_objects
from chainshaper.analysis.statistics import LatencyStatistics as LatencyStatistics
from chainshaper.analysis.statistics import latency_statistics as latency_statistics
from chainshaper.analysis.traversals import REASONS as REASONS
from chainshaper.analysis.traversals import traverse as traverse
