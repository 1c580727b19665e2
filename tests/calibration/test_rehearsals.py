"""Runs with scripted faults calibrate no drive: torque-scale=1.1 would become its calibration factor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tdhil.errors import UsageError
from tdhil.session import TurnsCount, find_by_known_pipe, find_by_reference, find_calibration, speed_by_position
from tdhil.session.speed_calibration import speed_by_turns
from tests.calibration.bodies import two

COUNT = TurnsCount(100.0, start_s=0.0, end_s=10.0)


@pytest.mark.parametrize("calibrate", [
    lambda runs, record: find_calibration(runs, "motor"),
    lambda runs, record: find_by_reference(record, Path("sensor.csv"), None, "motor", None, 0.95),
    lambda runs, record: find_by_known_pipe(record, Path("string.yaml"), 0.95),
    lambda runs, record: speed_by_position(record, 0.01, 0.95),
    lambda runs, record: speed_by_turns(COUNT, record, 1.0, 0.01, 0.95),
], ids=["body", "reference", "known pipe", "position", "turns"])
def test_a_rehearsal_calibrates_no_drive(tmp_path: Path, calibrate: Any) -> None:
    runs = two(tmp_path)
    record = runs[1].record
    rehearsed = replace(record, configuration={**record.configuration, "faults": ["torque-scale=1.1"]})
    with pytest.raises(UsageError, match=r"is a rehearsal of faults \(torque-scale=1\.1\)"):
        calibrate([runs[0], replace(runs[1], record=rehearsed)], rehearsed)
