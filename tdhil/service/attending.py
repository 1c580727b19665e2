"""Who is there while a run of the service goes: keeps its status, sees it go by, and asks for the code.

Nothing here holds the control loop up: what it sees it notes, and a thread writes the notes down.
"""

from __future__ import annotations

import hmac
import secrets
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers import Command, Mode, PowerState, Preflight, PreflightRefused, Sample
from profiles import visible
from tdhil.service.states import Check, Confirmation, NotSo, State, Status, now
from tdhil.service.store import Store, write_json

if TYPE_CHECKING:
    from tdhil.recording import Stage
    from tdhil.run import Display, Idle, Task

CODE_S: Final = 60.0
"""So long a code is good, once."""
TRIES: Final = 3
EXPECTED_S: Final = {"setup": 10.0, "speed": 50.0, "torque": 15.0, "hold": 15.0, "acquire": 300.0}

class Board:
    """The run's status; whoever changes it is done at once, a thread writes it down."""

    def __init__(self, store: Store, status: Status) -> None:
        self._store = store
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

    def close(self) -> None:
        """All of it is written, or can't be."""
        self._end = True
        self._wake.set()
        self._thread.join(10.0)

    def _write(self) -> None:
        last: Status | None = None
        while not (self._end and last is self._status):
            self._wake.wait()
            self._wake.clear()
            status = self._status
            try:
                self._store.save(status)
            except OSError as error:           # a full disk: the run ends by its log, not by this
                print(f"the state can't be written: {error}", file=sys.stderr)  # noqa: T201
                if self._end:
                    return
                time.sleep(0.5)
                self._wake.set()
                continue
            last = status


class Watcher:
    """Sees the run as it goes. `cycle` is called in the control loop and keeps two things in mind."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._looking = False          # for the drive's answer to a stop
        self.last_s = 0.0

    def look_for_the_stop(self) -> None:
        """From now on the first sample of a drive that brakes is noted."""
        self._looking = True

    def preflight(self, preflight: Preflight) -> None:
        checks = tuple(
            Check(visible(one.name), visible(one.wanted), visible(one.found), one.outcome.value, visible(one.where),
                  visible(one.next_step))
            for one in preflight.checks
        )
        who = preflight.identity
        self._board.know(
            preflight=checks, simulated=who.simulated, identity=visible(who.name),
            safe_action=preflight.safe_action.replace("_", " "),
        )

    def stage_started(self, name: str, expected_s: float) -> None:
        at = now()

        def step(status: Status) -> Status:
            status = replace(status, expected_s={**status.expected_s, name: expected_s})
            return status.to(State.MOVING, at, name) if status.state is State.MOVING else status

        self._board.change(step)

    def cycle(self, command: Command, sample: Sample) -> None:
        self.last_s = sample.time_s
        if self._looking and (
            sample.state is PowerState.QUICK_STOP or (command.mode is Mode.SPEED and command.speed_rad_s == 0.0)
        ):
            self._looking = False
            self._board.stop(seen=now())

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

    def __init__(self, binding: str, still_so: Callable[[], None], *, clock: Callable[[], float] = time.monotonic,
                 ) -> None:
        self.binding = binding
        self.code = f"{secrets.randbelow(10**6):06d}"
        self._still_so = still_so
        self._clock = clock
        self._until_s = clock() + CODE_S
        self._tries = TRIES
        self._lock = threading.Lock()
        self.confirmed_by: str | None = None
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

    def take(self, code: str, binding: str | None, who: str) -> None:
        """Raises PreflightRefused for what isn't the code for this; after some tries it is void."""
        self.look()
        with self._lock:
            if self.confirmed_by is not None:
                raise PreflightRefused("the code was used already", where="code")
            try:
                self._still_so()
            except PreflightRefused as error:
                self.void = error
                raise
            if binding is not None and not hmac.compare_digest(binding, self.binding):
                self.void = PreflightRefused("the confirmation is for another plan, rig or setting", where="binding",
                                             next_step="Nothing has moved; ask for it again")
                raise self.void
            if not hmac.compare_digest(code.encode(), self.code.encode()):
                self._tries -= 1
                if self._tries <= 0:
                    self.void = PreflightRefused(f"{TRIES} wrong codes", where="code",
                                                 next_step="Nothing has moved; ask for it again")
                    raise self.void
                raise PreflightRefused("that isn't the code", where="code",
                                       next_step="It stands on the terminal of tdhil serve")
            self.confirmed_by = who


class ServiceAttendant:
    """Who is there: whoever types in the code that is shown at the rig. A simulated drive asks nobody."""

    def __init__(self, board: Board, watcher: Watcher, folder: Path, bind: Callable[[Preflight], Confirming]) -> None:
        self._board, self._watcher, self._folder, self._bind = board, watcher, folder, bind
        self.confirming: Confirming | None = None

    @contextmanager
    def watch(self) -> Iterator[Display]:
        yield self._watcher

    def confirm(self, task: Task, preflight: Preflight, idle: Idle, unverified: tuple[str, ...]) -> None:
        if not preflight.identity.simulated:
            self._ask(task, preflight, idle, unverified)
        self._board.to(State.MOVING, "setup", confirmation=None)

    def _ask(self, task: Task, preflight: Preflight, idle: Idle, unverified: tuple[str, ...]) -> None:
        from tdhil.session import motion_summary

        confirming = self._bind(preflight)
        text = motion_summary(preflight, task.limits, task.request, unverified)
        expires = datetime.fromtimestamp(time.time() + CODE_S, UTC).isoformat(timespec="milliseconds")
        self.confirming = confirming
        self._board.to(State.AWAITING, confirmation=Confirmation(confirming.binding, text, expires))
        while not confirming.look():
            idle()                     # the drive's watchdog is fed meanwhile, and a stop is seen
        told = {"binding": confirming.binding, "at": now(), "by": confirming.confirmed_by}
        threading.Thread(target=self._write_down, args=(told,), daemon=True).start()

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
        print(text, flush=True)  # noqa: T201

    def warn(self, text: str) -> None:
        print(text, flush=True)  # noqa: T201
