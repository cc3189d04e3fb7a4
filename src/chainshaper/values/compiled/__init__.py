"""Compiled loops over bytes and columns, ready to run without their compiler.

Numba makes machine code of loops that are written in Python; importing and setting it up takes
half a second, which is as long as reading ten million events. Loops that every trace needs are
therefore written for addresses and counts only (:mod:`~chainshaper.values.compiled.memory`): what
Numba makes of those needs nothing of Python, so it is compiled once on a machine, then loaded from
an object file in some tens of milliseconds.

The file stands beside the kernel's module like Python's own compiled files, or in the user's
cache where that folder cannot be written; where neither can, every process compiles anew. Its
name is a digest of everything that decides what is in it: the sources of the kernel's folder and
of this one, Numba, LLVM, and the processor that it is for.

Machine code does what it wants, and a part of it ends the process. So only files are loaded that
root and the user of this process alone can change, and that end with the digest of what is in front
of it. Whatever is not so is compiled anew, and its file replaced where that is permitted.
"""

import ctypes
import functools
import hashlib
import importlib
import importlib.util
import os
import pwd
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from typing import Any

import llvmlite.binding as llvm  # type: ignore[import-untyped]

from chainshaper.values.errors import OperationError
from chainshaper.values.files import why_distrusted, write_whole

__all__ = ["kernel"]

_OF_NUMBAS_RUNTIME = re.compile(r"^declare (.*@(?:NRT_|numba_)\w+\([^)]*\)).*$", re.MULTILINE)
"""What code from Numba calls to raise and to free, which kernels never do.

It is defined in the object file itself, as a trap: under its own name it would take the place of
the real one for all code that Numba compiles in this process.
"""

_DIGEST_SIZE = hashlib.sha256().digest_size

_loading = Lock()  # LLVM's loader, and the compiler, are for one thread at a time


@functools.cache
def kernel(module: str, name: str) -> Callable[..., int]:
    """The function ``name`` of ``module``, as machine code.

    It takes and returns 64-bit integers, none of which are checked, and runs without Python's
    lock. The code is loaded, or compiled, at the first call.
    """

    @functools.cache
    def address() -> int:
        path, symbol = _module_file(module), f"{module}.{name}"
        file = f"{symbol}-{_digest(path.parent)}.o"
        for folder in _folders(path.parent):
            code = _read(folder / file)
            if code is not None:
                return _loaded(code, symbol)
        code = _compiled(getattr(importlib.import_module(module), name), symbol)
        _keep(code, _folders(path.parent), symbol, file)
        return _loaded(code, symbol)

    def call(*numbers: int) -> int:
        with _loading:
            place = address()
        function = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_int64] * len(numbers))(place)
        return int(function(*numbers))

    return call


def _module_file(module: str) -> Path:
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(module)
    return Path(spec.origin)


@functools.cache
def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for source in sorted([*folder.glob("*.py"), *Path(__file__).parent.glob("*.py")]):
        digest.update(source.read_bytes())
    made_by = [version("numba"), version("llvmlite"), llvm.get_process_triple()]
    made_for = [llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()]
    digest.update(repr(made_by + made_for).encode())
    return digest.hexdigest()[:24]


def _folders(beside: Path) -> Iterator[Path]:
    """Where machine code may be, best first. Links are followed here, once, before any check."""
    yield Path(os.path.realpath(beside / "__pycache__"))
    yield Path(os.path.realpath(_users_cache() / "chainshaper"))


def _users_cache() -> Path:
    """The cache that the environment names; where that is another user's (`sudo -E`), our own."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not named.is_absolute():  # and is to be ignored, as its specification has it
        named = Path(os.path.expanduser("~/.cache"))  # noqa: PTH111 - the other raises without one
    existing = next(place for place in (named, *named.parents) if os.path.exists(place))  # noqa: PTH110
    if why_distrusted(existing) is not None:
        with suppress(KeyError):  # a user without a name
            return Path(pwd.getpwuid(os.geteuid()).pw_dir, ".cache")
    return named


def _read(file: Path) -> bytes | None:
    """The object file's content, if it is as a trusted user wrote it."""
    try:
        if why_distrusted(file) is not None:
            return None
        content = file.read_bytes()
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
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        jit=True,
    )


def _compiled(dispatcher: Any, symbol: str) -> bytes:
    """The object file of a function that Numba compiles, callable as ``symbol``."""
    import numba

    function = dispatcher.py_func
    kind = numba.types.int64(*[numba.types.int64] * function.__code__.co_argcount)
    found = numba.cfunc(kind, error_model="numpy")(function)
    text = found.inspect_llvm().replace(found.native_name, symbol)
    text = _OF_NUMBAS_RUNTIME.sub(
        r"define internal \1 {\n  call void @llvm.trap()\n  unreachable\n}", text
    )
    if "declare void @llvm.trap()" not in text:
        text += "\ndeclare void @llvm.trap()\n"
    return bytes(_target().emit_object(llvm.parse_assembly(text)))


def _keep(code: bytes, folders: Iterator[Path], symbol: str, file: str) -> None:
    """Write the object file into the first folder that takes it, in place of older ones."""
    for folder in folders:
        try:
            _make_own(folder)
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


def _make_own(folder: Path) -> None:
    """Make a folder, and those above it, wherever root and we alone can change what is there."""
    for one in (*reversed(folder.parents), folder):
        if not one.exists() and why_distrusted(one.parent) is None:
            one.mkdir(mode=0o755, exist_ok=True)


_engines: list[Any] = []  # code lives as long as its engine


def _loaded(code: bytes, symbol: str) -> int:
    """The address of ``symbol`` in an object file."""
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target())
    engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _engines.append(engine)
    return int(engine.get_function_address(symbol))
