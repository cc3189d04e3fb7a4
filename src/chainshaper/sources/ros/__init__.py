"""Ask the ROS 2 of a running application, by a script (:mod:`.script`).

The script runs in the environment of one of the application's processes: our own Python seldom has
`rclpy`, and DDS domain and RMW must be those of the application's nodes. An environment says which
programs and libraries are loaded, so whoever wrote it chooses what runs. (Nowhere else does
chainshaper run something that it finds through another process.) Therefore the script

* has the rights of that process's user, no capabilities, and no way to get any;
* runs in a session of its own, for a limited time;
* has no open files but the script itself and the files that it may print into.

What it prints is not trusted.
"""

import ctypes
import fcntl
import json
import os
import pwd
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from chainshaper.linux.processes import process_folder, user_in, user_name
from chainshaper.linux.scheduling import signalled_with_parent
from chainshaper.linux.threads import read_proc
from chainshaper.sources.ros import script as ros_script
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import EndpointInfo

_NOT_FOR_US = ("LD_PRELOAD",)
"""Variables that are left out: libraries that trace the nodes must not trace the script."""

_WITH_ITS_PYTHON = """
set -f
if ros2=$(command -v ros2) && IFS= read -r first < "$ros2"; then
    case $first in "#!"*) exec ${first#??} - "$@" ;; esac
fi
exec python3 - "$@"
"""
"""Runs the script by the Python of the environment's `ros2`: others may have no `rclpy`."""

_MOST_PRINTED = 8 << 20
_LOOKS = 6
_SAME_PLACES = ("ns/user", "ns/mnt", "root")
_PR_SET_NO_NEW_PRIVS, _CAPABILITY_VERSION_3 = 38, 0x20080522
_PATIENCE_S, _START_S = 10, 20
"""The time that discovery may take; and Python and the RMW, to be loaded."""
_NAME = re.compile(r"[!-~]{0,255}/[!-~]{1,255}")
_LARGEST = 1 << 63
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True)
class Environment:
    """An environment, and the user with whose rights programs run in it."""

    variables: Mapping[str, str]
    user: int


@dataclass(frozen=True)
class Script:
    """A script that runs, and the descriptors of the files in memory into which it writes."""

    process: "subprocess.Popen[bytes]"
    output: int  # what it prints
    errors: int  # what it prints about errors

    def is_over(self) -> bool:
        """Return whether it has ended."""
        return self.process.poll() is not None

    def end(self, within_s: float = 0.0) -> tuple[str, str | None]:
        """Wait for its end; return what it printed, and why it failed, if it did.

        Kills its process group if it does not end in time. To be called once.
        """
        problem = None
        try:
            code = self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            problem = f"ROS 2 did not answer within {within_s:g} s"
            os.killpg(self.process.pid, signal.SIGKILL)  # it has not been waited for: still its id
            code = self.process.wait()
        output, errors = _content(self.output), _content(self.errors)
        if problem is None and code != 0:
            problem = errors.strip().rpartition("\n")[2] or f"the script ended with code {code}"
        return ("" if problem else output), problem


def environment_of(pid: int) -> Environment:
    """Return the environment of a process, as it is now.

    Raises OperationError: it has ended, may not be read, is no single user's, or in a container.
    """
    try:
        with process_folder(pid) as folder:
            for _ in range(_LOOKS):
                if (user := user_in(folder)) is not None:
                    break
                time.sleep(0.01)  # it may be about to become another program
            content = read_proc("environ", folder).decode(errors="surrogateescape")
            elsewhere = any(
                os.readlink(place, dir_fd=folder) != str(Path("/proc/self", place).readlink())
                for place in _SAME_PLACES
            )
            same_user = user_in(folder) == user  # else it has become another program meanwhile
    except OSError as error:
        raise OperationError(
            f"the environment of process {pid} cannot be read: {error.strerror}"
        ) from error
    unused = "so nothing that its environment names is run"
    if user is None or not same_user:
        raise OperationError(f"process {pid} was started by another user than runs it, {unused}")
    if elsewhere:
        raise OperationError(
            f"process {pid} is in a container or a namespace of its own, {unused} here: run"
            " chainshaper in there"
        )
    _becoming(user)
    pairs = (entry.partition("=") for entry in content.split("\0") if "=" in entry)
    return Environment({name: value for name, _, value in pairs if name}, user)


def own_environment() -> Environment:
    """Return our own environment."""
    return Environment(dict(os.environ), os.geteuid())


def run_with_rclpy(
    environment: Environment, script: str, *arguments: str, within_s: float
) -> tuple[str, str | None]:
    """Run a script file in an environment; return its output, and why it failed, if it did."""
    try:
        return start_with_rclpy(environment, script, *arguments).end(within_s)
    except OperationError as error:
        return "", str(error)


def start_with_rclpy(
    environment: Environment, script: str, *arguments: str, pass_fds: Sequence[int] = ()
) -> Script:
    """Start a script file in an environment, as its user; it keeps ``pass_fds`` open.

    Raises OperationError: we may not become that user, or nothing can be started.
    """
    as_user = _becoming(environment.user)
    variables = {
        name: text for name, text in environment.variables.items() if name not in _NOT_FOR_US
    }
    output, errors = _bounded_file(), _bounded_file()
    try:
        with Path(script).open("rb") as source:  # that user may not reach the file itself
            process = subprocess.Popen(
                ["/bin/sh", "-c", _WITH_ITS_PYTHON, "sh", *arguments],
                env=variables,
                cwd="/",
                stdin=source,
                stdout=output,
                stderr=errors,
                start_new_session=True,
                pass_fds=pass_fds,
                preexec_fn=partial(_confine, os.getpid()),  # noqa: PLW1509 - a few system calls
                **as_user,
            )
    except OSError as error:
        os.close(output)
        os.close(errors)
        user = user_name(environment.user)
        raise OperationError(
            f"no script of user {user} can be started: {error.strerror}"
        ) from error
    return Script(process, output, errors)


def _becoming(user: int) -> dict[str, Any]:
    """Return the arguments of `subprocess` that start a process as a user; none for our own user.

    Raises OperationError: there is no such user, or we may not become it.
    """
    if user == os.geteuid():
        return {}
    try:
        account = pwd.getpwuid(user)
    except KeyError:
        raise OperationError(
            f"user {user} of the application is not in this machine's user database: nothing is run"
            " as it"
        ) from None
    if os.geteuid() != 0:
        raise OperationError(
            f"the application is user {account.pw_name}'s, and what its environment names is run "
            "by that user only: run chainshaper as that user, or as root"
        )
    groups = os.getgrouplist(account.pw_name, account.pw_gid)
    return {"user": user, "group": account.pw_gid, "extra_groups": groups}


def _confine(parent: int) -> None:
    """Limit a new process to its user's rights, and make it end with us."""
    _libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    if os.getuid() != 0:
        header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
        if _libc.capset(header, (ctypes.c_uint32 * 6)()):
            os._exit(126)
    signalled_with_parent(parent, signal.SIGKILL)


def _bounded_file() -> int:
    """Open a file in memory that cannot grow beyond :data:`_MOST_PRINTED`."""
    descriptor = os.memfd_create("chainshaper", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, _MOST_PRINTED)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK)
    return descriptor


def _content(descriptor: int) -> str:
    """Return what was written into such a file, and close it."""
    content = os.pread(descriptor, _MOST_PRINTED, 0)
    with suppress(OSError):
        os.close(descriptor)
    return content.rstrip(b"\0").decode(errors="replace")


def ask_graph(environment: Environment) -> tuple[tuple[EndpointInfo, ...], str | None]:
    """Return all endpoints in the ROS graph of a node with this environment, or why there are none.

    DDS without its security plug-ins does not prove who is in the graph. So the size and the form
    of the answer are checked, and only names, types and QoS are taken from it.
    """
    answer, problem = run_with_rclpy(
        environment,
        ros_script.__file__,
        "graph",
        str(_PATIENCE_S),
        within_s=_PATIENCE_S + _START_S,
    )
    if problem is not None:
        return (), problem
    try:
        # Libraries may have printed something before.
        listed = json.loads(answer[answer.index('{"endpoints"') :])["endpoints"]
        endpoints = (EndpointInfo.model_validate(endpoint) for endpoint in listed)
        return tuple(endpoint for endpoint in endpoints if _is_ros(endpoint)), None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        return (), str(error)


@contextmanager
def publishing_diagnostics(
    environment: Environment,
) -> Iterator[Callable[[Sequence[Mapping[str, Any]]], str | None]]:
    """Start a node in this environment that publishes statuses, until the context ends.

    Yields a function that has it publish statuses on `/diagnostics`, each with ``name``, ``level``,
    ``message`` and ``values``; the function returns, once, why they are not published.

    Raises OperationError: as :func:`start_with_rclpy`.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)  # a node that does not read must not stop the watch
    try:
        script = start_with_rclpy(
            environment, ros_script.__file__, "diagnostics", str(reading), pass_fds=(reading,)
        )
    finally:
        os.close(reading)
    over = False

    def publish(statuses: Sequence[Mapping[str, Any]]) -> str | None:
        nonlocal over
        if over:
            return None
        try:
            os.write(writing, json.dumps(statuses).encode() + b"\n")
        except BlockingIOError:  # these are passed over
            return None
        except BrokenPipeError:
            over = True
            return script.end(_START_S)[1] or "the node that publishes it has ended"
        return None

    try:
        yield publish
    finally:
        os.close(writing)
        if not over:
            script.end(_START_S)


def _is_ros(endpoint: EndpointInfo) -> bool:
    """Return whether an endpoint's names and numbers are such as ROS 2 has."""
    values = endpoint.model_dump(exclude_none=True).values()
    names = (endpoint.node, endpoint.topic, endpoint.type)
    if not all(_NAME.fullmatch(name) for name in names if name):
        return False
    return all(value < _LARGEST for value in values if isinstance(value, int))
