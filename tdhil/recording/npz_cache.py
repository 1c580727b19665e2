"""Recording as an npz file for a cache, read in milliseconds. It is not a log: it has no frames, commands or events.

The arrays are stored unchanged, everything else as one JSON text. The recording that is read back is equal to the last
bit.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from io import BytesIO
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np

from tdhil.recording.builder import hints_of, structure
from tdhil.recording.recording import Recording

_ARRAYS: Final = ("time_s", "speed_rad_s", "torque_nm", "fresh", "limited")
_SOME: Final = ("commanded_torque_nm", "demanded_torque_nm", "position_rad")
"""Optional arrays of a recording."""
_FLAGS: Final = ("fresh", "limited")
_REST: Final = tuple(field.name for field in fields(Recording) if field.name not in (*_ARRAYS, *_SOME))
_TEXT: Final = "json"


def pack_recording(recording: Recording, beside: Mapping[str, Any]) -> bytes:
    """Return the bytes of the file. ``beside``: additional plain data for JSON. Raises TypeError or ValueError."""
    whole = asdict(recording)
    text = json.dumps({"recording": {name: whole[name] for name in _REST}, "beside": dict(beside)})
    file = BytesIO()
    arrays: dict[str, Any] = {name: getattr(recording, name) for name in _ARRAYS}
    arrays |= {name: array for name in _SOME if (array := getattr(recording, name)) is not None}
    arrays[_TEXT] = np.frombuffer(text.encode(), np.uint8)
    np.savez(file, **arrays)
    return file.getvalue()


def unpack_recording(path: Path) -> tuple[Recording, dict[str, Any]] | None:
    """Return the recording and the additional data; None for a missing or damaged file, or one of another kind."""
    try:
        with np.load(path, allow_pickle=False) as found:
            arrays = {name: found[name] for name in (*_ARRAYS, *_SOME) if name not in _SOME or name in found.files}
            content = json.loads(found[_TEXT].tobytes())
        size = len(arrays["time_s"])
        kinds = {name: np.dtype("?" if name in _FLAGS else "f8") for name in arrays}
        if any(one.dtype != kinds[name] or one.shape != (size,) for name, one in arrays.items()):
            return None
        hints, rest = hints_of(Recording), content["recording"]
        members = {name: structure(hints[name], rest[name]) for name in _REST}
        return Recording(**arrays, **members), dict(content["beside"])
    except (OSError, ValueError, TypeError, KeyError, EOFError, BadZipFile):
        return None
