"""What others did on the drive's bus in a run, for the log, whoever watches, and the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from drivers.drive import Drive, Telling


def summary(drive: Drive) -> tuple[str, ...]:
    """Of all of the run, a line each; nothing of a drive that doesn't notice."""
    return drive.summary() if isinstance(drive, Telling) else ()


def tell(drive: Drive, configure: Callable[..., None], say: Callable[[str], None]) -> None:
    """At the end: into the log's configuration, and to whoever watches."""
    if lines := summary(drive):
        configure(others=list(lines))
        for line in lines:
            say(f"on the drive's bus: {line}")


def warnings(run: Mapping[str, Any]) -> tuple[str, ...]:
    """For the result, from the log's configuration: the same live and replayed."""
    found = run.get("others")
    return tuple(f"on the drive's bus: {line}" for line in found) if isinstance(found, list) else ()
