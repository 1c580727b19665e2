"""Every sample of a log with its command, as a table in CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from tdhil.recording.log_reader import read_cycles

SAMPLE_COLUMNS: Final = (
    "time_s", "speed_rad_s", "torque_nm", "torque_demand_nm", "commanded_speed_rad_s", "commanded_torque_nm",
    "mode", "state", "status", "fresh", "limit_active", "standstill", "age_s", "half_width_s",
    "simulated", "position_rad",
)
"""Columns of a table. `tdhil replay` reads the first three from a CSV."""


def _rows(path: Path, simulated: int) -> Iterator[tuple[Any, ...]]:
    for command, one in read_cycles(path):
        speed, torque = (None, None) if command is None else (command.speed_rad_s, command.torque_nm)
        yield (
            one.time_s, one.speed_rad_s, one.torque_nm, one.torque_demand_nm, speed, torque,
            None if one.mode is None else one.mode.value, one.state.value, one.status, int(one.fresh),
            int(one.limit_active), int(one.standstill), one.age_s, one.half_width_s, simulated,
            one.position_rad,
        )


def write_samples(path: Path, target: Path, simulated: int) -> int:
    """Write every sample of a log to a new CSV file, and return their number. Raises LogError and OSError.

    Numbers have all digits, so that they are read back unchanged.
    """
    count = 0
    with target.open("x", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(SAMPLE_COLUMNS)
        for row in _rows(path, simulated):
            table.writerow(["" if cell is None else cell for cell in row])
            count += 1
    return count
