"""Stored torque calibration: its drive and date, and its application to a recording."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any, Final

from tdhil.estimation import normal_quantile
from tdhil.recording import FloatArray, Recording

KIND: Final = "torque_calibration"
OWN_LOG: Final = "own_log"
"""Key of a calibration that is applied to a log from which it was made."""
_NUMBERS: Final = ("value", "low", "high", "confidence")
_LEAST, _MOST = 0.1, 10.0
"""Range of a plausible factor. Beyond it, a document is not a calibration of a drive."""
_ALIKE = 1e-6
_NUMBERS_OF_DRIVE: Final = ("vendor", "product", "serial")


class CalibrationUnusable(ValueError):
    """Raised for a document that is not a calibration; the text states the fault."""


@dataclass(frozen=True)
class StoredCalibration:
    """``factor`` κ = true over reported torque, with its coverage interval. ``date`` in ISO 8601.

    ``drive`` and ``settings``: identity of the drive, and the settings that its unit of torque depends on.
    ``own_rel_sd``: relative standard uncertainty of the calibration's J, for a log from which the calibration was made;
    else 0.
    """

    factor: float
    low: float
    high: float
    confidence: float
    date: str
    drive: Mapping[str, Any]
    settings: Mapping[str, Any]
    simulated: bool
    own_rel_sd: float = 0.0

    @classmethod
    def of(cls, document: Any) -> "StoredCalibration":
        """Return the calibration in a document of ``tdhil calibrate torque``. Raises CalibrationUnusable."""
        if not isinstance(document, Mapping) or document.get("kind") != KIND:
            raise CalibrationUnusable("is no calibration of tdhil calibrate torque")
        factor = document.get("calibration_factor")
        if not isinstance(factor, Mapping):
            raise CalibrationUnusable("holds no calibration factor: that calibration was refused")
        numbers = _numbers_in(factor)
        if not numbers:
            raise CalibrationUnusable("holds a calibration factor that is no number")
        value, low, high, confidence = numbers
        if not (_LEAST <= low <= value <= high <= _MOST and 0.5 <= confidence < 1.0):
            raise CalibrationUnusable(f"holds a calibration factor that can't be: {value:g} ({low:g} to {high:g})")
        date = document.get("date")
        try:
            datetime.fromisoformat(str(date))
        except ValueError:
            raise CalibrationUnusable("holds no date") from None
        drive, settings = (document.get(name) or {} for name in ("drive", "settings"))
        if not isinstance(drive, Mapping) or not isinstance(settings, Mapping):
            raise CalibrationUnusable("names no drive")
        own_rel_sd, inertia = 0.0, document.get("inertia_kg_m2")
        if document.get(OWN_LOG) is True and isinstance(inertia, Mapping) and (own := _numbers_in(inertia)) and (
                0.0 < own[1] <= own[0] <= own[2] and 0.5 <= own[3] < 1.0):
            own_rel_sd = 0.5 * (own[2] - own[1]) / own[0] / normal_quantile(own[3])
        return cls(value, low, high, confidence, str(date), dict(drive), dict(settings),
                   document.get("simulated") is True, own_rel_sd)

    @property
    def day(self) -> str:
        """Date as ``2026-11-23``."""
        return f"{datetime.fromisoformat(self.date):%Y-%m-%d}"

    @property
    def rel_sd(self) -> float:
        """Relative standard deviation of a normal scale with this interval.

        The noise of a log from which the calibration was made is also in the factor, so both add linearly, not in
        quadrature. J is then not more certain than in the calibration.
        """
        return max(self.own_rel_sd, 0.5 * (self.high - self.low) / self.factor / normal_quantile(self.confidence))

    def another_drive(self, drive: Mapping[str, Any], settings: Mapping[str, Any], simulated: bool | None) -> str:
        """Return the difference to this drive or its settings, in words; '' if there is none.

        ``simulated``: whether this drive is simulated; None: not compared.
        """
        if simulated is not None and simulated != self.simulated:
            return "it was measured on a simulated drive" if self.simulated else "this drive is simulated"
        for name in _NUMBERS_OF_DRIVE:
            if self.knows(name, drive) and self.drive[name] != drive[name]:
                return f"its {name} is {self.drive[name]}, and {drive[name]} here"
        # Vendor and product number state the type of a drive, so its profile may have another name. Where they are not
        # known, as on Modbus, only the profile states the type and the unit of torque.
        typed = self.knows("vendor", drive) and self.knows("product", drive)
        for name, ours in self.settings.items():
            if _differ(ours, settings.get(name)) and not (typed and name == "profile"):
                return f"its {name} is {ours}, and {settings[name]} here"
        return ""

    def knows(self, name: str, drive: Mapping[str, Any]) -> bool:
        """Return whether this number of the drive is known on both sides. 0 is not known: Modbus has no such number."""
        return bool(self.drive.get(name) and drive.get(name))

    def too_old(self, started: str | None, valid_days: float) -> str:
        """Return the age of the calibration at the start of a run, in words, if it exceeds ``valid_days``; else ''."""
        try:
            age = datetime.fromisoformat(str(started)).astimezone() - datetime.fromisoformat(self.date).astimezone()
        except ValueError:
            return ""
        return f"{age.days} days old, and valid for {valid_days:g}" if age > timedelta(days=valid_days) else ""

    def applied(self, recording: Recording) -> Recording:
        """Return the recording with every torque in calibrated N·m.

        The commanded torque offset of a measured impedance stays in the drive's N·m. A calibration of the reported
        torque does not make the ratio to the commanded torque more certain.
        """
        factor = self.factor
        limit, asked = recording.torque_limit_nm, recording.impedance
        ratio_sd = math.sqrt(2.0) * recording.torque_scale_rel_sd
        if asked is not None and asked.torque_ratio_rel_sd is not None:
            ratio_sd = asked.torque_ratio_rel_sd
        return replace(
            recording,
            torque_nm=factor * recording.torque_nm,
            commanded_torque_nm=_scaled(recording.commanded_torque_nm, factor),
            demanded_torque_nm=_scaled(recording.demanded_torque_nm, factor),
            torque_limit_nm=None if limit is None else factor * limit,
            torque_offset_nm=factor * recording.torque_offset_nm,
            torque_resolution_nm=factor * recording.torque_resolution_nm,
            torque_scale_rel_sd=self.rel_sd,
            torque_agreement_rel_sd=recording.torque_scale_rel_sd,
            impedance=None if asked is None else replace(
                asked, torque_ratio=factor * asked.torque_ratio, torque_ratio_rel_sd=ratio_sd),
        )


def _scaled(signal: FloatArray | None, factor: float) -> FloatArray | None:
    return None if signal is None else factor * signal


def _differ(a: Any, b: Any) -> bool:
    if a is None or b is None:
        return False
    if isinstance(a, int | float) and isinstance(b, int | float):
        return abs(a - b) > _ALIKE * max(abs(a), abs(b))
    return bool(a != b)


def _numbers_in(stated: Mapping[str, Any]) -> tuple[float, ...]:
    """Return value, low, high and confidence; () if one of them is missing or no finite number."""
    numbers = [stated.get(name) for name in _NUMBERS]
    if not all(isinstance(one, int | float) and math.isfinite(one) for one in numbers):
        return ()
    return tuple(float(one) for one in numbers if isinstance(one, int | float))
