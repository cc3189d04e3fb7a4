"""The part of libbpf that a struct_ops policy needs, over ctypes.

libbpf.so.1 comes with every distribution that has BPF at all. An object file is opened, adjusted
and loaded, and its struct_ops map is attached. That gives a link, a file descriptor: when it is
closed, which the kernel does when the process ends, the policy is gone. All functions raise OSError
with what libbpf said.
"""

import ctypes
import functools
import os
import struct
from pathlib import Path
from typing import Any

from chainshaper.values.errors import PlatformError

LIBRARY = "libbpf.so.1"
_OLDEST = (1, 4)
"""The first version that tolerates members of sched_ext_ops that the kernel does not know."""
_KIND_ENUM64 = 19
_BTF_TYPE = struct.Struct("<III")
_TEST_RUN_OPTIONS = struct.Struct("<QQQIIQQIIIIIIII")
_messages: list[str] = []  # what libbpf has warned of since the object was opened


@functools.cache
def load_libbpf() -> Any:
    """Load the library and declare its functions. Raises PlatformError: it is absent or too old."""
    remedy = f"install libbpf {_OLDEST[0]}.{_OLDEST[1]} or newer (Debian 13: apt install libbpf1)"
    try:
        library = ctypes.CDLL(LIBRARY, use_errno=True)
    except OSError as error:
        raise PlatformError(f"{LIBRARY} cannot be loaded ({error}): {remedy}") from error
    version = (library.libbpf_major_version(), library.libbpf_minor_version())
    if version < _OLDEST:
        raise PlatformError(f"{LIBRARY} is version {version[0]}.{version[1]}: {remedy}")
    pointer, text, number = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int
    for name, result, *arguments in (
        ("bpf_object__open_file", pointer, text, pointer),
        ("bpf_object__load", number, pointer),
        ("bpf_object__close", None, pointer),
        ("bpf_object__find_map_by_name", pointer, pointer, text),
        ("bpf_object__find_program_by_name", pointer, pointer, text),
        ("bpf_program__fd", number, pointer),
        ("bpf_map__fd", number, pointer),
        ("bpf_map__initial_value", pointer, pointer, pointer),
        ("bpf_map__attach_struct_ops", pointer, pointer),
        ("bpf_link__destroy", number, pointer),
        ("bpf_map_update_elem", number, number, pointer, pointer, ctypes.c_uint64),
        ("bpf_map_lookup_elem", number, number, pointer, pointer),
        ("bpf_map_delete_elem", number, number, pointer),
        ("bpf_prog_test_run_opts", number, number, pointer),
        ("btf__load_vmlinux_btf", pointer),
        ("btf__free", None, pointer),
        ("btf__find_by_name", number, pointer, text),
        ("btf__type_by_id", pointer, pointer, ctypes.c_uint32),
        ("btf__name_by_offset", text, pointer, ctypes.c_uint32),
        ("libbpf_set_print", pointer, pointer),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    library.libbpf_set_print(_printer)
    return library


def _keep_message(level: int, pattern: bytes, arguments: int) -> int:
    """Keep a warning of libbpf for :func:`_failure`; all other messages are left out."""
    if level == 0:  # a warning
        text = ctypes.create_string_buffer(1 << 20)
        ctypes.CDLL(None).vsnprintf(
            text, ctypes.c_size_t(len(text)), pattern, ctypes.c_void_p(arguments)
        )
        _messages.append(text.value.decode(errors="replace").strip())
    return 0


_PRINTER = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p)
_printer = _PRINTER(_keep_message)


def _failure(step: str) -> OSError:
    """Make an error of the last function's error number, with what libbpf has warned of."""
    number = ctypes.get_errno()
    # The verifier gives its reason at the end of a long log.
    said = "; ".join(message[-400:] for message in _messages[-3:] if message)
    reason = f"{step}: {os.strerror(number)}"
    return OSError(number, f"{reason} ({said})" if said else reason)


class BpfObject:
    """An object file of BPF programs and maps.

    Methods that take a name raise KeyError: the object has nothing of that name.
    """

    def __init__(self, path: Path) -> None:
        self._library = load_libbpf()
        _messages.clear()
        self._object: int | None = self._library.bpf_object__open_file(bytes(path), None)
        if not self._object:
            raise _failure(f"opening {path}")

    def _find(self, kind: str, name: str) -> int:
        find = getattr(self._library, f"bpf_object__find_{kind}_by_name")
        address: int | None = find(self._object, name.encode())
        if not address:
            raise KeyError(f"the object has no {kind} {name}")
        return address

    def initial_bytes(self, map_name: str, size: int) -> "ctypes.Array[ctypes.c_char]":
        """Return the first ``size`` bytes of a map before it is loaded, to be written to."""
        address = self._library.bpf_map__initial_value(
            self._find("map", map_name), ctypes.byref(ctypes.c_size_t())
        )
        if not address:
            raise KeyError(f"map {map_name} has no initial value")
        return (ctypes.c_char * size).from_address(address)

    def load(self) -> None:
        """Have the kernel verify and keep all maps and programs."""
        if self._library.bpf_object__load(self._object):
            raise _failure("loading")

    def map_descriptor(self, name: str) -> int:
        return int(self._library.bpf_map__fd(self._find("map", name)))

    def run(self, program: str, context_size: int) -> "ProgramRun":
        """Return a `SEC("syscall")` program as a function."""
        return ProgramRun(self.program_descriptor(program), context_size)

    def program_descriptor(self, name: str) -> int:
        return int(self._library.bpf_program__fd(self._find("program", name)))

    def update(self, map_name: str, key: int, value: bytes) -> None:
        """Write one element of a map with 32-bit keys. Raises OSError: the kernel refuses."""
        descriptor, number = self.map_descriptor(map_name), ctypes.c_uint32(key)
        if self._library.bpf_map_update_elem(descriptor, ctypes.byref(number), value, 0):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    def element(self, map_name: str, key: int, size: int) -> bytes:
        """Read one element, of ``size`` bytes. Raises OSError: there is none."""
        descriptor, number = self.map_descriptor(map_name), ctypes.c_uint32(key)
        value = ctypes.create_string_buffer(size)
        if self._library.bpf_map_lookup_elem(descriptor, ctypes.byref(number), value):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return value.raw

    def delete(self, map_name: str, key: int) -> None:
        """Remove one element; harmless when there is none."""
        number = ctypes.c_uint32(key)
        self._library.bpf_map_delete_elem(self.map_descriptor(map_name), ctypes.byref(number))

    def attach_operations(self, map_name: str) -> int:
        """Put a struct_ops map in force; return the address of its link, for :meth:`detach`."""
        link: int | None = self._library.bpf_map__attach_struct_ops(self._find("map", map_name))
        if not link:
            raise _failure("attaching")
        return link

    def detach(self, link: int) -> None:
        self._library.bpf_link__destroy(link)

    def close(self) -> None:
        """Give back maps and programs; harmless when repeated."""
        if self._object:
            self._library.bpf_object__close(self._object)
            self._object = None


class ProgramRun:
    """A `SEC("syscall")` program, to be run on the calling core any number of times.

    It reads and writes ``context``. ``function(*arguments)`` runs it without a check, which takes
    less time.
    """

    def __init__(self, descriptor: int, context_size: int) -> None:
        self.context = ctypes.create_string_buffer(context_size)
        values = [0] * 15
        values[0], values[7] = _TEST_RUN_OPTIONS.size, context_size
        values[5] = ctypes.addressof(self.context)
        self._options = ctypes.create_string_buffer(_TEST_RUN_OPTIONS.pack(*values))
        self.function = load_libbpf().bpf_prog_test_run_opts
        self.arguments = (descriptor, ctypes.c_void_p(ctypes.addressof(self._options)))

    def __call__(self) -> None:
        """Run it. Raises OSError: the kernel refuses, or the program reports failure."""
        failed = self.function(*self.arguments)
        result = _TEST_RUN_OPTIONS.unpack_from(self._options)[9]
        if failed or result:
            raise OSError(ctypes.get_errno(), f"the program returned {result}")


def kernel_enum_value(enum: str, name: str) -> int | None:
    """Return the value of an enumerator of the running kernel; None: it has none of this name."""
    library = load_libbpf()
    btf = library.btf__load_vmlinux_btf()
    number = library.btf__find_by_name(btf, enum.encode()) if btf else -1
    try:
        if number < 0:
            return None
        address = library.btf__type_by_id(btf, number)
        _, information, _ = _BTF_TYPE.unpack(ctypes.string_at(address, _BTF_TYPE.size))
        is_wide = information >> 24 & 0x1F == _KIND_ENUM64
        member = struct.Struct("<III" if is_wide else "<II")
        members = ctypes.string_at(address + _BTF_TYPE.size, (information & 0xFFFF) * member.size)
        for name_offset, low, *high in member.iter_unpack(members):
            if library.btf__name_by_offset(btf, name_offset) == name.encode():
                return int(low | (high[0] << 32 if is_wide else 0))
        return None
    finally:
        library.btf__free(btf)
