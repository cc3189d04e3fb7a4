"""What a robot needs runs with what `pip install chainshaper` brings, and nothing of the extras.

A real environment: the interpreter below this one's, and a folder with the packages on which the
core depends, by their own metadata. Nothing else is there to be imported.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from small_chain import small_chain_text

import chainshaper as cs
from chainshaper import _core
from chainshaper.sources import open_source

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

ROOT = Path(__file__).parents[1]


def _named(requirement: str) -> str | None:
    """The distribution that a requirement asks for, None if it is one of an extra's."""
    return None if "extra ==" in requirement else re.split(r"[^\w.-]", requirement)[0].lower()


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of links to the package, and to those that it needs, and those need."""
    folder = tmp_path_factory.mktemp("core")
    (folder / "chainshaper").mkdir()
    # In editable installs the native library is in another folder than the rest.
    for source in {Path(cs.__file__).parent, Path(_core.__file__).parent}:
        for entry in source.iterdir():
            (folder / "chainshaper" / entry.name).symlink_to(entry)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted, known = [_named(one) for one in project["dependencies"]], set[str]()
    while wanted:
        name = wanted.pop()
        if name is None or name in known:
            continue
        known.add(name)
        try:
            found = metadata.distribution(name)
        except metadata.PackageNotFoundError:  # for another Python or processor
            continue
        wanted += [_named(one) for one in found.requires or ()]
        for top in {file.parts[0] for file in found.files or ()} - {"..", "__pycache__"}:
            if not (folder / top).exists():
                (folder / top).symlink_to(Path(str(found.locate_file(top))))
    assert not known & {"numba", "llvmlite", "scipy", "matplotlib"}
    return folder


def _run(core: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(core), "PYTHONDONTWRITEBYTECODE": "1"}
    python = getattr(sys, "_base_executable", sys.executable)
    command = [python, "-m", "chainshaper", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_measuring_planning_and_simulating_give_what_they_give_compiled(
    core: Path, tmp_path: Path
) -> None:
    (tmp_path / "app.yaml").write_text(small_chain_text())
    words = ["simulate", str(tmp_path / "app.yaml"), "--cycles", "15", "-o"]
    made = _run(core, *words, str(tmp_path / "robot"))
    assert made.returncode == 0, made.stderr
    cs.simulate(cs.load_application(tmp_path / "app.yaml"), tmp_path / "here", cycles=15)
    for table in (tmp_path / "here").glob("*.parquet"):
        assert table.read_bytes() == (tmp_path / "robot" / table.name).read_bytes()
    latency = _run(core, "latency", str(tmp_path / "robot"), "--json")
    here = cs.measure_latency(cs.open_recording(tmp_path / "here"))
    assert json.loads(latency.stdout)["max_ns"] == here.analysis.statistics.max_ns
    plan = _run(core, "plan", str(tmp_path / "robot"), "-o", str(tmp_path / "plan.yaml"))
    assert plan.returncode == 0, plan.stderr
    same = ["check", str(tmp_path / "robot"), "--baseline", str(tmp_path / "here")]
    checked = _run(core, *same)
    assert "Traceback" not in checked.stderr and "chainshaper[" not in checked.stderr
    trace = [sys.executable, str(ROOT / "examples/write_trace.py"), str(tmp_path / "trace")]
    subprocess.run(trace, check=True, capture_output=True, cwd=ROOT)
    read = _run(core, "info", str(tmp_path / "trace"), "--json")
    here_too = open_source(tmp_path / "trace")
    counted = {name: table.height for name, table in here_too.events.items() if table.height}
    events = json.loads(read.stdout)["events"]
    assert {name.removeprefix("ros2:"): count for name, count in events.items()} == counted


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["doctor", "--watch", "200ms"], 0, "core 0"),
        (["threads"], 0, "node"),
        (["status"], 0, ""),
        (["watch", "--json", "--chain", "/a../b", "--", "sleep", "1"], 0, ""),
        (["apply", "no_such_plan.yaml"], 2, "no_such_plan.yaml"),
        (["record", "--source", "preload", "--duration", "500ms", "-o", "REC", "--", "sleep", "1"],
         1, "no process"),
    ],
    ids=lambda words: words[0] if isinstance(words, list) else "",
)  # fmt: skip
def test_what_runs_on_a_robot_needs_no_extra(
    core: Path, tmp_path: Path, words: list[str], code: int, said: str
) -> None:
    finished = _run(core, *[str(tmp_path / one) if one == "REC" else one for one in words])
    assert "Traceback" not in finished.stderr
    assert "chainshaper[" not in finished.stderr
    assert finished.returncode == code, finished.stderr
    assert said in finished.stdout + finished.stderr


def test_figures_name_the_extra_that_draws_them(core: Path, tmp_path: Path) -> None:
    (tmp_path / "app.yaml").write_text(small_chain_text())
    cs.simulate(cs.load_application(tmp_path / "app.yaml"), tmp_path / "rec", cycles=20)
    recordings = [str(tmp_path / "rec")] * 2
    refused = _run(core, "compare", *recordings, "--figures", str(tmp_path / "figures"))
    assert refused.returncode == 3
    assert refused.stderr.strip().splitlines()[-1] == (
        "error: this needs matplotlib, which is not installed: install it with"
        " `pip install 'chainshaper[analysis]'`"
    )


def test_the_unit_is_one_that_systemd_takes(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed (package systemd)")
    text = (ROOT / "systemd/chainshaper@.service").read_text()
    commands = re.findall(r"^Exec\w+=/usr/bin/chainshaper (\w+)", text, re.MULTILINE)
    assert commands == ["apply", "release"]
    unit = tmp_path / "chainshaper@.service"
    unit.write_text(text.replace("/usr/bin/chainshaper", "/bin/true"))
    said = subprocess.run(
        ["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, check=False
    )
    assert (said.returncode, said.stderr) == (0, "")


SYSTEMCTL = """#!/bin/sh
# Keeps the services that run in a file, and writes down how it was called.
echo "$*" >> "$0.calls"
case $1 in
list-units) while read -r unit; do printf '%s loaded active\\n' "$unit"; done < "$0.running" ;;
stop) : > "$0.running" ;;
start) case $2 in *broken*) exit 1 ;; esac; printf '%s\\n' "$2" >> "$0.running" ;;
esac
"""


def _maintained(root: Path, script: str, *arguments: str) -> str:
    """A script of the package, run as dpkg runs it, on a machine whose `systemctl` is ours."""
    environment = {"PATH": f"{root}:/usr/bin:/bin", "DPKG_ROOT": str(root)}
    words = ["sh", str(ROOT / "scripts/debian" / script), *arguments]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stderr


def test_an_upgrade_starts_exactly_the_services_again_that_were_running(tmp_path: Path) -> None:
    """The order is dpkg's: old prerm, files, old postrm, new postinst."""
    running, memory = tmp_path / "systemctl.running", tmp_path / "run/chainshaper-to-start"
    (tmp_path / "run/systemd/system").mkdir(parents=True)
    (tmp_path / "systemctl").write_text(SYSTEMCTL)
    (tmp_path / "systemctl").chmod(0o755)
    units = [rf"chainshaper@{name}.service" for name in ("robot", r"left\x2darm", "broken")]
    running.write_text("".join(f"{unit}\n" for unit in units))
    _maintained(tmp_path, "prerm", "upgrade", "0.2.0")
    assert running.read_text() == "", "nothing runs while its files are replaced"
    _maintained(tmp_path, "postrm", "upgrade", "0.2.0")
    said = _maintained(tmp_path, "postinst", "configure", "0.1.0")
    assert running.read_text().split() == units[:2]
    assert "chainshaper@broken.service was running and does not start" in said
    assert not memory.exists()
    # Nothing was running: nothing starts, at an upgrade as at the first installation.
    running.write_text("")
    for script, *arguments in (("prerm", "upgrade", "3"), ("postinst", "configure", "2")):
        _maintained(tmp_path, script, *arguments)
    assert running.read_text() == ""
    # What was removed does not start with a later installation; a removal that failed undoes that.
    for last in (("postrm", "remove"), ("postinst", "abort-remove")):
        running.write_text(f"{units[0]}\n")
        assert "start the application again" in _maintained(tmp_path, "prerm", "remove")
        _maintained(tmp_path, *last)
        assert not memory.exists()
    assert running.read_text().split() == units[:1]


def test_the_packages_scripts_do_nothing_where_systemd_does_not_run(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "systemctl").write_text(SYSTEMCTL)
    (tmp_path / "systemctl").chmod(0o755)
    for script, argument in (
        ("prerm", "upgrade"),
        ("postrm", "upgrade"),
        ("postinst", "configure"),
    ):
        assert _maintained(tmp_path, script, argument) == ""
    assert not (tmp_path / "systemctl.calls").exists()


IN_A_COPY = """
mount --make-rprivate /
mount -t tmpfs none "$0" && mkdir "$0/changed" "$0/work" "$0/root"
mount -t overlay none -o "lowerdir=/,upperdir=$0/changed,workdir=$0/work" "$0/root"
mount -t proc none "$0/root/proc" && mount --rbind /dev "$0/root/dev"
mount -t tmpfs none "$0/root/tmp" && cp "$1" "$0/root/tmp/package.deb"
exec chroot "$0/root" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin sh -ec "$2"
"""
INSTALLED = """
there() { find /etc /usr /var/lib/dpkg /opt/chainshaper* -name '*chainshaper*' | sort; }
cd /tmp && there > before 2> /dev/null
test "$(dpkg-deb -c package.deb | head -1 | cut -c1-10)" = drwxr-xr-x  # it is the robot's /
dpkg -i package.deb > /dev/null
dpkg -i package.deb > /dev/null
python3 -c "
from importlib.metadata import entry_points
(found,) = entry_points(group='ros2cli.command', name='chain')
found.load()().main(args=__import__('argparse').Namespace(arguments=['--version']))"
chainshaper simulate /opt/chainshaper/lib/chainshaper/examples/synthetic_chain.yaml \\
    --cycles 20 -o simulated
chainshaper plan simulated -o plan.yaml
chainshaper apply plan.yaml --dry-run --backend litmus
chainshaper record -o recorded -- true 2>&1 | grep "no process has loaded the tracing library"
python3 -c 'import polars' 2>&1 | grep ModuleNotFoundError
chainshaper status
dpkg -r chainshaper > /dev/null
rm -rf simulated recorded plan.yaml && there > after 2> /dev/null
diff before after
dpkg -i package.deb > /dev/null
rm -rf /opt/chainshaper
dpkg -r chainshaper > removed 2>&1
grep "/opt/chainshaper is gone, so no plan in force was ended" removed > /dev/null
if grep Traceback removed; then exit 1; fi
there > after 2> /dev/null
diff before after && echo nothing is left
"""


@pytest.mark.timeout(600)
def test_a_debian_package_installs_works_and_leaves_nothing(tmp_path: Path) -> None:
    if "CHAINSHAPER_DEB" not in os.environ:
        pytest.skip("CHAINSHAPER_DEB=1 builds and installs a Debian package")
    environment = {**os.environ, "DEB_COMPRESSION": "0"}
    subprocess.run([ROOT / "scripts/build_deb", tmp_path], env=environment, check=True)
    (package,) = tmp_path.glob("*.deb")
    copy = tmp_path / "copy"
    copy.mkdir()
    command = ["unshare", "--mount", "sh", "-ec", IN_A_COPY, str(copy), str(package), INSTALLED]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    assert done.stdout.startswith("chainshaper ")
    assert done.stdout.endswith("no plan is in force\nnothing is left\n")
