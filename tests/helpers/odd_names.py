"""Names that are no UTF-8, or have in them what ends a word, a line or a name elsewhere."""

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest

ODD_NAMES = (
    b"\xfc",  # an "ü" of Latin 1
    "name of fifteen ä".encode()[:17],  # cut in the middle of the last character
    b"a b) S 1 (c\tnext",
    b"a\nUid:\t0\t0\t0\t0",
    b"a\rUid:\t0\t0\t0\t0",  # as long as a name of a program may be
    b"\x85\x1c\x0b\x0c\xe2\x80\xa8",  # each ends a line for `str.splitlines`
    b"\x1b]0;owned\x07",
    b"0::/\\040#\\012",
)
BY_NAME = pytest.mark.parametrize("name", ODD_NAMES, ids=ascii)

_PROGRAM = (
    "import ctypes, os, sys, threading\n"
    "libc, name = ctypes.CDLL(None), os.fsencode(sys.argv[1])\n"
    "def named():\n"
    "    libc.prctl(15, name, 0, 0, 0)\n"
    "    ready.set(); threading.Event().wait()\n"
    "ready = threading.Event()\n"
    "threading.Thread(target=named, daemon=True).start(); ready.wait()\n"
    "libc.prctl(15, name, 0, 0, 0)\n"
    "os.setresuid(*3 * [int(sys.argv[2])])\n"
    "print(); sys.stdout.flush(); sys.stdin.read()\n"
)


@contextmanager
def process_named(
    name: bytes, arguments: Sequence[bytes] = (), user: int | None = None
) -> Iterator["subprocess.Popen[bytes]"]:
    """A process, and a thread in it, of that name, which is also its first argument."""
    command = [sys.executable.encode(), b"-S", b"-c", _PROGRAM.encode(), name]
    command += [str(os.geteuid() if user is None else user).encode(), *arguments]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"\n"
        yield process
    finally:
        process.kill()
        process.communicate()
