"""What the process of a live node gets before it runs.

The launcher sends it as a line of JSON (:mod:`chainshaper.workload.launcher`), which the process
reads back as the same validated model.
"""

from chainshaper.control.plant_file import LoopFile
from chainshaper.values.yaml_file import FullName, Part
from chainshaper.workload.description import NodeDescription, TopicDescription


class Counterparts(Part):
    """How many publishers and subscriptions of a topic all nodes have together."""

    publishers: int
    subscriptions: int


class NodeSetup(Part):
    """A node's part of the application's description, and its place in the run."""

    name: str  # full
    node: NodeDescription
    topics: dict[FullName, TopicDescription]  # all that any node publishes
    announced: frozenset[str]  # topics that carry the names of modes
    counterparts: dict[FullName, Counterparts]  # by topic: discovery is complete with them
    domain: int  # DDS domain id
    discovery_ns: int  # how long discovery may take
    seed: int  # of execution times
    parent: int  # pid of the launcher, with which the process ends
    starts_chain: bool  # whether its timer or loop does
    origin_phase_ns: int  # where cycles begin behind the start, for gates that do not say
    control_loop: LoopFile | None  # where its callbacks have a part in it
    loop_period_ns: int  # of the control loop; 0: the application has none
    carried: int  # bytes of the control loop's numbers in each message
    delivery_core: int | None  # of DDS threads, if they are real-time and have a core of their own
