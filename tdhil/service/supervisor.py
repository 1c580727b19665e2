"""Supervisor of the runs of one service: starts each as a process, finds it after a restart, handles its failure.

It opens no drive's bus. Its data on a run are in the run's folder. The run's lock shows whether the run is alive. So
after a restart, a web that was killed finds all runs again. A restart moves nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

from drivers import CommunicationLost
from tdhil.errors import ExitCode, LogError, MessageCode, UsageError
from tdhil.service.access import RequestPace
from tdhil.service.audit import Audit
from tdhil.service.console import Console
from tdhil.service.limits import STOP_S
from tdhil.service.run_channel import STOP_FILE, RunRefused, ask, lives, send_signal, stands_still, take_life
from tdhil.service.run_state import (
    FULL,
    MAY_TURN,
    Conflict,
    FolderMissing,
    NoRoom,
    NotReacting,
    NotThere,
    State,
    Status,
    Told,
    Watch,
    blocking,
    now,
    option_wrong,
    page_text,
    way_to,
)
from tdhil.service.start_request import (
    RIG_ID,
    RigFile,
    Rigs,
    ValuesWrong,
    edited,
    is_as_it_was,
    options_of,
    require_motion,
    require_new_rig,
)
from tdhil.service.store import (
    CONNECTION_FILE,
    Index,
    Store,
    StoredRequest,
    read_json,
    write_json,
    write_new,
    write_whole,
)
from tdhil.session import Holder, holder_of, holders

KEPT_WORK: Final = "recover"
"""Task that outlives the service: no page waits for it."""
LOOK_S: Final = 0.2
"""Interval of the check whether a run is alive, s."""
INDEX_LOOKS: Final = 10
"""Number of checks between two tries to write a failed index entry."""
SIMULATED_STOP: Final = page_text("no real shaft turns: the simulated drive ended with its run")
Say = Callable[[str], None]


@dataclass(frozen=True)
class Asked:
    """A requested run. ``new``: False if an earlier request had the same key."""

    request: StoredRequest
    new: bool


class Jobs:
    """Queue of small jobs. One thread, started in advance, does them one after the other.

    `add` never waits. A new thread per job would be too slow: it takes 200 ms to start on a busy computer, and
    the reply to a Stop would wait for it.
    """

    def __init__(self, name: str, say: Say) -> None:
        self._jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
        threading.Thread(target=self._work, args=(self._jobs, say), name=name, daemon=True).start()

    def add(self, job: Callable[[], None]) -> None:
        """Add a job at the end of the queue."""
        self._jobs.put(job)

    def finish(self, within_s: float) -> bool:
        """Wait at most ``within_s`` for all jobs. Return whether they are done."""
        done = threading.Event()
        self._jobs.put(done.set)
        return done.wait(within_s)

    @staticmethod
    def _work(jobs: SimpleQueue[Callable[[], None]], say: Say) -> None:
        while True:
            try:
                jobs.get()()
            except Exception as error:         # one job failed: the others are still done
                say(f"{type(error).__name__}: {error}")


class Supervisor:
    """Supervisor of all runs, for any thread. ``say`` prints a line on the terminal of `tdhil serve`."""

    def __init__(
        self, store: Store, rigs: Rigs, audit: Audit, index: Index, *, say: Say = lambda text: None,
        command: Callable[[Path], list[str]] | None = None,
    ) -> None:
        self.store, self.rigs, self.audit, self.index = store, rigs, audit, index
        self.say = say
        self._command = command or (lambda folder: [sys.executable, "-m", "tdhil.service.run_process", str(folder)])
        self._asking = threading.Lock()
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._live: dict[str, str] = {}                # the rig of each, in the order of their start
        self._console = Console(store, say)
        self._lost: set[str] = set()
        self._failures: dict[str, str] = {}            # the latest failure of each run's check
        self._stops: dict[str, tuple[str, str]] = {}   # (who, when) requested the stop of a suspended run
        self._unconfirmed: dict[str, Status] = {}      # runs whose stop was not confirmed
        self._unindexed: set[str] = set()
        self._to_index: set[str] = set()               # runs that have just ended
        self._braking = False
        self.pace = RequestPace()
        self.not_at_rest: list[str] = []               # runs stopped by `brake`, standstill not confirmed
        self._end = threading.Event()
        self._workers: set[subprocess.Popen[bytes]] = set()
        self._working = threading.Lock()
        self._thread: threading.Thread | None = None
        self._begun: list[threading.Thread] = []
        self._notes = Jobs("audit", say)
        self._indexing = Jobs("index", say)            # separate: the index may be locked for long
        self._being_indexed: set[str] = set()

    # -- begin and end of the service ----------------------------------------------------------------------------

    def start(self) -> None:
        """Find the runs that are alive, handle those whose process is gone, and start the periodic check."""
        self.store.finish_deletions()
        for run in self.store.ids():
            with suppress(Exception):
                status = self.store.status(run)
                if not status.ended:
                    self._live[run] = status.rig
                elif status.state is State.STOP_NOT_CONFIRMED:
                    self._unconfirmed[run] = status
        self._in_background(lambda: self._audited(self.audit.begin))
        self._in_background(self._rebuild_index)       # with entries that a killed web did not write
        self._thread = threading.Thread(target=self._look, name="runs", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the supervision and the computations of pages. Runs continue."""
        with self._working:
            self._end.set()
            for worker in self._workers:
                worker.terminate()
        if self._thread is not None:
            self._thread.join(5.0)
        for thread in self._begun:
            thread.join(5.0)
        self._notes.finish(5.0)
        self._indexing.finish(5.0)

    def brake(self, who: str, within_s: float = STOP_S) -> bool:
        """Refuse new runs, stop those that may turn a shaft, and wait for standstill. Return whether all are there.

        `not_at_rest` lists the runs without a confirmed standstill, ended or not. A run that is only identified
        continues, since a stop does not shorten that.
        """
        with self._asking:             # a start in progress is finished first; then this run is stopped, too
            self._braking = True
        stopping = self.may_turn()
        for run in self.live():
            if run not in stopping and lives(self.store.runs / run):
                self.say(f"run {run} is still being identified; it continues")
        for run in stopping:
            try:
                self.stop(run, who)
            except (NotReacting, FolderMissing):       # its process was signalled
                pass
            except Exception as error:
                self.say(f"run {run}: the stop failed ({error})")
                self._terminate(run)
        if stopping:
            self.say(f"Stopping run {', '.join(stopping)}. tdhil waits {within_s:.0f} s at most for standstill."
                     " If a shaft keeps turning, use the hard-wired emergency stop.")
        end_s = time.monotonic() + within_s
        while not all(self._rests(run, recorded=True) for run in self.live()) and time.monotonic() < end_s:
            time.sleep(LOOK_S)
        turning = self.may_turn()
        for run in stopping:
            state = None               # unreadable: the shaft may turn
            with suppress(Exception):
                state = self.store.status(run).state
            self.say(f"run {run}: {state or 'its state can not be read'}")
            if run in turning or state in (None, State.STOP_NOT_CONFIRMED):
                self.not_at_rest.append(run)
        return not turning

    # -- requests ------------------------------------------------------------------------------------------------

    def live(self) -> list[str]:
        """Return the runs that have not ended."""
        return list(self._live)

    def may_turn(self) -> list[str]:
        """Return the live runs whose shaft is not known to be at standstill."""
        return [run for run in self.live() if not self._rests(run)]

    def _rests(self, run: str, *, recorded: bool = False) -> bool:
        """Return whether a live run confirmed standstill; with ``recorded``, whether its end is in its record, too."""
        with suppress(Exception):              # an unreadable run may turn its shaft
            status = self.store.status(run)
            confirmed = status.stop.confirmed is True
            return status.state is State.IDENTIFYING or (confirmed and (status.ended or not recorded))
        return False

    def ahead_of_the_index(self) -> list[str]:
        """Return the runs whose index entry is missing or out of date."""
        return [*{*self._live, *self._to_index, *self._unindexed}]

    def rig(self, rig_id: str) -> RigFile:
        """Return a rig. Without its file, a run that is not ended or not signed off keeps it. Raises NotThere."""
        try:
            return self.rigs.get(rig_id)
        except NotThere:
            if self.run_of(rig_id) is None and self.blocked(rig_id) is None:
                raise
        return RigFile(rig_id, Path(f"{rig_id}.yaml"), "", None,
                       f"{rig_id}.yaml was removed or renamed. Stop and sign-off act on the run of this rig")

    def all_rigs(self) -> list[RigFile]:
        """Return all rigs, and those without a file that a run keeps, as `rig`."""
        found = {one.id: one for one in self.rigs.all()}
        for name in {*self._live.values(), *(one.rig for one in tuple(self._unconfirmed.values()))} - {"", *found}:
            with suppress(NotThere):
                found[name] = self.rig(name)
        return [one for _, one in sorted(found.items())]

    def run_of(self, rig_id: str) -> str | None:
        """Return the present run of a rig; also one whose folder is missing, while its process runs."""
        for run in [run for run, rig in tuple(self._live.items()) if rig == rig_id]:
            try:
                if not self.store.status(run).ended:
                    return run
            except NotThere:
                if self._running(run) is not None:
                    return run
        return None

    def _running(self, run: str) -> subprocess.Popen[bytes] | None:
        """Return the process of a run that this service started; None if it has ended."""
        child = self._children.get(run)
        return child if child is not None and child.poll() is None else None

    def _terminate(self, run: str) -> bool:
        """Send SIGTERM to the run's process, which stops the shaft. Return whether it was sent."""
        if (child := self._running(run)) is None:
            return False
        child.terminate()
        return True

    def start_run(
        self, rig_id: str, asked: Mapping[str, Any], who: str, key: str | None = None, address: str = "",
    ) -> Asked:
        """Start a run. Raises NotThere, NotAllowed, UsageError, DataFileError, NoRoom for a full disk, and Conflict
        with the holder. ``address``: the client's.
        """
        rig = self.rigs.get(rig_id)
        options = options_of(asked, rig)
        require_motion(rig)
        rig.way(options)                       # contradictions are reported now, not by the run
        with self._asking:
            if key is not None and (before := self.store.request_with_key(rig_id, key, who)) is not None:
                if dict(before.options) != options:
                    raise Conflict("this key was used for another request", where="Idempotency-Key",
                                   next_step="Use a new key")
                return Asked(before, new=False)
            if key is not None and (gone := self.store.deleted_with_key(rig_id, key, who)) is not None:
                raise Conflict(f"the run of this key, {gone}, was deleted", where="Idempotency-Key",
                               next_step="Nothing was started. Use a new key for a new run")
            if self._braking:
                raise Conflict("the service is ending", next_step="Start tdhil serve again")
            self.refuse_busy(rig)
            simulated = rig.simulated
            if not simulated or rig.motion == "watched":           # such a run shows a code
                self.pace.begin(who, address, rig.id)
            request = self._write_down(StoredRequest("", rig.id, str(rig.path.resolve()), rig.sha256, options, who,
                                                     now(), simulated, rig.motion, key))
            run = request.id
            try:
                self._begin(request)
            except OSError as error:
                reported = Told.of(Conflict(f"the run's process can't be started ({error})", where=f"run {run}"))
                with suppress(OSError):
                    self.store.save(way_to(self.store.status(run), State.FAILED, now(), error=reported, exit_code=1))
                raise Conflict(reported.what, where=reported.where) from error
        self.note(who, "asked", run, rig.id, options=options)
        return Asked(request, new=True)

    def _write_down(self, request: StoredRequest) -> StoredRequest:
        """Give the run an id and a folder. Raises NoRoom, and LogError if the folder can't be written."""
        run = ""
        try:
            run = self.store.new_id()
            request = replace(request, id=run)
            self.store.begin(request)
        except OSError as error:
            if run:
                shutil.rmtree(self.store.runs / run, ignore_errors=True)
            what = f"the run's request can't be written ({error.strerror or error})"
            where = str(self.store.folder)
            if error.errno in FULL:
                raise NoRoom(what, where=where, next_step="Nothing was started. Free some disk space") from error
            raise LogError(what, where=where, next_step="Nothing was started. Check that folder") from error
        return request

    def refuse_busy(self, rig: RigFile) -> None:
        """Raise Conflict if the rig has a run, is held by another program, or needs a sign-off."""
        run = self.run_of(rig.id)
        if run is not None:
            raise Conflict(f"run {run} uses this rig", where=f"rig {rig.id}", holder=f"run {run}",
                           next_step="Wait until it has ended, or stop it")
        holder = self.holder(rig)
        if holder is not None:
            raise Conflict(f"the drive is held by {holder}", where=f"rig {rig.id}", holder=str(holder),
                           next_step="Wait until that run has ended, or end it there")
        bad = self.blocking_run(rig)
        if bad is not None:
            raise Conflict(
                f"the stop of run {bad} was neither confirmed nor signed off", where=f"rig {rig.id}",
                holder=f"run {bad}",
                next_step="Check that the shaft is at standstill and the drive is in order, then sign it off",
            )

    @staticmethod
    def holder(rig: RigFile) -> Holder | None:
        """Return the program that holds the lock on the rig's drive; None without one."""
        return holder_of(rig.address)

    def certainly_idle(self, rig: RigFile) -> bool:
        """Return whether no tdhil of this computer can move the rig's real drive, and no sign-off is missing."""
        address = rig.address
        return address is not None and holder_of(address) is None and self.blocking_run(rig) is None

    def blocked(self, rig_id: str) -> str | None:
        """Return the run that blocks the rig until it is signed off; None without one."""
        return self._blocking(lambda one: one.rig == rig_id)

    def blocking_run(self, rig: RigFile) -> str | None:
        """Return the run that blocks the rig, or its drive under the name of another rig, until it is signed off."""
        found = self.blocked(rig.id)
        if found is not None or not self._unconfirmed or (address := rig.address) is None:
            return found
        return self._blocking(lambda one: self._address_of(one.id) == address)

    def _blocking(self, of: Callable[[Status], bool]) -> str | None:
        statuses = [one for one in tuple(self._unconfirmed.values()) if of(one)]
        found = blocking(statuses, [one.id for one in statuses if self.store.signed_off(one.id) is not None])
        return None if found is None else found.id

    def _address_of(self, run: str) -> str | None:
        """Return the address of the drive that a run used; None if the run stored none."""
        found: str | None = (read_json(self.store.place(run) / CONNECTION_FILE) or {}).get("address")
        return found

    def confirm(self, run: str, code: str, binding: str | None, who: str, lease: str | None = None) -> Status:
        """Send the code to the run. Raises NotThere, and Conflict (nothing to confirm; wrong code; void code).

        ``lease``: the key of a page that will renew it, for a watched rig.
        """
        status, request = self.store.status(run), self.store.request(run)
        if status.ended or (request.simulated and request.motion != "watched"):
            nothing = f"there is nothing to confirm: the run is {status.state}"
            self.note(who, "confirmation refused", run, status.rig, why=nothing)
            raise Conflict(nothing, where=f"run {run}", next_step="The run has ended. Request it again"
                           if status.ended else "A simulated rig asks for no confirmation")
        try:
            found = ask(self.store.place(run),
                        {"do": "confirm", "code": code, "binding": binding, "by": who, "lease": lease})
        except (RunRefused, CommunicationLost) as error:
            self.note(who, "confirmation refused", run, status.rig, why=str(error))
            raise Conflict(error.what, where=error.where, next_step=error.next_step) from error
        self.note(who, "confirmed", run, status.rig, binding=binding)
        return Status.of_plain(found["status"])

    def renew(self, run: str, key: str, who: str, *, new_key: str | None, gone: str | None) -> Watch:
        """Report to a watched run that its page is visible or gone. Raises NotThere, Conflict, CommunicationLost."""
        asked = {"do": "lease", "key": key, "new_key": new_key, "gone": gone, "by": who}
        try:
            return Watch(**ask(self.store.place(run), asked)["watch"])
        except RunRefused as error:
            raise Conflict(error.what, where=error.where, next_step=error.next_step) from error

    def stop(self, run: str, who: str) -> Status:
        """Stop a run over its socket; without a reply, with SIGTERM. Both return at once.

        A suspended process (SIGSTOP, a debugger) can't stop the shaft, and must not continue later. It is killed, and
        its drive is stopped as for any run whose process was lost (decision 0022). Raises NotReacting then, NotThere,
        CommunicationLost if neither reached the run, and FolderMissing after SIGTERM without the run's folder.
        """
        rig = self._live.get(run)
        try:
            return self._stop(run, who)
        except NotThere:
            if not self._terminate(run):
                raise
        self.note(who, "stop asked", run, rig, process="without folder")
        raise FolderMissing(
            page_text("the folder of the run is missing. SIGTERM was sent to its process, which stops the shaft."
                      " Standstill can't be shown here"), where=f"run {run}",
            next_step=page_text("Check that the shaft comes to standstill. If it turns, use the hard-wired emergency"
                                " stop"))

    def _stop(self, run: str, who: str) -> Status:
        folder = self.store.place(run)
        wish = {"do": "stop", "by": who}
        try:
            try:
                found = ask(folder, wish, timeout_s=1.0)
            except (RunRefused, CommunicationLost):
                if (status := self.store.status(run)).ended:
                    return status
                if self._running(run) is None and not lives(folder):
                    by, at = self._stops.setdefault(run, (who, now()))         # `_died` records it
                    self.note(who, "stop asked", run, status.rig, process="lost")
                    first = status.stop if status.stop.asked else replace(status.stop, asked=at, by=by)
                    return replace(status, stop=first)
                self._kill_frozen(status, who)
                # The run's process may be starting. It reads this file once it listens, so one of both ways reaches it.
                write_json(folder / STOP_FILE, {"by": who, "at": now()})
                found = ask(folder, wish, timeout_s=1.0)
            status = Status.of_plain(found["status"])
        except NotReacting:
            raise
        except (RunRefused, CommunicationLost, OSError) as error:
            status = self.store.status(run)
            begins = status.state is State.REQUESTED and (folder / STOP_FILE).exists()
            reached = begins or (status.pid is not None and send_signal(status.pid, folder, signal.SIGTERM))
            if not status.ended and not reached and lives(folder):
                raise CommunicationLost(str(error), where=f"run {run}",
                                        next_step=page_text("Use the hard-wired emergency stop")) from error
        self.note(who, "stop asked", run, status.rig)
        return status

    def _kill_frozen(self, status: Status, who: str) -> None:
        """Kill the run's process if it is suspended; `_look` does the rest. Raises NotReacting then."""
        if status.pid is None or not stands_still(status.pid):
            return
        self._stops[status.id] = (who, now())
        folder = self.store.place(status.id)
        killed = send_signal(status.pid, folder, signal.SIGKILL)
        self.note(who, "stop asked", status.id, status.rig, process="stood still", killed=killed)
        done = (page_text("The service ended the process and sends tdhil stop to the run's drive") if killed else
                page_text("The service could not end the process, and sends nothing to the drive"))
        raise NotReacting(
            "the run's process does not respond: it is suspended, by SIGSTOP or a debugger."
            f" If a watchdog is armed in the drive, it now acts: {status.safe_action or 'unknown'}. {done}",
            where=f"run {status.id}",
            next_step="Check that the shaft comes to standstill. If it turns, use the hard-wired emergency stop")

    def held_beside(self, run: str) -> Holder | None:
        """Return the other program that holds the drive of a run whose motion is over; None for a missing run.

        Such a run holds no drive itself, so a stop of the run does not reach the shaft.
        """
        with suppress(NotThere):
            if self.store.status(run).state is State.IDENTIFYING:
                return holder_of(self._address_of(run))
        return None

    def stop_beside(self, run: str, holder: Holder, who: str) -> tuple[int, str]:
        """Run `tdhil stop` on the drive of a run that another program holds. Return the exit code and a text."""
        status = self.store.status(run)
        self.note(who, "stop asked", run, status.rig, drive_held_by=str(holder))
        seen, said = self._stop_drive_of(self.store.request(run), status)
        said = page_text(f"the motion of run {run} is over, and the drive is held by {holder}: {said}")
        self.say(said)
        return int(ExitCode.OK if seen else ExitCode.STOP_NOT_CONFIRMED), said

    def stop_drive(self, rig: RigFile, who: str) -> tuple[int, str]:
        """Run `tdhil stop` on a rig without a run of this service. Return the exit code and a text.

        If a run blocks the rig, the drive of that run is stopped, on the run's own connection.
        """
        self.note(who, "stop asked", None, rig.id)
        if (bad := self.blocking_run(rig)) is not None:
            seen, said = self._stop_drive_of(self.store.request(bad), self.store.status(bad))
        elif rig.simulated:
            seen, said = True, SIMULATED_STOP
        else:
            seen, said = _stop_seen(_tdhil_stop(rig.path))
        return int(ExitCode.OK if seen else ExitCode.STOP_NOT_CONFIRMED), said

    def _stop_drive_of(self, request: StoredRequest, status: Status) -> tuple[bool, str]:
        """Stop the drive of a run on the run's own connection. Return whether standstill was confirmed, and a text.

        It is never confirmed if the rig's file has changed since: then it is unknown which shaft was stopped.
        """
        if request.simulated:
            return True, SIMULATED_STOP
        path, kept = Path(request.rig_file), self.store.place(request.id) / CONNECTION_FILE
        same = is_as_it_was(path, request.rig_sha256)
        changed = page_text(f"{path.name} was changed or removed after the run was requested")
        if kept.exists():
            identity = [",".join(map(str, status.identity_numbers))] if any(status.identity_numbers) else []
            seen, said = _stop_seen([sys.executable, "-m", "tdhil.service.drive_stop", str(kept), *identity])
            if same:
                return seen, said
            address = self._address_of(request.id) or "unknown"
            return False, page_text(f"{said}, on the connection that the run used ({address}); {changed}, so tdhil"
                                " can't know whether this is still the rig's shaft")
        if not same:
            return False, page_text(f"{changed}, and the run stored no address of its drive: no stop was sent")
        return _stop_seen(_tdhil_stop(path))

    def sign_off(self, run: str, who: str, note: str) -> None:
        """Sign off a stop that was not confirmed. Raises NotThere and Conflict."""
        status = self.store.status(run)
        if status.state is not State.STOP_NOT_CONFIRMED:
            raise Conflict(f"there is nothing to sign off: the run is {status.state}", where=f"run {run}")
        if (signed := self.store.signed_off(run)) is not None:
            raise Conflict(f"{signed['by']} has signed this run off already", where=f"run {run}",
                           next_step="Load the page again. A remark belongs to the record of the run")
        self.store.sign_off(run, who, note)
        self.note(who, "signed off", run, status.rig, note=note)

    def edit_rig(self, rig_id: str, text: str, sha256: str, who: str) -> RigFile:
        """Replace the rig's file with this hash by the text. A copy of the old file is kept.

        Raises NotThere; UsageError, DataFileError and NotAllowed for an unacceptable text; Conflict if the file has
        changed or the rig is in use; LogError if it can't be written.
        """
        with self._asking:                     # no run can start meanwhile
            rig = self.rigs.get(rig_id)
            if self.rigs.built_in:
                raise UsageError("this rig is part of tdhil and can't be changed", where=f"rig {rig_id}",
                                 next_step="Use your own folder. Start the service again, with its other options too:"
                                           " tdhil serve --rigs DIR")
            self.refuse_busy(rig)
            try:
                before = rig.path.read_bytes()
            except OSError as error:
                raise LogError(f"the rig's file can't be read ({error.strerror or error})", where=rig.path.name,
                               next_step="Correct it on the service's computer") from error
            if sha256 != hashlib.sha256(before).hexdigest():
                raise Conflict("the rig's file was changed meanwhile", where=rig.path.name, next_step="Load it again",
                               entry=MessageCode.CHANGED_MEANWHILE)
            keys = edited(before, text, rig.path.name)
            try:
                kept = self.store.folder / "rigs" / rig.id / f"{sha256}.yaml"
                kept.parent.mkdir(parents=True, exist_ok=True, mode=0o750)
                write_whole(kept, before)
                path = rig.path.resolve()
                write_whole(path, text.encode(), stat.S_IMODE(path.stat().st_mode))
            except OSError as error:
                raise LogError(f"the rig's file can't be written ({error.strerror or error})", where=rig.path.name,
                               next_step="Edit it on the service's computer") from error
            found = self.rigs.get(rig_id)
        self.note(who, "rig file edited", None, rig_id, keys=list(keys), before=sha256, after=found.sha256)
        return found

    def add_rig(self, rig_id: str, text: str, who: str) -> RigFile:
        """Write the file of a new rig; an existing file is never overwritten.

        Raises UsageError for an id that is none or without a folder of rigs; DataFileError and NotAllowed for an
        unacceptable text; Conflict if the rig exists; LogError if the file can't be written.
        """
        folder = self.rigs.folder
        if folder is None:
            raise option_wrong("this service has no folder of rigs", f"rig {rig_id[:64]}",
                               "Start the service again, with its other options too: tdhil serve --rigs DIR")
        if not RIG_ID.fullmatch(rig_id):
            raise ValuesWrong([("id", "must be letters, digits, _, . and -, and begin with a letter or digit")])
        path = folder / f"{rig_id}.yaml"
        require_new_rig(text, path.name)
        try:
            write_new(path, text.encode())
        except FileExistsError:
            raise Conflict("this rig already exists", where=f"rig {rig_id}", next_step="Choose another id") from None
        except OSError as error:
            raise LogError(f"the rig's file can't be written ({error.strerror or error})", where=path.name,
                           next_step="Check the folder of rig files") from error
        found = self.rigs.get(rig_id)
        self.note(who, "rig added", None, rig_id, after=found.sha256)
        return found

    # -- supervision of the runs ---------------------------------------------------------------------------------

    def _begin(self, request: StoredRequest) -> None:
        run, folder = request.id, self.store.place(request.id)
        life = take_life(folder)
        try:
            with (folder / "process.log").open("ab") as said:
                self._children[run] = subprocess.Popen(
                    self._command(folder), stdin=subprocess.DEVNULL, stdout=said, stderr=said,
                    start_new_session=True, pass_fds=(life,),
                )
        finally:
            os.close(life)
        self._live[run] = request.rig

    def _look(self) -> None:
        looks = 0
        while not self._end.wait(LOOK_S):
            looks += 1
            if self._unindexed and looks % INDEX_LOOKS == 0:
                self._in_background(self._index_again)
            for run in self.live():
                try:
                    self._look_at(run)
                except Exception as error:     # the check of one run failed: the others are still supervised
                    failure = f"run {run}: {type(error).__name__}: {error}"
                    if self._failures.get(run) != failure:
                        self._failures[run] = failure
                        self.say(failure)

    def _look_at(self, run: str) -> None:
        try:
            folder = self.store.place(run)
            alive = self._running(run) is not None or lives(folder)
            status = self.store.status(run)
        except NotThere:
            child = self._children.get(run)
            if child is None or (code := child.poll()) is None:
                raise LogError("its folder is missing, and its process may still run",
                               next_step="Stop its rig: SIGTERM is sent to the process") from None
            if run not in self._lost:
                self._lost.add(run)
                self._in_background(lambda: self._end_without_folder(run, code))
            return
        if status.ended:
            if self._running(run) is not None:
                return                         # the run has written its final status, and its process is about to end
            self._settle(run, status)
        elif not alive:
            status = self.store.status(run)    # the run may have ended between the two checks
            if status.ended:
                self._settle(run, status)
            elif run not in self._lost:        # in a thread: a silent drive delays nothing else
                self._lost.add(run)
                self._in_background(lambda: self._settle(run, self._died(run, status)))
        elif status.state is State.AWAITING:
            self._console.show(run, status)

    def _settle(self, run: str, status: Status) -> None:
        if status.state is State.STOP_NOT_CONFIRMED:
            self._unconfirmed[run] = status
        child = self._children.pop(run, None)
        if child is not None:
            with suppress(subprocess.TimeoutExpired):
                child.wait(0.05)
        self._to_index.add(run)
        self._live.pop(run, None)
        self._console.forget(run)
        watched = {} if status.watch is None else {"watch": asdict(status.watch)}
        self.note("service", f"ended: {status.state}", run, status.rig, exit_code=status.exit_code, **watched)

    def _end_without_folder(self, run: str, code: int) -> None:
        """End a run whose folder is missing. Stop its drive if its process did not confirm standstill."""
        rig = self._live[run]
        try:
            said = f"its folder is missing; its process ended with exit code {code}"
            if code < 0 or code == ExitCode.STOP_NOT_CONFIRMED:
                said = f"{said}; {self.stop_drive(self.rig(rig), 'service')[1]}"
            self.say(f"run {run}: {said}")
        finally:
            self._children.pop(run, None)
            self._live.pop(run, None)
            self._console.forget(run)
            self.note("service", "ended: its folder is missing", run, rig, exit_code=code)

    def _died(self, run: str, status: Status) -> Status:
        """Handle a run whose process is gone: stop its drive first, then save the status and recover the log."""
        request = self.store.request(run)
        self.say(f"run {run}: its process is gone; stopping the drive")
        seen, said = self._stop_drive_of(request, status)
        state = State.INTERRUPTED if seen else State.STOP_NOT_CONFIRMED
        what = page_text(f"the process of the run was lost while it was {status.state}; {said}")
        next_step = "" if seen else page_text("Use the hard-wired emergency stop. Check that every shaft is at"
                                              " standstill, then sign off the stop of this run")
        reported = Told("CommunicationLost", what, what, f"run {run}", next_step, int(ExitCode.COMMUNICATION),
                    MessageCode.COMMUNICATION_LOST.code)
        by, asked = self._stops.pop(run, (status.stop.by, status.stop.asked))
        first = {} if status.stop.asked is not None else {"by": by, "asked": asked}
        stop = replace(status.stop, confirmed=seen, at_rest=now() if seen else None, **first)
        status = way_to(status, state, now(), error=reported, exit_code=int(reported.exit_code), stop=stop,
                        confirmation=None)
        self._save(status)
        self.store.release(run)
        self.say(f"run {run}: {what}")
        self._in_background(lambda: self._recover(run))
        return status

    def _save(self, status: Status) -> None:
        """Save the status, with retries until it is saved. While the disk is full, the rig stays blocked."""
        logged = False
        while not self._end.is_set():
            try:
                self.store.save(status)
                return
            except OSError as error:
                if not logged:
                    self.say(f"run {status.id}: its end can't be written yet: {error}")
                logged = True
                self._end.wait(1.0)

    def _recover(self, run: str) -> None:
        """Recover the log of a lost run as a clean copy, and identify from it."""
        found = self.work("recover", run, {})
        if found.get("document"):
            with suppress(OSError):
                write_json(self.store.place(run) / "result.json", found["document"])
        self._index(run)

    def work(self, what: str, run: str | None, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Compute a task in its own process, at a lower priority than all runs. Raises RunRefused, and Conflict if the
        service ends.
        """
        command = [sys.executable, "-m", "tdhil.service.worker", what]
        question = {"folder": None if run is None else str(self.store.place(run)), **asked}
        with self._working:
            if self._end.is_set() and what != KEPT_WORK:
                raise service_ended(what)
            worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                                      start_new_session=True)
            if what != KEPT_WORK:
                self._workers.add(worker)
        try:
            reply, said = worker.communicate(json.dumps(question).encode())
        finally:
            self._workers.discard(worker)
        try:
            found: dict[str, Any] = json.loads(reply)
        except ValueError:
            if self._end.is_set():
                raise service_ended(what) from None
            text = said.decode("utf-8", "replace").strip().splitlines()
            found = {"error": Told("Error", "the work failed", text[-1] if text else "", what, "", 1,
                                   MessageCode.WORKER_PROCESS_LOST.code).__dict__}
        if found.get("error"):
            raise RunRefused(Told(**found["error"]))
        return found

    # -- records: nothing that concerns a shaft waits for them --------------------- ----------------------------------

    def note(self, who: str, what: str, run: str | None, rig: str | None, **details: Any) -> None:
        """Write a line to the audit later; nothing waits for it."""
        self._notes.add(lambda: self._audited(lambda: self.audit.note(who, what, run=run, rig=rig, **details)))
        if run is not None:
            self._index_later(run)

    def reindex(self, run: str) -> None:
        """Renew the index entry of an ended run later. Until then, lists read its files."""
        self._to_index.add(run)
        self._index_later(run)

    def forget(self, run: str) -> None:
        """Remove a deleted run from memory and, later, from the index."""
        self._unconfirmed.pop(run, None)
        self.reindex(run)

    def _index_later(self, run: str) -> None:
        if run not in self._being_indexed:
            self._being_indexed.add(run)
            self._indexing.add(lambda: self._index(run))

    def _audited(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            self.say(f"the audit can't be written: {error}")

    def _index(self, run: str) -> None:
        self._being_indexed.discard(run)       # removed first, so that later changes are indexed once more
        try:
            try:
                self.index.put(self.store.summary(run))
            except NotThere:                   # deleted meanwhile
                self.index.remove(run)
            self._unindexed.discard(run)
        except Exception as error:             # a locked index or a full disk: the files are complete; retry
            if run not in self._unindexed:
                self.say(f"the index can't be written and is retried: {error}")
            self._unindexed.add(run)
        self._to_index.discard(run)

    def _index_again(self) -> None:
        for run in tuple(self._unindexed):
            self._index(run)

    def _rebuild_index(self) -> None:
        try:
            self.index.rebuild()
        except Exception as error:
            self.say(f"the index can't be made: {error}")

    def _in_background(self, work: Callable[[], None]) -> None:
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        self._begun = [one for one in self._begun if one.is_alive()] + [thread]

    def turned_by(self) -> str | None:
        """Return what may turn a real shaft of this computer: a run, or the holder of a drive; None without any."""
        for run in self.live():
            with suppress(Exception):
                if not self.store.request(run).simulated and self.store.status(run).state in MAY_TURN:
                    return f"run {run}"
        return next((str(one) for one in holders()), None)

    def turning(self) -> bool:
        """Return whether a real shaft of this computer may turn: a run moves, or a drive is held."""
        return self.turned_by() is not None

    def refuse_turning(self, where: str) -> None:
        """Raise Conflict while a real shaft of this computer may turn."""
        if (holder := self.turned_by()) is not None:
            raise Conflict(f"a drive on this computer is held by {holder}, so a shaft may turn", where=where,
                           holder=holder, next_step="Nothing was done, since it could disturb the bus or the"
                           " control loop of that drive. Repeat the request when the drive is free")


def service_ended(where: str) -> Conflict:
    """Return the refusal of a task that the service began, and did not finish before its own end."""
    return Conflict("the service ended before this was done", where=where, next_step="Repeat it")


def _tdhil_stop(rig_file: Path) -> list[str]:
    return [sys.executable, "-m", "tdhil", "stop", "--rig", str(rig_file), "--json"]


def _stop_seen(command: list[str]) -> tuple[bool, str]:
    """Run a stop in its own process (the web opens no bus). Return whether it confirmed standstill, and a text."""
    try:
        done = subprocess.run(command, capture_output=True, timeout=STOP_S, check=False,
                              stdin=subprocess.DEVNULL, start_new_session=True)
    except (OSError, subprocess.TimeoutExpired) as error:
        return False, f"tdhil stop: {error}"
    if done.returncode == ExitCode.OK:
        return True, page_text("tdhil stop confirmed standstill")
    found: Any = None
    with suppress(ValueError):
        found = json.loads(done.stdout)
    if isinstance(found, dict) and found.get("same_drive") is False:
        return False, page_text(f"another drive ({found.get('identity')}) replied at the address of the run: tdhil"
                                " stop braked the shaft of THAT drive, not the shaft of the run")
    return False, page_text("tdhil stop did NOT confirm standstill")
