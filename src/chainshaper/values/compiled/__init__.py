"""Compiled loops over bytes and columns, ready to run without their compiler.

Importing Numba takes half a second, as long as reading ten million events. So loops that every
trace needs are written for addresses and counts only (:mod:`~chainshaper.values.compiled.memory`):
what Numba makes of those needs nothing of Python. It is compiled once on a machine, in a process of
its own, whose 90 MB end with it, then loaded from an object file in some tens of milliseconds.

The file stands beside the kernel's module, or in the user's cache where that folder cannot be
written; where neither can, every process compiles anew. Its name is a digest of all that it was
made of. Only files are loaded that root and the user of this process alone can change, and that end
with the digest of what is in front of it.
"""

import ctypes
import functools
import hashlib
import importlib
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from chainshaper.values.errors import OperationError
from chainshaper.values.files import own_cache, why_distrusted, write_whole

try:
    import llvmlite.binding as llvm  # type: ignore[import-untyped]
except ModuleNotFoundError:  # Python interprets the functions (`memory`)
    llvm = None

_OF_NUMBAS_RUNTIME = re.compile(r"^declare (.*@(?:NRT_|numba_)\w+\([^)]*\)).*$", re.MULTILINE)
"""What code from Numba calls to raise and to free, which kernels never do: traps, in their file.

Under their own names they would take the place of the real ones for all code that Numba compiles.
"""

_DIGEST_SIZE = hashlib.sha256().digest_size
_loading = Lock()  # LLVM's loader, and the compiler, are for one thread at a time
_engines: list[Any] = []  # code lives as long as its engine


@functools.cache
def kernel(module: str, name: str) -> Callable[..., int]:
    """The function ``name`` of ``module``, as machine code, loaded or compiled at the first call.

    It takes and returns 64-bit integers, none of which are checked, and runs without Python's lock.
    """

    @functools.cache
    def address() -> int:
        spec, symbol = importlib.util.find_spec(module), f"{module}.{name}"
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError(module)
        beside = Path(spec.origin).parent
        file, folders = f"{symbol}-{_digest(beside)}.o", _folders(beside)
        code = next((found for folder in folders if (found := _read(folder / file))), None)
        if code is None:
            code = _compiled_apart(module, name) or compiled_here(module, name)
            _write(code, folders, symbol, file)
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target())
        engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(code))
        engine.finalize_object()
        _engines.append(engine)
        return int(engine.get_function_address(symbol))

    def interpreted(*numbers: int) -> int:
        with np.errstate(over="ignore"):  # as machine code computes
            function = getattr(importlib.import_module(module), name)
            return int(function(*map(np.int64, numbers)))

    def call(*numbers: int) -> int:
        with _loading:
            place = address()
        function = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_int64] * len(numbers))(place)
        return int(function(*numbers))

    return interpreted if llvm is None else call


@functools.cache
def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for source in sorted([*folder.glob("*.py"), *Path(__file__).parent.glob("*.py")]):
        digest.update(source.read_bytes())
    made_by = [version("numba"), version("llvmlite"), llvm.get_process_triple()]
    made_for = [llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()]
    digest.update(repr(made_by + made_for).encode())
    return digest.hexdigest()[:24]


def _folders(beside: Path) -> list[Path]:
    """Where machine code may be, best first. Links are followed here, once, before any check."""
    return [Path(os.path.realpath(beside / "__pycache__")), own_cache()]


def _read(file: Path) -> bytes | None:
    """The object file's content, if it is as a trusted user wrote it."""
    try:
        content = file.read_bytes() if why_distrusted(file) is None else b""
    except OSError:
        return None
    code, digest = content[:-_DIGEST_SIZE], content[-_DIGEST_SIZE:]
    return code if digest == _content_digest(code, file.name) else None


def _content_digest(code: bytes, name: str) -> bytes:
    return hashlib.sha256(name.encode() + b"\0" + code).digest()


@functools.cache
def _target() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    cpu, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(cpu=cpu, features=features, opt=3, jit=True)


def _compiled_apart(module: str, name: str) -> bytes:
    """What :func:`compiled_here` gives, from another process; nothing where none can be had.

    (An interpreter inside another program has no command of its own.) The process imports from
    where this one does, but from no current folder: it may be anybody's.
    """
    script = (
        "import sys; sys.path[:0] = sys.argv[1].split(':'); "
        "from chainshaper.values.compiled import compiled_here; "
        "sys.stdout.buffer.write(compiled_here(*sys.argv[2:]))"
    )
    folders = ":".join(filter(os.path.isabs, sys.path))
    command = [sys.executable, "-I", "-c", script, folders, module, name]
    with suppress(OSError, subprocess.SubprocessError):
        return subprocess.run(command, capture_output=True, check=True).stdout
    return b""


def compiled_here(module: str, name: str) -> bytes:
    """The object file of a function that Numba compiles, callable as ``MODULE.NAME``."""
    import numba

    function, symbol = getattr(importlib.import_module(module), name).py_func, f"{module}.{name}"
    kind = numba.types.int64(*[numba.types.int64] * function.__code__.co_argcount)
    found = numba.cfunc(kind, error_model="numpy")(function)
    text = found.inspect_llvm().replace(found.native_name, symbol)
    text = _OF_NUMBAS_RUNTIME.sub(
        r"define internal \1 {\n  call void @llvm.trap()\n  unreachable\n}", text
    )
    if "declare void @llvm.trap()" not in text:
        text += "\ndeclare void @llvm.trap()\n"
    return bytes(_target().emit_object(llvm.parse_assembly(text)))


def _write(code: bytes, folders: list[Path], symbol: str, file: str) -> None:
    """Write the object file into the first folder that takes it, in place of older ones."""
    for folder in folders:
        try:
            for one in (*reversed(folder.parents), folder):
                if not one.exists() and why_distrusted(one.parent) is None:
                    one.mkdir(mode=0o755, exist_ok=True)
            if why_distrusted(folder) is not None:
                continue
            # The linker does not mind what is behind the end of an object file.
            write_whole(folder / file, [code, _content_digest(code, file)])
            for old in folder.glob(f"{symbol}-*.o"):
                if old.name != file:
                    old.unlink(missing_ok=True)
        except (OSError, OperationError):
            continue
        return
