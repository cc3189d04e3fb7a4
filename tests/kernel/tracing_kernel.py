"""A kernel with LTTng's modules, for a guest that has the machine's own files as its own.

The tests of the tracers need half of what this machine has: the virtual environment, a compiler's
output, LTTng, bpftrace. So the guest gets all of it, read-only (`guest/machine_files.py`), and only
the kernel is another: Debian 12's, for which Debian's sources of LTTng's kernel tracer are built
here, against the headers of that kernel and with nothing installed. Of the tracer's probes only the
scheduler's is made, which takes a minute less than making all.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from guest_image import ROOT

from chainshaper.analysis.flow import data_flow
from chainshaper.sources import open_source

TESTS = (
    "tests/kernel/guest/record_with_lttng.py",
    "tests/sources/test_ebpf.py::test_every_argument_of_every_function_arrives_as_it_was_passed",
    "tests/sources/test_ebpf.py::"
    "test_an_application_that_runs_already_is_attached_to_and_its_chain_is_found",
)
TOOLS = {
    "make": "make",
    "gcc-12": "gcc-12",
    "lttng": "lttng-tools",
    "bpftrace": "bpftrace",
}
_LOADED_FIRST = ("virtio_pci", "9pnet_virtio", "9p", "overlay")
_PROBES = "lttng-probe-sched.o lttng-kprobes.o lttng-kretprobes.o lttng-uprobes.o"
"""The scheduler's; the others are parts of the tracer itself, which does not load without them."""


def unpack(packages: list[Path], folder: Path) -> Path:
    """The packages' files; the kernel's bootable image among them."""
    folder.mkdir(parents=True)
    for package in packages:
        subprocess.run(["dpkg-deb", "--extract", package, folder], check=True)
    (image,) = folder.glob("boot/vmlinuz-*")
    return image


def build_modules(folder: Path) -> None:
    """Make LTTng's modules in the unpacked packages, and put them beside the kernel's own.

    Raises:
        subprocess.CalledProcessError: they cannot be made; with what make has said.
    """
    sources = folder / "usr/src"
    (modules,) = folder.glob("lib/modules/*")
    headers = sources / f"linux-headers-{modules.name}"
    makefile = headers / "Makefile"
    makefile.write_text(makefile.read_text().replace("/usr/src/", f"{sources}/"))
    (lttng,) = sources.glob("lttng-modules-*")
    probes = lttng / "src/probes/Kbuild"
    kept, _, _ = probes.read_text().partition("obj-$(CONFIG_LTTNG)")
    probes.write_text(f"{kept}obj-$(CONFIG_LTTNG) += {_PROBES}\n")
    make = ["make", "-C", str(headers), f"M={lttng}", "CONFIG_LTTNG=m", "modules"]
    subprocess.run(make, check=True, capture_output=True, text=True)
    for module in lttng.rglob("*.ko"):
        shutil.copy(module, modules)
    depmod = ["depmod", "--basedir", str(folder), modules.name]
    subprocess.run(depmod, executable=folder / "bin/kmod", check=True)


def compare_execution_times(folder: Path) -> str:
    """Of callbacks recorded by `guest/record_with_lttng.py`, with what the programs measured.

    It is done here, because compiling the decoder takes minutes in the guest.
    """
    recording = open_source(folder / "trace")
    assert not any(recording.info.lost.values()), recording.info.lost
    instances = data_flow(recording.events).instances.drop_nulls("end")
    measured = []
    for printed in ("1", "2"):
        lines = [line.split() for line in (folder / printed).read_text().splitlines()]
        own = np.array([int(used) for _, used in lines])
        found = instances.filter(pid=int(lines[0][0])).sort("start")
        beyond = found["execution_ns"].to_numpy() / own - 1
        response = (found["end"] - found["start"]).to_numpy() / own
        measured.append(
            f"{len(own)} callbacks, execution times {beyond.min():.1%} / {np.median(beyond):.1%} / "
            f"{beyond.max():.1%} beyond the thread's own CPU time, response times "
            f"{response.min():.1f} to {response.max():.1f} times it"
        )
        # Where the host stops the guest between trace point and clock, one may be far off.
        assert np.median(np.abs(beyond)) < 0.03, measured
        assert abs(found["execution_ns"].sum() / own.sum() - 1) < 0.1, measured
        assert (response > 1.1).all(), measured
    return "; ".join(measured)


def guest_files(folder: Path) -> dict[str, bytes]:
    """What the image needs: modules that give it the machine's files, and what is to be run there.

    Modules are numbered in the order in which they are to be loaded.
    """
    (modules,) = folder.glob("lib/modules/*")
    needs = {}
    for line in (modules / "modules.dep").read_text().splitlines():
        path, _, others = line.partition(":")
        needs[Path(path).stem] = [*reversed(others.split()), path]
    paths = dict.fromkeys(path for name in _LOADED_FIRST for path in needs[name])
    tests = [sys.executable, str(ROOT / "tests/kernel/guest/run_tests.py"), *TESTS]
    told = {"command": tests, "folder": str(ROOT), "modules": str(modules.parent)}
    files = {"machine.json": json.dumps(told).encode()}
    for number, path in enumerate(paths):
        files[f"modules/{number:02} {Path(path).name}"] = (modules / path).read_bytes()
    return files
