"""Small traces that would fill the memory, or keep a core busy for hours."""

import json
import struct
import subprocess
import sys
from pathlib import Path

from test_bytes import PLAIN

PACKET = 16 << 10
MOST_MEMORY = 400 << 20  # of the GB that the first of them took; Python and Polars take 150
_CHILD = """
import json, resource, sys
resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))
resource.setrlimit(resource.RLIMIT_CPU, (150, 150))
from chainshaper.sources.ctf import CtfError, count_events, open_trace, read_events
for folder in sys.argv[1:]:
    try:
        trace = open_trace(folder)
        frames = read_events(trace)
        count_events(trace)
        rows = sum(frame.height for frame in frames.values())
        said = [*trace.warnings, *frames.warnings]
    except CtfError as error:
        rows, said = 0, [str(error)]
    # Not ru_maxrss, which a process inherits from the one that started it.
    peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
    print(json.dumps([int(peak.split()[1]) << 10, rows, said]))
"""

TEXT = "typealias integer { size = 8; align = 8; encoding = UTF8; } := chr;\n"
MANY = 5_000


def _options(number: int) -> str:
    enum = ", ".join(f"o{n} = {n}" for n in range(256))
    options = " ".join(f"stamp o{n};" for n in range(number))
    return f"enum : u8 {{ {enum} }} t; variant <t> {{ struct {{ }} o255; {options} }} v;"


def _doubling(times: int) -> str:
    return "".join(
        f"struct s{n + 1} {{ {f'struct s{n}' if n else 'u8'} a, b; }};\n" for n in range(times)
    )


def _events(number: int, fields: str) -> str:
    return "".join(
        f'event {{ name = "e{n}"; id = {n}; fields := {fields}; }};\n'
        for n in range(5000, 5000 + number)
    )


# Declarations, the fields of the event, its payload; what the message says, None for none.
BOMBS = {
    "a sequence of texts of no bits": (
        TEXT, "struct { u32 n; chr v[n][0]; }", struct.pack("<I", 60_000), None),
    "sequences in sequences": (
        TEXT, "struct { u32 n; struct { struct { chr v[0]; } v[n]; } v[n]; }",
        struct.pack("<I", 1000), None),
    "arrays in arrays": (
        TEXT, "struct { chr v[1000][1000][1000][0]; u8 x; }", b"\0", None),
    "one byte an event": (
        TEXT, "struct { u8 t; }", b"\0", None),
    "many texts of no bits": (
        TEXT, f"struct {{ u8 x; {' '.join(f'chr a{n}[0];' for n in range(MANY))} }}", b"\0",
        "far more memory"),
    "options that are not there": (
        "", f"struct {{ u8 n; struct {{ {_options(250)} }} v[n]; }}",
        bytes([250] + 250 * [255]), "far more memory"),
    "a large enumeration for many variants": (
        "enum many : u32 { " + ", ".join(f"o{n}" for n in range(50_000)) + " };\n",
        "struct { enum many t; " + " ".join(
            f"variant <t> {{ u8 o{n}; u8 o{n + 1}; }} v{n};" for n in range(2_000)) + " }",
        struct.pack("<I", 0), "names none of its options"),
    "structures that double, in many events": (
        _doubling(14) + _events(100, "struct { struct s14 x; }"), "struct { u8 x; }", b"\0",
        "nested too deeply"),
    "many classes of events": (
        _events(4_000, "struct { u8 x; }"), "struct { u8 x; }", b"\0", None),
    "an array without end that never happens": (
        _events(1, "struct { u32 a[2147483647][2147483647]; chr t[2147483647]; }") + "\n",
        "struct { u8 x; }", b"\0", None),
}  # fmt: skip


def write_bomb(folder: Path, declared: str, fields: str, payload: bytes) -> None:
    """A trace of one packet of events, the first half of them with this payload."""
    text = PLAIN.format(order="le", fields=fields)
    if "chr" in declared + fields and TEXT not in declared:
        declared = TEXT + declared
    (folder / "metadata").write_text(text.replace("trace {", declared + "trace {", 1))
    head = struct.pack("<BQ", 0, 1000)
    half = PACKET // (2 * len(head + payload))
    body = (head + payload) * half + (head + bytes(len(payload))) * half
    size = 8 * (12 + len(body))
    (folder / "stream").write_bytes(struct.pack("<III", 0xC1FC1FC1, size, size) + body)


def write_packets(folder: Path, header: str, packet: bytes, count: int) -> None:
    """A trace whose packets are all alike, with another packet header."""
    folder.mkdir()
    write_bomb(folder, TEXT, "struct { u8 x; }", b"\0")
    metadata = (folder / "metadata").read_text()
    (folder / "metadata").write_text(metadata.replace("struct { u32 magic; }", header))
    (folder / "stream").write_bytes(packet * count)


def test_a_few_bytes_take_little_memory_and_time(tmp_path: Path) -> None:
    folders = []
    for name, (declared, fields, payload, _) in BOMBS.items():
        folders.append(tmp_path / name)
        folders[-1].mkdir()
        write_bomb(folders[-1], declared, fields, payload)
    folders += [tmp_path / "headers", tmp_path / "damaged"]
    header = """struct { u32 magic; u32 n; enum : u32 { none = 0 } t;
        struct { variant <t> { struct { } none; } v; } v[n]; }"""
    packet = struct.pack("<IIIII", 0xC1FC1FC1, 10**6, 0, 160, 160)
    write_packets(folders[-2], header, packet, 20_000)
    damaged = struct.pack("<III", 0xC1FC1FC1, 8 * 13, 8 * 13) + b"\1"
    write_packets(folders[-1], "struct { u32 magic; }", damaged, 5_000)
    run = subprocess.run(
        [sys.executable, "-c", _CHILD, *map(str, folders)],
        capture_output=True, text=True, check=False, timeout=160,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    *of_bombs, headers, damaged_packets = map(json.loads, run.stdout.splitlines())
    for (name, (*_, reason)), (memory, rows, said) in zip(BOMBS.items(), of_bombs, strict=True):
        assert memory < MOST_MEMORY, name
        assert (rows > 0, said) == (True, []) if reason is None else reason in said[0], name
    assert headers[1] == 0
    assert "packet header" in headers[2][0]
    memory, rows, said = damaged_packets
    assert (memory < MOST_MEMORY, rows, len(said)) == (True, 0, 21), "a few warnings of many alike"
    assert said[-1].endswith("4980 more packets are like that")
