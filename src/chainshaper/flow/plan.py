"""From recordings to profiles of their chains (:mod:`.recorded_profile`), and to a plan."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from chainshaper.analysis import DataFlow, LatencyAnalysis, analyse_latency, recorded_flow
from chainshaper.analysis.chains import find_chain
from chainshaper.analysis.contradictions import refuse_contradicted
from chainshaper.analysis.data_age import LoopReading
from chainshaper.analysis.graph import graph_of
from chainshaper.flow.recorded_profile.across_hosts import profile_across_hosts
from chainshaper.flow.recorded_profile.chain_profile import profile_of
from chainshaper.flow.recorded_profile.loops import before_loop, recorded_loop
from chainshaper.flow.recorded_profile.modes import modes_in_force
from chainshaper.flow.recorded_profile.stages import Stage, graph_stages
from chainshaper.planning import Modes, Plan, PlanRequest, Profile, plan_chain
from chainshaper.planning.latencies import read_latencies
from chainshaper.planning.request import with_keywords
from chainshaper.values import events
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import chain_of, opened

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from chainshaper.planning.request import RequestKeywords

_STANDARD = PlanRequest()


def profile_chains(
    recording: Recording | str | Path,
    chains: Sequence[str | None] = (None,),
    *,
    period_ns: int | None = None,
    modes: Modes | None = None,
    mode_recordings: Mapping[str, str | Path] = MappingProxyType({}),
    since_ns: int = 0,
    until_ns: int | None = None,
) -> tuple[Profile, ...]:
    """Return what the planner needs of recorded chains (:func:`chainshaper.planning.plan_chain`).

    ``period_ns`` is for chains that no timer starts; None stands for the chain that the recording
    names, or the only one in it. All times but ``every_latency_ns`` are over cycles that the
    machine did not disturb (of fewer than two: over all). Of ``modes``, each has a profile of its
    own: of its recording or file of latencies in ``mode_recordings``, or of the cycles that began
    in it, by the description of what ran. What happened before ``since_ns`` or from ``until_ns`` on
    is left out.

    Of a chain across several hosts only the upper ends of its latencies are profiled.

    Of a chain that goes through a loop, what comes before the last one is profiled, with what was
    measured of that loop.

    Raises InputError: no such chain or mode, or a chain's period is not known, or known and given
    as well. OperationError: fewer than two complete traversals of a chain, or in a mode.
    """
    recording = opened(recording)
    all_events = recording.events
    begun, _ = events.first_and_last_start(all_events)
    if since_ns or until_ns is not None:
        until = None if until_ns is None else begun + until_ns
        recording = replace(recording, events=events.happened(all_events, begun + since_ns, until))
    flow = recorded_flow(recording)
    if recording.info.hosts:
        specs = [chain_of(recording, chain, flow) for chain in chains]
        return tuple(
            profile_across_hosts(recording, flow, spec, period_ns, modes) for spec in specs
        )
    measured = [_measured(flow, chain_of(recording, chain, flow)) for chain in chains]
    analyses = [of_chain.analysis for of_chain in measured]
    stages = [graph_stages(analysis.graph, analysis.chain) for analysis in analyses]
    planned = {number for of_chain in stages for stage in of_chain for number in stage.members}
    chained = {number for analysis in analyses for number in analysis.chain.callbacks}
    refuse_contradicted(flow.contradictions, planned | chained, recording.path)

    def profiled(analysis: LatencyAnalysis, stages_of_chain: Sequence[Stage]) -> Profile:
        return profile_of(
            recording,
            flow,
            analysis,
            stages=stages_of_chain,
            begun_ns=begun,
            period_ns=period_ns,
            planned=planned,
        )

    profiles = [
        _with_loop(profiled(of_chain.analysis, of_graph), recording, flow, of_chain)
        for of_chain, of_graph in zip(measured, stages, strict=True)
    ]
    if modes is None:
        return tuple(profiles)
    if unknown := ", ".join(mode_recordings.keys() - modes.bands.keys()):
        raise InputError(f"{unknown}: none of the modes {', '.join(modes.bands)}: correct it")
    # Announcements are counted from the first one on, also where that is left out.
    announced = recorded_flow(replace(recording, events=all_events)) if since_ns else flow
    for place, analysis in enumerate(analyses):
        of_modes: dict[str, Profile] = {}
        for mode, source in mode_recordings.items():
            if Path(source).is_file():
                latencies = read_latencies(Path(source))
                period = profiles[place].period_ns
                of_modes[mode] = Profile(latencies, period, recording=str(source))
            else:
                (of_modes[mode],) = profile_chains(
                    source,
                    chains[place : place + 1],
                    period_ns=period_ns,
                    since_ns=since_ns,
                    until_ns=until_ns,
                )
        in_force = modes_in_force(recording, announced, analysis.traversals["start"], modes)
        if of_modes or in_force.count():
            for mode in modes.bands.keys() - of_modes:
                within = analysis.traversals.filter(in_force == mode)
                with _naming_mode(mode):
                    of_modes[mode] = profiled(replace(analysis, traversals=within), stages[place])
        profiles[place] = replace(profiles[place], of_modes=of_modes)
    return tuple(profiles)


class _Measured(NamedTuple):
    """A chain before its last loop; that loop, and the chain through it (None: it has no loop)."""

    analysis: LatencyAnalysis
    reading: LoopReading | None
    through: LatencyAnalysis | None


def _measured(flow: DataFlow, spec: str) -> _Measured:
    """Return the analysis of a chain. Raises InputError: as :func:`profile_chains`."""
    chain = find_chain(graph_of(flow), spec)
    before, reading = before_loop(flow, chain)
    through = None if reading is None else analyse_latency(flow, chain)
    return _Measured(analyse_latency(flow, before), reading, through)


def _with_loop(
    profile: Profile, recording: Recording, flow: DataFlow, measured: _Measured
) -> Profile:
    """Return a profile with what was measured of the loop that reads the output, if any."""
    if measured.reading is None or measured.through is None:
        return profile
    loop = recorded_loop(recording, flow, measured.through, measured.reading, profile.period_ns)
    return replace(profile, loop=loop)


@contextmanager
def _naming_mode(mode: str) -> Iterator[None]:
    """Name the mode in an error that says that a profile cannot be made, and another remedy."""
    try:
        yield
    except OperationError as error:
        remedy = f"or give the mode's own profile (--mode-profile {mode}=REC)"
        raise OperationError(f"mode {mode}: {error}; {remedy}") from error


def plan_recording(
    recording: Recording | str | Path,
    chain: str | None = None,
    request: PlanRequest = _STANDARD,
    *,
    period_ns: int | None = None,
    sinks: Sequence[str] = (),
    **wishes: "Unpack[RequestKeywords]",
) -> Plan:
    """Plan a recorded chain: single-band shaping (eq. 1, 4) unless ``request`` says otherwise.

    ``wishes`` are fields of the request, such as ``bands=3``, in place of those in ``request``.
    ``sinks`` are chains to further outputs of the same graph. Raises: as :func:`profile_chains`
    and :func:`~chainshaper.planning.plan_chain`.
    """
    if not isinstance(chain, str | None):
        raise InputError("one chain goes here: profile several, and plan with `plan_application`")
    request = with_keywords(request, wishes)
    wanted = (chain, *sinks)
    profile, *further = profile_chains(recording, wanted, period_ns=period_ns, modes=request.modes)
    return Plan.of(plan_chain(profile, request, further))
