"""The file of a torque calibration: read, checked against the drive, kept in the log, and applied to a recording."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers import PreflightRefused
from profiles import CodedText, message_of
from tdhil.errors import MessageCode, UsageError, existing_file

if TYPE_CHECKING:
    from tdhil.calibration import StoredCalibration
    from tdhil.config import Rig
    from tdhil.recording import Recording
    from tdhil.session.run_record import RunRecord

KEPT: Final = "torque_calibration"
"""Key of the calibration in the log's configuration."""
VALID_DAYS: Final = 365.0
"""Validity of a calibration in days, unless rig.yaml states another."""
_CARRIED = (MessageCode.FACTOR_UNLIKE_SCALE, MessageCode.GEAR_LOSS_IN_FACTOR)
"""Warnings of a calibration that each result with it repeats."""
_LARGEST_FILE = 1 << 20
_AGAIN = "Make one with: tdhil calibrate torque without.mcap with.mcap --added J --save calibration.json"


def load_calibration(path: Path) -> dict[str, Any]:
    """Return the document of a calibration. Raises UsageError for a file that is not one."""
    from tdhil.calibration import CalibrationUnusable, StoredCalibration

    if not path.is_file():
        raise UsageError("there is no such file", where=str(path), next_step=_AGAIN)
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise ValueError("too large")
        document = json.loads(path.read_text(encoding="utf-8"))
        StoredCalibration.of(document)
    except CalibrationUnusable as error:
        raise UsageError(str(error), where=str(path), next_step=_AGAIN) from None
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"is no JSON ({str(error)[:80]})", where=str(path), next_step=_AGAIN) from None
    return dict(document)


def save_calibration(document: Mapping[str, Any], path: Path) -> None:
    """Write the document of a valid calibration, never over a file. Raises UsageError."""
    try:
        with path.open("x", encoding="utf-8") as file:
            json.dump(document, file, ensure_ascii=False, indent=2, allow_nan=False)
            file.write("\n")
    except FileExistsError:
        raise existing_file(f"--save {path}") from None
    except OSError as error:
        raise UsageError(f"can't be written ({error.strerror or error})", where=f"--save {path}",
                         entry=MessageCode.FILE_NOT_WRITABLE) from error


def refuse_rehearsal(record: RunRecord) -> None:
    """Raise UsageError for a rehearsal: a scripted fault, such as another torque scale, is no property of the drive."""
    from tdhil.report import rehearsed_faults

    if faults := rehearsed_faults(record.configuration):
        raise UsageError(f"is a rehearsal of faults ({', '.join(faults)}): no drive is calibrated by it",
                         where=record.log, next_step="Calibrate with runs without --fault")


def calibration_of_rig(rig: Rig | None) -> dict[str, Any] | None:
    """Return the calibration that rig.yaml names, for the log. Raises UsageError for a file that is not one."""
    if rig is None or rig.drive_data.torque_calibration is None:
        return None
    document = load_calibration(rig.folder / rig.drive_data.torque_calibration)
    return document | {"valid_days": rig.drive_data.calibration_valid_days}


def refuse_another_drive(run: Mapping[str, Any], identity: Mapping[str, Any]) -> None:
    """Check before motion that the calibration in the log's configuration belongs to this drive. Raises
    PreflightRefused.
    """
    found = stored_of(run)
    if found is None:
        return
    settings = drive_settings({**run, "identity": identity})
    if other := found.another_drive(identity, settings, bool(identity.get("simulated"))):
        raise PreflightRefused(f"the torque calibration is of another drive: {other}", where=KEPT,
                               next_step="Calibrate this drive, or take torque_calibration out of rig.yaml")


def stored_of(run: Mapping[str, Any]) -> StoredCalibration | None:
    """Return the calibration of a log's configuration; None without a valid one."""
    from tdhil.calibration import CalibrationUnusable, StoredCalibration

    document = run.get(KEPT)
    if document is None:
        return None
    try:
        return StoredCalibration.of(document)
    except CalibrationUnusable:
        return None


def other_drive(document: Mapping[str, Any], drive: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """Return how the drive of a calibration differs from this one, in words; '' if it does not, or is not known."""
    found = stored_of({KEPT: document})
    return "" if found is None else found.another_drive(drive, settings, None)


def with_calibration(run: Mapping[str, Any], recording: Recording, document: Mapping[str, Any], where: str,
                     sha256: str = "") -> dict[str, Any]:
    """Return the configuration with another calibration, for a replay. Raises UsageError if it belongs to another
    drive.

    ``sha256``: hash of the log. If the calibration comes from this log, the log's noise is in the calibration factor
    too.
    """
    from tdhil.calibration import OWN_LOG

    runs = document.get("runs")
    own = bool(sha256) and isinstance(runs, list) and any(
        isinstance(one, Mapping) and one.get("sha256") == sha256 for one in runs)
    changed = {**run, KEPT: {**document, OWN_LOG: True} if own else dict(document)}
    found = stored_of(changed)
    if found is None:
        raise UsageError("is no calibration", where=where, next_step=_AGAIN)
    if other := found.another_drive(drive_identity(run), drive_settings(run, recording), recording.simulated):
        raise UsageError(f"is of another drive: {other}", where=where, next_step="Name the calibration of this drive")
    return changed


def without_calibration(run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration with torque in the drive's own unit."""
    return {name: value for name, value in run.items() if name != KEPT}


@dataclass(frozen=True)
class AppliedCalibration:
    """A recording with its calibration. ``recording`` in calibrated N·m; ``day``: date of the calibration, '' if none
    was applied.
    """

    recording: Recording
    day: str = ""
    warnings: tuple[CodedText, ...] = ()


def apply_calibration(recording: Recording, run: Mapping[str, Any]) -> AppliedCalibration:
    """Apply the log's calibration to a recording: the same for a live run and for its replay."""
    document = run.get(KEPT)
    if document is None:
        return AppliedCalibration(recording)
    found = stored_of(run)
    if found is None:
        return _not_applied(recording, "the torque calibration in the log can't be read; it was not applied")
    if recording.impedance is not None:
        return _not_applied(recording, "the torque calibration was not applied: a measured impedance, and the gains"
                            " from it, are in the drive's own unit of torque")
    drive, settings = drive_identity(run), drive_settings(run, recording)
    if other := found.another_drive(drive, settings, recording.simulated):
        return _not_applied(recording, f"the torque calibration of {found.day} was not applied, since it is of another"
                            f" drive: {other}")
    return AppliedCalibration(found.applied(recording), found.day, tuple(
        _doubts(found, drive, settings, run.get("started"), document)))


def _not_applied(recording: Recording, text: str) -> AppliedCalibration:
    return AppliedCalibration(recording, "", (CodedText(text, MessageCode.CALIBRATION_WARNING),))


def _doubts(found: StoredCalibration, drive: Mapping[str, Any], settings: Mapping[str, Any], started: Any,
            document: Mapping[str, Any]) -> Iterator[CodedText]:
    """Yield the warnings about a calibration that was applied."""
    from tdhil.calibration import OWN_LOG
    from tdhil.report import text_of

    days = document.get("valid_days")
    if old := found.too_old(started, float(days) if isinstance(days, int | float) else VALID_DAYS):
        yield CodedText(f"the torque calibration of {found.day} is {old} (calibration_valid_days); calibrate again",
                        MessageCode.CALIBRATION_WARNING)
    texts, codes = (part if isinstance(part, list) else [] for part in (
        document.get("warnings"), document.get("warning_codes")))
    for text, code in zip(texts, codes, strict=False):
        if (entry := message_of(str(code))) is not None and entry in _CARRIED:
            yield CodedText(f"the torque calibration of {found.day} has a warning: {text_of(text)}", entry)
    names = found.settings.get("profile"), settings.get("profile")
    if all(names) and names[0] != names[1]:
        yield CodedText(f"the torque calibration of {found.day} was made with the profile {names[0]}, and this run with"
                        f" {names[1]}. Check that both have the same unit of torque", MessageCode.CALIBRATION_WARNING)
    if not document.get(OWN_LOG) and not found.knows("serial", drive):
        yield CodedText(f"it was not checked whether the torque calibration of {found.day} belongs to this drive: its"
                        " serial number is not known on both sides. Compare the nameplates",
                        MessageCode.CALIBRATION_UNCHECKED)


def drive_settings(run: Mapping[str, Any], recording: Recording | None = None) -> dict[str, Any]:
    """Return the settings on which the drive's unit of torque depends, as far as the log states them."""
    bench, profile = _part(run.get("bench")), _part(run.get("profile"))
    found = {"profile": profile.get("name"),
             "rated_torque_nm": _part(bench.get("drive_data")).get("rated_torque_nm")}
    if recording is not None:
        found |= {"torque_count_nm": recording.torque_resolution_nm or None, "gear_ratio": recording.gear_ratio}
    return found


def drive_identity(run: Mapping[str, Any], _recording: Recording | None = None) -> dict[str, Any]:
    """Return name and numbers of the drive; empty for a trace."""
    identity = _part(run.get("identity"))
    return {name: identity[name] for name in ("name", "vendor", "product", "serial") if name in identity}


def _part(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
