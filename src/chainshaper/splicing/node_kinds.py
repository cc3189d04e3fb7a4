"""Which kind of shaping node is written for an output.

The user chooses ``auto``, ``python`` or ``cpp``; ``auto`` is C++ where it can be built. The kind in
C++ follows from the output. All kinds shape alike, with the same parameters and the same log.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal, TypeAlias

from chainshaper.planning.chain_plan import ChainPlan
from chainshaper.splicing.message_types import headers_installed
from chainshaper.splicing.node_packages import missing_build_tool
from chainshaper.values.plan_choices import NodeChoice, NodeLanguage

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording

NodeKind: TypeAlias = Literal["python", "generic", "typed", "component"]
"""How a shaping node is made:

* ``python``: one file, which needs no building.
* ``generic``: one package in C++ for all types; the node takes and publishes serialized messages.
* ``typed``: the paper's package (section 4.2), generated for the type of one output.
* ``component``: the typed node as a component, which the container of the output's publisher loads.
"""
OF_ONE_TYPE = ("typed", "component")


def language_of(choice: NodeChoice, *, builds: bool) -> tuple[NodeLanguage, str]:
    """Return the language of the shaping nodes, and the reason; "" where the user chose it.

    ``builds``: the command that writes the nodes also builds them.
    """
    if choice != "auto":
        return choice, ""
    if not builds:
        return "python", "it needs no building (--build: in C++, where it can be built)"
    if (missing := missing_build_tool()) is not None:
        return "python", f"a node in C++ cannot be built here: {missing[0]}"
    return "cpp", "this ROS 2 environment can build it"


def kind_of(
    language: NodeLanguage, message_type: str | None, *, within_container: bool
) -> tuple[NodeKind, str]:
    """Return the kind of shaping node for an output of this type, and the reason."""
    if language == "python":
        return "python", "in Python"
    if message_type is None:
        return "generic", "in C++ for all types, since the type of the output is not known"
    installed = headers_installed(message_type)  # None: no ROS 2 is sourced that could say
    if within_container and installed is not False:
        return "component", "a component in C++, since the container of the publisher can load it"
    if installed:
        return "typed", f"in C++ for {message_type}, whose headers are installed"
    return "generic", f"in C++ for all types, since no headers of {message_type} are installed here"


def passes_within_container(plan: ChainPlan, publisher: str, recording: "Recording | None") -> bool:
    """Return whether subscribers get the plan's output within the publisher's container.

    The evidence of the plan says whether they get it without DDS. The recording, if there is one,
    says whether the process is a container: it has a service to load components.
    """
    if not plan.evidence.intra_process:
        return False
    if recording is None:
        return True
    from chainshaper.values import events

    tables = recording.events
    nodes = events.table(tables, "rcl_node_init").select("pid", name=events.NODE_NAME)
    services = events.table(tables, "rcl_service_init")
    loading = services.filter(services["service_name"].str.ends_with("/_container/load_node"))
    pids = {pid for pid, name in nodes.iter_rows() if name == publisher}
    return not pids.isdisjoint(loading["pid"])


def copies_made(plan: ChainPlan, kind: NodeKind, *, within_container: bool) -> Iterator[str]:
    """Yield a line where a node of this kind needs copies of messages that are not made now."""
    if not plan.evidence.intra_process or kind == "component":
        return
    remedy = "no container of components loads its publisher"
    if within_container:
        remedy = "choose --node cpp"
        if kind != "python":
            remedy = "name the type of the output with --type, and source the workspace that has it"
    yield (
        f"{plan.chain.output}: subscribers in the process of {plan.chain.publisher} get its"
        " messages without a copy; with this shaping node each message is serialized and copied, to"
        f" the shaping node and back: {remedy}"
    )
