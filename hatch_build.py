"""Wheels bring the library that stands in front of ROS 2, compiled; the build needs a C compiler.

`CC=aarch64-linux-gnu-gcc` builds the wheel of another machine. Without a compiler the wheel has no
library, fits every machine, and the first use compiles it; so do editable installs.
"""

import ast
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = "chainshaper/sources/preload"


class CustomBuildHook(BuildHookInterface[Any]):
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        source = Path(self.root, "src", FOLDER)
        compiler = shutil.which(os.environ.get("CC", "cc"))
        if version == "editable" or compiler is None:
            return
        said = {
            assigned.targets[0].id: ast.literal_eval(assigned.value)
            for assigned in ast.parse((source / "__init__.py").read_text()).body
            if isinstance(assigned, ast.Assign)
            and isinstance(assigned.targets[0], ast.Name)
            and assigned.targets[0].id in ("_FILE", "_OPTIONS", "_LIBRARIES")
        }
        self.scratch = tempfile.TemporaryDirectory()
        library = Path(self.scratch.name, said["_FILE"])
        words = [compiler, *said["_OPTIONS"], "-s", "-o", str(library), str(source / "preload.c")]
        subprocess.run([*words, *said["_LIBRARIES"]], check=True)
        machine = subprocess.check_output([compiler, "-dumpmachine"], text=True).partition("-")[0]
        newest = max(int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)", library.read_bytes()))
        build_data["force_include"][str(library)] = f"{FOLDER}/{library.name}"
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-manylinux_2_{newest}_{machine}"
