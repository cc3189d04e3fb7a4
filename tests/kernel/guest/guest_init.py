"""The first process of the guest: makes a small system, runs the checks, switches the machine off.

Results go to the second serial port, one JSON object per line: first the kernel, then each check,
at last `{"done": true}`, without which the host takes the run for a failure.
"""

import ctypes
import fcntl
import json
import os
import struct
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import machine_files

CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
ADD_ENTROPY = 0x40085203


def prepare() -> None:
    """Mount what a system has, and wait for its clock to settle."""
    for kind, place in (("proc", "/proc"), ("sysfs", "/sys"), ("devtmpfs", "/dev")):
        Path(place).mkdir(exist_ok=True)
        machine_files.mount(kind, Path(place))
    _seed_random_numbers()
    Path("/run").mkdir(exist_ok=True)
    Path("/tmp").mkdir(exist_ok=True)
    Path("/tmp").chmod(0o1777)
    os.environ["PYTHONPATH"] = "/src"
    deadline = time.monotonic() + 10
    while CLOCK_SOURCE.read_text().strip() != "tsc" and time.monotonic() < deadline:
        time.sleep(0.1)


def _seed_random_numbers() -> None:
    """Without a device for it, a machine without noise would wait for random numbers for ever."""
    seed = bytes(range(256)) * 2
    with Path("/dev/urandom").open("wb") as device:
        fcntl.ioctl(device, ADD_ENTROPY, struct.pack("ii512s", 8 * len(seed), len(seed), seed))


def run_checks(say: Any, names: list[str]) -> None:
    """Run what this kernel and number of cores call for, or the named ones."""
    sys.path[:0] = ["/src", "/checks"]
    import kernel_checks

    from chainshaper.enforcement.scx.back_end import is_realtime_kernel

    checks = list(kernel_checks.VIRTUAL_TIME)
    if os.cpu_count() == 2:
        checks = list(kernel_checks.TWO_CORES)
    elif is_realtime_kernel():
        checks += kernel_checks.REAL_TIME_KERNEL
    for check in checks:
        if names and check.__name__ not in names:
            continue
        name = check.__name__.replace("_", " ")
        say({"begins": name})
        try:
            say({"check": name, "passed": True, "text": check()})
        except BaseException as error:
            text = "".join(traceback.format_exception(error, limit=-3))
            say({"check": name, "passed": False, "text": text})


def main() -> None:
    prepare()
    with Path("/dev/ttyS1").open("w", buffering=1) as port:

        def say(what: dict[str, Any]) -> None:
            port.write(json.dumps(what) + "\n")

        say({"kernel": os.uname().release, "clock": CLOCK_SOURCE.read_text().strip()})
        try:
            if machine_files.TOLD.exists():
                machine_files.run_tests(port.write)
            else:
                run_checks(say, sys.argv[1:])
            say({"done": True})
        except BaseException:
            say({"fault": traceback.format_exc()})
    os.sync()
    ctypes.CDLL(None).reboot(0x4321FEDC)  # power off


if __name__ == "__main__":
    main()
