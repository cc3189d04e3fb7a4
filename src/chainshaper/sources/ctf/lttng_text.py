"""Metadata texts as LTTng's tracers write them, for the writer.

The declarations are those of lttng-ust 2.13 and lttng-modules 2.13, reproduced from what they
put into traces.
"""

import re
from collections.abc import Mapping

__all__ = ["lttng_metadata"]

_UUID = "2a6422d0-6cee-11e0-8c08-cb07d7b3a564"
_KINDS = {
    "u8": (8, 0, 10), "u16": (16, 0, 10), "u32": (32, 0, 10), "u64": (64, 0, 10),
    "s8": (8, 1, 10), "s16": (16, 1, 10), "s32": (32, 1, 10), "s64": (64, 1, 10),
    "x64": (64, 0, 16), "char": (8, 1, 10),
}  # fmt: skip
_FIELD = re.compile(r"(?P<kind>\w+)(\[(?P<length>\w*)\])?")

_HEAD = """/* CTF 1.8 */

typealias integer {{ size = 8; align = 8; signed = false; }} := uint8_t;
typealias integer {{ size = 16; align = {a16}; signed = false; }} := uint16_t;
typealias integer {{ size = 32; align = {a32}; signed = false; }} := uint32_t;
typealias integer {{ size = 64; align = {a64}; signed = false; }} := uint64_t;
typealias integer {{ size = 64; align = {a64}; signed = false; }} := unsigned long;
typealias integer {{ size = 5; align = 1; signed = false; }} := uint5_t;
typealias integer {{ size = 27; align = 1; signed = false; }} := uint27_t;

trace {{
	major = 1;
	minor = 8;
	uuid = "{uuid}";
	byte_order = {order};
	packet.header := struct {{
		uint32_t magic;
		uint8_t  uuid[16];
		uint32_t stream_id;
		uint64_t stream_instance_id;
	}};
}};

env {{
	hostname = "{host}";
	domain = "{domain}";
	tracer_name = "{tracer}";
	tracer_major = 2;
	tracer_minor = 13;
}};

clock {{
	name = "monotonic";
	uuid = "d499e0ca-e836-4e4d-b711-80e0e67a24a1";
	description = "Monotonic Clock";
	freq = 1000000000; /* Frequency, in Hz */
	/* clock value offset from Epoch is: offset * (1/freq) */
	offset = {offset};
}};

typealias integer {{
	size = 27; align = 1; signed = false;
	map = clock.monotonic.value;
}} := uint27_clock_monotonic_t;

typealias integer {{
	size = 32; align = {a32}; signed = false;
	map = clock.monotonic.value;
}} := uint32_clock_monotonic_t;

typealias integer {{
	size = 64; align = {a64}; signed = false;
	map = clock.monotonic.value;
}} := uint64_clock_monotonic_t;

struct packet_context {{
	uint64_clock_monotonic_t timestamp_begin;
	uint64_clock_monotonic_t timestamp_end;
	uint64_t content_size;
	uint64_t packet_size;
	uint64_t packet_seq_num;
	unsigned long events_discarded;
	uint32_t cpu_id;
}};

struct event_header_compact {{
	enum : uint5_t {{ compact = 0 ... 30, extended = 31 }} id;
	variant <id> {{
		struct {{
			uint27_clock_monotonic_t timestamp;
		}} compact;
		struct {{
			uint32_t id;
			uint64_clock_monotonic_t timestamp;
		}} extended;
	}} v;
}} align({a32});

struct event_header_large {{
	enum : uint16_t {{ compact = 0 ... 65534, extended = 65535 }} id;
	variant <id> {{
		struct {{
			uint32_clock_monotonic_t timestamp;
		}} compact;
		struct {{
			uint32_t id;
			uint64_clock_monotonic_t timestamp;
		}} extended;
	}} v;
}} align({a16});

stream {{
	id = 0;
	event.header := struct event_header_{header};
	packet.context := struct packet_context;
"""


def lttng_metadata(
    events: Mapping[str, Mapping[str, str]],
    context: Mapping[str, str] | None = None,
    *,
    header: str = "large",
    kernel: bool = False,
    big: bool = False,
    aligned: bool = False,
    offset: int = 1_700_000_000_000_000_000,
    host: str = "example",
) -> str:
    """The metadata of a trace with one stream class; event ids count up from 0.

    ``events`` maps names to fields and their kinds, ``context`` gives the stream's context: an
    integer ``u8`` … ``s64`` (``x64`` shown in hexadecimal), ``string``, an array ``u8[24]``,
    text ``char[16]`` or a sequence ``u64[]`` whose length is a field of its own as LTTng writes
    it.  ``aligned`` gives integers their natural alignment, as on machines that need it.
    """
    text = _HEAD.format(
        a16=16 if aligned else 8,
        a32=32 if aligned else 8,
        a64=64 if aligned else 8,
        uuid=_UUID,
        order="be" if big else "le",
        host=host,
        domain="kernel" if kernel else "ust",
        tracer="lttng-modules" if kernel else "lttng-ust",
        offset=offset,
        header=header,
    )
    if context:
        text += "\tevent.context := struct {\n" + _fields(context, aligned) + "\t};\n"
    text += "};\n\n"
    for number, (name, fields) in enumerate(events.items()):
        text += f'event {{\n\tname = "{name}";\n\tid = {number};\n\tstream_id = 0;\n'
        text += "\tfields := struct {\n" + _fields(fields, aligned) + "\t};\n};\n\n"
    return text


def _fields(fields: Mapping[str, str], aligned: bool) -> str:
    return "".join(_field(name, kind, aligned) for name, kind in fields.items())


def _field(name: str, kind: str, aligned: bool) -> str:
    if kind == "string":
        return f"\t\tstring _{name};\n"
    match = _FIELD.fullmatch(kind)
    if match is None or match["kind"] not in _KINDS:
        raise ValueError(f"field {name}: unknown kind {kind!r}")
    size, signed, base = _KINDS[match["kind"]]
    encoding = "UTF8" if match["kind"] == "char" else "none"
    integer = (
        f"integer {{ size = {size}; align = {size if aligned else 8}; signed = {signed};"
        f" encoding = {encoding}; base = {base}; }}"
    )
    length = match["length"]
    if length is None:
        return f"\t\t{integer} _{name};\n"
    if length:
        return f"\t\t{integer} _{name}[{length}];\n"
    counter = "integer { size = 32; align = 8; signed = 0; encoding = none; base = 10; }"
    return f"\t\t{counter} __{name}_length;\n\t\t{integer} _{name}[ __{name}_length ];\n"
