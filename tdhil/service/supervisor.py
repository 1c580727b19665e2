"""Holds the runs of one service: begins each as a process, finds them again, and sees to those that died.

It opens no drive's bus. What it knows of a run stands in the run's folder; whether one lives, its lock says. So a web
that was killed finds everything again, and nothing moves by that.
"""

from __future__ import annotations

import errno
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
from tdhil.errors import ExitCode, LogError, UsageError
from tdhil.service.access import RequestPace
from tdhil.service.audit import Audit
from tdhil.service.console import Console
from tdhil.service.run_channel import STOP_FILE, RunRefused, ask, lives, send_signal, stands_still, take_life
from tdhil.service.run_state import (
    MAY_TURN,
    Conflict,
    NoRoom,
    NotReacting,
    NotThere,
    State,
    Status,
    Told,
    Watch,
    blocking,
    now,
    way_to,
)
from tdhil.service.start_request import RigFile, Rigs, edited, is_as_it_was, options_of, require_motion
from tdhil.service.store import CONNECTION_FILE, Index, Store, StoredRequest, read_json, write_json, write_whole
from tdhil.session import Holder, holder_of, holders

LOOK_S: Final = 0.2
"""So often it is looked whether a run still lives."""
INDEX_LOOKS: Final = 10
"""Every so many looks what the index didn't take is tried again."""
STOP_S: Final = 60.0
"""What `tdhil stop` may take for a shaft that turns on."""
KEYS: Final = 500
"""So many runs back an Idempotency-Key is known."""
SIMULATED_STOP: Final = "nothing turns: the drive is simulated, and ended with its run"
Say = Callable[[str], None]


@dataclass(frozen=True)
class Asked:
    """A run that was asked for. ``new``: it was not asked for before with the same key."""

    request: StoredRequest
    new: bool


class Jobs:
    """Small jobs, done one after the other in one thread, which is there from the beginning.

    `add` waits for nothing. A thread for each job would not do: to start one takes 200 ms on a busy computer, and the
    answer to a Stop would wait for it.
    """

    def __init__(self, name: str, say: Say) -> None:
        self._jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
        threading.Thread(target=self._work, args=(self._jobs, say), name=name, daemon=True).start()

    def add(self, job: Callable[[], None]) -> None:
        """Do it after those that were added before."""
        self._jobs.put(job)

    def finish(self, within_s: float) -> bool:
        """Wait until all that was added is done. Is it?"""
        done = threading.Event()
        self._jobs.put(done.set)
        return done.wait(within_s)

    @staticmethod
    def _work(jobs: SimpleQueue[Callable[[], None]], say: Say) -> None:
        while True:
            try:
                jobs.get()()
            except Exception as error:         # of one job: the others are done all the same
                say(f"{type(error).__name__}: {error}")


class Supervisor:
    """For any thread. ``say``: a line on the terminal of `tdhil serve`."""

    def __init__(
        self, store: Store, rigs: Rigs, audit: Audit, index: Index, *, say: Say = lambda text: None,
        command: Callable[[Path], list[str]] | None = None,
    ) -> None:
        self.store, self.rigs, self.audit, self.index = store, rigs, audit, index
        self.say = say
        self._command = command or (lambda folder: [sys.executable, "-m", "tdhil.service.run_process", str(folder)])
        self._asking = threading.Lock()
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._live: dict[str, None] = {}               # in the order in which they began
        self._console = Console(store, say)
        self._lost: set[str] = set()
        self._stops: dict[str, tuple[str, str]] = {}   # (who, when) asked a frozen run to stop
        self._unconfirmed: dict[str, Status] = {}      # runs whose stop nobody saw through
        self._unindexed: set[str] = set()
        self._to_index: set[str] = set()               # those that have just ended
        self._braking = False
        self.pace = RequestPace()
        self.not_at_rest: list[str] = []               # of those that `brake` stopped
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._begun: list[threading.Thread] = []
        self._notes = Jobs("audit", say)
        self._indexing = Jobs("index", say)            # of its own: it may be locked for long
        self._being_indexed: set[str] = set()

    # -- begin and end of the service ----------------------------------------------------------------------------

    def start(self) -> None:
        """Find the runs that live, see to those that don't any more, and go on looking."""
        for run in self.store.ids():
            with suppress(Exception):
                status = self.store.status(run)
                if not status.ended:
                    self._live[run] = None
                elif status.state is State.STOP_NOT_CONFIRMED:
                    self._unconfirmed[run] = status
        self._in_background(self._begin_audit)
        self._in_background(self._rebuild_index)       # what a web that was killed left out of it
        self._thread = threading.Thread(target=self._look, name="runs", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Look no more. Runs go on."""
        self._end.set()
        if self._thread is not None:
            self._thread.join(5.0)
        for thread in self._begun:
            thread.join(5.0)
        self._notes.finish(5.0)
        self._indexing.finish(5.0)

    def brake(self, who: str, within_s: float = STOP_S) -> bool:
        """Begin no more runs, ask all to stop, and wait until they have ended; have they?

        `not_at_rest` has those of which nobody knows that they are, ended or not.
        """
        with self._asking:             # who is about to begin one has begun it, and it is among those that are stopped
            self._braking = True
        stopping = self.live()
        for run in stopping:
            with suppress(Exception):
                self.stop(run, who)
        if stopping:
            self.say(f"Braking: run {', '.join(stopping)}. It waits for rest, {within_s:.0f} s at most."
                      " If a shaft turns on, use the hard-wired stop.")
        end_s = time.monotonic() + within_s
        while self.live() and time.monotonic() < end_s:
            time.sleep(LOOK_S)
        for run in stopping:
            state = self.store.status(run).state
            self.say(f"run {run}: {state}")
            if run in self._live or state is State.STOP_NOT_CONFIRMED:
                self.not_at_rest.append(run)
        return not self.live()

    # -- what is asked for ---------------------------------------------------------------------------------------

    def live(self) -> list[str]:
        """The runs that haven't ended."""
        return list(self._live)

    def ahead_of_the_index(self) -> list[str]:
        """The runs that are not, or not any more, what the index says of them."""
        return [*{*self._live, *self._to_index, *self._unindexed}]

    def run_of(self, rig_id: str) -> str | None:
        """The run that has the rig."""
        for run in self.live():
            with suppress(NotThere):
                if self.store.request(run).rig == rig_id and not self.store.status(run).ended:
                    return run
        return None

    def start_run(
        self, rig_id: str, asked: Mapping[str, Any], who: str, key: str | None = None, address: str = "",
    ) -> Asked:
        """Begin a run. Raises NotThere, NotAllowed, UsageError, DataFileError, NoRoom for a full disk, and Conflict,
        naming the holder. ``address``: from where it was requested.
        """
        options = options_of(asked)
        rig = self.rigs.get(rig_id)
        require_motion(rig)
        rig.way(options)               # what the options contradict is said now, not by the run
        with self._asking:
            if key is not None and (before := self._by_key(rig_id, key, who)) is not None:
                if dict(before.options) != options:
                    raise Conflict("this key was used for another request", where="Idempotency-Key",
                                   next_step="Take a new key")
                return Asked(before, new=False)
            if self._braking:
                raise Conflict("the service is ending", next_step="Start tdhil serve again")
            self.refuse_busy(rig)
            simulated = rig.simulated
            if not simulated or rig.motion == "watched":           # it shows a code
                self.pace.begin(who, address, rig.id)
            request = self._write_down(StoredRequest("", rig.id, str(rig.path.resolve()), rig.sha256, options, who,
                                                     now(), simulated, rig.motion, key))
            run = request.id
            try:
                self._begin(run)
            except OSError as error:
                told = Told.of(Conflict(f"the run's process can't be started ({error})", where=f"run {run}"))
                with suppress(OSError):
                    self.store.save(way_to(self.store.status(run), State.FAILED, now(), error=told, exit_code=1))
                raise Conflict(told.what, where=told.where) from error
        self.note(who, "asked", run, rig.id, options=options)
        return Asked(request, new=True)

    def _write_down(self, request: StoredRequest) -> StoredRequest:
        """Give the run an id and a folder. Raises NoRoom, and LogError where the folder can't be written."""
        run = ""
        try:
            run = self.store.new_id()
            request = replace(request, id=run)
            self.store.begin(request)
        except OSError as error:
            if run:
                shutil.rmtree(self.store.runs / run, ignore_errors=True)
            what = f"the run can't be written down ({error.strerror or error})"
            where = f"--data {self.store.folder}"
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise NoRoom(what, where=where, next_step="Nothing was started. Free some of the disk") from error
            raise LogError(what, where=where, next_step="Nothing was started. See to that folder") from error
        return request

    def refuse_busy(self, rig: RigFile) -> None:
        """Raises Conflict where the rig has a run, is held by another program, or waits for a signature."""
        run = self.run_of(rig.id)
        if run is not None:
            raise Conflict(f"run {run} has this rig", where=f"rig {rig.id}", holder=f"run {run}",
                           next_step="Wait until it has ended, or stop it")
        holder = self.holder(rig)
        if holder is not None:
            raise Conflict(f"the drive is held by {holder}", where=f"rig {rig.id}", holder=str(holder),
                           next_step="Wait until that run has ended, or end it there")
        bad = self.blocked(rig.id)
        if bad is not None:
            raise Conflict(
                f"the stop of run {bad} was not confirmed, and nobody has signed it off", where=f"rig {rig.id}",
                holder=f"run {bad}", next_step="See that the shaft is at rest and the drive is well, then sign it off",
            )

    @staticmethod
    def holder(rig: RigFile) -> Holder | None:
        """Who holds the rig's drive by the lock."""
        return holder_of(rig.address)

    def nobody_moves(self, rig: RigFile) -> bool:
        """Is it known that no tdhil of this computer moves the rig's real drive, and that no stop of it is open?"""
        address = rig.address
        return address is not None and holder_of(address) is None and self.blocked(rig.id) is None

    def blocked(self, rig_id: str) -> str | None:
        """The run that blocks the rig until it is signed off."""
        statuses = [one for one in tuple(self._unconfirmed.values()) if one.rig == rig_id]
        found = blocking(statuses, [one.id for one in statuses if self.store.signed_off(one.id) is not None])
        return None if found is None else found.id

    def confirm(self, run: str, code: str, binding: str | None, who: str, lease: str | None = None) -> Status:
        """Hand the code on. Raises NotThere, Conflict (there is nothing to confirm; it isn't the code; it is void).

        ``lease``: the key of a page that will renew it, where the rig is watched.
        """
        status, request = self.store.status(run), self.store.request(run)
        if status.ended or (request.simulated and request.motion != "watched"):
            nothing = f"there is nothing to confirm: the run is {status.state}"
            self.note(who, "confirmation refused", run, status.rig, why=nothing)
            raise Conflict(nothing, where=f"run {run}", next_step="A simulated rig asks for no confirmation")
        try:
            found = ask(self.store.place(run),
                        {"do": "confirm", "code": code, "binding": binding, "by": who, "lease": lease})
        except (RunRefused, CommunicationLost) as error:
            self.note(who, "confirmation refused", run, status.rig, why=str(error))
            raise Conflict(error.what, where=error.where, next_step=error.next_step) from error
        self.note(who, "confirmed", run, status.rig, binding=binding)
        return Status.of_plain(found["status"])

    def renew(self, run: str, key: str, who: str, *, new_key: str | None, gone: str | None) -> Watch:
        """The page that confirmed a watched run is there, or goes. Raises NotThere, Conflict, CommunicationLost."""
        asked = {"do": "lease", "key": key, "new_key": new_key, "gone": gone, "by": who}
        try:
            return Watch(**ask(self.store.place(run), asked)["watch"])
        except RunRefused as error:
            raise Conflict(error.what, where=error.where, next_step=error.next_step) from error

    def stop(self, run: str, who: str) -> Status:
        """Have the run brake. By the socket; where that doesn't answer, by SIGTERM; both return at once.

        A process that stands still (SIGSTOP, a debugger) can't brake, and must not go on later: it is killed, and its
        drive is stopped as of any run whose process was lost (decision 0022). Raises NotReacting then, NotThere, and
        CommunicationLost where neither reached it.
        """
        folder = self.store.place(run)
        wish = {"do": "stop", "by": who}
        try:
            try:
                found = ask(folder, wish, timeout_s=1.0)
            except (RunRefused, CommunicationLost):
                if (status := self.store.status(run)).ended:
                    return status
                self._kill_frozen(status, who)
                # Its process may be about to begin. It looks for this file once it listens: one of us sees the other.
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
                raise CommunicationLost(str(error), where=f"run {run}", next_step="Use the hard-wired stop") from error
        self.note(who, "stop asked", run, status.rig)
        return status

    def _kill_frozen(self, status: Status, who: str) -> None:
        """Kill the run's process if it stands still; `_look` does the rest. Raises NotReacting then."""
        if status.pid is None or not stands_still(status.pid):
            return
        self._stops[status.id] = (who, now())
        folder = self.store.place(status.id)
        killed = send_signal(status.pid, folder, signal.SIGKILL)
        self.note(who, "stop asked", status.id, status.rig, process="stood still", killed=killed)
        watchdog = next((f" ({one.found})" for one in status.preflight if "watchdog" in one.name.lower()), "")
        done = ("The service ended the process and sends tdhil stop to the run's drive" if killed else
                "The service could not end the process, and sends nothing to the drive")
        raise NotReacting(
            f"the run's process doesn't react: it was stopped, by SIGSTOP or a debugger. The drive's watchdog{watchdog}"
            f" stops the shaft. {done}", where=f"run {status.id}",
            next_step="See that the shaft comes to rest. If it turns, use the hard-wired stop")

    def stop_drive(self, rig: RigFile, who: str) -> tuple[int, str]:
        """`tdhil stop` on a rig that has no run of this service: its exit code, and what was seen.

        A rig that a run blocks has the drive of that run stopped, on the run's own connection.
        """
        self.note(who, "stop asked", None, rig.id)
        if (bad := self.blocked(rig.id)) is not None:
            seen, said = self._stop_drive_of(self.store.request(bad), self.store.status(bad))
            return int(ExitCode.OK if seen else ExitCode.STOP_NOT_CONFIRMED), said
        if rig.simulated:
            return int(ExitCode.OK), SIMULATED_STOP
        seen, said = _stop_seen(_tdhil_stop(rig.path))
        return int(ExitCode.OK if seen else ExitCode.STOP_NOT_CONFIRMED), said

    def _stop_drive_of(self, request: StoredRequest, status: Status) -> tuple[bool, str]:
        """Stop the drive of a run, on the run's own connection. Was it seen at rest, and what is there to say?

        Never seen at rest where the rig's file was changed since: nobody knows then which shaft that was.
        """
        if request.simulated:
            return True, SIMULATED_STOP
        path, kept = Path(request.rig_file), self.store.place(request.id) / CONNECTION_FILE
        same = is_as_it_was(path, request.rig_sha256)
        changed = f"{path.name} was changed or removed after the run was requested"
        if kept.exists():
            identity = [",".join(map(str, status.identity_numbers))] if any(status.identity_numbers) else []
            seen, said = _stop_seen([sys.executable, "-m", "tdhil.service.drive_stop", str(kept), *identity])
            if same:
                return seen, said
            return False, (f"{said}, on the connection that the run had ({_address_in(kept)}); {changed}, so tdhil"
                           " can't know whether this is still the rig's shaft")
        if not same:
            return False, f"{changed}, and the run had not kept where its drive is: no stop was sent"
        return _stop_seen(_tdhil_stop(path))

    def sign_off(self, run: str, who: str, note: str) -> None:
        """Take a stop that wasn't confirmed upon oneself. Raises NotThere and Conflict."""
        status = self.store.status(run)
        if status.state is not State.STOP_NOT_CONFIRMED:
            raise Conflict(f"there is nothing to sign off: the run is {status.state}", where=f"run {run}")
        self.store.sign_off(run, who, note)
        self.note(who, "signed off", run, status.rig, note=note)

    def edit_rig(self, rig_id: str, text: str, sha256: str, who: str) -> RigFile:
        """Put the text in place of the rig's file of this hash; the old one is kept.

        Raises NotThere and UsageError, DataFileError and NotAllowed for a text that won't do, Conflict where the file
        is another one by now or the rig is in use, and LogError where it can't be written.
        """
        with self._asking:                     # and nobody begins a run meanwhile
            rig = self.rigs.get(rig_id)
            if self.rigs.built_in:
                raise UsageError("this rig comes with the program", where=f"rig {rig_id}",
                                 next_step="Name a folder of your own: tdhil serve --rigs")
            self.refuse_busy(rig)
            before = rig.path.read_bytes()
            if sha256 != hashlib.sha256(before).hexdigest():
                raise Conflict("the rig's file was changed meanwhile", where=rig.path.name, next_step="Load it again")
            keys = edited(before.decode("utf-8", "replace"), text, rig.path.name)
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

    # -- looking after them ----------------------------------------------------------------------------------------

    def _by_key(self, rig: str, key: str, who: str) -> StoredRequest | None:
        for run in self.store.ids()[:KEYS]:
            with suppress(Exception):
                request = self.store.request(run)
                if (request.rig, request.idempotency_key, request.asked_by) == (rig, key, who):
                    return request
        return None

    def _begin(self, run: str) -> None:
        folder = self.store.place(run)
        life = take_life(folder)
        try:
            with (folder / "process.log").open("ab") as said:
                self._children[run] = subprocess.Popen(
                    self._command(folder), stdin=subprocess.DEVNULL, stdout=said, stderr=said,
                    start_new_session=True, pass_fds=(life,),
                )
        finally:
            os.close(life)
        self._live[run] = None

    def _look(self) -> None:
        looks = 0
        while not self._end.wait(LOOK_S):
            looks += 1
            if self._unindexed and looks % INDEX_LOOKS == 0:
                self._in_background(self._index_again)
            for run in self.live():
                try:
                    self._look_at(run)
                except Exception as error:     # of one run: the others are looked after all the same
                    self.say(f"run {run}: {type(error).__name__}: {error}")

    def _look_at(self, run: str) -> None:
        folder = self.store.place(run)
        alive = lives(folder)
        status = self.store.status(run)
        if status.ended:
            if alive and run in self._children and self._children[run].poll() is None:
                return                         # it has said how it ended, and is about to end
            self._settle(run, status)
        elif not alive:
            status = self.store.status(run)    # it may have ended between the two looks
            if status.ended:
                self._settle(run, status)
            elif run not in self._lost:        # in a thread: a drive that doesn't answer keeps nobody else waiting
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

    def _died(self, run: str, status: Status) -> Status:
        """The run's process is gone. First the shaft, then the rest."""
        request = self.store.request(run)
        self.say(f"run {run}: its process is gone; stopping the drive")
        seen, said = self._stop_drive_of(request, status)
        state = State.INTERRUPTED if seen else State.STOP_NOT_CONFIRMED
        what = f"the process of the run was lost while it was {status.state}; {said}"
        next_step = "" if seen else "Use the hard-wired stop. See that every shaft is at rest, then sign it off"
        told = Told("CommunicationLost", what, what, f"run {run}", next_step, int(ExitCode.COMMUNICATION))
        by, asked = self._stops.pop(run, (status.stop.by, status.stop.asked))
        first = {} if status.stop.asked is not None else {"by": by, "asked": asked}
        stop = replace(status.stop, confirmed=seen, at_rest=now() if seen else None, **first)
        status = way_to(status, state, now(), error=told, exit_code=int(told.exit_code), stop=stop, confirmation=None)
        self._save(status)
        self.store.release(run)
        self.say(f"run {run}: {what}")
        self._in_background(lambda: self._recover(run))
        return status

    def _save(self, status: Status) -> None:
        """At last: as long as the disk is full, nobody takes the rig."""
        told = False
        while not self._end.is_set():
            try:
                self.store.save(status)
                return
            except OSError as error:
                if not told:
                    self.say(f"run {status.id}: its end can't be written yet: {error}")
                told = True
                self._end.wait(1.0)

    def _recover(self, run: str) -> None:
        """What the log of a lost run still holds, as a clean copy and as a result."""
        found = self.work("recover", run, {})
        if found.get("document"):
            with suppress(OSError):
                write_json(self.store.place(run) / "result.json", found["document"])
        self._index(run)

    def work(self, what: str, run: str | None, asked: Mapping[str, Any]) -> dict[str, Any]:
        """A piece of arithmetic in a process of its own, nicer than all that moves. Raises Refused."""
        command = [sys.executable, "-m", "tdhil.service.worker", what]
        question = {"folder": None if run is None else str(self.store.place(run)), **asked}
        done = subprocess.run(command, input=json.dumps(question).encode(), capture_output=True, check=False,
                              start_new_session=True)
        try:
            found: dict[str, Any] = json.loads(done.stdout)
        except ValueError:
            text = done.stderr.decode("utf-8", "replace").strip().splitlines()
            found = {"error": Told("Error", "the work failed", text[-1] if text else "", what, "", 1).__dict__}
        if found.get("error"):
            raise RunRefused(Told(**found["error"]))
        return found

    # -- what is written down of it: nothing that has to do with a shaft waits for it ----------------------------------

    def note(self, who: str, what: str, run: str | None, rig: str | None, **details: Any) -> None:
        """Into the audit, in time; nothing waits for it."""
        def write() -> None:
            try:
                self.audit.note(who, what, run=run, rig=rig, **details)
            except OSError as error:
                self.say(f"the audit can't be written: {error}")

        self._notes.add(write)
        if run is not None and run not in self._being_indexed:
            self._being_indexed.add(run)
            self._indexing.add(lambda: self._index(run))

    def _begin_audit(self) -> None:
        try:
            self.audit.begin()
        except OSError as error:
            self.say(f"the audit can't be written: {error}")

    def _index(self, run: str) -> None:
        self._being_indexed.discard(run)       # first: what changes from here on is indexed once more
        try:
            self.index.put(self.store.summary(run))
            self._unindexed.discard(run)
        except Exception as error:             # locked, or a full disk: the files have it, and it is tried again
            if run not in self._unindexed:
                self.say(f"the index has to wait: {error}")
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

    def turning(self) -> bool:
        """May a real shaft on this computer turn now: does a run of the service move, does anybody hold a drive?"""
        for run in self.live():
            with suppress(Exception):
                if not self.store.request(run).simulated and self.store.status(run).state in MAY_TURN:
                    return True
        return bool(holders())


def _tdhil_stop(rig_file: Path) -> list[str]:
    return [sys.executable, "-m", "tdhil", "stop", "--rig", str(rig_file), "--json"]


def _stop_seen(command: list[str]) -> tuple[bool, str]:
    """Run a stop in a process of its own (the web opens no bus): was the shaft seen at rest, and what is said of it?"""
    try:
        done = subprocess.run(command, capture_output=True, timeout=STOP_S, check=False,
                              stdin=subprocess.DEVNULL, start_new_session=True)
    except (OSError, subprocess.TimeoutExpired) as error:
        return False, f"tdhil stop: {error}"
    if done.returncode == ExitCode.OK:
        return True, "tdhil stop saw the shaft at rest"
    found: Any = None
    with suppress(ValueError):
        found = json.loads(done.stdout)
    if isinstance(found, dict) and found.get("same_drive") is False:
        return False, (f"another drive is there than the run had (identity {found.get('identity')}): tdhil stop saw ITS"
                       " shaft, and not that of the run")
    return False, "tdhil stop did NOT see the shaft at rest"


def _address_in(kept: Path) -> str:
    return str((read_json(kept) or {}).get("address") or "unknown")
