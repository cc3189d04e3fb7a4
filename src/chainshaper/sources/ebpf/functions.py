"""The functions that a process's callbacks are, found in its memory.

With uprobes no event says which function a callback is, but what stands around the address that is
its handle (64 bits, GCC's library):

* that of a timer is a member of `rclcpp::WallTimer<F, …>` or `GenericTimer<F, …>`, which begins
  with the address of its class's table, which leads to the class's name, stripped or not;
* that of a subscription or service begins with a `std::function`, which has the address of
  `std::_Function_handler<…, F>::_M_invoke`. Files name it unless they were stripped.

Upstream: Itanium C++ ABI, 2.5.2 and 2.9.5; libstdc++, `bits/std_function.h`.
"""

import ctypes
import os
import struct
from collections.abc import Iterable
from contextlib import suppress
from itertools import groupby
from operator import itemgetter
from pathlib import Path

from chainshaper.linux.processes import Region, region_at
from chainshaper.sources.elf import function_offsets, mapped_regions
from chainshaper.values.errors import text_of

_TIMERS = ("rclcpp::WallTimer<", "rclcpp::GenericTimer<")
_INVOKER = "_ZNSt17_Function_handlerI"
_BEFORE, _BEHIND = 64, 16
"""Words before and behind a callback's address that are looked at."""
_SHORTEST_NAME, _LONGEST_NAME = 3, 16_384


class _ProcessMemory:
    """The memory of a running process. ``invokers``: path → offset → mangled name, read so far."""

    def __init__(self, pid: int, memory: int, invokers: dict[str, dict[int, str]]) -> None:
        self.pid, self.memory, self.invokers = pid, memory, invokers
        self.regions = list(mapped_regions(pid))

    def words(self, address: int, count: int) -> tuple[int, ...]:
        """Eight-byte words; raises OSError where nothing is mapped."""
        data = os.pread(self.memory, 8 * count, address)
        return struct.unpack_from(f"={len(data) // 8}Q", data)

    def region(self, address: int) -> Region | None:
        return region_at(self.regions, address)

    def class_of(self, table: int) -> str | None:
        """The class whose table of virtual functions begins at an address, if one does."""
        with suppress(OSError, struct.error, ValueError):
            address = table - 8  # leads to what the class is, whose name is the second thing there
            for ahead in (0, 8):
                region = self.region(address + ahead)
                if region is None or region.executable:
                    return None
                (address,) = self.words(address + ahead, 1)
            if self.region(address) is not None:
                name = os.pread(self.memory, _LONGEST_NAME, address).partition(b"\0")[0]
                return demangled(name.removeprefix(b"*"))  # marks names that no other file may use
        return None

    def timer(self, callback: int) -> str | None:
        """The function of the timer whose member this is: the object before it says what it is."""
        with suppress(OSError):
            for word in reversed(self.words(callback - 8 * _BEFORE, _BEFORE)):
                name = self.class_of(word)
                if name is not None:
                    return type_argument(name, 0) if name.startswith(_TIMERS) else None
        return None

    def function(self, callback: int) -> str | None:
        """The function in the `std::function` behind this address."""
        with suppress(OSError):
            for word in self.words(callback, _BEHIND):
                region = self.region(word)
                if region is None or not region.executable:
                    continue
                if region.path not in self.invokers:
                    # In a container the path leads elsewhere from here.
                    functions = function_offsets(Path(f"/proc/{self.pid}/root{region.path}"))
                    self.invokers[region.path] = {
                        offset: name
                        for offset, name in functions.items()
                        if name.startswith(_INVOKER) and "9_M_invoke" in name
                    }
                mangled = self.invokers[region.path].get(word - region.start + region.offset)
                if mangled is not None:
                    return type_argument(demangled(mangled.encode()), 1)
        return None


def callback_functions(callbacks: Iterable[tuple[int, int]]) -> dict[tuple[int, int], str]:
    """(Process, callback) → the type of its function, where it is known and the process runs."""
    invokers: dict[str, dict[int, str]] = {}
    found: dict[tuple[int, int], str] = {}
    for pid, handles in groupby(sorted(set(callbacks)), key=itemgetter(0)):
        with suppress(OSError), Path(f"/proc/{pid}/mem").open("rb") as memory:
            process = _ProcessMemory(pid, memory.fileno(), invokers)
            for _, address in handles:
                name = process.timer(address)
                if name is None or name.startswith("std::function<"):
                    name = process.function(address)
                if name is not None:
                    found[pid, address] = name
    return found


def demangled(name: bytes) -> str | None:
    """A function or class as C++ writes it; None if that is no name, or libstdc++ is not there."""
    if len(name) < _SHORTEST_NAME:  # built-in types have such
        return None
    try:
        library, libc = ctypes.CDLL("libstdc++.so.6"), ctypes.CDLL(None)
    except OSError:
        return None
    library.__cxa_demangle.restype = ctypes.c_void_p
    text = library.__cxa_demangle(name, None, None, None)
    found = text_of(ctypes.string_at(text)) if text else None
    libc.free(ctypes.c_void_p(text))
    return found


def type_argument(name: str | None, number: int) -> str | None:
    """An argument of the first template in a name: 0 of ``a::B<c<d, e>, f>::g`` is ``c<d, e>``."""
    if name is None or "<" not in name:
        return None
    arguments, depth = [""], 0
    for character in name[name.index("<") :].replace("->", "→"):
        depth -= character in ">)]}"
        if depth == 0 and character == ">":
            break
        if character == "," and depth == 1:
            arguments.append("")
        elif depth:
            arguments[-1] += character
        depth += character in "<([{"
    arguments = [one.strip().replace("→", "->") for one in arguments]
    return arguments[number] if number < len(arguments) else None
