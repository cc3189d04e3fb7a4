"""Stream files on disk: mapping them and finding their packets (CTF 1.8, section 5)."""

import mmap
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.assembly import Assembly
from chainshaper.sources.ctf.errors import CtfError
from chainshaper.values.compiled import kernel

__all__ = ["MappedFile", "Scratch", "packet_table", "stream_paths"]

_scan_packets = kernel("chainshaper.sources.ctf.kernels", "scan_packets")
_rehash = kernel("chainshaper.sources.ctf.texts", "rehash")
_REASONS = {
    tb.BAD_MAGIC: "packet does not begin with the CTF magic number",
    tb.BAD_UUID: "packet belongs to another trace (uuid differs from the metadata's)",
    tb.BAD_STREAM: "packet of a stream class that the metadata does not declare",
    tb.BAD_SIZE: "packet with impossible content or packet size",
    tb.BAD_HEADER: "packet header cut short",
    tb.COSTLY: "packet headers that take far more work than their size warrants",
    tb.CUT: "last packet cut short by the end of the file",
}


class Scratch:
    """The tables that kernels work with in one thread, and their addresses.

    ``address`` is that of the table of addresses (see `tables`); it is valid as
    long as this lives.
    """

    def __init__(self, assembly: Assembly, files: int = 1) -> None:
        counters = max(assembly.counters, 1)
        ops, ranges = assembly.program.arrays()
        self.state = np.zeros(tb.STATE_WORDS, np.int64)
        self.state[tb.X_BUDGET] = 1 << 62
        self.rows = np.zeros(counters, np.int64)
        self.caps = np.full(counters, 1 << 62, np.int64)
        self.registers = np.zeros((files, assembly.registers), np.int64)
        # One place more than used: places are read eight bytes at a time.
        self.slots = np.zeros(1024 + 1, np.int32)
        self.entries = np.zeros((512, 4), np.int64)
        self._words = np.zeros(tb.MACHINE_WORDS, np.int64)
        self._tables = {
            tb.M_OPS: ops,
            tb.M_RANGES: ranges,
            tb.M_STATE: self.state,
            tb.M_ROWS: self.rows,
            tb.M_CAPS: self.caps,
            tb.M_SAVED: np.zeros(counters, np.int64),
            tb.M_STREAMS: assembly.streams(),
            tb.M_EVENTS: assembly.event_rows(),
            tb.M_IDS: np.array(assembly.ids or [0], np.int64),
            tb.M_BATCHES: np.zeros((len(assembly.events), 1 + 2 * tb.BATCH), np.int64),
        }
        for word, table in self._tables.items():
            self._words[word] = table.ctypes.data
        self._words[tb.M_COUNTERS] = counters
        self._place_dictionary()
        self.address = int(self._words.ctypes.data)

    def _place_dictionary(self) -> None:
        self._words[tb.M_SLOTS] = self.slots.ctypes.data
        self._words[tb.M_MASK] = len(self.slots) - 2
        self._words[tb.M_ENTRIES] = self.entries.ctypes.data
        self._words[tb.M_ROOM] = len(self.entries)

    def strings(self) -> NDArray[np.int64]:
        """Address, length, hash and last word of the strings in the dictionary, by code."""
        return self.entries[: self.state[tb.X_STRINGS]]

    def grow(self) -> None:
        """Give the dictionary four times its places."""
        entries = np.zeros((4 * len(self.entries), 4), np.int64)
        entries[: len(self.entries)] = self.entries
        self.entries = entries
        self.slots = np.zeros(4 * (len(self.slots) - 1) + 1, np.int32)
        self._place_dictionary()
        _rehash(self.address, int(self.state[tb.X_STRINGS]))


class MappedFile:
    """A file mapped for reading: ``address`` and ``size`` in bytes, valid until `close`."""

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as file:
                self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise CtfError(path, None, f"cannot map the file: {error}") from error
        self._view = np.frombuffer(self._map, np.uint8)
        self.address = int(self._view.ctypes.data)
        self.size = len(self._map)

    def forget(self, first: int, last: int) -> None:
        """Give back the memory of bytes [first, last); the file's pages stay cached."""
        first = -(-first // mmap.PAGESIZE) * mmap.PAGESIZE
        if last - first >= mmap.PAGESIZE and hasattr(mmap, "MADV_DONTNEED"):
            self._map.madvise(mmap.MADV_DONTNEED, first, last - first)

    def close(self) -> None:
        """Unmap the file."""
        del self._view
        self._map.close()


def stream_paths(folder: Path) -> list[Path]:
    """The stream files of a trace folder: all plain files but ``metadata`` and hidden ones."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.is_file() and path.name != "metadata" and not path.name.startswith(".")
    )


def packet_table(
    path: Path, assembly: Assembly, folder: int
) -> tuple[NDArray[np.int64], list[str]]:
    """The packets of a stream file (see `tables`) and warnings about it.

    Reading stops where a packet's header makes no sense, since nothing says where the next one
    begins; a packet that the end of the file cuts short is kept up to there.
    """
    if path.stat().st_size == 0:
        return np.zeros((0, tb.PACKET_COLUMNS), np.int64), []
    file = MappedFile(path)
    scratch = Scratch(assembly)
    scratch.state[tb.X_BUDGET] = tb.BUDGET * file.size
    packets = np.zeros((256, tb.PACKET_COLUMNS), np.int64)
    first, last = assembly.folders[folder]
    reached = np.zeros(2, np.int64)
    status = tb.FULL
    while status == tb.FULL:
        status = _scan_packets(
            scratch.address, scratch.registers.ctypes.data, file.address, file.size,
            packets.ctypes.data, len(packets), reached.ctypes.data, first, last,
        )  # fmt: skip
        if status == tb.FULL:
            packets = np.concatenate([packets, np.zeros_like(packets)])
    size, (offset, found) = file.size, reached.tolist()
    file.close()
    if status == tb.DONE:
        return packets[:found].copy(), []
    error = CtfError(
        path,
        offset,
        _REASONS[status],
        "events up to the cut are read"
        if status == tb.CUT
        else f"the last {size - offset} bytes of the file are not read",
    )
    return packets[:found].copy(), [str(error)]
