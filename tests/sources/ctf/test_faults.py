"""Damage gives an error that names the file, or a warning and everything readable."""

# ruff: noqa: PLR0917

import os
import random
import shutil
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ctf_writing import lttng_metadata, metadata_packets
from made import make_trace
from test_bytes import PLAIN

from chainshaper.sources.ctf import CtfError, count_events, open_trace, read_events

UUID = "2a6422d0-6cee-11e0-8c08-cb07d7b3a564"


def rows_of(folder: Any) -> Any:
    """All rows as texts, and all warnings."""
    trace = open_trace(folder)
    frames = read_events(trace)
    rows = [repr((name, row)) for name, frame in frames.items() for row in frame.rows()]
    assert sum(count_events(trace)[0].values()) == len(rows)
    return rows, [*trace.warnings, *frames.warnings]


def test_what_is_no_ctf_1_8_trace_is_named_with_its_remedy(tmp_path: Path) -> None:
    for paths, reason in (
        ([tmp_path / "absent"], "no such file"),
        ([tmp_path], "no file named metadata"),
        ([], "no trace given"),
    ):
        with pytest.raises(CtfError, match=reason) as caught:
            open_trace(*paths)
        assert caught.value.path == (paths[0] if paths else Path())
    (tmp_path / "metadata").write_bytes(b'\x1e{"type": "preamble", "version": 2}\n')
    with pytest.raises(CtfError, match=r"CTF 2 .* --trace-format=ctf-1\.8"):
        open_trace(tmp_path)
    text = PLAIN.format(order="le", fields="struct { " + "const " * 50_000 + "u8 x; }")
    (tmp_path / "metadata").write_text(text)
    assert open_trace(tmp_path).event_names == ("e",), "words repeated without end are read"


@pytest.mark.parametrize(("text", "place", "reason"), [
    ("trace { major = 1; };", 0, "byte_order"),
    ("/* CTF 1.8 */ trace { byte_order = le; ", 39, "expected"),
    ("nonsense;", 0, "unknown block"),
    ("typealias wrong := x;", 10, "unknown type 'wrong'"),
    ("typealias integer { size = 65; } := x;", 10, "65 bits"),
    ("typealias integer { size = 8; align = 3; } := x;", 10, "power of two"),
    ("trace { byte_order = le; }; event { name = a; id = 0; }; event { name = b; id = 0; };",
     57, "declared twice"),
    ("trace { byte_order = le; }; event { name = \"a", 43, "unterminated string"),
    ("/* no end", 0, "unterminated comment"),
    ("struct { " * 60, 297, "nested"),
    ("", 0, "no trace block"),
    ("trace { packet.header = 7; byte_order = le; };", 24, "must be a structure, not 7"),
    ("typealias integer { size = 8; signed = maybe; } := x;", 39, "unknown signed 'maybe'"),
    ("typealias 7 := x;", 10, "expected a type, found '7'"),
    ("typealias struct none := x;", 22, "unknown type 'struct none'"),
    ("typealias enum : struct { } { a } := x;", 28, "needs an integer type"),
    ("typealias integer { size = 8; } x[2] : y;", 37, "expected ':='"),
])  # fmt: skip
def test_metadata_faults_name_the_byte(tmp_path: Path, text: Any, place: Any, reason: Any) -> None:
    path = tmp_path / "metadata"
    for content, before in ((metadata_packets(text, UUID), 37), (text.encode(), 0)):
        path.write_bytes(content)
        with pytest.raises(CtfError, match=reason) as caught:
            open_trace(tmp_path)
        assert (caught.value.path, caught.value.offset) == (path, place + before)
        assert str(path) in str(caught.value)


@pytest.mark.parametrize(("place", "value", "reason"), [
    (24, 8 * 5000, "content"), (24, 8, "content"), (28, 0, "content"), (32, 1, "compressed"),
])  # fmt: skip
def test_lying_metadata_packets(tmp_path: Path, place: Any, value: Any, reason: Any) -> None:
    data = bytearray(metadata_packets(lttng_metadata({"e": {}}), UUID, size=1024))
    data[1024 + place : 1024 + place + 4] = struct.pack("<I", value)
    (tmp_path / "metadata").write_bytes(data)
    with pytest.raises(CtfError, match=reason) as caught:
        open_trace(tmp_path)
    assert caught.value.offset == 1024


DOUBLES = "".join(
    f"struct s{i + 1} {{ {f'struct s{i}' if i else 'u8'} a, b; }};\n" for i in range(60)
)
"""Sixty structures of two of the one before: 2^60 fields in a few lines."""


@pytest.mark.parametrize(("declared", "fields", "reason"), [
    ("", "struct { u8 a[missing]; }", "missing"),
    ("", "struct { variant <tag> { u8 x; } v; }", "tag"),
    ("", "struct { variant { u8 x; } v; }", "no tag"),
    (DOUBLES, "struct { struct s60 x; }", "nested too deeply"),
    (DOUBLES.replace("a, b", "a[99]"), "struct { struct s60 x; }", "nested too deeply"),
])  # fmt: skip
def test_types_that_cannot_be_laid_out_are_refused_at_once(
    tmp_path: Path, declared: str, fields: str, reason: str
) -> None:
    text = PLAIN.format(order="le", fields=fields)
    (tmp_path / "metadata").write_text(text.replace("event {", declared + "event {"))
    started = time.monotonic()
    with pytest.raises(CtfError, match=reason):
        open_trace(tmp_path)
    assert time.monotonic() - started < 60


def damaged(
    folder: Any,
    place: Any,
    data: Any,
    fields: Any = "struct { string s; }",
    payload: Any = b"text\0",
) -> Any:
    """Two packets of one event each, with ``data`` over the bytes at ``place`` of the first."""
    folder.mkdir(exist_ok=True)
    (folder / "metadata").write_text(PLAIN.format(order="le", fields=fields))
    packets = bytearray()
    for stamp in (1000, 2000):
        body = struct.pack("<BQ", 0, stamp) + payload
        size = 8 * (12 + len(body))
        packets += struct.pack("<III", 0xC1FC1FC1, size, size) + body
    packets[place : place + len(data)] = data
    (folder / "stream").write_bytes(packets)
    trace = open_trace(folder)
    frames = read_events(trace)
    times = frames["e"]["time"].to_list()
    assert sum(count_events(trace)[0].values()) == len(times)
    return times, [*trace.warnings, *frames.warnings]


@pytest.mark.parametrize(("place", "data", "times", "byte", "reason"), [
    (0, b"\0", [], 0, "magic"),
    (4, struct.pack("<I", 8), [], 0, "impossible"),
    (4, struct.pack("<I", 1 << 31), [], 0, "impossible"),
    (8, struct.pack("<I", 0), [], 0, "impossible"),
    (8, struct.pack("<I", 8 * 26 + 3), [], 0, "impossible"),
    (12, b"\x01", [2000], 12, "event id"),
    (25, b"!", [2000], 12, "string"),
    (26, b"?", [1000], 26, "magic"),
    (8, struct.pack("<I", 8 * 60000), [1000], 0, "cut short"),
])  # fmt: skip
def test_each_damage_names_its_byte(
    tmp_path: Path, place: Any, data: Any, times: Any, byte: Any, reason: Any
) -> None:
    read_times, warnings = damaged(tmp_path, place, data)
    assert read_times == times
    assert len(warnings) == 1
    assert f"{tmp_path / 'stream'}, byte {byte}: " in warnings[0]
    assert reason in warnings[0]


NOTHING = """struct { u32 n; enum : u8 { none = 0 } t;
    struct { variant <t> { struct { } none; } v[n]; } v[n]; }"""


@pytest.mark.parametrize(("fields", "payload", "reason"), [
    ("struct { u32 n; u8 a[n]; }", struct.pack("<I", 1 << 31), "longer"),
    ("struct { integer { size = 32; signed = true; } n; u32 a[n]; }",
     struct.pack("<i", -1), "longer"),
    ("struct { u32 n; integer { size = 8; encoding = UTF8; } a[n]; }",
     struct.pack("<I", 99), "longer"),
    ("struct { enum : u8 { x = 1 } t; variant <t> { u8 x; } v; }", b"\x02\x01", "tag"),
    ("struct { u32 n; u32 b; }", b"\1\2\3\4\5\6", "past the end"),
    ("struct { u8 a[2147483647][2147483647][2147483647]; }", b"abc", "past the end"),
    (NOTHING, struct.pack("<IB", 1 << 31, 0), "memory"),
])  # fmt: skip
def test_payloads_that_lie(tmp_path: Path, fields: Any, payload: Any, reason: Any) -> None:
    started = time.monotonic()
    times, warnings = damaged(tmp_path, 0, b"", fields, payload)
    assert time.monotonic() - started < 60
    assert (times, len(warnings)) == ([], 2)
    assert reason in warnings[0]


def test_other_traces_packets_and_stray_files_are_named(tmp_path: Path) -> None:
    make_trace(tmp_path, streams=1)
    count = len(rows_of(tmp_path)[0])
    (tmp_path / "notes.txt").write_text("not a stream at all, but long enough to be read as one")
    data = bytearray((tmp_path / "channel_0").read_bytes())
    data[4] ^= 1
    (tmp_path / "channel_1").write_bytes(data)
    (tmp_path / "channel_2").write_bytes(b"")
    (tmp_path / ".hidden").write_bytes(b"x")
    rows, warnings = rows_of(tmp_path)
    assert len(rows) == count, "what is behind the other trace's packet is a copy"
    said = ["uuid", "magic", "channel_0 as well; they count once"]
    assert [[text in warning for text in said] for warning in warnings] == np.eye(3).tolist()


# As for the campaigns of tests/cli/test_fuzzing.py.
CASES = int(os.environ.get("CHAINSHAPER_FUZZ_CASES", "300"))
SECONDS = 7 if CASES == 300 else 1e9


def test_random_damage_to_streams(tmp_path: Path) -> None:
    """Packets before the damage are intact; nothing hangs, crashes or appears from nowhere."""
    make_trace(tmp_path / "whole", streams=1, packets=4, events=15)
    whole = (tmp_path / "whole/channel_0").read_bytes()
    starts = open_trace(tmp_path / "whole").streams[0].packets["offset"].to_list()
    folder = tmp_path / "damaged"
    folder.mkdir()
    shutil.copy(tmp_path / "whole/metadata", folder)
    good = rows_of(tmp_path / "whole")[0]
    chance, deadline = random.Random(8), time.monotonic() + SECONDS
    for _ in range(CASES):
        data = bytearray(whole)
        first = len(data)
        for _ in range(chance.choice([1, 1, 2, 8])):
            place = chance.randrange(len(data))
            data[place] = chance.choice([0, 255, data[place] ^ (1 << chance.randrange(8))])
            first = min(first, place)
        if chance.random() < 0.2:
            del data[chance.randrange(len(data)) :]
            first = min(first, len(data))
        (folder / "channel_0").write_bytes(data)
        rows, _ = rows_of(folder)
        intact = 15 * sum(start <= first for start in starts[1:])
        assert len(set(rows) & set(good)) >= len(set(good)) - (60 - intact)
        assert len(rows) <= len(data)
        if time.monotonic() > deadline:
            break
