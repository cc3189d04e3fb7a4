"""Memories in which a process has written anything at all: its events are counted, others' whole.

CHAINSHAPER_DAMAGED_MEMORIES=10000 tries so many; the seed is fixed.
"""

import fcntl
import os
import random
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import called
from numpy.typing import NDArray
from odd_names import ODD_NAMES
from processes import wait_for

from chainshaper.flow.record import _known_endpoints
from chainshaper.sources.preload import (
    RECORD,
    PreloadTracer,
    TracedProcess,
    event_names,
    installed_library,
)
from chainshaper.sources.preload import memory as layout
from chainshaper.sources.preload import tracer as tracing
from chainshaper.sources.preload.events_header import FORMAT
from chainshaper.values.errors import InputError, text_of
from chainshaper.values.recording import Recording, open_recording, write_recording

COUNT = int(os.environ.get("CHAINSHAPER_DAMAGED_MEMORIES", "100"))
RINGS, RING_RECORDS, OBJECT_RECORDS = 2, 8, 12
NUMBERS = {name: number for number, name in enumerate(event_names(), layout.FIRST_EVENT)}
ADD_SEALS, SHRINK = 1033, 2
EXTREMES = (
    *(0, 1, 2, 3, 41, 255, 1 << 15, (1 << 16) - 1, (1 << 31) - 1, 1 << 31, (1 << 32) - 1),
    *(1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1),
)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memories of few records: those of the library have a million."""
    of_objects = layout.HEADER.itemsize + RINGS * layout.RING.itemsize
    of_records = of_objects + OBJECT_RECORDS * RECORD.itemsize
    sizes = {"_RINGS": RINGS, "_RING_RECORDS": RING_RECORDS, "_OBJECT_RECORDS": OBJECT_RECORDS}
    sizes |= {"_OF_OBJECTS": of_objects, "_OF_RECORDS": of_records}
    sizes["_SIZE"] = of_records + RINGS * RING_RECORDS * RECORD.itemsize
    for name, size in sizes.items():
        monkeypatch.setattr(layout, name, size)


def records(count: int, event: str, pid: int) -> NDArray[Any]:
    rows = np.zeros(count, RECORD)
    rows["time"] = time.monotonic_ns() - 1_000_000 + np.arange(count)
    rows["tid"], rows["event"], rows["values"][:, 0] = pid, NUMBERS[event], np.arange(count)
    return rows


def _texts_of(objects: NDArray[Any]) -> NDArray[np.uint8]:
    """The bytes of texts in records, a row each."""
    return objects["values"].view(np.uint8).reshape(objects.size, 48)[:, 8:]


def whole_memory(pid: int, text: bytes = b"node") -> bytearray:
    """One that the library may have written: a node, and five events in each ring."""
    header = np.zeros(1, layout.HEADER)
    values = (layout.MAGIC, FORMAT, pid, RINGS, RING_RECORDS, OBJECT_RECORDS, 3)
    for name, value in zip((*layout.COUNTS, "objects"), values, strict=True):
        header[name] = value
    rings = np.zeros(RINGS, layout.RING)
    rings["written"] = 5
    objects = np.zeros(OBJECT_RECORDS, RECORD)
    objects[:3] = records(3, "rcl_node_init", pid)
    for place, said in enumerate((text, b"/")):
        objects["event"][1 + place] = layout.TEXT
        objects["values"][1 + place] = 0
        objects["values"][1 + place, 0] = 16 * len(said) + 2 + place
        _texts_of(objects)[1 + place, : len(said)] = [*said]
    of_rings = np.concatenate([np.r_[records(5, "rcl_take", pid), np.zeros(3, RECORD)]] * RINGS)
    return bytearray(header.tobytes() + rings.tobytes() + objects.tobytes() + of_rings.tobytes())


def damaged_memory(chance: random.Random, pid: int) -> bytes:
    """Noise; noise behind a good header; single bytes, or whole fields, that are wrong."""
    memory = whole_memory(pid, chance.randbytes(5))
    kind = chance.randrange(4)
    if kind == 0:
        return chance.randbytes(len(memory))
    header = layout.HEADER.itemsize
    if kind == 1:
        return bytes(memory[:header]) + chance.randbytes(len(memory) - header)
    for _ in range(chance.randint(1, 12)):
        if kind == 2:
            memory[chance.randrange(len(memory))] = chance.randrange(256)
        else:
            size = chance.choice((2, 4, 8))
            at = size * chance.randrange(len(memory) // size)
            value = chance.choice(EXTREMES) & ((1 << 8 * size) - 1)
            memory[at : at + size] = value.to_bytes(size, "little")
    return bytes(memory)


def sealed(content: bytes) -> int:
    descriptor = os.memfd_create("chainshaper-trace", os.MFD_ALLOW_SEALING)
    os.write(descriptor, content)
    fcntl.fcntl(descriptor, ADD_SEALS, SHRINK)
    return descriptor


def add(tracer: PreloadTracer, content: bytes, pid: int) -> TracedProcess:
    descriptor = sealed(content)
    try:
        tracer._processes.append(TracedProcess(descriptor, pid))
    finally:
        os.close(descriptor)
    return tracer._processes[-1]


def recorded(tracer: PreloadTracer, path: Path) -> Recording:
    tracer._read_all()
    tables, info = tracer.recording()
    info = info.model_copy(update={"endpoints": _known_endpoints(tables, ())})
    recording = write_recording(path, tables, info)
    tracer.written()
    return recording


@pytest.mark.usefixtures("small")
def test_memories_of_any_content_cost_no_other_process_an_event(tmp_path: Path) -> None:
    chance, damaged, refused = random.Random(29), 0, 0
    for number in range(COUNT):
        folder = tmp_path / str(number)
        folder.mkdir()
        tracer = PreloadTracer(folder, ["command"], ())
        tracer.remove()
        good = add(tracer, bytes(whole_memory(7)), 7)
        content = damaged_memory(chance, 8)
        try:
            bad = add(tracer, content, 8)
        except InputError:
            bad, refused = None, refused + 1
        path = folder / "recording"
        recording = recorded(tracer, path)
        for name in recording.events:
            assert recording.events[name].height, "it can be read back"
        taken = recording.events["rcl_take"].filter(pid=7)
        assert sorted(taken["message"]) == sorted([*range(5)] * RINGS)
        assert good.damage is None
        assert good.lost == 0
        if bad is not None and bad.damage is not None:
            damaged += 1
            assert bad.damage in "".join(recording.info.notes)
            assert list(folder.iterdir()) == [path]
        for file in sorted(path.iterdir()):
            file.unlink()
        path.rmdir()
    assert refused > COUNT / 5
    assert damaged > COUNT / 3


BAD = {
    "tid": (0, 1 << 22 | 1, (1 << 32) - 1),
    "time": (-1, 1 << 62),
    "event": (0, layout.TEXT, NUMBERS["rcl_node_init"], 99, (1 << 16) - 1),
}


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(("field", "value"), [(f, v) for f, values in BAD.items() for v in values])
def test_what_stands_before_a_bad_record_is_there_and_what_follows_is_counted(
    tmp_path: Path, field: str, value: int
) -> None:
    memory = whole_memory(7)
    behind = len(memory) - RINGS * RING_RECORDS * RECORD.itemsize
    ring_records = np.frombuffer(memory, RECORD, RINGS * RING_RECORDS, behind)
    ring_records[field][3] = value  # of the first ring
    tracer = PreloadTracer(tmp_path, ["command"], ())
    add(tracer, bytes(memory), 7)
    recording = recorded(tracer, tmp_path / "recording")
    assert recording.events["rcl_take"]["message"].to_list() == [0, 1, 2]
    assert recording.info.lost == {"lost_events": 2 + 5}
    assert recording.info.processes == {7: "/node"}
    (note,) = (note for note in recording.info.notes if "left out" in note)
    assert note.startswith("process 7 (unknown): from where it has a record of event ")


@pytest.mark.usefixtures("small")
def test_texts_of_an_event_that_was_not_finished_are_no_other_events(tmp_path: Path) -> None:
    """A process was killed while it wrote: the texts are there, the event's number is not."""
    memory = whole_memory(7)
    at = layout.HEADER.itemsize + RINGS * layout.RING.itemsize
    objects = np.frombuffer(memory, RECORD, OBJECT_RECORDS, at)
    objects[3:6] = objects[:3]
    objects["event"][3] = 0
    _texts_of(objects)[4, :5] = [*b"other"]
    np.frombuffer(memory, layout.HEADER, 1)["objects"][0] = 6
    tracer = PreloadTracer(tmp_path, ["command"], ())
    add(tracer, bytes(memory), 7)
    nodes = recorded(tracer, tmp_path / "recording").events["rcl_node_init"]
    assert nodes["node_name"].to_list() == ["node"]


@pytest.mark.usefixtures("small")
def test_a_reader_that_ends_says_why_and_what_there_was_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracer = PreloadTracer(tmp_path, ["command"], ())
    monkeypatch.setattr(tracing, "installed_library", lambda: Path("/library.so"))
    try:
        tracer.start()
        add(tracer, bytes(whole_memory(7)), 7)
        wait_for((tmp_path / "process_0.records").exists, "what is written to be read")
        monkeypatch.setattr(TracedProcess, "new_records", lambda _: 1 // 0)
        wait_for(lambda: tracer.failure() is not None, "the reader's end to be told")
    finally:
        tracer.remove()
    reason = "reading events has failed (ZeroDivisionError: integer division or modulo by zero)"
    assert tracer.failure() == reason
    recording = write_recording(tmp_path / "recording", *tracer.recording())
    assert recording.events["rcl_take"].height == 5 * RINGS
    assert f"{reason}." in recording.info.notes


_TAKES = """
import ctypes, os, sys, time
libc, name = ctypes.CDLL(None), bytes.fromhex(sys.argv[1])
libc.prctl(15, name, 0, 0, 0)
for n in range(200):
    libc.ros_trace_rcl_take(ctypes.c_uint64(n))
    time.sleep(0.001)
libc.ros_trace_rcl_node_init(ctypes.c_uint64(1), None, name, b"/n" + name)
"""


def test_nodes_and_programs_of_any_name_are_recorded_to_their_last_event(tmp_path: Path) -> None:
    """And a command whose arguments are no text; the recording can be read, and shown."""
    installed_library()
    path = tmp_path / "recording"
    program = " & ".join(f'"$0" -c "$1" {name.hex()}' for name in ODD_NAMES)
    words = ["sh", "-c", f"{program} & wait", sys.executable]
    done = called("record", "-o", path, "--", *words, _TAKES, "\udcfc")
    assert done.code == 0, done.err
    recording = open_recording(path)
    taken = recording.events["rcl_take"].group_by("pid").len()
    assert taken["len"].to_list() == [200] * len(ODD_NAMES)
    assert recording.info.lost == {"lost_events": 0}
    assert recording.info.command[-1] == "\\xfc"
    names = set(recording.events["rcl_node_init"]["node_name"])
    assert {text_of(name) for name in ODD_NAMES if b"\0" not in name} == names
    assert called("info", path).code == 0
