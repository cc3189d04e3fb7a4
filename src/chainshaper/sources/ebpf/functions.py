"""Find the functions of a process's callbacks in its memory.

With uprobes no event says which function a callback is. But a callback's handle is an address in
the process, and the memory around it shows the function (64 bits, GCC's library):

* The handle of a timer's callback is the address of a member of `rclcpp::WallTimer<F, …>` or
  `GenericTimer<F, …>`. Such an object begins with the address of its class's table of virtual
  functions, which leads to the class's name, whether files were stripped or not.
* At the handle of a subscription's or service's callback is a `std::function`, which has the
  address of `std::_Function_handler<…, F>::_M_invoke`. Files name it unless they were stripped.

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
"""Bytes of a mangled name."""


class _ProcessMemory:
    """The memory of a running process.

    ``invokers``: file → offset → the mangled name of `…::_M_invoke` there; it grows as files are
    read, and processes share it.
    """

    def __init__(self, pid: int, memory: int, invokers: dict[str, dict[int, str]]) -> None:
        self.pid, self.memory, self.invokers = pid, memory, invokers
        self.regions = list(mapped_regions(pid))

    def words(self, address: int, count: int) -> tuple[int, ...]:
        """Read words of eight bytes; raises OSError where nothing is mapped."""
        data = os.pread(self.memory, 8 * count, address)
        return struct.unpack_from(f"={len(data) // 8}Q", data)

    def region(self, address: int) -> Region | None:
        """Return the mapped region of a file that an address is in."""
        return region_at(self.regions, address)

    def class_of(self, table: int) -> str | None:
        """Return the class whose table of virtual functions begins at an address, if one does."""
        with suppress(OSError, struct.error, ValueError):
            # In front of the table is the address of the class's type_info; its second word is the
            # address of the class's name.
            address = table - 8
            for ahead in (0, 8):
                region = self.region(address + ahead)
                if region is None or region.executable:
                    return None
                (address,) = self.words(address + ahead, 1)
            if self.region(address) is not None:
                name = os.pread(self.memory, _LONGEST_NAME, address).partition(b"\0")[0]
                return demangled(name.removeprefix(b"*"))  # `*` marks a name local to its file
        return None

    def timer(self, callback: int) -> str | None:
        """Return the function of a timer's callback; None: it is no timer's."""
        with suppress(OSError):
            # The object begins before its member, with the address of its class's table.
            for word in reversed(self.words(callback - 8 * _BEFORE, _BEFORE)):
                name = self.class_of(word)
                if name is not None:
                    return type_argument(name, 0) if name.startswith(_TIMERS) else None
        return None

    def function(self, callback: int) -> str | None:
        """Return the function in the `std::function` behind this address; None: there is none."""
        with suppress(OSError):
            for word in self.words(callback, _BEHIND):
                region = self.region(word)
                if region is None or not region.executable:
                    continue
                if region.path not in self.invokers:
                    # The path as the process sees it, which may be in a container.
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
    """Return (process, callback) → the type of its function, where that is found.

    Nothing is found of processes that have ended.
    """
    invokers: dict[str, dict[int, str]] = {}
    functions: dict[tuple[int, int], str] = {}
    for pid, handles in groupby(sorted(set(callbacks)), key=itemgetter(0)):
        with suppress(OSError), Path(f"/proc/{pid}/mem").open("rb") as memory:
            process = _ProcessMemory(pid, memory.fileno(), invokers)
            for _, address in handles:
                name = process.timer(address)
                if name is None or name.startswith("std::function<"):
                    name = process.function(address)
                if name is not None:
                    functions[pid, address] = name
    return functions


def demangled(name: bytes) -> str | None:
    """Return a function's or class's name as C++ writes it; None: no such name, or no libstdc++."""
    if len(name) < _SHORTEST_NAME:  # of built-in types
        return None
    try:
        library, libc = ctypes.CDLL("libstdc++.so.6"), ctypes.CDLL(None)
    except OSError:
        return None
    library.__cxa_demangle.restype = ctypes.c_void_p
    text = library.__cxa_demangle(name, None, None, None)
    readable = text_of(ctypes.string_at(text)) if text else None
    libc.free(ctypes.c_void_p(text))
    return readable


def type_argument(name: str | None, number: int) -> str | None:
    """Return an argument of the first template in a name, by its number.

    Argument 0 of ``a::B<c<d, e>, f>::g`` is ``c<d, e>``.
    """
    if name is None or "<" not in name:
        return None
    arguments, depth = [""], 0
    # `->` ends no template, so it is one other character for the time being.
    for character in name[name.index("<") :].replace("->", "→"):
        if character in ">)]}":
            depth -= 1
        if depth == 0 and character == ">":
            break
        if character == "," and depth == 1:
            arguments.append("")
        elif depth:
            arguments[-1] += character
        if character in "<([{":
            depth += 1
    arguments = [argument.strip().replace("→", "->") for argument in arguments]
    return arguments[number] if number < len(arguments) else None
