"""Where a run's log goes: never over an older one."""

from __future__ import annotations

import time
from pathlib import Path


def make_room(path: Path) -> Path | None:
    """Move an older log at ``path`` aside, named by the time it was last written; its new place, if there was one."""
    if not path.is_file():
        return None
    stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(path.stat().st_mtime))
    older = path.with_name(f"{path.stem}-{stamp}{path.suffix}")
    number = 1
    while older.exists():
        number += 1
        older = path.with_name(f"{path.stem}-{stamp}-{number}{path.suffix}")
    path.rename(older)
    return older
