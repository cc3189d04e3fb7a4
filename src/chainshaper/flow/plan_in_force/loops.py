"""Loops that are kept in step with outputs while a plan is in force."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

from chainshaper.enforcement.node_threads import Allocation
from chainshaper.flow.in_step import InStep, LoopStarts, find_loop, loops_in_step
from chainshaper.flow.plan_in_force.anchor import AnchoredPlan
from chainshaper.flow.plan_in_force.report import RunReport
from chainshaper.flow.polled_loop import PolledLoop
from chainshaper.flow.server_tables import server_table
from chainshaper.linux.scheduling import available_cores
from chainshaper.planning.chain_plan import ChainPlan, PlannedLoop
from chainshaper.planning.loops import with_output_alone_at
from chainshaper.planning.offsets import chain_name
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import OperationError


@dataclass
class LoopsInStep:
    """The loops of a run that are kept in step, by the places of their chains in the plan."""

    running: dict[int, InStep] = field(default_factory=dict)
    threads: Allocation = field(default_factory=lambda: Allocation((), ()))  # at the latest look

    def start(self, anchored: AnchoredPlan, allocation: Allocation) -> None:
        """Begin to keep the plan's loops in step.

        Raises OperationError: a gate is not there, or it is in a server whose slots do not move.
        """
        cores = set(available_cores()) - {server.core for server in anchored.plan.servers}
        pids = [listed.thread.pid for listed in allocation.threads]
        self.threads = allocation
        for place, chain, loop in loops_in_step(anchored.given):
            _refuse_closed(anchored, chain)
            self.running[place] = InStep(
                chain,
                pids,
                partial(self.find, loop),
                partial(in_force_from, anchored, place),
                begins_early=lambda: anchored.opens_early,
                cores=cores,
            )

    def find(self, loop: PlannedLoop) -> LoopStarts | None:
        """Look for a loop among the threads of the latest look.

        Where no library is in front of it, its wake-ups are counted from outside, and it cannot be
        moved.
        """
        of_node = [listed for listed in self.threads.threads if loop.node in listed.nodes]
        for pid in sorted({listed.thread.pid for listed in of_node}):
            if (mover := find_loop(pid, loop)) is not None:
                return mover
        if loop.in_step == "loop" or loop.thread is None or loop.period_ns is None:
            return None
        named = [listed.thread for listed in of_node if listed.thread.comm == loop.thread]
        return PolledLoop(named[0].pid, named[0].tid, loop.period_ns) if len(named) == 1 else None

    def show(self, report: RunReport, allocation: Allocation) -> None:
        """Show what was moved; end what has failed, and note why. ``allocation``: as by now."""
        self.threads = allocation
        steps = [step for kept in self.running.values() for step in kept.steps]
        report.show_steps(sorted(steps, key=lambda step: step.at_ns))
        for place, kept in tuple(self.running.items()):
            named = kept.state.name
            if kept.failure is not None:
                del self.running[place]
                kept.end()
                report.note(f"{named} are not in step any more: {kept.failure}")
            else:
                report.replace_notes(f"{named} are not in step", *_missing(kept))

    def end(self) -> None:
        """Slots and loops go back to where the plan, and the loops themselves, have them."""
        for kept in self.running.values():
            kept.end()


def in_force_from(anchored: AnchoredPlan, place: int, _moved_ns: int) -> int:
    """Return from when on a chain's gate has its slots elsewhere: in the middle of a cycle (ns)."""
    with anchored.lock:
        cycle_ns = anchored.plan.chains[place].cycle_ns
        since = time.monotonic_ns() + 2 * cycle_ns
        return since + (anchored.begins(place) - since) % cycle_ns - cycle_ns // 2


def _refuse_closed(anchored: AnchoredPlan, chain: ChainPlan) -> None:
    """Refuse to move a gate's slots where the back end keeps its thread in those of the plan.

    Raises OperationError.
    """
    if chain.loop is None or chain.loop.starts_ns is None or not anchored.gated:
        return
    moved = Plan.of(with_output_alone_at(chain, chain.loop.starts_ns[1]))
    if server_table(moved) != server_table(Plan.of(chain)):
        raise OperationError(
            f"the back end {anchored.back_end} keeps the shaping node of {chain_name(chain)} in its"
            " planned slot, which has to move with the loop: plan with --shaping-thread free"
        )


def _missing(kept: InStep) -> Sequence[str]:
    """Say what is missing for both to be in step, if something is."""
    state = kept.state
    if state.in_step:
        return ()
    if not state.is_there:
        return (
            f"{state.text}; start it beneath the library in front: `chainshaper watch -- COMMAND`",
        )
    return (state.text,)
