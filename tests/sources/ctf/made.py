"""Traces made by our own writer, as LTTng's tracers would have made them."""

import random
from pathlib import Path
from typing import Any

from ctf_writing import EventRecord, encode_packet, lttng_metadata, write_trace

from chainshaper.sources.ctf.tsdl import parse_tsdl

Kinds = dict[str, dict[str, str]]
USER_EVENTS: Kinds = {
    "ros2:callback_start": {"callback": "x64", "is_intra_process": "s32"},
    "ros2:callback_end": {"callback": "x64"},
    "ros2:rcl_node_init": {"node_handle": "x64", "node_name": "string", "namespace": "string"},
    "ros2:rmw_publisher_init": {"rmw_publisher_handle": "x64", "gid": "u8[24]"},
    "dds:links": {"subs": "u64[]", "flags": "u8[]", "label": "char[8]"},
    "ros2:nothing": {},
}
USER_CONTEXT = {"vpid": "s32", "vtid": "s32", "procname": "char[17]", "perf": "u64"}
KERNEL_EVENTS: Kinds = {
    "sched_switch": {
        "prev_comm": "char[16]", "prev_tid": "s32", "prev_prio": "s32", "prev_state": "s64",
        "next_comm": "char[16]", "next_tid": "s32", "next_prio": "s32",
    },
    "sched_wakeup": {"comm": "char[16]", "tid": "s32", "prio": "s32", "target_cpu": "s32"},
}  # fmt: skip
KERNEL_CONTEXT = {"pid": "s32", "tid": "s32", "vpid": "s32"}
START = (1 << 40) + 12345


def value(chance: random.Random, kind: str) -> Any:
    # Texts are never empty: babeltrace2 2.0 shows an empty one as the one before it.
    if kind == "string":
        return "".join(chance.choices("ab/_é", k=chance.randrange(1, 20)))
    base, _, length = kind.removesuffix("]").partition("[")
    if base == "char":
        return "".join(chance.choices("abc", k=chance.randrange(1, int(length))))
    if base != kind:
        return [value(chance, base) for _ in range(int(length) if length else chance.randrange(5))]
    size = int(kind[1:])
    return chance.randrange(1 << size) - (1 << size - 1 if kind[0] == "s" else 0)


def fields(chance: random.Random, kinds: dict[str, str]) -> dict[str, Any]:
    values = {name: value(chance, kind) for name, kind in kinds.items()}
    lengths = {f"_{name}_length": len(values[name]) for name, k in kinds.items() if k[-2:] == "[]"}
    return values | lengths


def records(
    seed: int,
    count: int,
    events: Kinds = USER_EVENTS,
    context: dict[str, str] = USER_CONTEXT,
    start: int = START,
) -> list[EventRecord]:
    """Random events; steps are long enough for compact time stamps to wrap."""
    chance, time, made = random.Random(seed), start, []
    for _ in range(count):
        time += chance.choice([0, 1, 1000, 60_000_000, 12_000_000_000])
        name, contexts = chance.choice(list(events)), fields(chance, context)
        made.append(EventRecord(name, time, fields(chance, events[name]), contexts))
    return made


def make_trace(
    folder: Path,
    *,
    streams: int = 3,
    packets: int = 4,
    events: int = 20,
    seed: int = 1,
    kernel: bool = False,
    **options: Any,
) -> list[EventRecord]:
    """A trace of LTTng's shape; returns its records in order of streams."""
    kinds, context = (KERNEL_EVENTS, KERNEL_CONTEXT) if kernel else (USER_EVENTS, USER_CONTEXT)
    options = {"header": "compact" if kernel else "large"} | options
    text = lttng_metadata(kinds, context, kernel=kernel, **options)
    declared = parse_tsdl(text)
    files, made = {}, []
    for cpu in range(streams):
        encoded, start = [], START
        for number in range(packets):
            part = records(100 * seed + 10 * cpu + number, events, kinds, context, start)
            start = part[-1].time
            about = {"cpu_id": cpu, "packet_seq_num": number}
            encoded.append(encode_packet(declared, part, about, instance=cpu, padding=cpu * 8))
            made += part
        files[f"channel_{cpu}"] = encoded
    write_trace(folder, text, files)
    return made
