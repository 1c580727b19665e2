"""The smoothing that a drive puts on what it reports, read from the objects its profile names."""

import math
import struct
from collections.abc import Callable

from drivers.canopen.sdo import Objects, name
from drivers.drive import ReportingFilters
from drivers.errors import ObjectRefused
from profiles.canopen import CanopenProfile, ReportingFilter

_FORMATS = {"u8": "<B", "u16": "<H", "u32": "<I", "i8": "<b", "i16": "<h", "i32": "<i", "f32": "<f"}


def read_filters(note: Callable[[str, str, str], None], objects: Objects, profile: CanopenProfile) -> ReportingFilters:
    """First-order lags in seconds, None where the drive doesn't tell; each is noted in the preflight table."""
    lags: dict[str, float] = {}
    sources = []
    for entry in profile.filters:
        where = name(entry.index, entry.sub)
        try:
            lag_s = lag_seconds(entry, objects.read_bytes(entry.index, entry.sub))
        except ObjectRefused:
            note(f"{entry.signal} filter", "the drive does not tell", where)
            continue
        note(f"{entry.signal} filter", f"{lag_s * 1000.0:.4g} ms", where)
        lags[entry.signal] = lag_s
        sources.append(f"{entry.signal} {where}")
    return ReportingFilters(lags.get("speed"), lags.get("torque"), ", ".join(sources))


def lag_seconds(entry: ReportingFilter, data: bytes) -> float:
    """Raw bytes of the object → time constant. A cut-off frequency f_c is a lag of 1/(2π f_c); 0 means no filter."""
    layout = struct.Struct(_FORMATS[entry.type])
    if len(data) < layout.size:
        raise ObjectRefused(f"{len(data)} bytes where {layout.size} were expected", where=name(entry.index, entry.sub))
    value = float(layout.unpack_from(data)[0]) * entry.per_lsb
    if not math.isfinite(value) or value < 0.0:
        raise ObjectRefused(f"{value} is no filter setting", where=name(entry.index, entry.sub))
    if entry.quantity == "time_constant_s":
        return value
    return 1.0 / (2.0 * math.pi * value) if value > 0.0 else 0.0
