"""The profile of a chain across several hosts: how long it takes at most, nothing of its nodes.

Its servers would be of several computers, each with cores and a clock of its own; planning these is
not done yet. So the profile has what a plan from bare latencies has, of the upper ends of the
intervals in which the latencies lie.
"""

import numpy as np

from chainshaper.analysis import DataFlow, analyse_latency
from chainshaper.analysis.chains import find_chain
from chainshaper.analysis.contradictions import refuse_contradicted
from chainshaper.analysis.graph import graph_of
from chainshaper.analysis.host_clocks import hosts_of_chain
from chainshaper.flow.recorded_profile.chain_profile import complete_cycles, period_of
from chainshaper.flow.recorded_profile.loops import before_loop
from chainshaper.planning import Modes, Profile
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording


def profile_across_hosts(
    recording: Recording, flow: DataFlow, spec: str, period_ns: int | None, modes: Modes | None
) -> Profile:
    """Return the profile of a chain in a recording of several hosts.

    Raises InputError: it runs on one of them only, goes through a loop, or modes are asked for; or
    its period is not known. OperationError: it has fewer than two complete traversals.
    """
    chain = find_chain(graph_of(flow), spec)
    names = [host.name for host in recording.info.hosts]
    hosts = tuple(names[number] for number in hosts_of_chain(flow, chain.callbacks))
    if len(hosts) == 1:
        raise InputError(
            f"{recording.path}: {chain.spec} runs on {hosts[0]} only: plan it from that host's own"
            " recording, which says on which cores"
        )
    if modes is not None:
        raise InputError(f"{chain.spec} goes over {', '.join(hosts)}: plan it without modes")
    _, reading = before_loop(flow, chain)
    if reading is not None:
        raise InputError(
            f"{chain.spec} goes over {', '.join(hosts)} and through a loop, which is not planned"
            " across hosts yet: name the chain up to the topic that the loop reads"
        )
    refuse_contradicted(flow.contradictions, chain.callbacks, recording.path)
    analysis = analyse_latency(flow, chain)
    cycles = complete_cycles(recording, analysis)
    return Profile(
        latencies_ns=cycles.measured["latency_high_ns"].to_numpy().astype(np.int64),
        every_latency_ns=cycles.every["latency_high_ns"].to_numpy().astype(np.int64),
        period_ns=period_of(analysis, period_ns),
        spec=chain.spec,
        recording=str(recording.path),
        hosts=hosts,
        incomplete=analysis.statistics.incomplete - analysis.incomplete.get("not used", 0),
        disturbed=int(cycles.every["disturbed"].sum()),
        realtime=recording.info.realtime,
        lost_events=sum(recording.info.lost.values()) or None,
        all_disturbed=cycles.all_disturbed or None,
    )
