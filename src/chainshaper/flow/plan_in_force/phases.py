"""Shaping nodes get where cycles begin: asked for in the background, and looked after."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from chainshaper.enforcement.node_threads import Allocation
from chainshaper.flow.phase import Telling, tell_phase
from chainshaper.flow.plan_in_force.anchor import AnchoredPlan
from chainshaper.planning.chain_plan import shaping_nodes


@dataclass
class PhaseMessages:
    """What shaping nodes are being told of where cycles begin."""

    under_way: list[Telling] = field(default_factory=list)

    def send(
        self, anchored: AnchoredPlan, allocation: Allocation, moved_ns: Mapping[int, int]
    ) -> None:
        """Begin to give shaping nodes of these chains where cycles, moved by so much, begin."""
        for place, by_ns in moved_ns.items():
            chain = anchored.plan.chains[place]
            begins = (anchored.begins(place) + by_ns) % chain.cycle_ns
            self.under_way.append(tell_phase(shaping_nodes(chain), allocation, begins))

    def finished(self) -> list[str] | None:
        """What went wrong once all nodes know, or never will; None while some are being told."""
        if not all(telling.is_over() for telling in self.under_way):
            return None
        problems = [problem for telling in self.under_way for problem in telling.end()]
        self.under_way.clear()
        return problems

    def end(self) -> None:
        """Wait for no answers any more."""
        for telling in self.under_way:
            telling.end()
