"""What the process of a live node gets before it runs, and what it answers.

The launcher sends each as a line of JSON (:mod:`chainshaper.workload.launcher`); the process reads
it back as the same validated model.
"""

from chainshaper.values.yaml_file import FullName, Part
from chainshaper.workload.description import NodeDescription, TopicDescription


class Counterparts(Part):
    """How many publishers and subscriptions all nodes together have of one topic."""

    publishers: int
    subscriptions: int


class NodeSetup(Part):
    """A node as its process builds it: its part of the application's description, and its place in
    the run.
    """

    name: str  # full
    node: NodeDescription
    topics: dict[FullName, TopicDescription]  # all that any node publishes
    announced: frozenset[str]  # topics that carry the names of modes
    counterparts: dict[FullName, Counterparts]  # by topic: discovery is complete with them
    domain: int  # DDS domain id
    discovery_ns: int  # how long discovery may take
    seed: int  # of execution times
    parent: int  # pid of the launcher, with which the process ends
    origin_phase_ns: int  # where cycles begin behind the start, for gates that do not say
    delivery_core: int | None  # of DDS threads, if they are real-time and have a core of their own
