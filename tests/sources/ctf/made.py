"""Traces made by our own writer, as LTTng's tracers would have made them."""

# ruff: noqa: PLR0917

import random
from typing import Any

from ctf_writing import EventRecord, encode_packet, lttng_metadata, write_trace

from chainshaper.sources.ctf.tsdl import parse_tsdl

USER_EVENTS = {
    "ros2:callback_start": {"callback": "x64", "is_intra_process": "s32"},
    "ros2:callback_end": {"callback": "x64"},
    "ros2:rcl_node_init": {"node_handle": "x64", "node_name": "string", "namespace": "string"},
    "ros2:rmw_publisher_init": {"rmw_publisher_handle": "x64", "gid": "u8[24]"},
    "dds:links": {"subs": "u64[]", "flags": "u8[]", "label": "char[8]"},
    "ros2:nothing": {},
}
USER_CONTEXT = {"vpid": "s32", "vtid": "s32", "procname": "char[17]", "perf": "u64"}
KERNEL_EVENTS = {
    "sched_switch": {
        "prev_comm": "char[16]", "prev_tid": "s32", "prev_prio": "s32", "prev_state": "s64",
        "next_comm": "char[16]", "next_tid": "s32", "next_prio": "s32",
    },
    "sched_wakeup": {"comm": "char[16]", "tid": "s32", "prio": "s32", "target_cpu": "s32"},
}  # fmt: skip
KERNEL_CONTEXT = {"pid": "s32", "tid": "s32", "vpid": "s32"}
START = (1 << 40) + 12345


def value(chance: Any, kind: Any) -> Any:
    # Texts are never empty: babeltrace2 2.0 shows an empty one as the one before it.
    if kind == "string":
        return "".join(chance.choices("ab/_é", k=chance.randrange(1, 20)))
    if kind.startswith("char"):
        return "".join(chance.choices("abc", k=chance.randrange(1, int(kind[5:-1]))))
    if "[" in kind:
        length = kind[kind.index("[") + 1 : -1]
        count = int(length) if length else chance.randrange(5)
        return [value(chance, kind[: kind.index("[")]) for _ in range(count)]
    size = int(kind[1:])
    number = chance.randrange(1 << size)
    return number - (1 << size - 1) if kind[0] == "s" else number


def fields(chance: Any, kinds: Any) -> Any:
    found = {}
    for name, kind in kinds.items():
        found[name] = value(chance, kind)
        if kind.endswith("[]"):
            found[f"_{name}_length"] = len(found[name])
    return found


def records(
    seed: Any,
    count: Any,
    events: Any = USER_EVENTS,
    context: Any = USER_CONTEXT,
    step: Any = 60_000_000,
    start: Any = START,
) -> Any:
    """Random events; steps are long enough for compact time stamps to wrap."""
    chance = random.Random(seed)
    names, time, made = list(events), start, []
    for _ in range(count):
        time += chance.choice([0, 1, 1000, step, 200 * step])
        name = chance.choice(names)
        own = fields(chance, context)
        made.append(EventRecord(name, time, fields(chance, events[name]), own))
    return made


def make_trace(
    folder: Any,
    *,
    streams: Any = 3,
    packets: Any = 4,
    events: Any = 20,
    seed: Any = 1,
    kernel: Any = False,
    **options: Any,
) -> Any:
    """A trace of LTTng's shape; returns its records in order of streams."""
    kinds = KERNEL_EVENTS if kernel else USER_EVENTS
    context = KERNEL_CONTEXT if kernel else USER_CONTEXT
    header = "compact" if kernel else "large"
    options = {"header": header} | options
    text = lttng_metadata(kinds, context, kernel=kernel, **options)
    declared = parse_tsdl(text)
    files, made = {}, []
    for cpu in range(streams):
        encoded, start = [], START
        for number in range(packets):
            part = records(100 * seed + 10 * cpu + number, events, kinds, context, start=start)
            start = part[-1].time
            about = {"cpu_id": cpu, "packet_seq_num": number}
            encoded.append(encode_packet(declared, part, about, instance=cpu, padding=cpu * 8))
            made += part
        files[f"channel_{cpu}"] = encoded
    write_trace(folder, text, files)
    return made
