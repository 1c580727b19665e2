"""Operator interface of a run in the service: keeps the run's status, watches the run, and requests the code.

Nothing here delays the control loop: changes are kept in memory, and a thread writes them to disk.
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
from tdhil.errors import MessageCode, TdhilError
from tdhil.service.run_state import Check, Confirmation, NotSo, State, Status, Watch, now
from tdhil.service.store import Store, write_json

if TYPE_CHECKING:
    from tdhil.recording import LiveInertia, RunLog, Stage
    from tdhil.runner import Display, Idle, StopRequest, Task

CODE_S: Final = 60.0
"""Time for which a code is valid, s. It can be used once."""
TRIES: Final = 3
LEASE_S: Final = 5.0
"""Time for which a watched run continues without its page, s. The page renews the lease every second."""
SILENT_S: Final = 2.0
"""Time without a message of the page after which the run's status reports this, s."""
LEASE_LOOK_S: Final = 0.05
WATCH: Final = "watch"
"""Kind of the log event that records whether a watched run is watched."""
WATCHED: Final = {
    None: "its page is open", "hidden": "its page is hidden", "closed": "its page was closed or reloaded",
    "silent": "its page sends nothing",
}


class Board:
    """The run's status. A change returns at once, and a thread writes it to disk.

    Some disk space is reserved for it: a full disk ends a run, and its last status is still written.
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
        """Apply a change of the status; ignore an impossible one. A display error never ends a run."""
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
        """Record when the drive first reacted to a stop. A later stop does not change that time."""
        at = now()
        self.change(lambda status: replace(status, stop=replace(status.stop, seen=status.stop.seen or at)))

    def close(self) -> None:
        """Wait up to 10 s until the status is written, or writing has failed. Release the reserved disk space."""
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
            except OSError as error:           # a full disk: the log ends the run, not the status
                print_line(f"the run's status can't be written: {error}")
                if self._end:
                    return
                time.sleep(0.5)
                self._wake.set()
                continue
            last = status


def print_line(text: str) -> None:
    """Print a line for process.log. It is lost if the disk is full."""
    with suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)  # noqa: T201


class Watcher:
    """Display of the run. The control loop calls `cycle`, which sets flags and writes waiting remarks to the log."""

    def __init__(self, board: Board, stop: StopRequest | None = None) -> None:
        self._board, self._stop = board, stop
        self._looking = False          # waiting for the drive's reaction to a stop
        self.viewed = False            # whether J is estimated during the run
        self._remarks: deque[str] = deque()
        self.log: RunLog | None = None

    def asked_to_stop(self, who: str) -> None:
        """Record a requested stop. `cycle` later records the first sample of the braking drive.

        A request after standstill stops nothing and is not part of the record. The audit has it.
        """
        self._looking = True
        at = now()

        def step(status: Status) -> Status:
            if status.stop.asked is None and status.stop.at_rest is None and not status.ended:
                status = replace(status, stop=replace(status.stop, asked=at, by=who))
            return status.to(State.STOPPING, at) if status.state is State.MOVING else status

        self._board.change(step)

    def remark(self, text: str) -> None:
        """Write a text to the log with the next cycle. Any thread may call it."""
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
            safe_action=preflight.reaction,
        )

    def stage_started(self, name: str, expected_s: float) -> None:
        at = now()

        def step(status: Status) -> Status:
            status = replace(status, expected_s={**status.expected_s, name: expected_s})
            return status.to(State.MOVING, at, name) if status.state is State.MOVING else status

        self._board.change(step)

    def cycle(self, command: Command, sample: Sample) -> None:
        if self._stop is not None and self._stop.signum is not None:
            if not self._stop.why:             # by a signal; a stop over the socket is noted there
                self.asked_to_stop("a signal")
            self._stop = None
        if self._remarks and self.log is not None:
            self.log.event(sample.time_s, WATCH, self._remarks.popleft())
        if self._looking and (
            sample.state is PowerState.QUICK_STOP or (command.mode is Mode.SPEED and command.speed_rad_s == 0.0)
        ):
            self._looking = False
            self._board.stop_seen()

    @property
    def follows_inertia(self) -> bool:
        """Return whether J is estimated during the run: in real time always, else if a page shows the run."""
        return self.viewed

    def inertia(self, found: LiveInertia) -> None:
        """Do nothing: J is in the log, and the pages read the log."""

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
    """The code of one run: six digits, valid once, for `CODE_S`, for one plan on one rig in its present state."""

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
        """Return whether the run is confirmed. Raises PreflightRefused if the code is void or has expired."""
        with self._lock:
            if self.confirmed_by is not None:
                return True
            if self.void is None and self.left_s <= 0.0:
                self.void = PreflightRefused(
                    f"the code was not entered within {CODE_S:g} s", where="code",
                    next_step="Nothing has moved; request the run again",
                    entry=MessageCode.CODE_REFUSED,
                )
            if self.void is not None:
                raise self.void
            return False

    def take(self, code: str, binding: str | None, who: str, lease_key: str = "") -> None:
        """Check an entered code. Raises PreflightRefused for a wrong one. `TRIES` wrong codes make the code void."""
        self.look()
        with self._lock:
            if self.confirmed_by is not None:
                raise PreflightRefused("the code has already been used", where="code", entry=MessageCode.CODE_REFUSED)
            if self.watched and not lease_key:
                raise PreflightRefused("this rig moves only while the operator watches the page that confirmed",
                                       where="lease",
                                       next_step="Confirm the run on its live page, and keep this page open",
                                       entry=MessageCode.CODE_REFUSED)
            try:
                self._still_so()
            except TdhilError as error:                # the rig's file has changed or can't be read
                self.void = PreflightRefused(error.what, where=error.where, next_step=error.next_step,
                                             entry=MessageCode.CHANGED_MEANWHILE)
                raise self.void from error
            if binding is not None and not _same(binding, self.binding):
                self.void = PreflightRefused("the confirmation belongs to another plan, rig or setting",
                                             where="binding",
                                             next_step="Nothing has moved; request the run again",
                                             entry=MessageCode.CODE_REFUSED)
                raise self.void
            if not _same(code, self.code):
                self._tries -= 1
                if self._tries <= 0:
                    self.void = PreflightRefused(f"{TRIES} wrong codes were entered, which is the limit", where="code",
                                                 next_step="Nothing has moved; request the run again",
                                                 entry=MessageCode.CODE_REFUSED)
                    raise self.void
                raise PreflightRefused("the code is wrong", where="code",
                                       next_step="Read the code on the terminal of tdhil serve or tdhil attend",
                                       entry=MessageCode.CODE_REFUSED)
            self.lease_key = lease_key
            self.confirmed_by = who


def _same(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode("utf-8", "replace"), other.encode())


class Lease:
    """Lets a watched run continue while the page that confirmed it reports every second that it is visible.

    It uses its own clock and thread: neither control time nor the web affects it. ``change`` receives each change.
    ``lost`` is called once, when the lease is lost. ``needed`` returns whether a shaft may still move.
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
        """Start the check of the page's silence, until `end`."""
        threading.Thread(target=self._hold, name="lease", daemon=True).start()

    def end(self) -> None:
        """End the lease, when nothing moves any more."""
        self._end.set()

    def renew(self, key: str, who: str, *, new_key: str = "", gone: str = "") -> Watch:
        """Renew the lease; ``gone``: the page was hidden or closed. ``new_key``: it was reloaded; the old key is void.

        Raises PreflightRefused if another page has the lease. A lost lease never returns.
        """
        self.look()
        with self._lock:
            if self.watch.lost is not None or not self._needed():
                raise PreflightRefused("the lease has ended and can't be renewed", where="lease",
                                       entry=MessageCode.CODE_REFUSED)
            known = _same(key, self._key) or (new_key != "" and _same(new_key, self._key))   # a reply may be lost
            if who != self.watch.by or not known:
                raise PreflightRefused("another page watches this run", where="lease",
                                       next_step="Stop works from every page", entry=MessageCode.CODE_REFUSED)
            if gone:
                if self.watch.how != "closed":         # a closed page is hidden, too; either message may arrive first
                    self._know(gone=self.watch.gone or now(), how=gone)
                return self.watch
            self._heard_s = self._clock()
            self._key = new_key or self._key
            if self.watch.gone is not None:
                self._know(gone=None, how=None)
            return self.watch

    def look(self) -> None:
        """End the lease if the page was silent for `LEASE_S`."""
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
            self._lost(self.watch)     # first, before anything slow
            self._change(self.watch)

    def _know(self, **known: Any) -> None:
        before, self.watch = self.watch, replace(self.watch, **known)
        if self.watch != before:
            self._change(self.watch)

    def _hold(self) -> None:
        while not self._end.wait(LEASE_LOOK_S):
            self.look()


class ServiceOperator:
    """Interface to the operator, who enters the code shown at the rig. A simulated drive needs no code.
    A watched rig is treated as a real drive, also if it is simulated.
    """

    def __init__(
        self, board: Board, watcher: Watcher, folder: Path, bind: Callable[[Preflight], Confirming], *,
        watched: bool = False, unwatched: Callable[[Watch], None] = lambda watch: None,
    ) -> None:
        """Make the interface. ``unwatched``: called when the lease is lost; it brakes the run."""
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
        text = motion_summary(preflight, task.limits, task.request, unverified, task.case)
        if self._watched:
            text += ("  [ ] an operator watches the page that confirms, for the whole run: the shaft brakes once it\n"
                     f"      is hidden or closed for {LEASE_S:g} s\n")
        expires = datetime.fromtimestamp(time.time() + CODE_S, UTC).isoformat(timespec="milliseconds")
        self.confirming = confirming
        self._board.to(State.AWAITING, confirmation=Confirmation(confirming.binding, text, expires))
        while not confirming.look():
            idle()                     # meanwhile the drive's watchdog is served, and a stop is detected
        if self._watched:
            self.lease = Lease(
                confirming.lease_key, confirming.confirmed_by or "", change=self._note_watch, lost=self._unwatched,
                needed=lambda: self._board.status.state in (State.AWAITING, State.MOVING),
            )
            self.lease.start()
        confirmed = {"binding": confirming.binding, "at": now(), "by": confirming.confirmed_by}
        threading.Thread(target=self._write_down, args=(confirmed,), daemon=True).start()

    def _note_watch(self, watch: Watch) -> None:
        self._board.know(watch=watch)
        self._watcher.remark(WATCHED[watch.how] if watch.lost is None else f"{WATCHED[watch.how]}: the run brakes")

    def _write_down(self, confirmed: Mapping[str, Any]) -> None:
        with suppress(OSError):
            write_json(self._folder / "confirm.json", confirmed)

    def confirm_speed(self, speed_rad_s: float, why: str, idle: Idle) -> None:
        raise PreflightRefused(
            f"no operator can confirm that the shaft turns at {speed_rad_s:.3g} rad/s ({why})", where="service",
            next_step="Start this run at the rig: tdhil identify --rig FILE. Or name the drive's position object in the"
            " profile (position). Or measure the speed, and then accept the unit of speed (--accept-speed-unit)",
            entry=MessageCode.SPEED_UNIT_NOT_SEEN,
        )

    def say(self, text: str) -> None:
        print_line(text)

    def warn(self, text: str) -> None:
        print_line(text)
