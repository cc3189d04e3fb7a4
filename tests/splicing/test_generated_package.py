"""The packages: file by file, as catkin_pkg and CMake read them, and what building them needs."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from chainshaper.splicing.shaping_process import (
    build_package,
    generic_package,
    message_type_named,
    typed_package,
)
from chainshaper.values.errors import InputError, OperationError, PlatformError

EXPECTED = Path(__file__).parent / "typed_package"
TYPE = "sensor_msgs/msg/PointCloud2"


@pytest.fixture(autouse=True)
def no_ros_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)


def packages() -> dict[str, dict[str, str]]:
    return {
        "chainshaper_shaping": generic_package(),
        "shaping_sensor_msgs_point_cloud2": typed_package(message_type_named(TYPE)),
        "shaping_std_msgs_header": typed_package(message_type_named("std_msgs/msg/Header")),
    }


def written(folder: Path, name: str) -> Path:
    for path, text in packages()[name].items():
        (folder / name / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / name / path).write_text(text)
    return folder / name


def test_the_typed_package_is_the_expected_one_file_by_file() -> None:
    files = packages()["shaping_sensor_msgs_point_cloud2"]
    for expected in EXPECTED.rglob("*"):
        if expected.is_file():
            assert files.pop(str(expected.relative_to(EXPECTED))) == expected.read_text(), expected
    headers = {
        "gate.hpp",
        "gate_log.hpp",
        "handover.hpp",
        "node.hpp",
        "readiness.hpp",
        "schema.hpp",
    }
    assert files.keys() == {
        "src/shaping_node.cpp",
        "scripts/respawning",
        *(f"include/chainshaper_shaping/{header}" for header in headers),
    }
    for path, text in files.items():
        assert text == generic_package()[path], "the gate is the same in both packages"


def test_no_template_is_left_unfilled() -> None:
    for name, files in packages().items():
        for path, text in files.items():
            assert not path.endswith(".in")
            assert "@" not in text.replace("chainshaper@example.org", ""), (name, path)


@pytest.mark.parametrize("name", packages())
def test_catkin_pkg_reads_the_manifest(tmp_path: Path, name: str) -> None:
    reader = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg is not installed")
    warnings: list[str] = []
    package = reader.parse_package(str(written(tmp_path, name)), warnings=warnings)
    package.validate(warnings=warnings)
    assert warnings == []
    assert package.name == name
    assert package.get_build_type() == "ament_cmake"
    depends = [depend.name for depend in package.build_depends]
    assert depends == sorted(set(depends)), "each once"
    assert {"rclcpp", "std_msgs"} <= set(depends)
    assert ("sensor_msgs" in depends) == ("sensor_msgs" in name)


@pytest.mark.parametrize("name", packages())
def test_cmake_configures_it(tmp_path: Path, name: str) -> None:
    """With modules in place of the ROS 2 packages; what is linked shows in the compiler's flags."""
    if shutil.which("cmake") is None or shutil.which("c++") is None:
        pytest.skip("cmake or c++ is not installed")
    modules = tmp_path / "modules"
    modules.mkdir()
    (modules / "Findament_cmake.cmake").write_text(
        "set(ament_cmake_FOUND TRUE)\nfunction(ament_package)\nendfunction()\n"
    )
    for package, target in (
        ("rclcpp", "rclcpp::rclcpp"),
        ("std_msgs", "std_msgs::cpp"),
        ("sensor_msgs", "sensor_msgs::cpp"),
    ):
        (modules / f"Find{package}.cmake").write_text(
            f"set({package}_FOUND TRUE)\n"
            f"add_library({target} INTERFACE IMPORTED)\n"
            f"set_property(TARGET {target} PROPERTY INTERFACE_COMPILE_DEFINITIONS WITH_{package})\n"
            f"set({package}_TARGETS {target})\n"
        )
    build = tmp_path / "build"
    run = subprocess.run(
        ["cmake", "-S", written(tmp_path, name), "-B", build, f"-DCMAKE_MODULE_PATH={modules}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert "Warning" not in run.stderr
    flags = (build / "CMakeFiles" / "shaping_node.dir" / "flags.make").read_text()
    assert "-std=gnu++17" in flags
    assert "-DWITH_rclcpp" in flags
    assert "-DWITH_std_msgs" in flags
    assert ("-DWITH_sensor_msgs" in flags) == ("sensor_msgs" in name)


@pytest.mark.parametrize(
    ("name", "header"),
    [
        ("PointCloud2", "point_cloud2"),
        ("Imu", "imu"),
        ("NavSatFix", "nav_sat_fix"),
        ("UInt8MultiArray", "u_int8_multi_array"),
        ("TFMessage", "tf_message"),
        ("PoseWithCovarianceStamped", "pose_with_covariance_stamped"),
        ("ColorRGBA", "color_rgba"),
    ],
)
def test_headers_are_named_as_rosidl_names_them(name: str, header: str) -> None:
    """The file names in /opt/ros/*/include of upstream's packages."""
    assert message_type_named(f"some_msgs/msg/{name}").snake_name == header


@pytest.mark.parametrize(
    "text",
    [
        "",
        "PointCloud2",
        "sensor_msgs/PointCloud2",
        "sensor_msgs/srv/SetCameraInfo",
        "sensor_msgs/msg/pointCloud2",
        "Sensor/msg/PointCloud2",
        "sensor_msgs/msg/Point Cloud",
        "../msg/Evil",
        "sensor_msgs/msg/X;rm",
    ],
)
def test_what_is_no_type_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"is not a message type: write PACKAGE/msg/TYPE"):
        message_type_named(text)


def test_a_type_that_is_not_installed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = tmp_path / "share" / "sensor_msgs" / "msg"
    messages.mkdir(parents=True)
    for name in ("PointCloud2", "PointCloud", "Image"):
        (messages / f"{name}.msg").touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    assert message_type_named(TYPE).full_name == TYPE
    with pytest.raises(InputError, match=r"has no message PontCloud2: did you mean PointCloud2"):
        message_type_named("sensor_msgs/msg/PontCloud2")
    with pytest.raises(InputError, match="no package sensr_msgs with messages"):
        message_type_named("sensr_msgs/msg/PointCloud2")


# Building -------------------------------------------------------------------------------------


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is all of PATH, with everything there that a build needs; none of it real."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("colcon", "cmake", "c++"):
        program = folder / name
        program.write_text('#!/bin/sh\necho "$0 $*"\nexit ${STAND_IN_CODE:-0}\n')
        program.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/some")
    monkeypatch.delenv("CXX", raising=False)
    return folder


@pytest.mark.parametrize("program", ["colcon", "cmake", "c++"])
def test_a_missing_build_tool_is_named(programs: Path, program: str, tmp_path: Path) -> None:
    (programs / program).unlink()
    with pytest.raises(PlatformError) as caught:
        build_package(tmp_path)
    assert str(caught.value).startswith(f"{program}, which building the shaping node needs")
    assert "apt install" in str(caught.value)


def test_the_compiler_that_the_environment_names_is_looked_for(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CXX", "clang++-99 -stdlib=libc++")
    with pytest.raises(PlatformError, match=r"^clang\+\+-99, which building"):
        build_package(tmp_path)


def test_a_missing_ros_environment_is_named(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    with pytest.raises(PlatformError, match="needs a ROS 2 environment, and none is sourced"):
        build_package(tmp_path)


def test_a_build_that_fails_says_how_it_ended(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STAND_IN_CODE", "2")
    with pytest.raises(OperationError) as caught:
        build_package(tmp_path)
    assert "failed with exit code 2" in str(caught.value)
    assert "build --base-paths . --merge-install" in str(caught.value)


def test_a_build_tells_what_to_source(programs: Path, tmp_path: Path) -> None:
    assert build_package(tmp_path) == tmp_path / "install" / "setup.bash"
    assert os.environ["PATH"] == str(programs)
