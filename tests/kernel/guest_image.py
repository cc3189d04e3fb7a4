"""The guest's file system: an initramfs with Python, libbpf, the package, and the checks."""

import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
PYTHON = "3.13"
"""The guest's version of Python, which the package's compiled library has to be of."""

_NOT_NEEDED = (
    "usr/include",
    "usr/share",
    "usr/lib/python3*/test",
    "usr/lib/python3*/idlelib",
    "usr/lib/python3*/pydoc_data",
    "usr/lib/python3*/ensurepip",
    "usr/lib/python3/dist-packages/numpy/**/tests",
    "usr/lib/python3*/lib-dynload/_codecs_*",
    "usr/lib/*/gconv",
    "usr/lib/*/perl*",
    "usr/lib/*/libcrypto*",
    "usr/lib/*/libdb-*",
    "var",
)
_INIT = f"""#!/usr/bin/python{PYTHON}
import sys
sys.path.insert(0, "/checks")
import guest_init
guest_init.main()
"""


def unpack_kernel(package: Path, folder: Path) -> Path:
    subprocess.run(["dpkg-deb", "--extract", package, folder], check=True)
    images = [*folder.glob("**/vmlinuz"), *folder.glob("boot/vmlinuz-*")]
    if len(images) != 1:
        raise FileNotFoundError(f"{package} holds {len(images)} kernel images")
    return images[0]


def make_image(
    userland: list[Path], folder: Path, files: Mapping[str, bytes] | None = None
) -> Path:
    """An initramfs in ``folder``, with ``files`` added; the C program is compiled for it."""
    root = folder / "root"
    root.mkdir(parents=True)
    for package in userland:
        subprocess.run(["dpkg-deb", "--extract", package, root], check=True)
    for pattern in _NOT_NEEDED:
        for path in root.glob(pattern):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
    for name in ("blas", "lapack"):  # as Debian's alternatives have them
        link = f"lib{name}.so.3"
        (root / "usr/lib/x86_64-linux-gnu" / link).symlink_to(f"{name}/{link}")
    for name in ("bin", "lib", "lib64", "sbin"):
        if not (root / name).exists():
            (root / name).symlink_to(f"usr/{name}")
    ignored = shutil.ignore_patterns("__pycache__")
    _unpack_package(root / "src")
    shutil.copytree(HERE / "guest", root / "checks", ignore=ignored)
    subprocess.run(
        ["cc", "-O2", "-Wall", "-static", "-o", root / "checks/spin", HERE / "guest/spin.c"],
        check=True,
    )
    for name, data in {"init": _INIT.encode(), **(files or {})}.items():
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_bytes(data)
    (root / "init").chmod(0o755)
    return _archive(root, folder / "initramfs.cpio")


def _unpack_package(folder: Path) -> None:
    """Unpack a wheel for the guest's Python: the package with its compiled libraries."""
    of_pyenv = (Path.home() / ".pyenv/versions").glob(f"{PYTHON}.*/bin/python3")
    python = next(map(str, of_pyenv), None) or shutil.which(f"python{PYTHON}")
    if python is None:
        raise FileNotFoundError(f"no Python {PYTHON} is here to build the guest's library with")
    wheels = folder.with_name("wheels")
    subprocess.run(
        [sys.executable, ROOT / "scripts/build_wheels", wheels],
        env={**os.environ, "PYTHONS": python, "TRY": "0"},
        check=True,
    )
    (wheel,) = wheels.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    shutil.rmtree(wheels)


def _archive(root: Path, output: Path) -> Path:
    """A cpio archive (format newc, which the kernel reads), uncompressed: unpacked sooner."""
    with output.open("wb") as file:
        for number, path in enumerate(sorted(root.rglob("*")), start=1):
            status = path.lstat()
            data = b""
            if path.is_symlink():
                data = bytes(path.readlink())
            elif path.is_file():
                data = path.read_bytes()
            name = str(path.relative_to(root)).encode()
            file.write(_header(number, status.st_mode, len(data), len(name)) + name + b"\0")
            file.write(b"\0" * (-file.tell() % 4) + data)
            file.write(b"\0" * (-file.tell() % 4))
        end = b"TRAILER!!!"
        file.write(_header(0, 0, 0, len(end)) + end + b"\0")
        file.write(b"\0" * (-file.tell() % 512))
    return output


def _header(number: int, mode: int, size: int, name_length: int) -> bytes:
    """newc: the magic, then 13 fields of eight hexadecimal digits; everything belongs to root."""
    fields = (number, mode, 0, 0, 1, 0, size, 0, 0, 0, 0, name_length + 1, 0)
    return b"070701" + b"".join(b"%08X" % field for field in fields)
