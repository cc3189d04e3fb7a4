"""What carrying out a plan would change of the threads of a running application."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

from chainshaper.enforcement.back_ends import choose_back_end
from chainshaper.enforcement.litmus import litmus_commands
from chainshaper.enforcement.planned_threads import server_members
from chainshaper.enforcement.thread_scheduling import (
    WantedScheduling,
    left_by_back_end,
    left_reservations,
    plan_scheduling,
    waiting_receivers,
)
from chainshaper.flow.anchoring import carried_out
from chainshaper.flow.plan_checks import (
    refuse_other_clocks,
    refuse_simulated,
    refuse_unfit,
)
from chainshaper.flow.server_tables import server_table
from chainshaper.flow.threads import find_threads
from chainshaper.linux.scheduling import available_cores
from chainshaper.planning.plan import Plan, open_until_done
from chainshaper.values.errors import OperationError

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording  # slow to import


@dataclass(frozen=True)
class Changes:
    """What a plan would change: threads, or with the commands of LITMUS^RT's tools."""

    back_end: str
    reason: str  # why this back end
    threads: tuple[WantedScheduling, ...]
    commands: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]


def planned_changes(
    plan: Plan,
    back_end: str = "auto",
    *,
    recording: "Recording | None" = None,
    phase_ns: int | None = None,
    users: Collection[str | int] = (),
) -> Changes:
    """Return what :func:`.apply_plan` would do, with the same errors.

    The commands of LITMUS^RT are returned on any kernel.
    """
    unopened, plan = plan, open_until_done(plan)
    table = server_table(plan)
    allocation = find_threads(plan, recording, users=users)
    if back_end != "litmus":
        choice = choose_back_end(back_end)
        refuse_unfit(plan, choice.name)
        refuse_simulated(plan, allocation)
        refuse_other_clocks(plan, allocation)
        wanted = plan_scheduling(plan, allocation, available_cores())
        threads = left_by_back_end(choice.name, wanted, plan.free_threads)
        notes = (
            *allocation.notes,
            *waiting_receivers(plan, threads),
            *left_reservations(threads),
        )
        return Changes(choice.name, choice.reason, threads, (), notes)
    notes, anchor_ns, members = allocation.notes, 0, dict[str, list[int | str]]()
    try:
        anchored = carried_out(unopened, allocation, phase_ns)
        anchor_ns = anchored.anchor_ns
        table = server_table(open_until_done(anchored.plan, anchored.waits_ns))
        for name, group in server_members(plan, allocation).items():
            members[name] = [member.thread.tid for member in group]
    except OperationError:
        members = {
            server.name: [f"TID:{thread.node}" for thread in server.threads]
            for server in plan.servers
        }
        notes += ("slots are counted from a beginning that is measured when the chain runs",)
    return Changes("litmus", "asked for", (), litmus_commands(table, members, anchor_ns), notes)
