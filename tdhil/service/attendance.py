"""Who is there while a run of the service goes: keeps its status, sees it go by, and asks for the code.

Nothing here holds the control loop up: what it sees it notes, and a thread writes the notes down.
"""

from __future__ import annotations

import hmac
import secrets
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers import Command, Mode, PowerState, Preflight, PreflightRefused, Sample
from profiles import visible
from tdhil.errors import TdhilError
from tdhil.service.run_state import Check, Confirmation, NotSo, State, Status, Watch, now
from tdhil.service.store import Store, write_json

if TYPE_CHECKING:
    from tdhil.recording import RunLog, Stage
    from tdhil.runner import Display, Idle, StopRequest, Task

CODE_S: Final = 60.0
"""So long a code is good, once."""
TRIES: Final = 3
LEASE_S: Final = 5.0
"""So long a watched run goes on without its page, which renews the lease every second."""
SILENT_S: Final = 2.0
"""After so long without a word of the page, the run's status says so."""
LEASE_LOOK_S: Final = 0.05
WATCH: Final = "watch"
"""An event of the log: who watches a watched run, and who doesn't."""
WATCHED: Final = {
    None: "its page is there", "hidden": "its page is hidden", "closed": "its page was closed, or loads anew",
    "silent": "nothing is heard of its page",
}
EXPECTED_S: Final = {"setup": 10.0, "speed": 50.0, "torque": 15.0, "hold": 15.0, "acquire": 300.0}

class Board:
    """The run's status; whoever changes it is done at once, a thread writes it down.

    Some of the disk is reserved for it: how a run ended is told even where the disk has run full, which ends it.
    """

    def __init__(self, store: Store, status: Status) -> None:
        self._store = store
        store.reserve(status.id)
        self._status = status
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._end = False
        self._thread = threading.Thread(target=self._write, name="status", daemon=True)
        self._thread.start()

    @property
    def status(self) -> Status:
        return self._status

    def change(self, step: Callable[[Status], Status]) -> None:
        """A step that can't be is left out: what a page shows never ends a run."""
        with self._lock, suppress(NotSo):
            self._status = step(self._status)
        self._wake.set()

    def to(self, state: State, stage: str | None = None, **known: Any) -> None:
        at = now()
        self.change(lambda status: status.to(state, at, stage, **known))

    def know(self, **known: Any) -> None:
        self.change(lambda status: replace(status, **known))

    def stop(self, **known: Any) -> None:
        self.change(lambda status: replace(status, stop=replace(status.stop, **known)))

    def stop_seen(self) -> None:
        """Note when the drive first answered a stop; a later stop leaves that time as it is."""
        at = now()
        self.change(lambda status: replace(status, stop=replace(status.stop, seen=status.stop.seen or at)))

    def close(self) -> None:
        """All of it is written, or can't be."""
        self._end = True
        self._wake.set()
        self._thread.join(10.0)
        self._store.release(self._status.id)

    def _write(self) -> None:
        last: Status | None = None
        while not (self._end and last is self._status):
            self._wake.wait()
            self._wake.clear()
            status = self._status
            try:
                self._store.save(status)
            except OSError as error:           # a full disk: the run ends by its log, not by this
                tell(f"the state can't be written: {error}")
                if self._end:
                    return
                time.sleep(0.5)
                self._wake.set()
                continue
            last = status


def tell(text: str) -> None:
    """A line for process.log; where its disk is full, for nobody."""
    with suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)  # noqa: T201


class Watcher:
    """Sees the run as it goes. `cycle` is called in the control loop: it keeps two things in mind, and puts into the
    log what others left for it.
    """

    def __init__(self, board: Board, stop: StopRequest | None = None) -> None:
        self._board, self._stop = board, stop
        self._looking = False          # for the drive's answer to a stop
        self._remarks: deque[str] = deque()
        self.log: RunLog | None = None

    def asked_to_stop(self, who: str) -> None:
        """A stop was asked for: note it, and the first sample of a drive that brakes."""
        self._looking = True
        at = now()

        def step(status: Status) -> Status:
            if status.stop.asked is None and not status.ended:
                status = replace(status, stop=replace(status.stop, asked=at, by=who))
            return status.to(State.STOPPING, at) if status.state is State.MOVING else status

        self._board.change(step)

    def remark(self, text: str) -> None:
        """For the log, with the next cycle. From any thread."""
        self._remarks.append(text)

    def preflight(self, preflight: Preflight) -> None:
        checks = tuple(
            Check(visible(one.name), visible(one.wanted), visible(one.found), one.outcome.value,
                  visible(one.where), visible(one.next_step))
            for one in preflight.checks
        )
        who = preflight.identity
        self._board.know(
            preflight=checks, simulated=who.simulated, identity=visible(who.name),
            identity_numbers=(who.vendor, who.product, who.revision, who.serial),
            safe_action=preflight.safe_action.replace("_", " "),
        )

    def stage_started(self, name: str, expected_s: float) -> None:
        at = now()

        def step(status: Status) -> Status:
            status = replace(status, expected_s={**status.expected_s, name: expected_s})
            return status.to(State.MOVING, at, name) if status.state is State.MOVING else status

        self._board.change(step)

    def cycle(self, command: Command, sample: Sample) -> None:
        if self._stop is not None and self._stop.signum is not None:
            if not self._stop.why:             # by a signal; whoever comes by the socket is noted there
                self.asked_to_stop("a signal")
            self._stop = None
        if self._remarks and self.log is not None:
            self.log.event(sample.time_s, WATCH, self._remarks.popleft())
        if self._looking and (
            sample.state is PowerState.QUICK_STOP or (command.mode is Mode.SPEED and command.speed_rad_s == 0.0)
        ):
            self._looking = False
            self._board.stop_seen()

    def planned(self, plan: Any) -> None:
        expected_s = float(plan.duration_s) + 5.0
        self._board.change(lambda one: replace(one, expected_s={**one.expected_s, "acquire": expected_s}))

    def stage_ended(self, stage: Stage) -> None:
        if stage.name == "acquire" or stage.outcome == "aborted":
            self._stopping()

    def stopped(self, confirmed: bool) -> None:
        self._stopping()
        self._board.stop(confirmed=confirmed, at_rest=now() if confirmed else None)

    def _stopping(self) -> None:
        at = now()
        self._board.change(lambda one: one.to(State.STOPPING, at) if one.state is State.MOVING else one)


class Confirming:
    """The code of one run: six digits, once, for so long, for one plan on one rig as it was found."""

    def __init__(self, binding: str, still_so: Callable[[], None], *, watched: bool = False,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self.binding, self.watched = binding, watched
        self.code = f"{secrets.randbelow(10**6):06d}"
        self._still_so = still_so
        self._clock = clock
        self._until_s = clock() + CODE_S
        self._tries = TRIES
        self._lock = threading.Lock()
        self.confirmed_by: str | None = None
        self.lease_key = ""
        self.void: PreflightRefused | None = None

    @property
    def left_s(self) -> float:
        return self._until_s - self._clock()

    def look(self) -> bool:
        """Was it confirmed? Raises PreflightRefused once it can't be any more."""
        with self._lock:
            if self.confirmed_by is not None:
                return True
            if self.void is None and self.left_s <= 0.0:
                self.void = PreflightRefused(
                    f"not confirmed within {CODE_S:g} s", where="code", next_step="Nothing has moved; ask for it again"
                )
            if self.void is not None:
                raise self.void
            return False

    def take(self, code: str, binding: str | None, who: str, lease_key: str = "") -> None:
        """Raises PreflightRefused for what isn't the code for this; after some tries it is void."""
        self.look()
        with self._lock:
            if self.confirmed_by is not None:
                raise PreflightRefused("the code was used already", where="code")
            if self.watched and not lease_key:
                raise PreflightRefused("this rig moves only while the page that confirms is watched", where="lease",
                                       next_step="Confirm it on the run's live page, and stay there")
            try:
                self._still_so()
            except TdhilError as error:                # changed, or not to be read any more
                self.void = PreflightRefused(error.what, where=error.where, next_step=error.next_step)
                raise self.void from error
            if binding is not None and not _same(binding, self.binding):
                self.void = PreflightRefused("the confirmation is for another plan, rig or setting", where="binding",
                                             next_step="Nothing has moved; ask for it again")
                raise self.void
            if not _same(code, self.code):
                self._tries -= 1
                if self._tries <= 0:
                    self.void = PreflightRefused(f"{TRIES} wrong codes", where="code",
                                                 next_step="Nothing has moved; ask for it again")
                    raise self.void
                raise PreflightRefused("that isn't the code", where="code",
                                       next_step="It stands on the terminals of tdhil serve and tdhil attend")
            self.lease_key = lease_key
            self.confirmed_by = who


def _same(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode("utf-8", "replace"), other.encode())


class Lease:
    """A watched run goes on as long as the page that confirmed it says every second that it is seen.

    On a clock and in a thread of its own: neither control time nor the web has a part in it. ``change`` is told of
    each change, ``lost`` once, at the end; ``needed`` says whether a shaft may still move.
    """

    def __init__(
        self, key: str, by: str, *, change: Callable[[Watch], None], lost: Callable[[Watch], None],
        needed: Callable[[], bool], clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._key, self._change, self._lost, self._needed, self._clock = key, change, lost, needed, clock
        self._heard_s = clock()
        self._lock = threading.Lock()
        self._end = threading.Event()
        self.watch = Watch(by, now())
        change(self.watch)

    def start(self) -> None:
        """Look at the clock from now on, until `end`."""
        threading.Thread(target=self._hold, name="lease", daemon=True).start()

    def end(self) -> None:
        """Nothing moves any more."""
        self._end.set()

    def renew(self, key: str, who: str, *, new_key: str = "", gone: str = "") -> Watch:
        """The page is there, or says how it goes. ``new_key``: it was loaded anew, and the old key is void.

        Raises PreflightRefused where another page has the lease, and where it was lost: it never comes back.
        """
        self.look()
        with self._lock:
            if self.watch.lost is not None or not self._needed():
                raise PreflightRefused("it has ended: nothing brings it back", where="lease")
            known = _same(key, self._key) or (new_key != "" and _same(new_key, self._key))   # an answer may be lost
            if who != self.watch.by or not known:
                raise PreflightRefused("another page watches this run", where="lease",
                                       next_step="Stop works from every page")
            if gone:
                if self.watch.how != "closed":         # closing hides it too, and either may come first
                    self._know(gone=self.watch.gone or now(), how=gone)
                return self.watch
            self._heard_s = self._clock()
            self._key = new_key or self._key
            if self.watch.gone is not None:
                self._know(gone=None, how=None)
            return self.watch

    def look(self) -> None:
        """Lose it where it is time."""
        with self._lock:
            silent_s = self._clock() - self._heard_s
            if self.watch.lost is not None or silent_s < SILENT_S or not self._needed():
                return
            if silent_s < LEASE_S:
                if self.watch.gone is None:
                    self._know(gone=now(), how="silent")
                return
            watch = self.watch
            self.watch = replace(watch, lost=now(), gone=watch.gone or now(), how=watch.how or "silent")
            self._lost(self.watch)     # first of all
            self._change(self.watch)

    def _know(self, **known: Any) -> None:
        before, self.watch = self.watch, replace(self.watch, **known)
        if self.watch != before:
            self._change(self.watch)

    def _hold(self) -> None:
        while not self._end.wait(LEASE_LOOK_S):
            self.look()


class ServiceOperator:
    """Who is there: whoever types in the code that is shown at the rig. A simulated drive asks nobody, unless its rig
    is watched: then everything is as on a real one.
    """

    def __init__(
        self, board: Board, watcher: Watcher, folder: Path, bind: Callable[[Preflight], Confirming], *,
        watched: bool = False, unwatched: Callable[[Watch], None] = lambda watch: None,
    ) -> None:
        """``unwatched`` makes the run brake."""
        self._board, self._watcher, self._folder, self._bind = board, watcher, folder, bind
        self._watched, self._unwatched = watched, unwatched
        self.confirming: Confirming | None = None
        self.lease: Lease | None = None

    @contextmanager
    def watch(self) -> Iterator[Display]:
        yield self._watcher

    def confirm(self, task: Task, preflight: Preflight, idle: Idle, unverified: tuple[str, ...]) -> None:
        if self._watched or not preflight.identity.simulated:
            self._ask(task, preflight, idle, unverified)
        self._board.to(State.MOVING, "setup", confirmation=None)

    def _ask(self, task: Task, preflight: Preflight, idle: Idle, unverified: tuple[str, ...]) -> None:
        from tdhil.session import motion_summary

        confirming = self._bind(preflight)
        text = motion_summary(preflight, task.limits, task.request, unverified)
        if self._watched:
            text += ("  [ ] somebody watches the page that confirms, for the whole run: the shaft brakes once it is\n"
                     f"      hidden or closed for {LEASE_S:g} s\n")
        expires = datetime.fromtimestamp(time.time() + CODE_S, UTC).isoformat(timespec="milliseconds")
        self.confirming = confirming
        self._board.to(State.AWAITING, confirmation=Confirmation(confirming.binding, text, expires))
        while not confirming.look():
            idle()                     # the drive's watchdog is fed meanwhile, and a stop is seen
        if self._watched:
            self.lease = Lease(
                confirming.lease_key, confirming.confirmed_by or "", change=self._note_watch, lost=self._unwatched,
                needed=lambda: self._board.status.state in (State.AWAITING, State.MOVING),
            )
            self.lease.start()
        told = {"binding": confirming.binding, "at": now(), "by": confirming.confirmed_by}
        threading.Thread(target=self._write_down, args=(told,), daemon=True).start()

    def _note_watch(self, watch: Watch) -> None:
        self._board.know(watch=watch)
        self._watcher.remark(WATCHED[watch.how] if watch.lost is None else f"{WATCHED[watch.how]}: the run brakes")

    def _write_down(self, told: Mapping[str, Any]) -> None:
        with suppress(OSError):
            write_json(self._folder / "confirm.json", told)

    def confirm_speed(self, speed_rad_s: float, why: str, idle: Idle) -> None:
        raise PreflightRefused(
            f"nobody is there to see whether the shaft turns at {speed_rad_s:.3g} rad/s ({why})", where="service",
            next_step="Run it once at the rig (tdhil identify); say in the profile where the drive tells its angle"
            " (position); or take the unit of speed by name: accept_speed_unit",
        )

    def say(self, text: str) -> None:
        tell(text)

    def warn(self, text: str) -> None:
        tell(text)
