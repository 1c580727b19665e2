"""Messages to another system over HTTP: a run has ended or failed, or a rig's results have changed.

Each event is one POST of a JSON object, from a separate thread: nothing else waits for it. With a secret the header
``X-Tdhil-Signature`` holds ``sha256=`` and the HMAC-SHA256 of the body. tdhil follows no redirect, and reads only the
status of the reply. Runs that ended before the service started are not sent.
"""

from __future__ import annotations

import hashlib
import hmac
import http.client
import json
import os
import ssl
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from tdhil.errors import MessageCode, UsageError
from tdhil.service.run_state import State, now

if TYPE_CHECKING:
    from tdhil.service.store import Summary

EVERY_S: Final = 1.0
"""Polling interval, s."""
TIMEOUT_S: Final = 10.0
"""Longest wait for a connection and for the reply, s."""
TRIES_S: Final = (0.0, 5.0, 60.0)
"""Delay before each try to send a message, s. After the last failed try, the message is dropped and reported."""
RUNS: Final = 100
"""Number of latest runs that a poll checks."""
SECRET_FILE: Final = "TDHIL_WEBHOOK_SECRET_FILE"
SIGNATURE: Final = "X-Tdhil-Signature"
_GOOD: Final = (State.DONE.value, State.STOPPED.value)
Say = Callable[[str], None]
Trend = Mapping[str, Any]


@dataclass(frozen=True)
class Webhook:
    """Address that receives the messages. ``secret`` is never shown."""

    url: str
    secret: bytes | None = field(default=None, repr=False)

    @staticmethod
    def of(url: str, environment: Mapping[str, str] = os.environ) -> Webhook:
        """Parse and check an address. Raises UsageError; its text contains no password."""
        try:
            parts = urlsplit(url)
            good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        except ValueError:
            good = False
        if not good:
            raise UsageError("must be http:// or https://, a host, and optionally a port and a path", where="--webhook",
                             next_step="Use https://host/path", entry=MessageCode.SERVICE_OPTION_WRONG)
        if parts.password is not None or parts.username is not None:
            raise UsageError("a user or a password must not be in the address", where="--webhook",
                             next_step=f"Put a secret into a file, and name the file in {SECRET_FILE}",
                             entry=MessageCode.SERVICE_OPTION_WRONG)
        return Webhook(url, _secret(environment))

    def send(self, body: bytes) -> None:
        """Send one message. Raises OSError or HTTPException, also for a status that is not 2xx."""
        parts = urlsplit(self.url)
        port, host = parts.port, str(parts.hostname)
        connection = (
            http.client.HTTPSConnection(host, port, timeout=TIMEOUT_S, context=ssl.create_default_context())
            if parts.scheme == "https" else http.client.HTTPConnection(host, port, timeout=TIMEOUT_S))
        headers = {"Content-Type": "application/json", "User-Agent": "tdhil"}
        if self.secret is not None:
            headers[SIGNATURE] = f"sha256={hmac.new(self.secret, body, hashlib.sha256).hexdigest()}"
        try:
            connection.request("POST", (parts.path or "/") + (f"?{parts.query}" if parts.query else ""), body, headers)
            status = connection.getresponse().status
        finally:
            connection.close()
        if not 200 <= status < 300:
            raise OSError(f"answered with HTTP {status}")

    def __str__(self) -> str:
        parts = urlsplit(self.url)
        return f"{parts.scheme}://{parts.netloc}{parts.path}"


def _secret(environment: Mapping[str, str]) -> bytes | None:
    if (name := environment.get(SECRET_FILE)) is None:
        return None
    try:
        return Path(name).read_bytes().strip()
    except OSError as error:
        raise UsageError(f"can't be read ({error.strerror or error})", where=f"{SECRET_FILE} {name}",
                         next_step="The file must contain only the secret, readable by its owner only",
                         entry=MessageCode.SERVICE_OPTION_WRONG) from None


class Notifier:
    """Sender of a message for each ended run, and for each change of a rig in its results, from `start` to `close`.

    ``runs`` returns the latest runs; ``trends`` a rig's trend without and with a run, as `tdhil trend --json` does.
    """

    def __init__(
        self, webhook: Webhook, runs: Callable[[], Sequence[Summary]],
        trends: Callable[[str, str], tuple[Trend, Trend]], say: Say = lambda text: None,
    ) -> None:
        self._webhook, self._runs, self._trends, self._say = webhook, runs, trends, say
        self._known: set[str] = set()
        self._since = now()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="webhook", daemon=True)

    def start(self) -> None:
        """Start to send. Runs that ended before are not sent."""
        self._since = now()
        self._say(f"Webhook: ended runs and changes are sent to {self._webhook}")
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
                trouble = f"Webhook: {type(error).__name__}: {error}"
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
        data = json.dumps(body, ensure_ascii=False, allow_nan=False).encode()
        for after_s in TRIES_S:
            if self._end.wait(after_s):
                return
            try:
                self._webhook.send(data)
            except (OSError, http.client.HTTPException) as error:
                trouble = str(error) or type(error).__name__
            else:
                return
        self._say(f"Webhook: {self._webhook}: {trouble}. The message on run {body['run']} was not delivered")


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
