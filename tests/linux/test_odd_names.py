"""Whatever others call programs, files, groups and mount points: it is read, and misleads none."""

import json
import mmap
import os
import subprocess
import sys
from pathlib import Path

import pytest
from gated import needs_cgroups, own_cgroup, sleeping
from odd_names import BY_NAME, ODD_NAMES, process_named
from strangers import NOBODY, needs_root

from chainshaper.enforcement.freezer import groups_of, stray_groups
from chainshaper.linux import cgroups
from chainshaper.linux.processes import list_processes, read_process, regions_in, user_of
from chainshaper.linux.threads import find_thread, list_threads, read_proc, status_field
from chainshaper.values.errors import shown, storable, text_of

pytestmark = pytest.mark.timed

CLI = [sys.executable, "-m", "chainshaper"]


def test_bytes_that_are_no_text_are_shown_as_bytes() -> None:
    assert text_of(b"m\xfc\xc3\xa4\xc3") == "m\\xfcä\\xc3"
    assert shown(os.fsdecode(b"/mnt/\xfc")) == "/mnt/\\xfc"
    assert storable({"\udcfc": ["ä\ud800", 1, ("b", None)]}) == {
        "\\xfc": ["ä\\ud800", 1, ["b", None]]
    }


@BY_NAME
def test_a_program_of_any_name_is_read(name: bytes) -> None:
    with process_named(name, (b"--ros-args", b"-r", b"__node:=\xfcx")) as child:
        seen = read_process(child.pid)
        assert seen is not None
        comm = text_of(name[:15])
        assert [thread.comm for thread in seen.threads] == [comm, comm]
        assert seen.command[4] == text_of(name)
        assert seen.command[-1] == "__node:=\\xfcx"
        assert seen.parent == os.getpid()
        assert find_thread(child.pid) == seen.threads[0]
        assert child.pid in {one.pid for one in list_processes()}
        json.dumps(seen.command).encode()
        "".join(seen.command).encode()


@needs_root
@BY_NAME
def test_no_name_makes_a_strangers_process_roots(name: bytes) -> None:
    with process_named(name, user=NOBODY) as child:
        assert user_of(child.pid) == NOBODY
        status = read_proc(f"/proc/{child.pid}/status")
        assert status_field(status, "Uid") == [NOBODY] * 4


@BY_NAME
def test_mapped_files_of_any_name_are_told_apart(name: bytes, tmp_path: Path) -> None:
    path = os.fsencode(tmp_path) + b"/" + name.replace(b"/", b"")
    with open(path, "wb+") as file:  # noqa: PTH123 - of bytes
        file.write(b"x")
        file.flush()
        with mmap.mmap(file.fileno(), 1):
            regions = list(regions_in(read_proc("/proc/self/maps")))
    shown_as = path.replace(b"\n", b"\\012")
    assert os.fsdecode(shown_as) in {one.path for one in regions}


@needs_root
@needs_cgroups
@pytest.mark.parametrize("name", [one for one in ODD_NAMES if b"\n" not in one], ids=ascii)
def test_groups_of_any_name_are_found(name: bytes) -> None:
    with own_cgroup("odd") as home, sleeping() as pid:
        folder = home / os.fsdecode(name.replace(b"/", b""))
        folder.mkdir()
        (folder / "cgroup.procs").write_text(str(pid))
        try:
            assert cgroups.cgroup_of(pid) == folder
            child = cgroups.make_threaded_child(folder, "gated")
            assert cgroups.move_thread(pid, child)
            assert cgroups.cgroup_of(pid) == child
            assert cgroups.dissolve(child) is None
            assert groups_of(None) == ()
            assert folder not in stray_groups(())
        finally:
            (home.parent / "cgroup.procs").write_text(str(pid))


_MOUNTS = """
set -e
for folder in "$0"/*; do mount -t tmpfs "$1" "$folder"; done
exec "${@:2}"
"""


def beneath_odd_mounts(folder: Path, *command: str) -> "subprocess.CompletedProcess[bytes]":
    """A command where, for it alone, something is mounted at folders of all these names."""
    for name in ODD_NAMES:
        (folder / os.fsdecode(name.replace(b"/", b""))).mkdir()
    source = os.fsdecode(b"none of\t\xfc\n")
    words = ["unshare", "--mount", "bash", "-c", _MOUNTS, str(folder), source, *command]
    return subprocess.run(words, capture_output=True, check=False)


@needs_root
@pytest.mark.parametrize(
    "verb",
    [("status",), ("status", "--json"), ("release",), ("threads",), ("doctor", "--watch", "10ms")],
)
def test_verbs_go_on_beneath_mount_points_programs_and_groups_of_any_name(
    verb: tuple[str, ...], tmp_path: Path
) -> None:
    with process_named(ODD_NAMES[0], ODD_NAMES):
        done = beneath_odd_mounts(tmp_path, *CLI, *verb)
    assert done.returncode in (0, 3), done.stderr.decode(errors="replace")
    assert b"Traceback" not in done.stderr
    done.stdout.decode()  # it is UTF-8, whatever it names
    done.stderr.decode()


@needs_root
@needs_cgroups
def test_the_hierarchy_is_found_at_a_mount_point_of_any_name(tmp_path: Path) -> None:
    """It is mounted a second time, and not to be seen any more where it was."""
    ask = (
        "import os; from chainshaper.linux import cgroups; "
        "print(ascii(os.fsencode(cgroups.mount_point())), cgroups.cgroup_of(os.getpid()).is_dir())"
    )
    folder = tmp_path / "ä \udcfc\n\\"
    folder.mkdir()
    program = f'set -e; mount -t cgroup2 none "$0"; umount {cgroups.mount_point()}; exec "$@"'
    words = ["unshare", "--mount", "bash", "-c", program, str(folder), sys.executable, "-c", ask]
    done = subprocess.run(words, capture_output=True, check=True)
    assert done.stdout.decode().strip() == f"{os.fsencode(folder)!a} True"


def test_threads_are_listed_by_the_bytes_of_their_names(tmp_path: Path) -> None:
    with process_named(b"\xc3\xa4\xc3") as child:
        assert {one.comm for one in list_threads(child.pid)} == {"ä\\xc3"}
