"""Processes of ours: how they are started, and how they ended.

A process of ours often has more rights than whoever fills the folder that it is started in. So its
Python is isolated (``-I``): it finds nothing through the current folder, through PYTHON* variables
or among the user's own packages. Of what this drops, a process gets back what it needs, by its
place, and only if root and we alone can change it: our package, and behind all other folders those
of the libraries that it says it needs.
"""

import contextlib
import importlib.util
import os
import shutil
import signal
import site
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from chainshaper.values.errors import OperationError
from chainshaper.values.trusted_files import why_distrusted

__all__ = [
    "LIBRARIES",
    "end_in_words",
    "is_installed",
    "module_command",
    "named_folders",
    "tool_environment",
    "what_happened",
]

LIBRARIES = ("cyclonedds", "llvmlite", "numba", "numpy", "polars", "pydantic", "scipy", "yaml")
"""What processes import that simulate, or have DDS; all others need Python alone."""

_PACKAGE = Path(__file__).resolve().parents[1]
_START = (
    "import importlib.util as u, runpy, sys; package, folders, module = sys.argv[1:4]; "
    "del sys.argv[1:4]; sys.path += [f for f in folders.split(':') if f and f not in sys.path]; "
    "s = u.spec_from_file_location('chainshaper', package) if package else None; "
    "m = s and sys.modules.setdefault('chainshaper', u.module_from_spec(s)); "
    "s and s.loader.exec_module(m); "
    "runpy.run_module(module, run_name='__main__', alter_sys=True)"
)


def module_command(module: str, libraries: Sequence[str] = ()) -> list[str]:
    """How a module runs as a process of ours; its arguments go behind.

    ``libraries`` are found where this process finds them.

    Raises:
        OperationError: others may change the package, and an isolated Python has no other.
    """
    package, reason = str(_PACKAGE / "__init__.py"), why_distrusted(_PACKAGE)
    if reason is not None:
        elsewhere = (*named_folders(), site.getusersitepackages(), str(Path.cwd()))
        if str(_PACKAGE.parent) in elsewhere:
            raise OperationError(
                f"chainshaper's own processes do not run from {_PACKAGE.parent}: {reason}; see "
                "that only root and you can write there, or install chainshaper elsewhere"
            )
        package = ""  # whoever installed this Python has it find the package, and answers for that
    folders = os.pathsep.join(dict.fromkeys(_folders_of(libraries)))
    return [sys.executable, "-I", "-c", _START, package, folders, module]


def _folders_of(libraries: Sequence[str]) -> Iterator[str]:
    """Where libraries are, as far as an isolated Python does not look there, or must not."""
    own = (*site.getsitepackages(), str(Path(os.__file__).parent))
    for library in libraries:
        found = importlib.util.find_spec(library)
        if found is not None and found.origin is not None:
            place = Path(found.origin).parents[1 if found.submodule_search_locations else 0]
            if not str(place).startswith(own) and why_distrusted(place) is None:
                yield str(place)


def named_folders() -> list[str]:
    """The folders that PYTHONPATH names, but for those that mean the current one."""
    return [*filter(os.path.isabs, os.environ.get("PYTHONPATH", "").split(os.pathsep))]


def tool_environment() -> dict[str, str]:
    """Our environment, for tools that we run: their programs are in no current folder."""
    folders = filter(os.path.isabs, os.environ.get("PATH", "").split(os.pathsep))
    return {**os.environ, "PATH": os.pathsep.join(folders) or os.defpath}


def is_installed(tool: str) -> bool:
    """Whether :func:`tool_environment` has this program."""
    return shutil.which(tool, path=tool_environment()["PATH"]) is not None


def end_in_words(code: int) -> str:
    """A return code of `subprocess`: ``ended with code 3``, ``was killed by SIGSEGV``."""
    if code >= 0:
        return f"ended with code {code}"
    with contextlib.suppress(ValueError):
        return f"was killed by {signal.Signals(-code).name}"
    return f"was killed by signal {-code}"  # most real-time signals have no name of their own


def what_happened(process: "subprocess.Popen[Any]") -> str | None:
    """Why a child of ours is not at work any more, None while it is."""
    options = os.WEXITED | os.WSTOPPED | os.WNOHANG | os.WNOWAIT
    try:
        state = os.waitid(os.P_PID, process.pid, options)
    except ChildProcessError:
        return "ended"
    if state is None:
        return None
    if state.si_code == os.CLD_STOPPED:
        return f"was stopped by signal {state.si_status}"
    if state.si_code == os.CLD_EXITED:
        return f"ended with status {state.si_status}"
    return f"was killed by signal {state.si_status}"
