"""The packages: file by file, as catkin_pkg and CMake read them, and what building them needs."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from chainshaper.splicing.message_types import message_type_named
from chainshaper.splicing.node_packages import build_package, cpp_package
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.licence import package_values

TYPE = "sensor_msgs/msg/PointCloud2"
NAMES = ["chainshaper_shaping", "shaping_sensor_msgs_point_cloud2", "shaping_std_msgs_header"]


@pytest.fixture(autouse=True)
def no_ros_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)


def package(name: str) -> dict[str, str]:
    if name == NAMES[0]:
        return cpp_package()
    return cpp_package(message_type_named(TYPE if name == NAMES[1] else "std_msgs/msg/Header"))


def written(folder: Path, name: str) -> Path:
    for path, text in package(name).items():
        (folder / name / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / name / path).write_text(text)
    return folder / name


def test_the_cpp_package_is_the_generic_one_but_for_what_names_its_type() -> None:
    generic, files = cpp_package(), package(NAMES[1])
    for path, text in {**generic, **files}.items():
        assert not path.endswith(".in")
        assert "@" not in text.replace(package_values()["EMAIL"], ""), path
    lines = files.pop("include/message.hpp").splitlines()
    assert [line for line in lines if "sensor_msgs" in line] == [
        '#include "sensor_msgs/msg/point_cloud2.hpp"',
        "using Message = sensor_msgs::msg::PointCloud2;",
        f'inline constexpr const char * message_type = "{TYPE}";',
    ]
    for read_by_tools in ("CMakeLists.txt", "package.xml"):
        del files[read_by_tools]
    headers = ("gate_log", "guest", "handover", "node", "readiness", "schema", "shaper")
    decisions = (
        "decision",
        "gate",
        "queue",
        "schedules",
        "throttling",
        "words",
    )  # of the native library
    assert files.keys() == {
        *("src/shaping_node.cpp", "scripts/respawning", "LICENSE"),
        *(f"include/chainshaper_shaping/{header}.hpp" for header in headers),
        *(f"include/gate/{header}.hpp" for header in decisions),
    }
    assert files.items() <= generic.items(), "the gate is the same in both packages"


@pytest.mark.parametrize("name", NAMES)
def test_catkin_pkg_reads_the_manifest(tmp_path: Path, name: str) -> None:
    reader = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg is not installed")
    warnings: list[str] = []
    manifest = reader.parse_package(str(written(tmp_path, name)), warnings=warnings)
    manifest.validate(warnings=warnings)
    assert warnings == []
    assert (manifest.name, manifest.get_build_type()) == (name, "ament_cmake")
    assert manifest.description.endswith({NAMES[0]: "any type", NAMES[1]: TYPE}.get(name, ""))
    depends = [depend.name for depend in manifest.build_depends]
    assert depends == ["rclcpp", *(["sensor_msgs"] if "sensor_msgs" in name else []), "std_msgs"]


@pytest.mark.parametrize("name", NAMES[:2])
def test_cmake_configures_it(tmp_path: Path, name: str) -> None:
    """With modules in place of the ROS 2 packages; what is linked shows in the compiler's flags."""
    if shutil.which("cmake") is None or shutil.which("c++") is None:
        pytest.skip("cmake or c++ is not installed")
    modules = tmp_path / "modules"
    modules.mkdir()
    (modules / "Findament_cmake.cmake").write_text(
        "set(ament_cmake_FOUND TRUE)\nfunction(ament_package)\nendfunction()\n"
    )
    linked = {"rclcpp": "rclcpp::rclcpp", "std_msgs": "std::cpp", "sensor_msgs": "sensor::cpp"}
    for one, target in linked.items():
        (modules / f"Find{one}.cmake").write_text(
            f"set({one}_FOUND TRUE)\n"
            f"add_library({target} INTERFACE IMPORTED)\n"
            f"set_property(TARGET {target} PROPERTY INTERFACE_COMPILE_DEFINITIONS WITH_{one})\n"
            f"set({one}_TARGETS {target})\n"
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
    installed = (build / "cmake_install.cmake").read_text()
    found = re.findall(r'/lib/(\w+)" TYPE \w+ FILES "\S+/(\w+)"', installed)
    assert set(found) >= {(name, "shaping_node"), (name, "respawning")}
    flags = (build / "CMakeFiles" / "shaping_node.dir" / "flags.make").read_text()
    assert "-O3 -DNDEBUG -Wall -Wextra -std=gnu++17" in flags
    assert {one for one in linked if f"-DWITH_{one}" in flags} == {
        *("rclcpp", "std_msgs"),
        *(["sensor_msgs"] if "sensor_msgs" in name else []),
    }


@pytest.mark.parametrize(
    ("name", "header"),
    [
        ("PointCloud2", "point_cloud2"),
        ("UInt8MultiArray", "u_int8_multi_array"),
        ("TFMessage", "tf_message"),
        ("ColorRGBA", "color_rgba"),
    ],
)
def test_headers_are_named_as_rosidl_names_them(name: str, header: str) -> None:
    """The file names in /opt/ros/*/include of upstream's packages."""
    assert message_type_named(f"some_msgs/msg/{name}").snake_name == header


def test_what_is_no_type_or_not_installed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for text in (
        *("", "PointCloud2", "sensor_msgs/PointCloud2", "sensor_msgs/srv/SetCameraInfo"),
        *("sensor_msgs/msg/pointCloud2", "Sensor/msg/PointCloud2", "sensor_msgs/msg/Point Cloud"),
        *("../msg/Evil", "sensor_msgs/msg/X;rm"),
    ):
        with pytest.raises(InputError, match=r"is not a message type: write PACKAGE/msg/TYPE"):
            message_type_named(text)
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
    (tmp_path / "share/rclcpp").mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    return folder


def test_a_build_names_what_it_lacks_how_it_failed_and_what_to_source(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert build_package(tmp_path) == tmp_path / "install" / "setup.bash"
    monkeypatch.setenv("STAND_IN_CODE", "2")
    with pytest.raises(OperationError, match=r"(?s)exit code 2.*--base-paths . --merge-install"):
        build_package(tmp_path)
    for name in ("colcon", "cmake", "c++"):
        (programs / name).rename(programs / "away")
        with pytest.raises(
            PlatformError, match=rf"^{name.replace('+', '.')}, which building .*apt"
        ):
            build_package(tmp_path)
        (programs / "away").rename(programs / name)
    monkeypatch.setenv("CXX", "clang++-99 -stdlib=libc++")
    with pytest.raises(PlatformError, match=r"^clang\+\+-99, which building"):
        build_package(tmp_path)
    monkeypatch.delenv("CXX")
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    with pytest.raises(PlatformError, match="needs a ROS 2 environment, and none is sourced"):
        build_package(tmp_path)
