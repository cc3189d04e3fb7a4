"""Talking to LTTng: its command-line client, and the session daemon that must be there.

The client is what every LTTng installation has; its Python bindings, which `ros2 trace` needs, are
not always there. It gives machine-readable answers (`--mi xml`) and never learns which session is
the user's "current" one, because it works in a home directory of its own.

Which session daemon traces an application depends on who runs it:

* A root daemon runs already, and we are root or in the group `tracing`: it traces everybody's
  processes, and the kernel. We add a session to it, and leave it as it was. Other applications of
  this machine are then recorded too.
* Otherwise we start one and end it afterwards: a root daemon if we are root, else one of our
  user's. It listens for applications in a home directory of our own, which the command gets as its
  `LTTNG_HOME`. So it traces the command and nothing else.

Recordings that run at the same time, and daemons that others start meanwhile, share nothing with a
daemon of ours: its run directory, where clients look for it, is in our home directory. Root's is
/var/run/lttng whatever its environment says, so root's daemon and clients have that directory
mounted there, in mount namespaces that they alone see. Where root may not mount (most containers),
the daemon is where all look for it, and there can be one recording at a time.

We may be killed at any moment. The kernel then ends a daemon of ours; everything else is left to a
shell that waits for our end, destroys our sessions in another's daemon and removes the home
directory.

Upstream: lttng-tools, `utils_get_rundir` and `set_session_daemon_path`; lttng-ust,
`setup_local_apps`; lttng(1), lttng-sessiond(8).
"""

import os
import shlex
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

from chainshaper.linux.own_processes import is_installed, tool_environment
from chainshaper.linux.scheduling import signalled_with_parent
from chainshaper.linux.threads import read_proc
from chainshaper.values.errors import OperationError, PlatformError

__all__ = ["Lttng", "connect"]

_PACKAGES = (
    "install LTTng (Debian and Ubuntu: `apt-get install lttng-tools liblttng-ust-dev`), or record "
    "with `--source ebpf`, which needs neither"
)
_ANSWER_S = 60.0
_START_S = 15.0
_RUN_DIRECTORY = Path("/var/run/lttng")
_APART = (
    *("unshare", "--mount", "--propagation=slave", "sh", "-c"),
    f'mkdir -p {_RUN_DIRECTORY} && mount --bind "$0" {_RUN_DIRECTORY} && exec "$@"',
)
_AFTERWARDS = """
read -r _
for name in $(timeout 60 lttng --no-sessiond --mi xml list | grep -o "$0-[0-9]*"); do
    timeout 60 lttng --no-sessiond destroy "$name"
done
rm -rf "$LTTNG_HOME"
"""


@dataclass(frozen=True)
class Lttng:
    """A connection to a session daemon.

    ``home`` is a directory of our own, whose unique name sessions are called after. ``afterwards``
    is the shell that clears up when we are gone. ``daemon`` is the daemon's process where we have
    started it, and ``inside`` what commands begin with that shall see its run directory.
    """

    home: Path
    afterwards: "subprocess.Popen[bytes]"
    daemon: "subprocess.Popen[bytes] | None" = None
    inside: tuple[str, ...] = ()

    @property
    def environment(self) -> dict[str, str]:
        """What an application needs to find the daemon."""
        return {} if self.daemon is None else {"LTTNG_HOME": str(self.home)}

    def ask(self, *arguments: str) -> ElementTree.Element:
        """Run `lttng ARGUMENTS` and return its answer.

        Raises:
            OperationError: it fails; with its own words.
        """
        what = shlex.join(("lttng", *arguments))
        try:
            run = subprocess.run(
                [*self.inside, "lttng", "--no-sessiond", "--mi", "xml", *arguments],
                env=_environment(self.home),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=_ANSWER_S,
                check=False,
                start_new_session=True,  # Ctrl-C is ours to react to
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise OperationError(
                f"`lttng {' '.join(arguments)}` does not answer: {error}"
            ) from None
        if run.returncode != 0:
            said = [line.strip() for line in run.stderr.splitlines() if line.strip()]
            reason = said[-1].removeprefix("Error: ") if said else f"exit code {run.returncode}"
            raise OperationError(f"`{what}` failed: {reason}")
        try:
            return ElementTree.fromstring(run.stdout)  # noqa: S314 - LTTng's own, no stranger's
        except ElementTree.ParseError as error:
            raise OperationError(f"`{what}` answers no XML: {error}") from None

    def close(self) -> None:
        """End the daemon if it is ours, and remove the home directory; harmless when repeated."""
        if self.daemon is not None:
            self.daemon.terminate()
            try:
                self.daemon.wait(_START_S)
            except subprocess.TimeoutExpired:
                self.daemon.kill()
                self.daemon.wait()
        self.afterwards.communicate()


def connect() -> Lttng:
    """Find the session daemon that traces our applications, or start one.

    Raises:
        PlatformError: LTTng is not installed, or cannot make two recordings at a time here.
        OperationError: the daemon does not start; with its own words.
    """
    if not is_installed("lttng"):
        raise PlatformError(f"the command `lttng` is not there: {_PACKAGES}")
    lttng = _without_daemon()
    try:
        found = _answers(lttng)
        if found and not _hears_one_command_only():
            return lttng
        lttng = replace(lttng, inside=_run_directory_apart(lttng.home))
        if found and not lttng.inside:
            raise PlatformError(
                "another recording runs, and LTTng can make one at a time here, because root may "
                "not mount: wait for its end, or record where mounting is permitted (Docker: "
                "`--privileged`)"
            )
        if not is_installed("lttng-sessiond"):
            raise PlatformError(
                f"no LTTng session daemon runs, and `lttng-sessiond` is not there: {_PACKAGES}"
            )
        return _with_daemon(lttng)
    except BaseException:
        lttng.close()
        raise


def _without_daemon() -> Lttng:
    # Sockets lie in it, whose paths may have 108 characters only: not beside the recording.
    home = Path(tempfile.mkdtemp(prefix="chainshaper-lttng-"))
    afterwards = subprocess.Popen(
        ["sh", "-c", _AFTERWARDS, home.name],
        env=_environment(home),
        stdin=subprocess.PIPE,  # ends with us, however that happens
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    return Lttng(home, afterwards)


def _hears_one_command_only() -> bool:
    """Whether the root daemon that runs is another recording's: no other application finds it."""
    with suppress(OSError, ValueError):
        pid = int((_RUN_DIRECTORY / "lttng-sessiond.pid").read_text())
        return b"--apps-sock=" in read_proc(f"/proc/{pid}/cmdline")
    return False


def _run_directory_apart(home: Path) -> tuple[str, ...]:
    """What root's commands begin with that see a run directory of our own; empty if not permitted.

    All other users' is in the home directory anyway.
    """
    if os.getuid() != 0:
        return ()
    folder = home / "run"
    folder.mkdir()
    inside = (*_APART, str(folder))
    try:
        trial = subprocess.run(
            [*inside, "true"], env=_environment(home), capture_output=True, check=False
        )
    except OSError:  # no `unshare` here
        return ()
    return inside if trial.returncode == 0 else ()


def _with_daemon(lttng: Lttng) -> Lttng:
    said = lttng.home / "daemon.log"
    folder = lttng.home / ".lttng"
    folder.mkdir()
    for version in range(5, 20):  # the name under which applications look has their ABI's version
        (folder / f"lttng-ust-sock-{version}").symlink_to("applications")
    with said.open("wb") as log:
        daemon = subprocess.Popen(
            [*lttng.inside, "lttng-sessiond", "--quiet", f"--apps-sock={folder / 'applications'}"],
            env=_environment(lttng.home),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
            # It ends in order, with its consumers, should we be killed.
            preexec_fn=partial(signalled_with_parent, os.getpid(), signal.SIGINT),  # noqa: PLW1509 - one call
        )
    started = replace(lttng, daemon=daemon)
    deadline = time.monotonic() + _START_S
    while not _answers(started):
        if daemon.poll() is not None or time.monotonic() > deadline:
            last = _last_line(said.read_text(errors="replace").splitlines())
            started.close()
            raise OperationError(f"the LTTng session daemon does not start: {last}")
        time.sleep(0.05)
    return started


def _answers(lttng: Lttng) -> bool:
    try:
        lttng.ask("list")
    except OperationError:
        return False
    return True


def _last_line(lines: Sequence[str]) -> str:
    return next((line for line in reversed(lines) if line.strip()), "it says nothing")


def _environment(home: Path) -> dict[str, str]:
    return {**tool_environment(), "LTTNG_HOME": str(home)}
