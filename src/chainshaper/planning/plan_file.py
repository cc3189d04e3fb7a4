"""A plan on disk: YAML that a person reads, edits and compares, checked again when it is read.

:func:`load_plan` tolerates whatever a person does to the layout (comments, order of keys, flow or
block style) and refuses whatever would not run: each wrong value is named with its file, line, key,
the reason and what to write instead.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from chainshaper.planning.plan import Plan, band_predictions, publish_slots
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.files import new_file, write_whole
from chainshaper.values.yaml_file import AS_YAML, read_model

_HEADER = """\
# A chainshaper plan: the reservation servers that give a ROS 2 chain a constant latency.
# Edit it as you like; it is checked when it is used. Durations carry units (59ms, 250us);
# slots are half-open, [start, end), and count from the start of a cycle.
"""

_SECTION_COMMENTS = {
    "evidence": "the measurements behind the plan",
    "margin": "epsilon: how far the chain's slot reaches beyond the longest latency measured",
    "offset": "this chain's cycles start so much after the instant that all chains count from",
    "anchor": "what starts a cycle: the message's origin stamp (stamp), or the servers (cycle)",
    "overrun": "an output that missed its last slot: wait for the next, discard, publish at once",
    "messages": "several outputs in one cycle: all leave in order, or the newest, or the first",
    "fallback": "while the shaping node is not there: bypass, outputs go around it; or silence",
    "servers": "a thread runs only in its server's slots; a smaller priority is better",
    "shaping_node": "republishes the output in its slots; receivers get SCHED_FIFO below servers",
    "modes": "each mode's band, 1 is the first slot; the topic (std_msgs/String) names the mode",
    "predicted": "for the slots as planned; not updated when they are edited",
}


def load_plan(path: str | Path) -> Plan:
    """Read a plan.

    Raises:
        InputError: no such file, not YAML, or wrong values; each is named with its line, key,
            reason and remedy.
    """
    return read_model(path, Plan, made_by="written by `chainshaper plan`")


def dump_plan(plan: Plan) -> str:
    """The YAML text of a plan; reading it gives an equal plan."""
    values = plan.model_dump(mode="json", by_alias=True, exclude_none=True, context=AS_YAML)
    for server in values["servers"]:
        server["slots"] = _Inline(server["slots"])
        server["threads"] = [_InlineMapping(thread) for thread in server["threads"]]
    if plan.offset_ns == 0:
        del values["offset"]
    if plan.shaping_node is None and plan.fallback == "bypass":
        del values["fallback"]
    for node in (values.get("shaping_node"), *values["further_shaping_nodes"]):
        if node is not None:
            node["receivers"] = _Inline(node["receivers"])
    if not values["further_shaping_nodes"]:
        del values["further_shaping_nodes"]
    if "modes" in values:
        values["modes"]["bands"] = _InlineMapping(values["modes"]["bands"])
    values["predicted"]["shares"] = _Inline(values["predicted"]["shares"])
    if "confidence_interval" in values["margin"]:
        values["margin"]["confidence_interval"] = _Inline(values["margin"]["confidence_interval"])

    text = _HEADER
    for key, value in values.items():
        if key in _SECTION_COMMENTS:
            text += f"# {_SECTION_COMMENTS[key]}\n"
        text += yaml.dump({key: value}, Dumper=_Dumper, sort_keys=False, width=100)
    return text


def save_plan(plan: Plan, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a plan, whole or not at all.

    Raises:
        InputError: ``path`` exists (and ``overwrite`` is not set), or its folder does not.
        OperationError: it cannot be written; nothing is left behind, an existing file stays.
    """
    path = Path(path)
    if not (overwrite and path.is_file()):
        new_file(path)
    write_whole(path, [dump_plan(plan).encode()])


def save_plans(plans: Sequence[Plan], folder: str | Path) -> list[Path]:
    """Write the plans of several chains into a new folder, each named after its output.

    Raises:
        InputError: ``folder`` exists, or what it stands in does not.
        OperationError: they cannot be written; nothing is left behind.
    """
    folder = Path(folder)
    try:
        folder.mkdir()
    except FileExistsError as error:
        raise InputError(f"{folder} exists already and is not overwritten: name another") from error
    except FileNotFoundError as error:
        raise InputError(f"{folder.parent}: no such folder to make {folder.name} in") from error
    except OSError as error:
        raise OperationError(f"{folder}: the folder cannot be made: {error}") from error
    written: list[Path] = []
    try:
        for number, plan in enumerate(plans, start=1):
            name = (plan.chain.output or "plan").strip("/").replace("/", "_")
            written.append(folder / f"{number}_{name}.yaml")
            save_plan(plan, written[-1])
    except OperationError:
        for path in written:
            path.unlink(missing_ok=True)
        folder.rmdir()
        raise
    return written


def plan_json(plan: Plan) -> dict[str, Any]:
    """The plan as plain data for ``--json``: integer nanoseconds, keys ending in ``_ns``.

    ``bands_ns`` are the ends of the publish slots, ascending; the slots themselves are pairs of
    nanoseconds in ``servers``. ``predicted_bands`` are those of
    :func:`~chainshaper.planning.plan.band_predictions`.
    """
    return {
        **plan.model_dump(mode="json"),
        "bands_ns": [end for _, end in publish_slots(plan)],
        "predicted_bands": [band._asdict() for band in band_predictions(plan)],
    }


class _Inline(list[Any]):
    """A sequence that is written on one line."""


class _InlineMapping(dict[str, Any]):
    """A mapping that is written on one line."""


class _Dumper(yaml.SafeDumper):
    pass


_Dumper.add_representer(
    _Inline,
    lambda dumper, data: dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True),
)
_Dumper.add_representer(
    _InlineMapping,
    lambda dumper, data: dumper.represent_mapping("tag:yaml.org,2002:map", data, flow_style=True),
)
