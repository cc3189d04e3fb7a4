"""A description of a large application: hundreds of nodes in containers, chains over many cores.

It is made to try how everything does on a graph of that size without a robot of that size. Each
chain leads from a sensor's timer through perception and planning to a command, on one core. The
other nodes look at topics of the chains, or have timers, at lower priorities. Nodes of a core share
its containers in turn.
"""

import random
from collections.abc import Iterator
from typing import NamedTuple

from chainshaper.values.errors import InputError
from chainshaper.workload.description import (
    Application,
    CallbackDescription,
    ExecutionTime,
    NodeDescription,
    Scheduling,
    SchedulingOfApplication,
    TopicDescription,
)

STAGES = (
    ("sensing", "driver", "raw"),
    ("sensing", "filter", "filtered"),
    ("perception", "detection", "objects"),
    ("perception", "tracking", "tracks"),
    ("planning", "prediction", "predicted"),
    ("planning", "trajectory", "trajectory"),
    ("control", "follower", "followed"),
    ("control", "gate", "command"),
)
"""Of each stage of a chain: namespace, node, and the topic that it publishes."""

SENSORS = ("lidar", "camera", "radar", "imu", "gnss", "odometry")
SIDES = ("front", "rear", "left", "right")
PERIODS_NS = (50_000_000, 100_000_000, 100_000_000, 200_000_000)
CHAIN_PRIORITY, LOAD_PRIORITY, DDS_PRIORITY = 80, 20, 90
LOAD = 0.3
"""The share of a core that nodes outside chains take at most."""

_MOST_TAKES_NS = 2_000_000  # an instance of a chain's callback; a chain fits into half its period


class LargeApplication(NamedTuple):
    """An application, and its chains as ``FIRST..LAST``."""

    application: Application
    chains: tuple[str, ...]


def large_application(
    nodes: int = 300, containers: int = 20, chains: int = 12, cores: int = 8, seed: int = 1
) -> LargeApplication:
    """Describe an application of so many nodes, in ``containers``, with ``chains`` over ``cores``.

    Raises InputError: too few nodes for the chains, or fewer containers than cores, or none at all.
    """
    for name, number in (("chain", chains), ("core", cores)):
        if number < 1:
            raise InputError(f"{number} {name}s: ask for 1 at least")
    of_chains = chains * (len(STAGES) + 1)
    if nodes < of_chains:
        reason = f"{chains} chains of {len(STAGES)} nodes, each with an actuator, need {of_chains}"
        raise InputError(f"{nodes} nodes are too few: {reason}; ask for more nodes or fewer chains")
    if not cores <= containers <= nodes:
        reason = "each core has a container of its own at least, and each container a node"
        raise InputError(f"{containers} containers for {cores} cores and {nodes} nodes: {reason}")
    generator = random.Random(seed)  # noqa: S311 - a description, no secret
    names = [_sensor(number) for number in range(chains)]
    described: dict[str, NodeDescription] = {}
    used = [0] * cores  # nodes so far
    for number, sensor in enumerate(names):
        core = number % cores
        period_ns = PERIODS_NS[number % len(PERIODS_NS)]
        for name, callback in _chain(sensor, period_ns, generator):
            described[name] = _node(callback, core, CHAIN_PRIORITY, used, containers)
    topics = [f"/{space}/{sensor}/{topic}" for sensor in names for space, _, topic in STAGES]
    timers_per_core = -(-(nodes - of_chains) // (2 * cores))
    for number in range(nodes - of_chains):
        core = number % cores
        if number % 2:
            name = f"visualisation/view_{number}"
            callback = CallbackDescription(
                subscription=generator.choice(topics),
                execution=ExecutionTime(uniform_ns=(20_000, 100_000)),
            )
        else:
            name = f"system/monitor_{number}"
            period_ns = generator.choice(PERIODS_NS) * 5
            most_ns = round(LOAD * period_ns / (2 * timers_per_core))
            callback = CallbackDescription(
                timer_ns=period_ns,
                phase_ns=generator.randrange(0, period_ns, 1_000_000),
                execution=ExecutionTime(uniform_ns=(most_ns // 4, most_ns)),
                publishes=(f"/{name}/status",),
            )
        described[name] = _node(callback, core, LOAD_PRIORITY, used, containers)
    specs = tuple(f"/sensing/{sensor}/raw../control/{sensor}/command" for sensor in names)
    dds = Scheduling(core=0, priority=DDS_PRIORITY)
    application = Application(
        name=f"{nodes} nodes in {containers} containers",
        chain=specs[0],
        seed=seed,
        scheduling=SchedulingOfApplication(
            executors=Scheduling(core=0, priority=CHAIN_PRIORITY), dds=dds
        ),
        topics={topic: TopicDescription(payload=64) for topic in topics},
        nodes=described,
    )
    return LargeApplication(application, specs)


def _sensor(number: int) -> str:
    """Name a chain's sensor: ``lidar_front``, …, with a number behind it where names run out."""
    sensor = SENSORS[number % len(SENSORS)]
    turn, place = divmod(number // len(SENSORS), len(SIDES))
    return f"{sensor}_{SIDES[place]}" + (f"_{turn + 1}" if turn else "")


def _chain(
    sensor: str, period_ns: int, generator: random.Random
) -> Iterator[tuple[str, CallbackDescription]]:
    """Yield the nodes of a chain, by name, and what each does."""
    share_ns = min(_MOST_TAKES_NS, period_ns // (4 * len(STAGES)))
    before: str | None = None
    for space, node, topic in STAGES:
        most_ns = round(share_ns * generator.uniform(0.4, 1.0))
        yield (
            f"{space}/{sensor}/{node}",
            CallbackDescription(
                timer_ns=period_ns if before is None else None,
                subscription=before,
                execution=ExecutionTime(uniform_ns=(most_ns // 3, most_ns)),
                publishes=(f"/{space}/{sensor}/{topic}",),
            ),
        )
        before = f"/{space}/{sensor}/{topic}"
    takes = ExecutionTime(constant_ns=50_000)
    yield f"vehicle/{sensor}/actuator", CallbackDescription(subscription=before, execution=takes)


def _node(
    callback: CallbackDescription, core: int, priority: int, used: list[int], containers: int
) -> NodeDescription:
    """Describe a node on a core, in the next of the containers that this core has."""
    cores = len(used)
    of_core = range(core, containers, cores)
    container = of_core[used[core] % len(of_core)]
    used[core] += 1
    return NodeDescription(
        callbacks=(callback,), core=core, priority=priority, container=f"container_{container + 1}"
    )
