"""Talking to LTTng: its command-line client, and the session daemon that must be there.

The client is what every LTTng installation has; its Python bindings are not always there, and
`ros2 trace` needs them. It is asked for machine-readable answers (`--mi xml`) and never finds out
which session is the user's "current" one, because it works in a home directory of its own.

Which session daemon traces an application depends on who runs it:

* A root daemon runs already, and we are root or in the group `tracing`: it traces everybody's
  processes, and the kernel. We add a session to it, and leave it as it was. Other applications of
  this machine are then recorded too.
* Otherwise we start one and end it afterwards: a root daemon if we are root, else one of our
  user's. It listens for applications in a home directory of our own, which the command gets as its
  `LTTNG_HOME`. So it traces the command and nothing else, and a daemon of the user's keeps its
  sessions.

Upstream: lttng-tools, `utils_get_rundir`; lttng-ust, `setup_local_apps`; lttng(1).
"""

import os
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

from chainshaper.enforcement.realtime import signalled_with_parent
from chainshaper.errors import OperationError, PlatformError

__all__ = ["Lttng", "connect"]

_PACKAGES = (
    "install LTTng (Debian and Ubuntu: `apt-get install lttng-tools liblttng-ust-dev`), or record "
    "with `--source ebpf`, which needs neither"
)
_ANSWER_S = 60.0
_START_S = 15.0


@dataclass(frozen=True)
class Lttng:
    """A connection to a session daemon; ``daemon`` is its process where we have started it."""

    home: Path
    daemon: "subprocess.Popen[bytes] | None" = None

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
                ["lttng", "--no-sessiond", "--mi", "xml", *arguments],
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
        if self.daemon is not None and self.daemon.poll() is None:
            self.daemon.terminate()
            try:
                self.daemon.wait(_START_S)
            except subprocess.TimeoutExpired:
                self.daemon.kill()
                self.daemon.wait()
        shutil.rmtree(self.home, ignore_errors=True)


def connect() -> Lttng:
    """Find the session daemon that traces our applications, or start one.

    Raises:
        PlatformError: LTTng is not installed.
        OperationError: the daemon does not start; with its own words.
    """
    if shutil.which("lttng") is None:
        raise PlatformError(f"the command `lttng` is not there: {_PACKAGES}")
    # Sockets lie in it, whose paths may have 108 characters only: not beside the recording.
    lttng = Lttng(Path(tempfile.mkdtemp(prefix="chainshaper-lttng-")))
    try:
        if _answers(lttng):
            return lttng
        if shutil.which("lttng-sessiond") is None:
            raise PlatformError(
                f"no LTTng session daemon runs, and `lttng-sessiond` is not there: {_PACKAGES}"
            )
        return _with_daemon(lttng)
    except BaseException:
        lttng.close()
        raise


def _with_daemon(lttng: Lttng) -> Lttng:
    said = lttng.home / "daemon.log"
    folder = lttng.home / ".lttng"
    folder.mkdir()
    for version in range(5, 20):  # the name under which applications look has their ABI's version
        (folder / f"lttng-ust-sock-{version}").symlink_to("applications")
    with said.open("wb") as log:
        daemon = subprocess.Popen(
            ["lttng-sessiond", "--quiet", f"--apps-sock={folder / 'applications'}"],
            env=_environment(lttng.home),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
            # It ends in order, with its consumers, should we be killed.
            preexec_fn=partial(signalled_with_parent, os.getpid(), signal.SIGINT),  # noqa: PLW1509 - one call
        )
    started = Lttng(lttng.home, daemon)
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
    return {**os.environ, "LTTNG_HOME": str(home)}
