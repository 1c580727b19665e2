"""Changes to the records of ended runs: annotations, archive, deletion, signature of an acceptance.

The recorded log and its result are never changed.

Each change is in the audit before it is made. Without an audit entry nothing changes.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tdhil.errors import LogError, MessageCode
from tdhil.file_hash import sha256_of
from tdhil.service.acceptance_signature import (
    FILE,
    LONGEST_NAME,
    LONGEST_REMARK,
    PASS,
    SIGNED,
    AcceptanceSignature,
    hash_of,
)
from tdhil.service.annotations import LONGEST_TEXT, one_line, tags_of
from tdhil.service.run_channel import lives
from tdhil.service.run_state import Conflict, State, now
from tdhil.service.start_request import ValuesWrong, require_right
from tdhil.service.store import LOG, read_as, read_json, write_json
from tdhil.service.supervisor import Supervisor


class RunRecords:
    """The records of ended runs, for any thread. ``reading``: whether a computation still reads the files of a run."""

    def __init__(self, supervisor: Supervisor, reading: Callable[[str], bool] = lambda run: False) -> None:
        self._supervisor, self._store = supervisor, supervisor.store
        self._reading = reading
        self._lock = threading.Lock()
        self._hashes: dict[str, tuple[tuple[int, int, int], str]] = {}

    def annotate(self, run: str, who: str, *, tags: Sequence[str] | None = None, **texts: str | None) -> None:
        """Edit tags and texts (of `STATED`) of a run; None leaves a value. Raises NotThere, LogError, and ValuesWrong
        with all wrong values.
        """
        wrong: list[tuple[str, str]] = []
        wanted: dict[str, Any] = {}
        for name, text in texts.items():
            if text is not None:
                wanted[name] = one_line(text)
                if len(wanted[name]) > LONGEST_TEXT[name]:
                    wrong.append((name, f"must be a text of at most {LONGEST_TEXT[name]} characters"))
        if tags is not None:
            try:
                wanted["tags"] = tags_of(tags)
            except ValueError as error:
                wrong.append(("tags", str(error)))
        require_right(wrong)
        self._edit(run, who, **wanted)

    def archive(self, run: str, who: str, *, archived: bool) -> None:
        """Hide a run from lists and histories, or show it again. Raises NotThere, Conflict and LogError."""
        if archived:
            self._require_settled(run)
        self._edit(run, who, archived=archived)

    def delete(self, run: str, who: str, confirm: str) -> tuple[list[str], str]:
        """Delete a run with its files. Return the names of the files and the SHA-256 of the log, '' without one.

        ``confirm``: the run's id, as the user typed it. Raises NotThere, LogError, ValuesWrong for another id, and
        Conflict for a run that is in motion, that blocks its rig, or to which a calibration or a sign-off refers.
        """
        with self._lock:
            folder, request = self._store.place(run), self._store.request(run)
            if confirm.strip() != run:
                raise ValuesWrong([("confirm", f"type the id of the run, {run}")])
            self._require_settled(run)
            where = f"run {run}"
            if run in self._supervisor.live() or lives(folder):
                raise Conflict("the process of the run is about to end", where=where,
                               next_step="Try again in some seconds")
            if self._reading(run):
                raise Conflict("the log is being identified again", where=where, next_step="Wait until that has ended")
            if self._store.signed_off(run) is not None:
                raise Conflict("a sign-off refers to this run: it is kept", where=where, next_step="Archive it")
            if self.signature(run) is not None:
                raise Conflict("the acceptance of this run is signed: it is kept", where=where, next_step="Archive it")
            log_sha256 = sha256_of(folder / LOG, missing="", name=LOG)
            if (found := self._calibration_from(log_sha256)) is not None:
                raise Conflict(f"the torque calibration {found.name} refers to this run: it is kept", where=where,
                               next_step="Archive it")
            files = sorted(str(one.relative_to(folder)) for one in folder.rglob("*") if not one.is_dir())
            self._audit(who, "run deleted", run, request.rig, files=files, log_sha256=log_sha256,
                        asked=request.asked, asked_by=request.asked_by)
            try:
                self._store.keep_key(request)
                self._store.delete(run)
            except OSError as error:
                self._supervisor.note(who, "deletion failed", run, request.rig, why=str(error))
                raise LogError(f"the run can't be deleted ({error.strerror or error})", where=where,
                               next_step="Check the folder of the service") from error
        self._supervisor.forget(run)
        return files, log_sha256

    # -- acceptance --------------------------------------------------------------------------------------------------

    def signature(self, run: str) -> AcceptanceSignature | None:
        """Return the signature under the acceptance of a run; None without one. Raises NotThere."""
        return read_as(AcceptanceSignature, self._store.place(run) / FILE)

    def acceptance(self, run: str) -> tuple[dict[str, Any], str]:
        """Return the present acceptance of a run, and the SHA-256 of its log. Raises NotThere, and Conflict without an
        acceptance or a log.
        """
        where = f"run {run}"
        found = (self._store.result(run) or {}).get("acceptance")
        if not isinstance(found, Mapping):
            raise Conflict("this run has no acceptance: no values were expected of it", where=where,
                           next_step="State them in rig.yaml (acceptance:), or request the run with expected values"
                                     " (--expect)")
        if not (digest := self._log_sha256(run)):
            raise Conflict("this run has no log", where=where)
        return dict(found), digest

    def sign_acceptance(
        self, run: str, who: str, role: str, *, name: str, verdict: str, log_sha256: str, remark: str,
    ) -> None:
        """Sign the acceptance of a run. ``verdict``, ``log_sha256``: as the person saw them. Raises NotThere,
        LogError, ValuesWrong with all wrong values, and Conflict if it is signed, or if verdict or log are others.
        """
        name, remark = one_line(name), one_line(remark)
        with self._lock:
            request, where = self._store.request(run), f"run {run}"
            self._require_settled(run)
            if request.rehearsal:
                raise Conflict("faults were rehearsed in this run: it can't be the acceptance of a rig", where=where)
            if request.uploaded is not None:
                raise Conflict("this recording was uploaded: it can't be the acceptance of a rig", where=where)
            present, digest = self.acceptance(run)
            if (before := self.signature(run)) is not None:
                raise Conflict(f"the acceptance is signed already: by {before.name}, {before.at}", where=where,
                               next_step="Start a new run for another acceptance")
            if verdict != present.get("verdict"):
                raise Conflict(f"the verdict is {present.get('verdict')}, not {verdict[:20]}", where=where,
                               next_step="Load the page again", entry=MessageCode.CHANGED_MEANWHILE)
            if log_sha256 != digest:
                raise Conflict("the log is not the one that the page showed", where=where,
                               next_step="Load the page again", entry=MessageCode.CHANGED_MEANWHILE)
            wrong = []
            if not 1 <= len(name) <= LONGEST_NAME:
                wrong.append(("name", f"must be a name of at most {LONGEST_NAME} characters"))
            if len(remark) > LONGEST_REMARK:
                wrong.append(("remark", f"must be a text of at most {LONGEST_REMARK} characters"))
            if verdict != PASS and not remark:
                wrong.append(("remark", f"a remark is needed, because the verdict is {verdict}"))
            require_right(wrong)
            signature = AcceptanceSignature(name, role, who, now(), remark, verdict, digest, hash_of(present))
            self._audit(who, SIGNED, run, request.rig, **asdict(signature))
            try:
                write_json(self._store.place(run) / FILE, asdict(signature))
            except OSError as error:
                self._supervisor.note(who, "signature failed", run, request.rig, why=str(error))
                raise LogError(f"the signature can't be written ({error.strerror or error})", where=where,
                               next_step="Nothing was signed. Free some disk space, or check the folder"
                               " of the service") from error

    # -- evidence ----------------------------------------------------------------------------------------------------

    def ask_evidence(self, run: str, who: str, *, publisher: str, publish: str) -> str:
        """Record who requested an archive with which permission. Return the rig. Raises NotThere, LogError, and
        Conflict for a run that has not ended, or has no log.
        """
        with self._lock:
            request, where = self._store.request(run), f"run {run}"
            self._require_settled(run)
            if not (self._store.place(run) / LOG).is_file():
                raise Conflict("this run has no log", where=where)
            self._audit(who, "evidence requested", run, request.rig, publisher=publisher, publish=publish)
        return request.rig

    def _log_sha256(self, run: str) -> str:
        """Return the SHA-256 of the log; from memory while the file keeps its size and times."""
        path = self._store.place(run) / LOG
        try:
            looked = path.stat()
        except OSError:
            return ""
        stamp = (looked.st_size, looked.st_mtime_ns, looked.st_ctime_ns)
        known = self._hashes.get(run)
        if known is None or known[0] != stamp:
            known = self._hashes[run] = (stamp, sha256_of(path, missing="", name=LOG))
        return known[1]

    # ----------------------------------------------------------------------------------------------------------------

    def _edit(self, run: str, who: str, **wanted: Any) -> None:
        with self._lock:
            recorded, before = self._store.request(run), self._store.annotations(run)
            after = before.edited(recorded.options, who, now(), **wanted)
            new = after.edits[len(before.edits):]
            if not new:
                return
            for one in new:
                self._audit(who, "annotation edited", run, recorded.rig, field=one.field, old=one.old, new=one.new)
            try:
                self._store.annotate(run, after)
            except OSError as error:
                self._supervisor.note(who, "edit failed", run, recorded.rig, why=str(error))
                raise LogError(f"the annotations can't be written ({error.strerror or error})", where=f"run {run}",
                               next_step="Nothing was changed. Free some disk space, or check the folder"
                               " of the service") from error
        self._supervisor.reindex(run)

    def _require_settled(self, run: str) -> None:
        """Raise Conflict for a run that has not ended, or whose stop is not signed off."""
        status, where = self._store.status(run), f"run {run}"
        if not status.ended:
            raise Conflict(f"the run has not ended: it is {status.state}", where=where,
                           next_step="Wait until it has ended, or stop it")
        if status.state is State.STOP_NOT_CONFIRMED and self._store.signed_off(run) is None:
            raise Conflict("the stop of this run was neither confirmed nor signed off", where=where,
                           next_step="Check that the shaft is at standstill, then sign it off")

    def _calibration_from(self, log_sha256: str) -> Path | None:
        """Return the calibration file, beside a rig's file or named in it, that was made from this log."""
        if not log_sha256:
            return None
        rigs = self._supervisor.rigs
        paths = [] if rigs.folder is None else sorted(rigs.folder.glob("*.json"))
        for one in rigs.all():
            if one.rig is not None and (named := one.rig.drive_data.torque_calibration) is not None:
                paths.append(one.rig.folder / named)
        for path in paths:
            runs = (read_json(path) or {}).get("runs")
            if isinstance(runs, list) and any(
                    isinstance(one, dict) and one.get("sha256") == log_sha256 for one in runs):
                return path
        return None

    def _audit(self, who: str, what: str, run: str, rig: str, **details: Any) -> None:
        try:
            self._supervisor.audit.note(who, what, run=run, rig=rig, **details)
        except OSError as error:
            raise LogError(f"the audit can't be written ({error.strerror or error})", where="audit",
                           next_step="Nothing was changed. Free some disk space, or check the folder"
                           " of the service") from error
