"""Programs of tests that contain the gate in C++, from the headers of the package for all types."""

import shutil
import subprocess
from pathlib import Path

import pytest

from chainshaper.splicing.node_packages import cpp_package


def compiled(source: Path, folder: Path, name: str = "g++") -> Path:
    """The program of a source file, compiled into a folder; no warning is let pass."""
    compiler = shutil.which(name)
    if compiler is None:
        pytest.skip(f"{name} is not installed, so the gate in C++ cannot be compiled")
    for path, text in cpp_package().items():
        if path.endswith(".hpp"):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text)
    program = folder / source.stem
    warnings = ["-Wall", "-Wextra", "-Wconversion", "-Werror"]
    options = ["-std=c++17", "-O1", *warnings, f"-I{folder / 'include'}", "-static"]
    subprocess.run([compiler, *options, source, "-o", program], check=True, timeout=150)
    return program
