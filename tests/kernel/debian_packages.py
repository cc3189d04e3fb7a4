"""Debian packages for the guests: fetched through apt, which checks them, and kept in a cache.

apt is given folders of its own, so that the machine's package lists and sources play no part; the
archive's keys are the machine's. What was fetched once is used again without a network, after
comparing its digest with the one that was written down. Delete the cache to get newer kernels.
"""

import hashlib
import json
import os
import subprocess
from pathlib import Path

CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "chainshaper" / "kernels"
KEYS = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
MIRROR = "http://deb.debian.org/debian"
SUITES = ("trixie", "trixie-backports", "sid")
USERLAND = ("python3.13-minimal", "libpython3.13-stdlib", "libbpf1")
FLAVOURS = ("cloud-amd64", "rt-amd64")
"""A normal kernel (for virtual machines: small) and a PREEMPT_RT one."""


class PackageError(Exception):
    """Packages cannot be had; the message ends with what apt said."""


def fetch(kernels: list[str]) -> tuple[list[Path], list[Path]]:
    """Packages of the guests' programs, and of the kernels: the newest of each flavour, or named.

    Raises:
        PackageError: they are not in the cache and cannot be downloaded.
    """
    CACHE.mkdir(parents=True, exist_ok=True)
    manifest = CACHE / "manifest.json"
    known: dict[str, dict[str, str]] = {}
    if manifest.exists():
        known = json.loads(manifest.read_text())
    wanted = [name for name in kernels or ["newest"] if name not in known]
    if "userland" not in known or wanted:
        apt = _Apt(CACHE / "apt")
        apt.run("apt-get", "update")
        if "userland" not in known:
            known["userland"] = _digests(apt.download_all(USERLAND))
        for name in wanted:
            names = apt.newest_kernels() if name == "newest" else [name]
            known[name] = _digests([apt.download(each) for each in names])
        made = manifest.with_suffix(".new")
        made.write_text(json.dumps(known, indent=1))
        made.rename(manifest)
    userland = _checked(known["userland"])
    return userland, [path for name in kernels or ["newest"] for path in _checked(known[name])]


def _digests(packages: list[Path]) -> dict[str, str]:
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in packages}


def _checked(digests: dict[str, str]) -> list[Path]:
    for name, digest in digests.items():
        path = Path(name)
        if not path.exists() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            raise PackageError(f"{path} is gone or damaged: delete {CACHE} and try again")
    return [Path(name) for name in digests]


class _Apt:
    """apt with folders of its own."""

    def __init__(self, folder: Path) -> None:
        if not KEYS.exists():
            raise PackageError(f"no {KEYS}: apt install debian-archive-keyring")
        self._archives = folder / "archives"
        (folder / "lists" / "partial").mkdir(parents=True, exist_ok=True)
        (self._archives / "partial").mkdir(parents=True, exist_ok=True)
        (folder / "status").touch()
        sources = folder / "sources.list"
        sources.write_text(
            "".join(f"deb [signed-by={KEYS}] {MIRROR} {suite} main\n" for suite in SUITES)
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
            "APT::Default-Release": SUITES[0],
            "APT::Install-Recommends": "0",
            "APT::Sandbox::User": "root",
        }
        self._options = [
            word for name, value in settings.items() for word in ("-o", f"{name}={value}")
        ]

    def run(self, program: str, *arguments: str) -> str:
        """Its output."""
        command = [program, *self._options, *arguments]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, cwd=self._archives
        )
        if done.returncode:
            said = "\n".join((done.stderr or done.stdout).strip().splitlines()[-5:])
            raise PackageError(f"{program} {' '.join(arguments)} failed:\n{said}")
        return done.stdout

    def download_all(self, names: tuple[str, ...]) -> list[Path]:
        """Packages with all that they depend on."""
        for old in self._archives.glob("*.deb"):
            old.unlink()
        self.run("apt-get", "install", "--yes", "--download-only", *names)
        return sorted(self._archives.glob("*.deb"))

    def download(self, name: str) -> Path:
        """One package by itself."""
        uri = self.run("apt-get", "download", "--print-uris", name).split()
        self.run("apt-get", "download", name)
        return self._archives / uri[1]

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
