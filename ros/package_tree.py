"""Makes the folder of Python packages that a package for ROS 2 or Debian installs.

    python3 ros/package_tree.py BUILD PACKAGES

PACKAGES gets chainshaper, compiled for this Python, with what distributions lack inside it
(`chainshaper/vendored`, pinned in `vendored.txt`). BUILD has what the next run builds on.
CMakeLists.txt and scripts/build_deb call it. It needs pip, CMake, a C++ compiler and Python's
headers.

The pinned files come from PyPI; where there is no network, from the folder `ros/wheels`:

    python3 ros/package_tree.py --download     fills it, for this Python and processor
"""

import argparse
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
SOURCE = HERE.parent
WHEELS = HERE / "wheels"
VENDORED, TOOLS = HERE / "vendored.txt", HERE / "build_tools.txt"
# Runs the build backend without pip, whose older versions hand on no settings.
_BUILD = (
    "import sys; from scikit_build_core.build import build_wheel; "
    "build_wheel(sys.argv[1], {'build-dir': sys.argv[2]})"
)


def main() -> None:
    """Make the folder of packages, or download what it is made of."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("build", type=Path, nargs="?")
    parser.add_argument("packages", type=Path, nargs="?")
    parser.add_argument("--download", action="store_true")
    words = parser.parse_args()
    if words.download:
        for pins in (VENDORED, TOOLS):
            _pip("download", "--dest", str(WHEELS), pins=pins)
    elif words.packages is None:
        parser.error("name BUILD and PACKAGES, or --download")
    else:
        make_tree(words.build.absolute(), words.packages.absolute())


def make_tree(build: Path, packages: Path) -> None:
    """Build chainshaper below ``build``, and unpack it into ``packages`` beside what it needs."""
    build.mkdir(parents=True, exist_ok=True)
    tools = _installed(TOOLS, build / "tools")
    vendored = _installed(VENDORED, build / "vendored")
    made = build / "wheel"
    shutil.rmtree(made, ignore_errors=True)
    environment = {
        "CMAKE_BUILD_PARALLEL_LEVEL": str(os.cpu_count() or 1),  # unless the user says another
        **os.environ,
        "PYTHONPATH": str(tools),
    }
    command = [sys.executable, "-c", _BUILD, str(made), str(build / "native")]
    subprocess.run(command, check=True, cwd=SOURCE, env=environment)
    shutil.rmtree(packages, ignore_errors=True)
    (wheel,) = made.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    shutil.copytree(vendored, packages / "chainshaper" / "vendored")


def _installed(pins: Path, folder: Path) -> Path:
    """Install pinned packages into a folder, unless the same pins are there already."""
    done = folder.with_suffix(".pins")
    wanted = f"{sys.version}\n{pins.read_text()}"
    if not (done.is_file() and done.read_text() == wanted):
        shutil.rmtree(folder, ignore_errors=True)
        _pip("install", "--no-compile", "--target", str(folder), pins=pins)
        shutil.rmtree(folder / "bin", ignore_errors=True)
        done.write_text(wanted)
    return folder


def _pip(verb: str, *words: str, pins: Path) -> None:
    """Run pip for pinned packages, from files where they are here; end the build where it fails."""
    where = ["--no-index", "--find-links", str(WHEELS)] if WHEELS.is_dir() else []
    if verb == "download":
        where = []
    command = [sys.executable, "-m", "pip", verb, "--quiet", "--disable-pip-version-check"]
    command += ["--require-hashes", "--no-deps", "--only-binary", ":all:", *where]
    finished = subprocess.run([*command, *words, "-r", str(pins)], check=False)
    if finished.returncode:
        sys.exit(
            f"error: pip could not get what {pins} names: where there is no network, fill {WHEELS}"
            " beforehand by `python3 ros/package_tree.py --download` on a machine that has one"
        )


if __name__ == "__main__":
    main()
