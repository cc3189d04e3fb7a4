"""Splicing the shaping node into a described application (paper, section 3.2.2, Design 2).

What the Republisher Editor does to a launch file is done here to the description of the live
workload: the publisher's output topic is remapped to ``…_tmp``, and a node that subscribes to
that topic and republishes on the original one is added. Subscribers notice nothing.
"""

from pydantic import ValidationError

from chainshaper.errors import InputError
from chainshaper.planning.plan import Plan, ShapingNode, publish_slots
from chainshaper.workload.description import (
    Application,
    CallbackDescription,
    GateDescription,
    NodeDescription,
)
from chainshaper.yaml_file import explanations, key_text

__all__ = ["splice_application"]


def splice_application(application: Application, plan: Plan) -> Application:
    """The application extended by the plan's shaping node; the given one is left as it is.

    Raises:
        InputError: the plan has no shaping node or does not fit the application.
    """
    shaping = plan.shaping_node
    if shaping is None:
        raise InputError(
            "the plan has no `shaping_node`, so there is nothing to splice: plan again with "
            "`chainshaper plan REC --chain FIRST..LAST -o plan.yaml`"
        )
    if plan.further_shaping_nodes:
        raise InputError(
            "the plan has `further_shaping_nodes`, but one can be spliced into a live workload: "
            "remove them from the plan"
        )
    if shaping.name in {name.strip("/") for name in application.nodes}:
        raise InputError(
            f"the application has a node {shaping.name!r} already, the name that the plan gives to "
            "the shaping node: change it in the plan"
        )
    publishers = [name for name, cb in application.callbacks() if shaping.output in cb.publishes]
    if len(publishers) != 1:
        raise InputError(
            f"the plan shapes {shaping.output}, which "
            f"{', '.join(publishers) or 'no node'} of the application publishes; exactly one node "
            "must"
        )
    if any(shaping.input in callback.publishes for _, callback in application.callbacks()):
        raise InputError(
            f"the application publishes {shaping.input} already, the name that the plan gives to "
            "the unshaped output: change `shaping_node.input` in the plan"
        )
    nodes = {
        name: _remapped(node, shaping.output, shaping.input) if name == publishers[0] else node
        for name, node in application.nodes.items()
    }
    nodes[shaping.name] = _described(plan, shaping)
    topics = dict(application.topics)
    if shaping.output in topics:
        topics[shaping.input] = topics[shaping.output]  # the same quality of service
    return application.model_copy(update={"nodes": nodes, "topics": topics})


def _described(plan: Plan, shaping: ShapingNode) -> NodeDescription:
    try:
        return NodeDescription(
            core=shaping.core,
            priority=shaping.fifo_priority,
            callbacks=(
                CallbackDescription(
                    subscription=shaping.input,
                    publishes=(shaping.output,),
                    gate=GateDescription(
                        slots=publish_slots(plan),
                        cycle_ns=plan.cycle_ns,
                        anchor=plan.anchor,
                        spin_ns=shaping.spin_ns,
                        pause_ns=shaping.pause_ns,
                    ),
                ),
            ),
        )
    except ValidationError as error:
        problems = [
            f"{key_text(where)}: {reason}" for where, reason in explanations(error, NodeDescription)
        ]
        raise InputError(f"the plan's shaping node cannot be run: {'; '.join(problems)}") from error


def _remapped(node: NodeDescription, old: str, new: str) -> NodeDescription:
    callbacks = tuple(
        callback.model_copy(
            update={
                "publishes": tuple(new if topic == old else topic for topic in callback.publishes)
            }
        )
        for callback in node.callbacks
    )
    return node.model_copy(update={"callbacks": callbacks})
