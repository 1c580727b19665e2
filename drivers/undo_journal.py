"""The settings that a run changes in a drive: how to undo them, and a journal of them on disk.

The journal is written before each change and cleared by the restore.

A host that is killed restores nothing. The file (one for each drive, in the log's folder) then shows what is left in
the drive. `tdhil doctor` reports it, and the next run restores it before it reads the drive's limits. So a limit
widened by a dead run does not count as the drive's own.

Simulated drives have no journal. A run is refused if the file can't be written; nothing has been changed then.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.drive import Identity
from drivers.errors import CommunicationLost, ObjectRefused, PreflightRefused
from drivers.preflight import PreflightTable
from profiles import MessageCode

PREFIX, SUFFIX = "drive-left-", ".json"


# ---------------------------------------------------------------------------------------------------------------------
# Undoing the changes of this run.


class Undos:
    """The changes of a run that were not restored yet, in their order."""

    def __init__(self) -> None:
        self._entries: list[tuple[list[str], Callable[[], None]]] = []

    def add(self, names: list[str], undo: Callable[[], None]) -> None:
        """Register ``undo``, which `restore` calls, with the names of its settings. The caller may add names later."""
        self._entries.append((names, undo))

    @property
    def names(self) -> tuple[list[str], ...]:
        """Names of the settings of each change."""
        return tuple(names for names, _ in self._entries)

    def restore(self, changed: Callable[[], tuple[str, ...]]) -> tuple[str, ...]:
        """Undo every change, the last one first. Return those that could not be restored, a line each.

        Without a connection no further change is undone. One line then names all that are left: ``changed()``.
        """
        failed: list[str] = []
        while self._entries:
            try:
                self._entries[-1][1]()
            except ObjectRefused as error:
                failed.append(str(error))
            except CommunicationLost as error:
                failed.append(left_behind(changed(), error))
                self._entries.clear()
                break
            self._entries.pop()
        return tuple(failed)


def left_behind(names: tuple[str, ...], error: Exception) -> str:
    """Return one line: the settings that are left in the drive, and the error that prevented their restore."""
    return f"{', '.join(names)}: {error}" if names else str(error)


# ---------------------------------------------------------------------------------------------------------------------
# The journal, for the next run.


@dataclass(frozen=True)
class Change:
    """One setting: ``where`` as in messages, the former value, and the value that a run wrote."""

    where: str
    before: bytes
    after: bytes

    @property
    def text(self) -> str:
        """Text for messages: 6072h was left at 400, and was 100 before."""
        now, then = (int.from_bytes(data, "little") for data in (self.after, self.before))
        return f"{self.where} was left at {now}; before that run it was {then}"


class UndoJournal:
    """The file of one drive in ``folder``; `opened` selects the drive."""

    def __init__(self, folder: Path, address: str) -> None:
        self._folder = folder
        self._address = address
        self._path: Path | None = None
        self._drive = ""
        self._entries: dict[str, Change] = {}

    def opened(self, identity: Identity) -> tuple[Change, ...]:
        """Return the settings that an earlier run left in this drive. Raises PreflightRefused for an unreadable
        file.
        """
        if identity.simulated:
            return ()
        name = f"{PREFIX}{identity.vendor:X}-{identity.product:X}-{identity.serial:X}-{self._address}{SUFFIX}"
        self._path = self._folder / name
        self._drive = f"{identity.name}, {self._address}"
        if self._path.exists():
            self._entries = {one.where: one for one in read(self._path)[1]}
        return tuple(self._entries.values())

    def changing(self, where: str, before: bytes, after: bytes) -> None:
        """Record a setting before it is changed; the first former value is kept."""
        if self._path is not None:
            self._enter(where, before, after)
            self._save()

    def changing_in_motion(self, where: str, before: bytes, after: bytes) -> None:
        """Record a change in a cycle: without waiting for the disk, and without an error if the file can't be written.

        The file survives the end of this process. A computer that loses its power may lose this change.
        """
        if self._path is not None:
            self._enter(where, before, after)
            with suppress(PreflightRefused):
                self._save(wait=False)

    def _enter(self, where: str, before: bytes, after: bytes) -> None:
        known = self._entries.get(where)
        self._entries[where] = Change(where, known.before if known is not None else before, after)

    def given_back(self, where: str) -> None:
        """Clear a setting that was restored, or changed by another tool."""
        if self._path is not None and self._entries.pop(where, None) is not None:
            with suppress(PreflightRefused):       # a surplus entry does no harm: it is compared with the drive
                self._save()

    def _save(self, *, wait: bool = True) -> None:
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
                if wait:
                    os.fsync(file.fileno())
            scratch.replace(self._path)
        except OSError as error:
            raise PreflightRefused(
                f"the file with the former settings of the drive can't be written: {error}", where=str(self._path),
                next_step="Name a writable folder with --log",
                entry=MessageCode.UNDO_FILE_PROBLEM,
            ) from error


def read(path: Path) -> tuple[str, tuple[Change, ...]]:
    """Return the drive's name and the settings left in it. Raises PreflightRefused for an invalid file."""
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        entries = tuple(
            Change(str(one["where"]), bytes.fromhex(one["before"]), bytes.fromhex(one["after"]))
            for one in document["settings"]
        )
        return str(document["drive"]), entries
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PreflightRefused(
            f"the file with the former settings of the drive can't be read: {error}", where=str(path),
            next_step="Compare the drive's settings with its documents, and remove the file",
            entry=MessageCode.UNDO_FILE_PROBLEM,
        ) from error


def restore_left(
    table: PreflightTable, journal: UndoJournal, changes: Iterable[Change], restore: Callable[[Change], bool]
) -> bool:
    """Restore the settings that an earlier run left in the drive because its host died, if they are unchanged.

    ``restore`` writes the former value of a change if the drive still has the later one, and returns whether it did.
    Return whether a setting was restored.
    """
    given, others = [], []
    for one in changes:
        try:
            if restore(one):
                given.append(one.text)
            else:
                others.append(one.where)
            journal.given_back(one.where)
        except ObjectRefused as error:
            table.note("left by an earlier run", f"{one.text}; {error.what}", one.where, "Set it at the drive")
    if given:
        table.note("left by an earlier run", f"{', '.join(given)}: restored now", "log's folder")
    if others:
        table.note("left by an earlier run", f"{', '.join(others)}: changed since by another tool, not restored")
    return bool(given)
