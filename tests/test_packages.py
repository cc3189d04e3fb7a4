"""What packages say agrees: version, maintainer, licence, dependencies; the ROS package runs."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest
from command_line import called
from packaging.markers import default_environment
from packaging.requirements import Requirement
from small_chain import small_chain_text

import chainshaper as cs
from chainshaper.splicing.node_packages import cpp_package

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()  # noqa: S314 - our own
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")


def test_the_version_is_the_same_wherever_it_stands() -> None:
    """`pyproject.toml` has it; what cannot read that repeats it."""
    version = PROJECT["version"]
    assert re.fullmatch(r"[1-9]\d*\.\d+\.\d+", version), "semantic, from 1.0.0 on"
    assert called("--version").out == f"chainshaper {version}\n"
    assert MANIFEST.findtext("version") == version
    releases = re.findall(r"^(\d\S*) \((.*)\)\n-+$", (ROOT / "CHANGELOG.rst").read_text(), re.M)
    assert releases[0][0] == version
    assert f"The version is {version}" in (ROOT / "docs/versions.md").read_text()
    assert f"- Version: {version}" in (ROOT / "QUALITY_DECLARATION.md").read_text()


def test_maintainer_and_licence_are_the_same_in_every_package(tmp_path: Path) -> None:
    (maintainer,) = PROJECT["maintainers"]
    (tmp_path / "app.yaml").write_text(small_chain_text())
    cs.generate_package(cs.load_application(tmp_path / "app.yaml"), tmp_path / "robot")
    shaping = cpp_package()
    robot = {path.name: path.read_text() for path in (tmp_path / "robot").rglob("*.*")}
    licence = (ROOT / "LICENSE").read_text()
    assert shaping["LICENSE"] == (tmp_path / "robot/LICENSE").read_text() == licence
    manifests = [ElementTree.fromstring(files["package.xml"]) for files in (shaping, robot)]  # noqa: S314
    for manifest in (MANIFEST, *manifests):
        (declared,) = manifest.iter("maintainer")
        assert (declared.text, declared.get("email")) == (maintainer["name"], maintainer["email"])
        (declared,) = manifest.iter("license")
        assert (declared.text, declared.get("file")) == (PROJECT["license"], "LICENSE")
        assert next(manifest.iter("version")).text == PROJECT["version"]
    for name, text in {**shaping, **robot}.items():
        if name.endswith((".cpp", ".hpp", ".py")):
            first = text.splitlines()[0]
            assert re.fullmatch(rf"(//|#) Copyright 2026 {maintainer['name']}", first), name


def _pins(name: str) -> Iterator[Requirement]:
    text = (ROOT / "ros" / name).read_text().replace("\\\n", " ")
    for line in text.splitlines():
        if not line.startswith("#"):
            assert "--hash=sha256:" in line
            yield Requirement(line.partition("--hash")[0])


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_every_dependency_is_declared_or_brought_in_a_version_that_suffices(
    python: str, machine: str
) -> None:
    """Also those of what builds us: bloom and colcon install from no package index."""
    declared = {depend.text for depend in MANIFEST.iter("exec_depend")}
    environment: dict[str, str] = {**default_environment()}  # type: ignore[dict-item]
    environment |= {
        "python_version": python,
        "python_full_version": f"{python}.1",
        "platform_machine": machine,
    }
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    for name, requirements in (
        ("vendored.txt", PROJECT["dependencies"]),
        ("build_tools.txt", build),
    ):
        pinned = {
            pin.name: next(iter(pin.specifier)).version
            for pin in _pins(name)
            if pin.marker is None or pin.marker.evaluate(environment)
        }
        for requirement in map(Requirement, requirements):
            if requirement.marker and not requirement.marker.evaluate(environment):
                assert requirement.name not in pinned
            elif requirement.name == "pyyaml":
                assert "python3-yaml" in declared
            else:
                assert requirement.specifier.contains(pinned[requirement.name]), requirement


def test_catkin_pkg_reads_the_manifest_without_a_warning() -> None:
    reader = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg is not installed")
    warnings: list[str] = []
    manifest = reader.parse_package(str(ROOT), warnings=warnings)
    manifest.validate(warnings=warnings)
    assert (warnings, manifest.get_build_type()) == ([], "cmake")


def test_bloom_finds_the_changes_of_this_version() -> None:
    """As REP 132 wants them: it reads lists below a version, and no sections in it."""
    changelogs = pytest.importorskip("catkin_pkg.changelog", reason="catkin_pkg is not installed")
    text = (ROOT / "CHANGELOG.rst").read_text().replace("(unreleased)", "(2026-11-28)")
    read = changelogs.populate_changelog_from_rst(changelogs.Changelog("chainshaper"), text)
    version, _, contents = next(iter(read.foreach_version()))
    assert version == PROJECT["version"]
    listed = "\n".join(map(str, contents))
    for topic in ("Recording", "Planning", "Enforcement", "Installation"):
        assert f"{topic}:" in listed
    assert "``watch``" in listed
    assert "Not stable" not in listed


@pytest.mark.building
@pytest.mark.timeout(900)
def test_the_ros_package_is_built_by_cmake_and_brings_what_it_needs(tmp_path: Path) -> None:
    """As colcon does for the build type `cmake`; run by a Python that has none of our packages."""
    if shutil.which("cmake") is None:
        pytest.skip("cmake or c++ is not installed")
    python = getattr(sys, "_base_executable", sys.executable)
    # Of this checkout, in which CMake compiles only what has changed since.
    build, prefix = ROOT / "build/colcon", tmp_path / "install"
    for command in (
        ["cmake", "-S", str(ROOT), "-B", str(build), f"-DPython3_EXECUTABLE={python}"],
        ["cmake", "--build", str(build)],
        ["cmake", "--install", str(build), "--prefix", str(prefix)],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    (packages,) = prefix.glob("lib/python3.*/site-packages")
    ours = {path.relative_to(ROOT / "src") for path in (ROOT / "src/chainshaper").rglob("*")}
    wanted = {p for p in ours if (ROOT / "src" / p).is_file() and "__pycache__" not in p.parts}
    assert {path for path in wanted if not (packages / path).is_file()} == set()
    assert (prefix / "share/ament_index/resource_index/packages/chainshaper").is_file()
    environment = {"PATH": os.defpath, "PYTHONPATH": str(packages)}
    (tmp_path / "app.yaml").write_text(small_chain_text())
    recording = str(tmp_path / "recording")
    for words, said in (
        (["bin/chainshaper", "--version"], f"chainshaper {PROJECT['version']}"),
        (["lib/chainshaper/chainshaper", "--help"], "Usage: chainshaper"),
        (["bin/chainshaper", "simulate", str(tmp_path / "app.yaml"), "-o", recording], ""),
        (["bin/chainshaper", "plan", recording, "--json"], '"bands_ns"'),
    ):
        command = [str(prefix / words[0]), *words[1:]]
        ran = subprocess.run(command, env={"PATH": os.defpath}, capture_output=True, text=True)  # noqa: PLW1510
        assert ran.returncode == 0, ran.stderr
        assert said in ran.stdout
    # `ros2` finds the entry points, its process finds nothing of what is brought.
    program = (
        "import importlib.metadata as m; (found,) = m.entry_points(group='ros2cli.command'); "
        "print(found.load().NAME); import polars"
    )
    ran = subprocess.run(  # noqa: PLW1510
        [python, "-c", program], env=environment, capture_output=True, text=True
    )
    assert ran.stdout == "chain\n"
    assert "No module named 'polars'" in ran.stderr
