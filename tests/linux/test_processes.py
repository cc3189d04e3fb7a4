"""Processes as /proc shows them, and nodes' names from command lines, by rcl's rules."""

import os
import shlex
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from tempfile import NamedTemporaryFile

import pytest
from actors import acting
from containers import needs_namespaces
from hypothesis import given
from hypothesis import strategies as st
from known import known
from processes import wait_for

from chainshaper.linux.processes import (
    descendants,
    find_applications,
    guessed_name,
    list_processes,
    middleware_limit,
    named_nodes,
    read_process,
    takes_ros_arguments,
)
from chainshaper.linux.threads import parents

CASES = {
    "talker": (),
    "talker --ros-args": (),
    "talker --ros-args -r __node:=x": ("/x",),
    "talker --ros-args --remap __node:=x": ("/x",),
    "talker --ros-args -r __name:=x": ("/x",),
    "talker --ros-args -r __node:=x -r __ns:=/y": ("/y/x",),
    "talker --ros-args -r __ns:=/y/z -r __node:=x": ("/y/z/x",),
    "talker --ros-args -r __node:=x -r __ns:=/": ("/x",),
    "talker --ros-args -r old:__node:=x": ("/x",),
    "talker --ros-args -r old:__node:=x -r old:__ns:=/y": ("/y/x",),
    "talker --ros-args -r old:__ns:=/y": ("/y/old",),
    "two --ros-args -r a:__node:=x -r b:__node:=y": ("/x", "/y"),
    "two --ros-args -r a:__node:=x -r b:__node:=y -r __ns:=/n": ("/n/x", "/n/y"),
    # Of rules that apply the first counts.
    "talker --ros-args -r __node:=x -r __node:=y": ("/x",),
    "two --ros-args -r __node:=x -r b:__node:=y": ("/x",),
    "two --ros-args -r b:__node:=y -r __node:=x": ("/y", "/x"),
    "two --ros-args -r b:__node:=y -r __ns:=/n -r b:__ns:=/late": ("/n/y",),
    "two --ros-args -r b:__node:=y -r b:__ns:=/early -r __ns:=/n": ("/early/y",),
    # Parameters, their files and levels are values, whatever they look like.
    "talker --ros-args -p text:=__node:=no -r __node:=x": ("/x",),
    "talker --ros-args -p __node:=no": (),
    "talker --ros-args -p 'text:=-r __node:=no'": (),
    "talker --ros-args --params-file -r __node:=x": (),
    "talker --ros-args --log-level debug -r __node:=x": ("/x",),
    "talker --ros-args --log-level rcl:=debug --disable-rosout-logs -r __node:=x": ("/x",),
    "talker --ros-args -r chatter:=__node -r a/b:=/c": (),
    # Only behind --ros-args, and not behind --.
    "talker -r __node:=x": (),
    "talker __node:=x": (),
    "talker --ros-args -r a:=b -- -r __node:=no": (),
    "talker --ros-args -- --ros-args -r __node:=x": ("/x",),
    "sh -c 'talker --ros-args -r __node:=x'": (),
    # What rcl refuses to start with names no node.
    "talker --ros-args -r": (),
    "talker --ros-args -r __node:=": (),
    "talker --ros-args -r __node:=/foo/bar": (),
    "talker --ros-args -r __node:=3d": (),
    "talker --ros-args -r __ns:=foo -r __node:=x": ("/x",),
    "talker --ros-args -r :__node:=x": (),
    "talker --ros-args -r ~:__node:=x": (),
}


@pytest.mark.parametrize(("line", "names"), CASES.items(), ids=list(CASES))
def test_nodes_are_named_as_rcl_names_them(line: str, names: tuple[str, ...]) -> None:
    assert named_nodes(shlex.split(line)) == names


NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,8}", fullmatch=True)
NAMESPACES = st.from_regex(r"/|(/[a-z][a-z0-9_]{0,5}){1,3}", fullmatch=True)
VALUES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)
# Whatever else may stand behind --ros-args, with its value where it takes one.
OTHERS = st.one_of(
    st.tuples(st.just("-p"), st.builds("{}:={}".format, NAMES, VALUES)),
    st.tuples(st.just("-p"), st.builds("text:=__node:={}".format, NAMES)),
    st.tuples(st.sampled_from(["--params-file", "--log-level", "-e", "--enclave"]), VALUES),
    st.tuples(st.just("-r"), st.builds("{}:=/{}".format, NAMES.filter(str.islower), NAMES)),
    st.tuples(st.sampled_from(["--disable-rosout-logs", "--enable-stdout-logs"])),
)


@given(
    st.lists(VALUES.filter(lambda value: value != "--ros-args"), max_size=3),
    NAMES,
    NAMESPACES,
    st.lists(OTHERS, max_size=4),
    st.data(),
)
def test_a_node_is_found_among_whatever_else_there_is(
    before: list[str], name: str, namespace: str, others: list[tuple[str, ...]], data: st.DataObject
) -> None:
    rules = [("-r", f"__node:={name}"), ("--remap", f"__ns:={namespace}")]
    arguments = data.draw(st.permutations([*others, *rules]))
    command = ["program", *before, "--ros-args", *(word for part in arguments for word in part)]
    assert named_nodes(command) == (f"{namespace.rstrip('/')}/{name}",)
    assert takes_ros_arguments(command)


@given(st.lists(VALUES, max_size=8))
def test_any_command_line_can_be_read(command: list[str]) -> None:
    for name in (*named_nodes(["a", "--ros-args", *command]), *named_nodes(command)):
        assert name.startswith("/")
    guessed_name(command)


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("/opt/ros/jazzy/lib/demo_nodes_cpp/talker --ros-args", "/talker"),
        ("/usr/bin/python3 -u /opt/ros/jazzy/lib/demo_nodes_py/listener.py", "/listener"),
        ("python3.12 -m", None),
        ("python3 -c 'import rclpy'", None),
        ("./my-node", "/my_node"),
    ],
)
def test_without_a_rule_the_program_gives_a_guess(line: str, name: str | None) -> None:
    assert guessed_name(shlex.split(line)) == name
    assert named_nodes(shlex.split(line)) == ()


CYCLONE = ("gc", "dq.builtins", "dq.user", "tev", "recv")


def test_a_process_shows_its_command_line_and_threads(tmp_path: Path) -> None:
    arguments = ("--ros-args", "-p", "text:=two words")
    with acting(tmp_path, *CYCLONE, arguments=arguments) as actor:
        process = known(read_process(actor.pid))
    assert process.command[-3:] == arguments
    assert process.parent == os.getpid()
    assert process.inner_pid == actor.pid or process.inner_pid < actor.pid
    assert {thread.comm for thread in process.threads[1:]} == set(CYCLONE)
    assert process.threads[0].tid == actor.pid


def test_threads_that_only_dds_has_tell_a_participant(tmp_path: Path) -> None:
    for names, participates in ((CYCLONE, True), (("gc", "lease"), False), ((), False)):
        with acting(tmp_path, *names) as actor:
            process = known(read_process(actor.pid))
            assert process.participates is participates
            assert bool(find_applications([process])) is participates


ZENOH = ("app-0", "net-0", "acc-0", "tx-0", "rx-0")


@pytest.mark.parametrize(
    ("names", "limit"),
    [
        (CYCLONE, None),
        (("dds.udp.7410", "dds.shm.7411"), None),
        (ZENOH, None),
        ((*CYCLONE, "KeepAlive"), "iceoryx"),
        (("recv", "rCo00001##Evt"), "connext"),
        (("talker", "talker"), "unnamed"),
        ((), None),
    ],
)
def test_middleware_that_is_known_in_part_is_named(
    names: tuple[str, ...], limit: str | None, tmp_path: Path
) -> None:
    with acting(tmp_path, *names) as actor:
        process = known(read_process(actor.pid))
    assert middleware_limit(replace(process, participates=True)) == limit
    assert process.participates is (limit != "unnamed" and bool(names))


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed")
def test_threads_of_fast_dds_that_have_no_names_are_known_by_what_they_wait_for(
    tmp_path: Path,
) -> None:
    """Those that receive, and none of the program's own that waits for a datagram too."""
    source, library = Path(__file__).with_name("unnamed_receivers.cpp"), tmp_path / "libfastrtps.so"
    build = [known(shutil.which("g++")), "-std=c++17", "-O1", "-fPIC", str(source)]
    subprocess.run([*build, "-DLIBRARY", "-shared", "-o", str(library)], check=True)
    program = [*build, str(library), f"-Wl,-rpath,{tmp_path}", "-o", str(tmp_path / "program")]
    subprocess.run(program, check=True)
    with NamedTemporaryFile(dir="/dev/shm", prefix="fastrtps_port") as port:
        port.write(bytes(4096))
        port.flush()
        child = subprocess.Popen([tmp_path / "program", port.name], stdout=subprocess.PIPE)
        try:
            said = dict(known(child.stdout).readline().split() for _ in range(4))
            receiving = {int(said[b"datagrams"]), int(said[b"port"])}
            wait_for(lambda: _receiving(child.pid) == receiving, "its threads to wait")
            process = known(read_process(child.pid))
        finally:
            child.kill()
            child.communicate()
    assert process.participates
    assert middleware_limit(process) == "unnamed"


def _receiving(pid: int) -> set[int]:
    threads = known(read_process(pid)).threads
    return {one.tid for one in threads if (one.role, one.kind) == ("dds", "receive")}


def test_a_forked_helper_takes_no_part_whatever_its_command_line_says(tmp_path: Path) -> None:
    arguments = ("--ros-args", "-r", "__node:=talker")
    with acting(tmp_path, *CYCLONE, arguments=arguments) as actor:
        helper, node = known(read_process(actor.fork())), known(read_process(actor.pid))
    assert helper.command == node.command
    assert (helper.participates, node.participates) == (False, True)


def test_descendants_are_children_and_theirs(tmp_path: Path) -> None:
    with acting(tmp_path) as actor:
        child = actor.fork()
        assert descendants(parents(), actor.pid) == {actor.pid, child}
        assert {actor.pid, child} <= descendants(parents(), os.getpid())
    assert descendants({2: 1, 3: 2, 4: 3, 5: 1}, 2) == {2, 3, 4}


@needs_namespaces
def test_a_process_in_a_user_namespace_without_users_is_read_as_of_no_single_user() -> None:
    """As every container is for an instant: `unshare` makes the namespace, and then its users."""
    process = subprocess.Popen(["unshare", "--user", "sleep", "60"])
    try:
        command = Path(f"/proc/{process.pid}/cmdline")
        wait_for(lambda: command.read_bytes() == b"sleep\x0060\0", "sleep in its namespace")
        assert Path(f"/proc/{process.pid}/uid_map").read_bytes() == b""
        assert known(read_process(process.pid)).user is None
    finally:
        process.kill()
        process.wait()


def test_what_is_gone_or_the_kernels_own_is_no_process() -> None:
    pid = os.posix_spawn("/bin/true", ["true"], {})
    os.waitpid(pid, 0)
    assert read_process(pid) is None
    assert all(process.command for process in list_processes())
