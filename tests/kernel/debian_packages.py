"""Debian packages for the guests: fetched through apt, which checks them, and kept in a cache.

apt is given folders of its own, so that the machine's package lists and sources play no part; the
archive's keys are the machine's. What was fetched once is used again without a network, after
comparing its digest with the one that was written down. Delete the cache to get newer kernels.
"""

import functools
import hashlib
import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "chainshaper" / "kernels"
KEYS = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
MIRROR = "http://deb.debian.org/debian"
SUITES = ("trixie", "trixie-backports", "sid")
TRACING_SUITE = "bookworm"  # LTTng 2.13 builds for its kernel
USERLAND = ("python3.13", "libbpf1", "python3-numpy", "python3-pydantic", "python3-yaml")
FLAVOURS = ("cloud-amd64", "rt-amd64")
"""A normal kernel (for virtual machines: small) and a PREEMPT_RT one."""


class PackageError(Exception):
    """Packages cannot be had; the message ends with what apt said."""


def fetch_userland() -> list[Path]:
    """Packages of the guests' programs. Raises PackageError: they cannot be had."""
    return _cached(" ".join(USERLAND), SUITES, lambda apt: apt.download_all(USERLAND))


def fetch_kernels(name: str = "newest") -> list[Path]:
    """The kernel of the named package, or the newest of each flavour. Raises PackageError."""
    return _cached(name, SUITES, lambda apt: apt.download_kernels(name))


def fetch_for_tracing() -> list[Path]:
    """Debian 12's kernel and its headers, the sources of LTTng's modules, and `depmod`."""
    return _cached("tracing", (TRACING_SUITE,), _Apt.download_for_tracing)


def _cached(
    key: str, suites: tuple[str, ...], download: Callable[["_Apt"], list[Path]]
) -> list[Path]:
    CACHE.mkdir(parents=True, exist_ok=True)
    manifest = CACHE / "manifest.json"
    known: dict[str, dict[str, str]] = {}
    if manifest.exists():
        known = json.loads(manifest.read_text())
    if key not in known:
        known[key] = _digests(download(_updated_apt(suites)))
        made = manifest.with_suffix(".new")
        made.write_text(json.dumps(known, indent=1))
        made.rename(manifest)
    return _checked(known[key])


def _digests(packages: list[Path]) -> dict[str, str]:
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in packages}


def _checked(digests: dict[str, str]) -> list[Path]:
    for name, digest in digests.items():
        path = Path(name)
        if not path.exists() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            raise PackageError(f"{path} is gone or damaged: delete {CACHE} and try again")
    return [Path(name) for name in digests]


@functools.cache
def _updated_apt(suites: tuple[str, ...]) -> "_Apt":
    apt = _Apt(CACHE / ("apt" if suites == SUITES else f"apt-{suites[0]}"), suites)
    apt.run("apt-get", "update")
    return apt


class _Apt:
    def __init__(self, folder: Path, suites: tuple[str, ...]) -> None:
        if not KEYS.exists():
            raise PackageError(f"no {KEYS}: apt install debian-archive-keyring")
        self._archives = folder / "archives"
        (folder / "lists" / "partial").mkdir(parents=True, exist_ok=True)
        (self._archives / "partial").mkdir(parents=True, exist_ok=True)
        (folder / "status").touch()
        sources = folder / "sources.list"
        sources.write_text(
            "".join(f"deb [signed-by={KEYS}] {MIRROR} {suite} main\n" for suite in suites)
        )
        settings = {
            "Dir::Etc::sourcelist": sources,
            "Dir::Etc::sourceparts": "-",
            "Dir::State": folder,
            "Dir::State::status": folder / "status",
            "Dir::State::lists": folder / "lists",
            "Dir::Cache": folder,
            "Dir::Cache::archives": self._archives,
            "APT::Architecture": "amd64",
            "APT::Architectures": "amd64",
            "APT::Default-Release": suites[0],
            "APT::Install-Recommends": "0",
            "APT::Sandbox::User": "root",
        }
        self._options = [
            word for name, value in settings.items() for word in ("-o", f"{name}={value}")
        ]

    def run(self, program: str, *arguments: str) -> str:
        command = [program, *self._options, *arguments]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, cwd=self._archives
        )
        if done.returncode:
            said = "\n".join((done.stderr or done.stdout).strip().splitlines()[-5:])
            raise PackageError(f"{program} {' '.join(arguments)} failed:\n{said}")
        return done.stdout

    def download_all(self, names: tuple[str, ...]) -> list[Path]:
        kernels = {*self._archives.glob("linux-*.deb")}  # other keys of the manifest
        for old in {*self._archives.glob("*.deb")} - kernels:
            old.unlink()
        self.run("apt-get", "install", "--yes", "--download-only", *names)
        return sorted({*self._archives.glob("*.deb")} - kernels)

    def download(self, name: str) -> Path:
        uri = self.run("apt-get", "download", "--print-uris", name).split()
        self.run("apt-get", "download", name)
        return self._archives / uri[1]

    def download_kernels(self, name: str) -> list[Path]:
        names = self.newest_kernels() if name == "newest" else [name]
        return [self.download(each) for each in names]

    def download_for_tracing(self) -> list[Path]:
        (headers,) = self._dependencies("linux-headers-amd64")
        names = [headers, headers.replace("headers", "image", 1), "lttng-modules-dkms", "kmod"]
        names += [n for n in self._dependencies(headers) if "-common" in n or "-kbuild-" in n]
        return [self.download(name) for name in names]

    def _dependencies(self, name: str) -> list[str]:
        lines = self.run("apt-cache", "depends", name).splitlines()
        return [line.split()[1] for line in lines if line.lstrip().startswith("Depends:")]

    def newest_kernels(self) -> list[str]:
        """One package name per flavour. `linux-binary` is a kernel without its modules."""
        found = []
        for flavour in FLAVOURS:
            pattern = f"^linux-binary-[0-9.]+.*[0-9]-{flavour}$"
            lines = self.run("apt-cache", "search", "--names-only", pattern).splitlines()
            names = [line.split()[0] for line in lines]
            if not names:
                raise PackageError(f"no package {pattern} in {', '.join(SUITES)}")
            found.append(max(names, key=_version))
        return found


def _version(name: str) -> tuple[int, ...]:
    release = name.split("-")[2].partition("+")[0]
    return tuple(int(part) for part in release.split("."))
