"""A speed calibration from a recording and counted turns, and its section in the file of the drive's calibration."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tdhil.errors import MessageCode, UsageError
from tdhil.session.run_record import RunRecord
from tdhil.session.stored_calibration import load_calibration, other_drive, refuse_rehearsal, save_calibration

if TYPE_CHECKING:
    from tdhil.calibration import CountedTurns, SpeedCalibration

SECTION: Final = "speed_calibration"
"""Key of the speed calibration in the file. The file may also contain a torque calibration."""
TURNS_SD, SECONDS_SD = 0.25, 0.3
"""Standard uncertainties: of a count of turns by eye, a quarter of a turn, and of a stopwatch by hand at
both ends, s.
"""
SPEED_REL_SD = 0.001
"""Assumed relative standard uncertainty of a mean speed that is read from a display."""


@dataclass(frozen=True)
class TurnsCount:
    """A count as the operator states it, turns at the motor or main shaft. None: not stated.

    ``seconds``: duration by the clock; otherwise the time between ``start_s`` and ``end_s``, which are times of the
    log.
    """

    turns: float
    turns_sd: float | None = None
    seconds: float | None = None
    seconds_sd: float | None = None
    speed_rad_s: float | None = None
    speed_sd_rad_s: float | None = None
    start_s: float | None = None
    end_s: float | None = None


def speed_by_position(record: RunRecord, wanted: float, confidence: float) -> SpeedCalibration:
    """Return the calibration factor from a log whose drive reports a position. Raises UsageError for a log
    without one.
    """
    from tdhil.calibration import calibrate_by_position
    from tdhil.estimation import angle_ratios
    from tdhil.recording import before_abort

    record.require_motion()
    refuse_rehearsal(record)
    if record.recording.position_rad is None:
        raise UsageError("holds no position of the drive", where=record.log,
                         next_step="Count turns of the shaft: --turns 100 --seconds 312.4 --speed 2.0")
    steady, excited = angle_ratios(before_abort(record.recording))
    if not steady and not excited:
        raise UsageError("holds no stretch with both a position and a speed that can be used", where=record.log,
                         next_step="Run it for longer, or count turns of the shaft: --turns 100 --seconds 312.4")
    return calibrate_by_position((*steady, *excited), wanted, confidence)


def speed_by_turns(
    count: TurnsCount, record: RunRecord | None, ratio: float, wanted: float, confidence: float
) -> tuple[CountedTurns, SpeedCalibration]:
    """Return the calibration factor from counted turns. ``ratio``: turns of the motor per counted turn.

    The mean reported speed is stated, or taken from ``record``. Raises UsageError for data that do not fit together.
    """
    from tdhil.calibration import CountedTurns, calibrate_by_turns

    seconds = count.seconds
    if record is None:
        if count.speed_rad_s is None or seconds is None:
            raise UsageError("needs the time of the count and the mean reported speed", where="--turns",
                             next_step="Such as: tdhil calibrate speed --turns 100 --seconds 312.4 --speed 2.0")
        speed, bound = count.speed_rad_s, 0.0
        speed_sd = SPEED_REL_SD * abs(speed) if count.speed_sd_rad_s is None else count.speed_sd_rad_s
    else:
        refuse_rehearsal(record)
        if count.start_s is None or count.end_s is None or not count.start_s < count.end_s:
            raise UsageError("needs the times of the log between which the turns were counted", where=record.log,
                             next_step="Such as: tdhil calibrate speed run.mcap --turns 100 --from 20 --to 332.4")
        speed, bound = _reported(record, count.start_s, count.end_s)
        speed_sd = 0.0
        seconds = count.end_s - count.start_s if seconds is None else seconds
    counted = CountedTurns(
        count.turns * ratio, (TURNS_SD if count.turns_sd is None else count.turns_sd) * ratio, seconds,
        SECONDS_SD if count.seconds_sd is None else count.seconds_sd, speed, speed_sd, bound)
    try:
        return counted, calibrate_by_turns(counted, wanted, confidence)
    except ValueError as error:
        raise UsageError(f"can't be used: {error}", where="--turns" if record is None else record.log) from None


def _reported(record: RunRecord, start_s: float, end_s: float) -> tuple[float, float]:
    from tdhil.estimation import mean_speed

    time = record.recording.time_s
    if not len(time) or not (time[0] <= start_s and end_s <= time[-1]):
        held = f"{time[0]:.1f} to {time[-1]:.1f} s" if len(time) else "no sample"
        raise UsageError(f"does not hold the times {start_s:g} to {end_s:g} s; it holds {held}", where=record.log,
                         next_step="Choose --from and --to within the log")
    found = mean_speed(record.recording, start_s, end_s)
    if found is None or not math.isfinite(found[0]) or found[0] == 0.0:
        raise UsageError(f"has no usable speed throughout {start_s:g} to {end_s:g} s", where=record.log,
                         next_step="Choose a stretch without missing samples, in which the shaft turns")
    return found


def add_speed_calibration(document: Mapping[str, Any], path: Path) -> bool:
    """Put the section into the file; a torque calibration in it is kept. Return True if the drive was compared.

    Raises UsageError for a file that is not a calibration, has a speed calibration already, or belongs to another
    drive.
    """
    check_speed_place(path)
    if not path.exists():
        save_calibration({"kind": SECTION, SECTION: dict(document)}, path)
        return True
    kept = load_calibration(path)
    drive, settings = (document[name] or {} for name in ("drive", "settings"))
    if other := other_drive(kept, drive, settings):
        raise UsageError(f"is of another drive: {other}", where=f"--save {path}", next_step="Name another file")
    if kept.get("simulated") is not document["simulated"] and drive:
        raise UsageError("one of both calibrations is simulated, the other is not", where=f"--save {path}",
                         next_step="Name another file")
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        save_calibration({**kept, SECTION: dict(document)}, beside)
        beside.replace(path)
    except OSError as error:
        raise UsageError(f"can't be written ({error.strerror or error})", where=f"--save {path}",
                         entry=MessageCode.FILE_NOT_WRITABLE) from error
    finally:
        beside.unlink(missing_ok=True)
    return bool(drive and kept.get("drive"))


def check_speed_place(path: Path) -> None:
    """Refuse a file that can't take a speed calibration. Raises UsageError."""
    if not path.exists():
        return
    try:
        alone = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        alone = None
    if isinstance(alone, dict) and SECTION in alone:
        raise UsageError("already holds a speed calibration and was not changed", where=f"--save {path}",
                         next_step="Name another file, or move the existing one")
    load_calibration(path)
