"""The native libraries, built for another machine than this one."""

import fcntl
import functools
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_PATIENCE_S = 600  # other tests compile at the same time


@functools.cache
def built_for_arm64() -> Path:
    """The folder with the libraries that stand in front of ROS 2, for arm64.

    It is one of this checkout, in which CMake compiles only what has changed since.
    """
    for compiler in ("aarch64-linux-gnu-gcc", "aarch64-linux-gnu-g++"):
        if shutil.which(compiler) is None:
            pytest.skip(f"{compiler} is not installed")
    cmake = shutil.which("cmake") or shutil.which("cmake", path=str(Path(sys.executable).parent))
    assert cmake is not None, "scripts/setup has installed it"
    folder = ROOT / "build/arm64"
    options = ["-DCHAINSHAPER_BINDINGS=OFF", f"-DPython_EXECUTABLE={sys.executable}"]
    toolchain = f"-DCMAKE_TOOLCHAIN_FILE={ROOT / 'core/toolchains/arm64.cmake'}"
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:  # the tests run in several processes
        fcntl.flock(lock, fcntl.LOCK_EX)
        words = [cmake, "-S", str(ROOT / "core"), "-B", str(folder), toolchain, *options]
        subprocess.run(words, check=True, capture_output=True, timeout=_PATIENCE_S)
        build = [cmake, "--build", str(folder), "--parallel", "2", "--target"]
        targets = ["chainshaper_core", "chainshaper_trace", "chainshaper_gate"]
        subprocess.run([*build, *targets], check=True, capture_output=True, timeout=_PATIENCE_S)
    return folder / "preloaded"
