"""Notifications: a run has ended or failed, or a rig's results have changed.

Each way has a thread of its own: nothing else waits for it. Runs that ended before the service started are not sent.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, Protocol

from tdhil.service.run_state import State, now

if TYPE_CHECKING:
    from tdhil.service.run_filter import Summary

EVERY_S: Final = 1.0
"""Polling interval, s."""
TRIES_S: Final = (0.0, 5.0, 60.0)
"""Delay before each try to send a message, s. After the last failed try, the message is dropped and reported."""
RUNS: Final = 100
"""Number of latest runs that a poll checks."""
_GOOD: Final = (State.DONE.value, State.STOPPED.value)
Say = Callable[[str], None]
Trend = Mapping[str, Any]


class Receiver(Protocol):
    """Way to a receiver of notifications. ``str`` of it has no password."""

    @property
    def name(self) -> str:
        """Return the kind of way, for texts."""
        ...

    @property
    def caution(self) -> str:
        """Return what to know when the sending starts, as an addition to the address; '' for nothing."""
        ...

    def at(self, site: str) -> Receiver:
        """Return the same way for a service whose pages have this address."""
        ...

    def send(self, message: Mapping[str, Any]) -> None:
        """Send one message, a JSON object. Raises OSError."""
        ...


class Notifier:
    """Sender of a message for each ended run, and for each change of a rig in its results, from `start` to `close`.

    ``runs`` returns the latest runs; ``trends`` a rig's trend without and with a run, as `tdhil trend --json` does.
    """

    def __init__(
        self, receiver: Receiver, runs: Callable[[], Sequence[Summary]],
        trends: Callable[[str, str], tuple[Trend, Trend]], say: Say = lambda text: None,
    ) -> None:
        self._receiver, self._runs, self._trends, self._say = receiver, runs, trends, say
        self._known: set[str] = set()
        self._since = now()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name=receiver.name, daemon=True)

    def start(self) -> None:
        """Start to send. Runs that ended before are not sent."""
        self._since = now()
        self._say(f"{self._receiver.name}: ended runs and changes are sent to {self._receiver}{self._receiver.caution}")
        self._thread.start()

    def close(self) -> None:
        """End. A message that is being sent may be lost."""
        self._end.set()

    def _run(self) -> None:
        said = ""
        while not self._end.wait(EVERY_S):
            try:
                for body in self.news():
                    self._deliver(body)
                trouble = ""
            except Exception as error:         # one poll failed: the next poll reports again
                trouble = f"{self._receiver.name}: {type(error).__name__}: {error}"
            if trouble not in ("", said):
                self._say(trouble)
            said = trouble

    def news(self) -> Iterator[dict[str, Any]]:
        """Yield the messages of the runs that have ended since the last call, the oldest first."""
        for one in sorted(self._runs(), key=lambda run: run.id):
            if one.ended is None or one.ended < self._since or one.id in self._known:
                continue
            self._known.add(one.id)
            yield message_of(one)
            if one.state == State.DONE and not one.rehearsal and not one.uploaded:
                yield from changes_of(one, *self._trends(one.rig, one.id))

    def _deliver(self, body: Mapping[str, Any]) -> None:
        for after_s in TRIES_S:
            if self._end.wait(after_s):
                return
            try:
                self._receiver.send(body)
            except OSError as error:
                trouble = str(error) or type(error).__name__
            else:
                return
        self._say(f"{self._receiver.name}: {self._receiver}: {trouble}. The message on run {body['run']} was not"
                  " delivered")


def message_of(run: Summary) -> dict[str, Any]:
    """Return the message on an ended run: data of its row, and whether it ended as requested."""
    return {
        "event": "run.ended" if run.state in _GOOD else "run.failed", "run": run.id, "rig": run.rig, "state": run.state,
        "asked": run.asked, "ended": run.ended, "simulated": run.simulated, "rehearsal": run.rehearsal,
        "uploaded": run.uploaded,
        "exit_code": run.exit_code, "verdict": run.verdict, "inertia_kg_m2": run.inertia_kg_m2,
        "low_kg_m2": run.low_kg_m2, "high_kg_m2": run.high_kg_m2, "path": f"/runs/{run.id}",
    }


def changes_of(run: Summary, before: Trend, after: Trend) -> Iterator[dict[str, Any]]:
    """Yield a message for each quantity of the rig that has a new change or drift with this run."""
    known = {one["column"]: one for one in before.get("quantities", ())}
    for quantity in after.get("quantities", ()):
        earlier = known.get(quantity["column"], {})
        changed = len(quantity.get("changes", ())) > len(earlier.get("changes", ()))
        drifts = bool(quantity.get("drift")) and not earlier.get("drift")
        if changed or drifts:
            yield {"event": "rig.changed" if changed else "rig.drifts", "run": run.id, "rig": run.rig,
                   "quantity": quantity["column"], "text": quantity["text"], "path": f"/rigs/{run.rig}"}
