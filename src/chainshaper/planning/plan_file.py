"""The file of a plan: YAML that a person reads and edits.

A file has a list of chains. Each server is written out in the first chain that has it; further
chains have its name in its place.

Files of earlier versions have one chain and no list; :func:`convert_plan` reads these.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from shutil import rmtree
from textwrap import indent
from typing import Any, Literal

import yaml

from chainshaper.planning.chain_plan import ChainPlan, band_predictions, publish_slots
from chainshaper.planning.overruns import expected
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import OperationError
from chainshaper.values.files import new_file, write_whole
from chainshaper.values.yaml_file import AS_YAML, read_model, wrong_values_refused

_HEADER = """\
# A chainshaper plan: the reservation servers that give a ROS 2 chain a constant latency.
# Edit it as you like; it is checked when it is used. Durations carry units (59ms, 250us);
# slots are half-open, [start, end), and count from the start of a cycle.
"""

# Fields that are not written while they have their default.
_NOT_WRITTEN = {
    "offset_ns",
    "into_open_slot",
    "shaping_thread",
    "equal_priorities",
    "slot_ends",
    "further_shaping_nodes",
}
_SECTION_COMMENTS = {
    "evidence": "the measurements behind the plan",
    "margin": "epsilon: how far the chain's slot reaches beyond the longest latency measured",
    "offset": "this chain's cycles start so much after the instant that all chains count from",
    "anchor": "what starts a cycle: the message's origin stamp (stamp), or the servers (cycle)",
    "overrun": "an output that missed its last slot: wait for the next, discard, publish at once",
    "into_open_slot": "an output that comes when its slot is open: at once, or in the next slot",
    "messages": "several outputs in one cycle: all leave in order, or the newest",
    "fallback": "while the shaping node is not there: bypass, outputs go around it; or silence",
    "shaping_thread": "shaping nodes' threads run in their servers' slots only; free: their gates"
    " alone time them",
    "equal_priorities": "servers of one core and priority take turns; apart: they never overlap",
    "slot_ends": "closed: a callback that is not done when its slot ends goes on in the next one;\n"
    "# open-until-done: its server stays open for it",
    "servers": "a thread runs only in its server's slots; a smaller priority is better, and of\n"
    "# its threads the first is the most urgent",
    "shaping_node": "republishes the output in its slots; those that receive it have\n"
    "# SCHED_FIFO above the servers of chains, for so long in a cycle; or, without a place, below",
    "modes": "each mode's band, 1 is the first slot; the topic (std_msgs/String) names the mode",
    "adaptation": "how slots follow the latencies (apply --adapt): later when so many times the"
    " promised share\n# of a window is late, earlier for this gain after so many cycles",
    "loop": "reads the output, at a phase that is another one at each start of the loop; ages count"
    " from the\n# start of a cycle, of a message's first use and of all cycles of the loop",
    "predicted": "for the slots as planned; not updated when they are edited",
}


def load_plan(path: str | Path) -> Plan:
    """Read a plan from its file. Raises: as :func:`.read_model`."""
    return read_model(path, Plan, made_by="written by `chainshaper plan`")


class _EarlierPlan(ChainPlan):
    """A plan as files of earlier versions have it: of one chain."""

    format: Literal[1] = 1


def convert_plan(path: str | Path) -> Plan:
    """Read a plan from a file of an earlier version. Raises: as :func:`.read_model`."""
    made_by = "that `chainshaper plan` of an earlier version wrote"
    return _of_earlier(read_model(path, _EarlierPlan, made_by=made_by))


def _of_earlier(plan: _EarlierPlan) -> Plan:
    return Plan.of(ChainPlan(**{name: getattr(plan, name) for name in ChainPlan.model_fields}))


def dump_plan(plan: Plan) -> str:
    """Return the YAML text of a plan, each server written once; reading it gives an equal plan."""
    text, known = f"{_HEADER}format: 2\nchains:\n", set[str]()
    for chain_plan in plan.chains:
        values = _yaml_values(chain_plan)
        names = [server["name"] for server in values["servers"]]
        pairs = zip(names, values["servers"], strict=True)
        values["servers"] = [name if name in known else server for name, server in pairs]
        known.update(names)
        text += "- " + indent(_sections(values), "  ")[2:]
    return text


def _yaml_values(chain_plan: ChainPlan) -> dict[str, Any]:
    """Return the plan of a chain as it is written: without fields that say nothing."""
    not_written = {*_NOT_WRITTEN}
    if chain_plan.shaping_node is None:
        not_written.add("fallback")
    fields = ChainPlan.model_fields
    defaults = {name for name in not_written if getattr(chain_plan, name) == fields[name].default}
    values = chain_plan.model_dump(
        mode="json", by_alias=True, exclude_none=True, exclude=defaults, context=AS_YAML
    )
    for server in values["servers"]:
        server["threads"] = [
            _OnOneLine(
                {
                    key: value
                    for key, value in thread.items()
                    # A callback group's id says these two as well.
                    if value and not ("callback_group" in thread and key in ("node", "callbacks"))
                }
            )
            for thread in server["threads"]
        ]
        if not server["best_effort"]:
            del server["best_effort"]
    if "receivers" in values["predicted"]:
        del values["predicted"]["receivers"]["shares"]  # receivers have no bands
    if "modes" in values:
        values["modes"]["bands"] = _OnOneLine(values["modes"]["bands"])
    return values


def _sections(values: dict[str, Any]) -> str:
    """Return the fields of a chain's plan as YAML, with their comments."""
    text = ""
    for key, value in values.items():
        if key in _SECTION_COMMENTS:
            text += f"# {_SECTION_COMMENTS[key]}\n"
        text += yaml.dump({key: value}, Dumper=_Dumper, sort_keys=False, width=100)
    return text


class _OnOneLine(dict[str, Any]):
    """A mapping that is written on one line."""


class _Dumper(yaml.SafeDumper):
    """Sequences stand on one line, unless there are mappings in them."""

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> Any:
        on_one_line = flow_style or not any(isinstance(item, dict) for item in sequence)
        return super().represent_sequence(tag, sequence, on_one_line)


_Dumper.add_representer(
    _OnOneLine, lambda dumper, data: dumper.represent_mapping("tag:yaml.org,2002:map", data, True)
)


def save_plan(plan: Plan, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a plan, whole or not at all.

    Raises InputError: ``path`` exists (and ``overwrite`` is not set), or its folder does not exist.
    OperationError: the file cannot be written; nothing is left behind, an existing file stays.
    """
    path = Path(path)
    if not (overwrite and path.is_file()):
        new_file(path)
    write_whole(path, [dump_plan(plan).encode()])


def save_plans(chains: Sequence[ChainPlan], folder: str | Path) -> list[Path]:
    """Write the plan of each chain into a new folder, named after its output; all or none.

    Raises: as :func:`save_plan`.
    """
    folder = new_file(folder)
    try:
        folder.mkdir()
    except OSError as error:
        raise OperationError(f"{folder}: the folder cannot be made: {error}") from error
    written: list[Path] = []
    try:
        for number, chain_plan in enumerate(chains, start=1):
            name = (chain_plan.chain.output or "plan").strip("/").replace("/", "_")
            written.append(folder / f"{number}_{name}.yaml")
            save_plan(Plan.of(chain_plan), written[-1])
    except OperationError:
        rmtree(folder)
        raise
    return written


def plan_json(chain_plan: ChainPlan) -> dict[str, Any]:
    """Return the plan of a chain as plain data for ``--json``: integers in ns, keys end in ``_ns``.

    Besides the plan it has the ends of the publish slots (``bands_ns``), :func:`band_predictions`,
    and what will be seen (``expected``: :class:`~chainshaper.planning.overruns.Expected`).
    """
    seen = expected(chain_plan)
    return {
        **chain_plan.model_dump(mode="json"),
        "expected": None if seen is None else {**seen._asdict(), "leave_ns": list(seen.leave_ns)},
        "bands_ns": [end for _, end in publish_slots(chain_plan)],
        "predicted_bands": [band._asdict() for band in band_predictions(chain_plan)],
    }


def plan_in(values: Mapping[str, Any], where: object = "the plan") -> Plan:
    """Return the plan from the plain data of a recording or a run, also of an earlier version.

    Raises InputError, which begins with ``where``: the values are no plan.
    """
    model: type[Plan | _EarlierPlan] = Plan if "chains" in values else _EarlierPlan
    with wrong_values_refused(model, f"{where}: "):
        plan = model.model_validate(values, strict=False)
    return _of_earlier(plan) if isinstance(plan, _EarlierPlan) else plan


def plan_values(plan: Plan) -> dict[str, Any]:
    """Return a plan as plain data for a recording or a run, as :func:`plan_in` reads it."""
    return plan.model_dump(mode="json")
