"""For colcon: the package of this repository that it builds, of the type `ament_python`.

colcon installs no dependencies. Those without a package of a distribution come from PyPI, into the
Python that ROS runs with, best in a virtual environment (docs/install.md), which is all
that `ros2 chain` needs, with or without colcon.

The C++ library is built by CMake, as pip does it, with the nanobind of that environment.

It stands in a folder of its own because colcon cannot read what setuptools makes of a
pyproject.toml beside it. Paths are relative to this folder, as colcon demands.
"""

import re
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

NAME = "chainshaper"
SOURCES = "../src"
PROJECT = Path("../pyproject.toml")
VERSION = re.search(r'^version = "(.+)"$', PROJECT.read_text(), re.MULTILINE)
assert VERSION is not None  # noqa: S101 - pyproject.toml is ours

PACKAGE = Path(SOURCES, NAME)
DATA = [  # modules are found by setuptools; nodes that are written out for ROS 2 are no modules
    str(path.relative_to(PACKAGE))
    for path in PACKAGE.rglob("*")
    if path.is_file()
    and path.suffix != ".pyc"
    and not (path.suffix == ".py" and path.with_name("__init__.py").exists())
]


class CMakeBuild(build_ext):
    """Builds the native library, and what stands in front of ROS 2, by `core/CMakeLists.txt`."""

    def build_extension(self, ext: Extension) -> None:
        beside = Path(self.get_ext_fullpath(ext.name)).absolute().parent
        options = [f"-DPython_EXECUTABLE={sys.executable}", "-DCMAKE_BUILD_TYPE=Release"]
        build = str(Path(self.build_temp).absolute())
        subprocess.run(["cmake", "-S", "../core", "-B", build, *options], check=True)
        subprocess.run(["cmake", "--build", build, "--parallel", "2"], check=True)
        # CMake installs into a folder named as the package: that is where this one is.
        install = ["cmake", "--install", build, "--strip", "--prefix", str(beside.parent)]
        subprocess.run(install, check=True)


setup(
    name=NAME,
    ext_modules=[Extension(f"{NAME}._core", sources=[])],
    cmdclass={"build_ext": CMakeBuild},
    version=VERSION[1],
    package_dir={"": SOURCES},
    packages=find_packages(SOURCES),
    package_data={NAME: DATA},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": ["chainshaper = chainshaper.__main__:main"],
        "ros2cli.command": ["chain = chainshaper.cli.ros2_chain:ChainCommand"],
    },
)
