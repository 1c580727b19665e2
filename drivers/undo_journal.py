"""What a run changes in a drive is written down before it is changed, and struck out once it is given back.

A host that is killed gives nothing back. What then stands in the file (one for each drive, in the log's folder) is what
the drive was left with: `tdhil doctor` names it, and the next run gives it back before it looks at the drive's limits,
so that what a dead run has widened isn't taken for the drive's own.

Nothing is kept of simulated drives. A file that can't be written refuses the run: nothing has been changed then.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.drive import Identity
from drivers.errors import PreflightRefused

PREFIX, SUFFIX = "drive-left-", ".json"


@dataclass(frozen=True)
class Change:
    """One setting: ``where`` as people call it, what stood there, and what a run put in its place."""

    where: str
    before: bytes
    after: bytes

    @property
    def text(self) -> str:
        """For people: 6072h is 400, and was 100 before."""
        now, then = (int.from_bytes(data, "little") for data in (self.after, self.before))
        return f"{self.where} was left at {now}, and was {then} before"


class UndoJournal:
    """The file of one drive in ``folder``; `opened` says whose."""

    def __init__(self, folder: Path, address: str) -> None:
        self._folder = folder
        self._address = address
        self._path: Path | None = None
        self._drive = ""
        self._entries: dict[str, Change] = {}

    def opened(self, identity: Identity) -> tuple[Change, ...]:
        """What an earlier run left in this drive. Raises PreflightRefused for a file that can't be understood."""
        if identity.simulated:
            return ()
        name = f"{PREFIX}{identity.vendor:X}-{identity.product:X}-{identity.serial:X}-{self._address}{SUFFIX}"
        self._path = self._folder / name
        self._drive = f"{identity.name}, {self._address}"
        if self._path.exists():
            self._entries = {one.where: one for one in read(self._path)[1]}
        return tuple(self._entries.values())

    def changing(self, where: str, before: bytes, after: bytes) -> None:
        """A setting is about to be changed; what first stood there stays what stood there."""
        if self._path is not None:
            known = self._entries.get(where)
            self._entries[where] = Change(where, known.before if known is not None else before, after)
            self._save()

    def given_back(self, where: str) -> None:
        """It stands as it stood, or isn't ours any more."""
        if self._path is not None and self._entries.pop(where, None) is not None:
            with suppress(PreflightRefused):       # too much in the file does no harm: it is compared with the drive
                self._save()

    def _save(self) -> None:
        assert self._path is not None
        try:
            if not self._entries:
                self._path.unlink(missing_ok=True)
                return
            document = {
                "drive": self._drive,
                "settings": [
                    {"where": one.where, "before": one.before.hex(), "after": one.after.hex()}
                    for one in self._entries.values()
                ],
            }
            scratch = self._path.with_suffix(".new")
            with scratch.open("w", encoding="utf-8") as file:
                json.dump(document, file, indent=1)
                file.flush()
                os.fsync(file.fileno())
            scratch.replace(self._path)
        except OSError as error:
            raise PreflightRefused(
                f"what the run changes in the drive can't be written down: {error}", where=str(self._path),
                next_step="Give the log a folder that can be written to, with --log",
            ) from error


def read(path: Path) -> tuple[str, tuple[Change, ...]]:
    """The drive as people know it, and what was left in it. Raises PreflightRefused for a file that isn't one."""
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        entries = tuple(
            Change(str(one["where"]), bytes.fromhex(one["before"]), bytes.fromhex(one["after"]))
            for one in document["settings"]
        )
        return str(document["drive"]), entries
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PreflightRefused(
            f"what a run left in a drive can't be read: {error}", where=str(path),
            next_step="Compare the drive's settings with its documents, and remove the file",
        ) from error
