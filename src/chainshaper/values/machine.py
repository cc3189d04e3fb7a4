"""What was found on a machine: its abilities, and how it stalls."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import polars as pl

from chainshaper.values.recording import StallMeterInfo

__all__ = ["Check", "MachineReport", "State"]

State: TypeAlias = Literal["good", "limited", "absent"]


@dataclass(frozen=True)
class Check:
    """One ability: ``needed_for`` says what goes without it, ``remedy`` what would bring it."""

    name: str
    state: State
    found: str
    needed_for: str
    remedy: str = ""


@dataclass(frozen=True)
class MachineReport:
    """All checks, and the stalls seen while watching every core (`machine_stall` table)."""

    checks: tuple[Check, ...]
    stalls: pl.DataFrame
    stall_meter: StallMeterInfo
    watched_ns: int
