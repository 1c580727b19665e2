"""Archive mark of a run of `tdhil serve`: its file annotations.json beside the log, in the folder of the service."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Final

ANNOTATIONS_FILE: Final = "annotations.json"
"""File in a run's folder with its later edits."""
_LARGEST: Final = 16 * 2**20
"""Largest file that is read, bytes: a run with thousands of edits has less."""


def is_archived(log: str | Path) -> bool:
    """Return whether the service has archived the run of this log; False for a log elsewhere, and for a URL."""
    path = Path(log).with_name(ANNOTATIONS_FILE)
    with suppress(OSError, ValueError, RecursionError):
        if path.stat().st_size <= _LARGEST:
            found = json.loads(path.read_bytes())
            return isinstance(found, dict) and found.get("archived") is True
    return False
