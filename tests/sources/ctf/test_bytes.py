"""Traces assembled byte by byte, so that neither our writer nor our types are trusted."""

import struct
from pathlib import Path
from typing import Any

import pytest
from reference import assert_equal_to_babeltrace

from chainshaper.sources.ctf import CtfError, open_trace, read_events

PLAIN = """/* CTF 1.8 */
typealias integer {{ size = 8; align = 8; }} := u8;
typealias integer {{ size = 32; align = 8; }} := u32;
clock {{ name = c; uuid = "d499e0ca-e836-4e4d-b711-80e0e67a24a1"; freq = 1000000000; offset = 5; }};
typealias integer {{ size = 64; align = 8; map = clock.c.value; }} := stamp;
trace {{ major = 1; minor = 8; byte_order = {order}; packet.header := struct {{ u32 magic; }}; }};
stream {{
    event.header := struct {{ u8 id; stamp timestamp; }};
    packet.context := struct {{ u32 content_size; u32 packet_size; }};
}};
event {{ name = "e"; id = 0; fields := {fields}; }};
"""


def one_event(folder: Any, fields: Any, payload: Any, order: Any = "le", name: Any = "e") -> Any:
    """A trace of one packet with one event at time 1000."""
    mark, content = "<" if order == "le" else ">", 8 * (21 + len(payload))
    folder.mkdir(exist_ok=True)
    text = PLAIN.format(order=order, fields=fields).replace('"e"', f'"{name}"')
    (folder / "metadata").write_text(text)
    head = struct.pack(mark + "III", 0xC1FC1FC1, content, content)
    (folder / "stream").write_bytes(head + struct.pack(mark + "BQ", 0, 1000) + payload)
    return read_events(open_trace(folder))[name].drop("cpu", "pid", "tid").to_dicts()


BITS = """struct {
    integer { size = 3; align = 1; } a; integer { size = 7; align = 1; signed = true; } b;
    integer { size = 14; align = 1; } c; integer { size = 16; align = 8; } d; }"""
WIDE = """struct { integer { size = 5; align = 1; } a;
    integer { size = 64; align = 1; signed = true; } b; integer { size = 3; align = 1; } c; }"""
NUMBER = -0x123456789ABCDEF
UNSIGNED = NUMBER & (1 << 64) - 1
GAP = b"\xff" * 3
VARIANT = """struct { enum : u8 { number = 0, text = 5 ... 9, many = 128 ... 255 } tag;
    variant <tag> { u8 number; string text; struct { u8 n; u8 v[n]; } many; } v; u8 after; }"""
ARRAYS = """struct { enum : u8 { a = 0, b = 1 } tag; variant <tag> { u8 a; u8 b[2]; } v;
    u8 after; }"""


# Fields of the event, its payload, what it means; the byte order where it is not little-endian.
# What no table has a column for shows by where the field behind it is found.
KNOWN: dict[str, tuple[Any, ...]] = {
    "bits_from_the_low_end": (
        BITS, (5 | (-3 & 0x7F) << 3 | 0x2BCD << 10).to_bytes(3, "little") + b"\x34\x12",
        {"a": 5, "b": -3, "c": 0x2BCD, "d": 0x1234}),
    "bits_from_the_high_end": (
        BITS, (5 << 21 | (-3 & 0x7F) << 14 | 0x2BCD).to_bytes(3, "big") + b"\x12\x34",
        {"a": 5, "b": -3, "c": 0x2BCD, "d": 0x1234}, "be"),
    "a_number_across_nine_bytes": (
        WIDE, (21 | UNSIGNED << 5 | 6 << 69).to_bytes(9, "little"), {"a": 21, "b": NUMBER, "c": 6}),
    "a_number_across_nine_bytes_from_the_high_end": (
        WIDE, (21 << 67 | UNSIGNED << 3 | 6).to_bytes(9, "big"),
        {"a": 21, "b": NUMBER, "c": 6}, "be"),
    # The event header ends at byte 21; s aligns the payload to 24: a there, b at 28, s at 32.
    "alignment_counts_from_the_packet": (
        """struct { integer { size = 8; } a; integer { size = 32; align = 32; } b;
        struct { integer { size = 8; } x; } align(64) s; struct { } align(32) padding;
        integer { size = 8; } c; }""",
        GAP + b"\x01" + GAP + b"\x02\0\0\0" + b"\x03" + GAP + b"\x04",
        {"a": 1, "b": 2, "c": 4}),
    "floats": (
        """struct { floating_point { exp_dig = 8; mant_dig = 24; align = 8; } f;
        floating_point { exp_dig = 11; mant_dig = 53; align = 8; } d; u8 after; }""",
        struct.pack("<fd", 1.5, -2.25e100) + b"\x09", {"after": 9}),
    "arrays_of_bytes": (
        "struct { u8 a[3]; u8 n; u8 b[n]; u8 none[0]; u8 c[2]; }",
        bytes([1, 0, 255, 2, 5, 6, 7, 8]),
        {"a": [1, 0, 255], "n": 2, "b": [5, 6], "none": [], "c": [7, 8]}),
    "text_ends_at_its_nul": (
        """struct { string s; integer { size = 8; encoding = UTF8; } t[6]; integer { size = 8; } n;
        integer { size = 8; encoding = ASCII; } q[n]; string { encoding = ASCII; } empty; }""",
        "caf\u00e9\0".encode() + b"ab\0xyz" + b"\x03" + b"ful" + b"\0",
        {"s": "caf\u00e9", "t": "ab", "n": 3, "q": "ful", "empty": ""}),
    "texts_of_whole_words": (
        "struct { string s; integer { size = 8; encoding = UTF8; } t[16]; string u; }",
        b"eight by\0" + b"sixteen bytes...eight by\0",
        {"s": "eight by", "t": "sixteen bytes...", "u": "eight by"}),
    "arrays_sequences_and_structures_nest": (
        """struct { struct { u8 x; u8 n; } pair[2]; u8 n; u8 grid[2][3];
        struct { u8 m; u32 v[m]; string s; } list[n]; u8 none[0];
        struct { u8 n; u8 v[n]; } ragged[2]; u8 after; }""",
        bytes([1, 2, 3, 4, 2, *range(6), 1]) + struct.pack("<I", 70000) + b"one\0\0none\0"
        + bytes([0, 2, 7, 8, 9]),
        {"n": 2, "none": [], "after": 9}),
    "the_first_option": (VARIANT, b"\0\x2a\x09", {"tag": 0, "after": 9}),
    "a_range_of_tags": (VARIANT, b"\x07hello\0\x09", {"tag": 7, "after": 9}),
    "an_option_with_a_sequence": (VARIANT, bytes([200, 2, 8, 9, 9]), {"tag": 200, "after": 9}),
    "an_option_with_an_array": (ARRAYS, bytes([1, 5, 6, 9]), {"tag": 1, "after": 9}),
    "not_the_option_with_an_array": (ARRAYS, bytes([0, 5, 9]), {"tag": 0, "after": 9}),
    "negative_tags": (
        """struct { enum : integer { size = 8; signed = true; } { low = -5 ... -1, "high" = 3 } tag;
        variant <tag> { u8 low; u32 high; } v; u8 after; }""",
        b"\xfd\x11\x09", {"tag": -3, "after": 9}),
}  # fmt: skip


def test_known_bytes_mean_what_the_specification_says(tmp_path: Path) -> None:
    for name, (fields, payload, expected, *order) in KNOWN.items():
        row = one_event(tmp_path / name, fields, payload, "".join(order) or "le", name)
        assert row == [{"time": 1000, **expected}], name
    assert_equal_to_babeltrace(tmp_path)


def test_fields_of_one_name_that_do_not_fit_together_are_refused(tmp_path: Path) -> None:
    one_event(tmp_path / "a", "struct { u8 x; }", b"\1")
    one_event(tmp_path / "b", "struct { u8 x[2]; }", b"\1\2")
    with pytest.raises(CtfError, match=r"types that do not fit together.*one by one"):
        read_events(open_trace(tmp_path))


def test_what_babeltrace_shows_otherwise(tmp_path: Path) -> None:
    fields = "struct { string a; string b; integer { size = 8; encoding = UTF8; } c[2]; }"
    assert one_event(tmp_path, fields, b"x\0\0\0\0")[0] == {
        "time": 1000,
        "a": "x",
        "b": "",
        "c": "",
    }
    fields = "struct { struct { } a[3]; u8 n; struct { } b[n]; u8 c[n][0]; u8 d; }"
    expected = {"time": 1000, "n": 2, "d": 7}
    assert one_event(tmp_path, fields, b"\2\7") == [expected], "there is nothing to show in these"
    row = one_event(tmp_path, "struct { string s; }", b"a\xffb\0")[0]
    assert row["s"] == "a\\xffb", "bytes that are no UTF-8 are shown"


def test_lengths_and_tags_from_every_scope(tmp_path: Path) -> None:
    (tmp_path / "metadata").write_text("""/* CTF 1.8 */
        typealias integer { size = 8; align = 8; } := u8;
        typealias integer { size = 32; align = 8; } := u32;
        clock { name = c; };
        typealias integer { size = 64; align = 8; map = clock.c.value; } := stamp;
        trace { major = 1; minor = 8; byte_order = le;
            packet.header := struct { u32 magic; u8 of_header; }; };
        stream {
            packet.context := struct { u32 content_size; u32 packet_size;
                u8 of_packet; u8 cpu_id; };
            event.header := struct { u8 id; stamp timestamp; };
            event.context := struct { u8 shared; u8 own; };
        };
        event { name = "e"; id = 0;
            context := struct { u8 own; enum : u8 { x = 1, y = 2 } tag; };
            fields := struct {
                u8 own;
                u8 a[trace.packet.header.of_header];
                u8 b[stream.packet.context.of_packet];
                u8 c[stream.event.context.shared];
                u8 d[event.context.own];
                u8 e[own];
                u8 f[shared];
                u8 g[stream.event.context.own];
                struct { u8 own; u8 h[own]; u8 i[event.fields.own]; } inner;
                variant <event.context.tag> { u8 x; u32 y; } v;
                u8 after;
            }; };
    """)
    body = b"\0" + struct.pack("<Q", 77) + bytes([2, 3]) + bytes([1, 2]) + bytes([1])
    for count in (1, 2, 2, 1, 1, 2, 3):
        body += bytes(range(10, 10 + count))
    body += bytes([2, 50, 51, 60]) + struct.pack("<IB", 99, 9)
    size = 8 * (15 + len(body))
    head = struct.pack("<IBIIBB", 0xC1FC1FC1, 1, size, size, 2, 3)
    (tmp_path / "stream").write_bytes(head + body)
    row = read_events(open_trace(tmp_path))["e"].to_dicts()[0]
    counts = {name: len(row[name]) for name in "abcdefg"}
    assert counts == {"a": 1, "b": 2, "c": 2, "d": 1, "e": 1, "f": 2, "g": 3}
    assert (row["cpu"], row["after"]) == (3, 9)


def test_clock_frequency_and_offset_are_exact(tmp_path: Path) -> None:
    text = PLAIN.format(order="le", fields="struct { u8 n; }")
    text = text.replace("freq = 1000000000; offset = 5;", "freq = 3; offset_s = 7; offset = 4;")
    (tmp_path / "metadata").write_text(text)
    head = struct.pack("<III", 0xC1FC1FC1, 8 * 22, 8 * 22)
    (tmp_path / "stream").write_bytes(head + struct.pack("<BQB", 0, 10, 1))
    trace = open_trace(tmp_path)
    assert trace.clock_offset_ns == 8_333_333_333
    assert read_events(trace)["e"]["time"].to_list() == [3_333_333_333]


def test_a_trace_without_headers_is_one_packet_of_one_event_class(tmp_path: Path) -> None:
    (tmp_path / "metadata").write_text("""
        trace { major = 1; minor = 8; byte_order = le; };
        event { name = "only"; fields := struct { integer { size = 16; } n; }; };
    """)
    (tmp_path / "stream").write_bytes(struct.pack("<HHH", 1, 2, 3))
    assert read_events(open_trace(tmp_path))["only"]["n"].to_list() == [1, 2, 3]


def test_alike_names_are_told_apart(tmp_path: Path) -> None:
    fields = "struct { u8 time; u8 tid; u8 _x; u8 x; }"
    row = one_event(tmp_path, fields, bytes([1, 2, 3, 4]))[0]
    assert (row["time"], row["payload.time"], row["payload.tid"]) == (1000, 1, 2)
    assert (row["x"], row["payload.x"]) == (3, 4)
