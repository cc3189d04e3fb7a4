"""Which chains of a plan have slots that can follow their latencies, and how far."""

from chainshaper.flow.server_tables import server_table
from chainshaper.planning.chain_plan import Adaptation, revised
from chainshaper.planning.offsets import chain_name
from chainshaper.planning.overruns import why_not_followed
from chainshaper.planning.plan import Plan, open_until_done, reach, with_slots_moved
from chainshaper.values.errors import InputError


def followed_chains(
    plan: Plan, back_end: str, max_latency_ns: int | None = None
) -> tuple[Plan, dict[int, tuple[int, int]], list[str]]:
    """Find the chains whose slots can follow their latencies under a back end.

    Returns the plan, with ``max_latency_ns`` in it; how far the slots of each such chain may be
    moved (ns, earlier and later), by its place; and why the other chains' slots stay. Raises
    InputError: all stay.
    """
    chains, reaches, why_not = list(plan.chains), dict[int, tuple[int, int]](), list[str]()
    for place, chain in enumerate(plan.chains):
        rules = chain.adaptation or Adaptation()
        if max_latency_ns is not None:
            rules = rules.model_copy(update={"max_latency_ns": max_latency_ns})
        try:
            reach_ns = _reach(plan, place, rules, back_end, reaches)
        except InputError as error:
            why_not.append(f"slots of {chain_name(chain)} cannot follow its latencies: {error}")
        else:
            chains[place] = revised(chain, adaptation=rules)
            reaches[place] = reach_ns
    if not reaches:
        raise InputError("; ".join(why_not))
    return Plan.of(*chains), reaches, why_not


def _reach(
    plan: Plan,
    place: int,
    rules: Adaptation,
    back_end: str,
    reaches: dict[int, tuple[int, int]],
) -> tuple[int, int]:
    """Return how far the slots of a chain may be moved (ns).

    ``reaches`` has the chains whose slots follow already. Raises InputError: they cannot be moved.
    """
    chain = plan.chains[place]
    if (reason := why_not_followed(chain)) is not None:
        raise InputError(reason)
    following = {
        server.name: plan.chains[followed]
        for followed in reaches
        for server in plan.chains[followed].servers
    }
    for server in chain.servers:
        if server.name in following:
            sharing = chain_name(following[server.name])
            raise InputError(f"its server {server.name} is also that of {sharing}, which follows")
    reach_ns = reach(plan, place, rules.max_latency_ns)
    furthest = [with_slots_moved(plan, {place: moved_ns}) for moved_ns in reach_ns]
    tables = {server_table(open_until_done(moved)) for moved in (plan, *furthest)}
    if len(tables) > 1 and back_end not in ("freezer", "fifo"):
        remedy = "choose freezer, or `shaping_thread: free`"
        raise InputError(f"the back end {back_end} does not move slots: {remedy}")
    return reach_ns
