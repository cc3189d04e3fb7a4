"""Which functions callbacks are, found in the memory of the processes that run them.

With LTTng `rclcpp_callback_register` says it, with uprobes no event does. But a callback's handle
is an address, and what stands around it tells (on 64-bit machines, for objects made by GCC's
library):

* that of a timer is a member of `rclcpp::WallTimer<F, …>` or `GenericTimer<F, …>`. The object
  begins with the address of its class's table, which leads to the class's name, stripped or not;
* that of a subscription or service begins with a `std::function`, which has the address of
  `std::_Function_handler<…, F>::_M_invoke`. Files name it unless they were stripped; what was
  stripped still has the names of what others may use as well, which lambdas are not.

In both, F is the type whose name `rclcpp_callback_register` has.

Upstream: Itanium C++ ABI, 2.5.2 and 2.9.5; libstdc++, `bits/std_function.h`; rclcpp, `timer.hpp`,
`any_subscription_callback.hpp`.
"""

import ctypes
import os
import struct
from bisect import bisect
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from chainshaper.sources.ebpf.trace_points import function_offsets

__all__ = ["callback_functions", "demangled", "type_argument"]

_TIMERS = ("rclcpp::WallTimer<", "rclcpp::GenericTimer<")
_INVOKER = "_ZNSt17_Function_handlerI"
_BEFORE, _BEHIND = 64, 16
"""Words before and behind a callback's address that are looked at."""
_SHORTEST_NAME, _LONGEST_NAME = 3, 16_384


@dataclass(frozen=True)
class _Region:
    """Memory that a file is mapped to; ``offset`` is where in the file it begins."""

    start: int
    end: int
    offset: int
    executable: bool
    path: str


@dataclass
class _Process:
    """A process whose memory is open; ``invokers`` are those that were found in files so far."""

    pid: int
    memory: int
    invokers: dict[str, dict[int, str]]
    regions: list[_Region] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.regions = list(_regions(self.pid))

    def words(self, address: int, count: int) -> tuple[int, ...]:
        """Eight-byte words; raises OSError where nothing is mapped."""
        data = os.pread(self.memory, 8 * count, address)
        return struct.unpack(f"={len(data) // 8}Q", data[: len(data) // 8 * 8])

    def region(self, address: int) -> _Region | None:
        number = bisect(self.regions, address, key=lambda one: one.start) - 1
        found = self.regions[number] if number >= 0 else None
        return found if found is not None and address < found.end else None


def callback_functions(callbacks: Iterable[tuple[int, int]]) -> dict[tuple[int, int], str]:
    """(Process, callback) → the type of its function, for callbacks of processes that run.

    Those that are not known, or cannot be read, are left out.
    """
    handles: dict[int, list[int]] = {}
    for pid, callback in callbacks:
        handles.setdefault(pid, []).append(callback)
    invokers: dict[str, dict[int, str]] = {}
    found: dict[tuple[int, int], str] = {}
    for pid, addresses in handles.items():
        with suppress(OSError):  # it has ended, or is another user's
            memory = os.open(f"/proc/{pid}/mem", os.O_RDONLY)
            try:
                process = _Process(pid, memory, invokers)
                for address in addresses:
                    name = _timer(process, address)
                    if name is None or name.startswith("std::function<"):
                        name = _function(process, address)
                    if name is not None:
                        found[pid, address] = name
            finally:
                os.close(memory)
    return found


def _regions(pid: int) -> Iterator[_Region]:
    for line in Path(f"/proc/{pid}/maps").read_text(errors="replace").splitlines():
        span, rights, offset, _, _, *path = line.split(maxsplit=5)
        if path and path[0].startswith("/"):
            start, end = (int(bound, 16) for bound in span.split("-"))
            yield _Region(start, end, int(offset, 16), "x" in rights, path[0])


def _class(process: _Process, table: int) -> str | None:
    """The class whose table of virtual functions begins at an address, if one does."""
    with suppress(OSError, struct.error):
        address = table - 8  # leads to what the class is, whose name is the second thing there
        for ahead in (0, 8):
            region = process.region(address + ahead)
            if region is None or region.executable:
                return None
            (address,) = process.words(address + ahead, 1)
        if process.region(address) is not None:
            name = os.pread(process.memory, _LONGEST_NAME, address).partition(b"\0")[0]
            return demangled(name.removeprefix(b"*"))  # marks names that no other file may use
    return None


def _timer(process: _Process, callback: int) -> str | None:
    """The function of the timer whose member this is: the object before it says what it is."""
    with suppress(OSError):
        for word in reversed(process.words(callback - 8 * _BEFORE, _BEFORE)):
            name = _class(process, word)
            if name is not None:
                return type_argument(name, 0) if name.startswith(_TIMERS) else None
    return None


def _function(process: _Process, callback: int) -> str | None:
    """The function in the `std::function` behind this address."""
    with suppress(OSError):
        for word in process.words(callback, _BEHIND):
            region = process.region(word)
            if region is None or not region.executable:
                continue
            if region.path not in process.invokers:
                # In a container the path leads elsewhere from here.
                functions = function_offsets(Path(f"/proc/{process.pid}/root{region.path}"))
                process.invokers[region.path] = {
                    offset: name
                    for offset, name in functions.items()
                    if name.startswith(_INVOKER) and "9_M_invoke" in name
                }
            mangled = process.invokers[region.path].get(word - region.start + region.offset)
            if mangled is not None:
                return type_argument(demangled(mangled.encode()), 1)
    return None


def demangled(name: bytes) -> str | None:
    """A function or class as C++ writes it; None if that is no name, or libstdc++ is not there."""
    if len(name) < _SHORTEST_NAME:  # built-in types have such
        return None
    try:
        library, libc = ctypes.CDLL("libstdc++.so.6"), ctypes.CDLL(None)
    except OSError:
        return None
    library.__cxa_demangle.restype = ctypes.c_void_p
    status = ctypes.c_int()
    text = library.__cxa_demangle(name, None, None, ctypes.byref(status))
    if not text:
        return None
    try:
        return ctypes.string_at(text).decode(errors="replace")
    finally:
        libc.free(ctypes.c_void_p(text))


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
