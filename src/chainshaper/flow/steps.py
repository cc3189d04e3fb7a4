"""The steps of the flow as functions: from recordings to a plan, and a run shaped by it.

Each joins two rooms of the library (analysis and planning, splicing and workload), so that none
of them needs to know the other. Each verb of the command line is one call of a function here or
in a room.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from chainshaper.analysis import analyse_latency, data_flow
from chainshaper.flow.profiles import profile_of
from chainshaper.planning import Plan, PlanRequest, Profile, plan_chain
from chainshaper.planning.overruns import refuse_offset
from chainshaper.planning.plan import publisher_servers
from chainshaper.sources import open_source
from chainshaper.splicing.application import splice_application
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import chain_of, longest_stall
from chainshaper.workload.description import Application
from chainshaper.workload.live import Enforcement, Progress, origin_timer, run_application

__all__ = [
    "plan_recording",
    "profile_chains",
    "shape_application",
]

_STANDARD = PlanRequest()


def profile_chains(
    recording: Recording | str | Path,
    chains: Sequence[str | None] = (None,),
    *,
    period_ns: int | None = None,
) -> tuple[Profile, ...]:
    """What the planner needs of recorded chains: see :func:`chainshaper.planning.plan_chain`.

    Period, cores and priorities are those of the recording; ``period_ns`` is for chains that no
    timer starts. None stands for the chain that the recording names.

    Raises:
        InputError: no such chain, or no period.
        OperationError: a chain with fewer than two complete undisturbed traversals.
    """
    if not isinstance(recording, Recording):
        recording = open_source(recording)
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    stall = longest_stall(recording)
    return tuple(
        profile_of(
            recording,
            flow,
            analyse_latency(flow, chain_of(recording, chain)),
            period_ns=period_ns,
            longest_stall_ns=stall,
        )
        for chain in chains
    )


def plan_recording(
    recording: Recording | str | Path,
    chain: str | None = None,
    request: PlanRequest = _STANDARD,
    *,
    period_ns: int | None = None,
    sinks: Sequence[str] = (),
) -> Plan:
    """Plan a recorded chain: single-band shaping (eq. 1, 4) unless ``request`` says otherwise.

    L̄ is the maximum over the cycles that the machine did not disturb: a stall of the machine is
    not part of the chain's latency. ``sinks`` are chains to further outputs of the same graph.

    Raises: as :func:`profile_chains` and :func:`chainshaper.planning.plan_chain`.
    """
    profile, *further = profile_chains(recording, (chain, *sinks), period_ns=period_ns)
    return plan_chain(profile, request, further)


def shape_application(
    application: Application,
    plan: Plan,
    output: str | Path,
    *,
    cycles: int = 320,
    realtime: bool | None = None,
    enforcement: Enforcement | None = None,
    command: Sequence[str] = (),
    progress: Progress = lambda *_: None,
) -> Recording:
    """Splice the plan's shaping node into an application, run it and record it.

    ``enforcement`` puts the plan's servers in force while it runs. A shaping node does without;
    the thread of an asynchronous publisher is gated unless ``enforcement`` does so
    (:func:`chainshaper.flow.apply.publishers_gated`).

    Raises:
        InputError: the plan does not fit the application, or has an offset; and what
            :func:`~chainshaper.workload.live.run_application` raises.
        PlatformError: the plan gates a publisher's thread, and threads cannot be frozen here.
    """
    refuse_offset(plan)
    if any(publisher_servers(plan)) and enforcement is None:
        from chainshaper.flow.apply import publishers_gated

        enforcement = partial(publishers_gated, plan)
    period = origin_timer(application).timer_ns
    if period != plan.chain.period_ns:
        raise InputError(
            f"the plan is for a chain with the period {format_duration(plan.chain.period_ns)}, but "
            f"{application.chain} of {application.name!r} has {format_duration(period or 0)}: plan "
            "again from a recording of this application"
        )
    return run_application(
        splice_application(application, plan),
        output,
        cycles=cycles,
        realtime=realtime,
        plan=plan.model_dump(mode="json"),
        enforcement=enforcement,
        command=command,
        progress=progress,
    )
