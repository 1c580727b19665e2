"""Client of a service: ``tdhil.Client("http://127.0.0.1:8420")``. It needs the standard library only."""

from __future__ import annotations

import json
import ssl
import time
import urllib.error
import urllib.request
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from http.client import HTTPException
from pathlib import Path
from typing import IO, Any, Final
from urllib.parse import quote, urlencode

from drivers import CommunicationLost
from profiles import message_of
from tdhil.errors import MessageCode, TdhilError, UsageError, existing_file
from tdhil.new_file import whole_or_none
from tdhil.service.limits import API, REPLY_S

_ARCHIVED: Final[dict[bool, dict[str, Any]]] = {False: {}, True: {"archived": "true"}}
"""Fields of a request without archived runs, and with them."""
_ENDED: Final = frozenset({"done", "refused", "stopped", "failed", "stop_not_confirmed", "interrupted"})


class ServiceError(TdhilError):
    """Refusal by the service: ``kind`` and ``exit_code`` from its error tree, HTTP ``status``.

    ``holder``: the run that holds the rig, if this is the reason of the refusal.
    """

    def __init__(self, status: int, body: Mapping[str, Any]) -> None:
        stated = body.get("error") or {}
        super().__init__(str(stated.get("what", f"HTTP {status}")), where=str(stated.get("where", "")),
                         next_step=str(stated.get("next_step", "")))
        self.status = status
        self.kind = str(stated.get("kind", ""))
        self.exit_code = stated.get("exit_code", 1)
        self.entry = message_of(str(stated.get("code", ""))) or self.entry
        self.holder = body.get("holder")


class _NowhereElse(urllib.request.HTTPRedirectHandler):
    """HTTP handler that follows no redirect, so that the token goes to no other server."""

    def redirect_request(self, *_: Any) -> None:
        return None


class Client:
    """Client of one service. Replies are the documents of its API (``/api/v1/openapi.json`` describes them).

    ``token``: of `tdhil serve tokens add`; it is sent over TLS only. ``ca``: certificates to trust (a PEM file; None:
    those of the system). Raises ServiceError for a refusal, CommunicationLost if the service can't be reached, and
    UsageError for a token without TLS.
    """

    def __init__(
        self, url: str = "http://127.0.0.1:8420", *, token: str | None = None, ca: str | Path | None = None,
        timeout_s: float = REPLY_S,
    ) -> None:
        self._url = url.rstrip("/")
        self._timeout_s = timeout_s
        if token is not None and not self._url.startswith("https://"):
            raise UsageError("a token is sent over TLS only", where=self._url[:100], next_step="Use https://…")
        self._headers = {"Content-Type": "application/json"}
        if token is not None:
            self._headers["Authorization"] = f"Bearer {token}"
        # No proxy and no redirect: the service is at the given address.
        handlers: list[urllib.request.BaseHandler] = [urllib.request.ProxyHandler({}), _NowhereElse()]
        if ca is not None:
            try:
                handlers.append(urllib.request.HTTPSHandler(context=ssl.create_default_context(cafile=str(ca))))
            except OSError as error:
                raise UsageError(f"can't be read as certificates ({error.strerror or error})", where=str(ca)) from error
        self._opener = urllib.request.build_opener(*handlers)

    def me(self) -> dict[str, Any]:
        """Return this client's ``name`` and ``roles`` in the service."""
        return self._object("GET", "/me")

    def rigs(self) -> list[dict[str, Any]]:
        """Return the rigs, each with its ``id``, its state and its present run."""
        found: list[dict[str, Any]] = self._json("GET", "/rigs")
        return found

    def rig(self, rig: str) -> dict[str, Any]:
        return self._object("GET", f"/rigs/{quote(rig, safe='')}")

    def draft_rig(self, profile: str, **entries: Any) -> dict[str, Any]:
        """Return the file of a new rig, with its mistakes by field; ``entries`` as in `schemas.DraftBody`."""
        return self._object("POST", "/new-rig/draft", {"profile": profile, **entries})

    def scan(self, profile: str, address: Mapping[str, str]) -> dict[str, Any]:
        """Return the drives at an address. No other master may be active on the bus."""
        return self._object("POST", "/new-rig/scan", {"profile": profile, "address": dict(address), "alone": True})

    def add_rig(self, rig: str, text: str) -> dict[str, Any]:
        """Add a rig with the text of its file. An existing one is never overwritten."""
        return self._object("POST", "/rigs", {"id": rig, "text": text})

    def trend(self, rig: str) -> dict[str, Any]:
        """Return a rig's results over time, and whether they changed: the document of ``tdhil trend --json``."""
        found: dict[str, Any] = self._object("GET", f"/rigs/{quote(rig, safe='')}/trend")["trend"]
        return found

    def compare(self, *runs: str, archived: bool = False) -> dict[str, Any]:
        """Return a comparison of runs: the document of ``tdhil compare --json``. ``archived``: archived runs, too."""
        asked = urlencode({"runs": ",".join(runs), **_ARCHIVED[archived]})
        found: dict[str, Any] = self._object("GET", f"/runs/compare?{asked}")["comparison"]
        return found

    def plan(self, rig: str, **options: Any) -> dict[str, Any]:
        """Return the plan of a run with these options, and its expected result. No drive is connected."""
        return self._object("POST", f"/rigs/{quote(rig, safe='')}/plan", options)

    def start(self, rig: str, *, key: str | None = None, **options: Any) -> dict[str, Any]:
        """Request a run, with the command line's options. ``key``: the same key never starts a second run."""
        headers = {} if key is None else {"Idempotency-Key": key}
        return self._object("POST", f"/rigs/{quote(rig, safe='')}/runs", options, headers)

    def runs(
        self, *, rig: str | None = None, state: str | None = None, text: str | None = None, archived: bool = False,
        limit: int = 100,
    ) -> list[dict[str, Any]]:
        """Return the runs, the newest first. ``text``: words to search for. ``archived``: archived runs, too."""
        asked = {"rig": rig, "state": state, "text": text, "limit": limit, **_ARCHIVED[archived]}
        given = {name: value for name, value in asked.items() if value is not None}
        found: list[dict[str, Any]] = self._json("GET", f"/runs?{urlencode(given)}")
        return found

    def run(self, run: str) -> dict[str, Any]:
        return self._object("GET", f"/runs/{quote(run, safe='')}")

    def confirm(self, run: str, code: str, binding: str | None = None) -> dict[str, Any]:
        """Confirm motion with the six-digit code that is shown at the rig."""
        return self._object("POST", f"/runs/{quote(run, safe='')}/confirm", {"code": code, "binding": binding})

    def stop(self, run: str) -> dict[str, Any]:
        """Stop the run. This is no emergency stop: it needs network, computer, cable and drive."""
        return self._object("POST", f"/runs/{quote(run, safe='')}/stop", {})

    def stop_rig(self, rig: str) -> dict[str, Any]:
        """Stop the rig's present run. Without a run, stop the rig's drive, as ``tdhil stop`` does."""
        return self._object("POST", f"/rigs/{quote(rig, safe='')}/stop", {})

    def annotate(self, run: str, *, tags: Sequence[str] | None = None, **texts: str | None) -> dict[str, Any]:
        """Edit tags and texts (``operator``, ``note``, ``customer``, ``order_number``, ``place``) of an ended run.

        None leaves a value. The log stays as it is.
        """
        body = {"tags": None if tags is None else list(tags), **texts}
        return self._object("POST", f"/runs/{quote(run, safe='')}/annotations", body)

    def archive(self, run: str, archived: bool = True) -> dict[str, Any]:
        """Hide a run from lists and histories, or show it again."""
        return self._object("POST", f"/runs/{quote(run, safe='')}/archive", {"archived": archived})

    def delete(self, run: str, *, confirm: str) -> dict[str, Any]:
        """Delete an ended run with its files. ``confirm``: the run's id once more."""
        return self._object("POST", f"/runs/{quote(run, safe='')}/delete", {"confirm": confirm})

    def acceptance(self, run: str) -> dict[str, Any]:
        """Return the acceptance of a run, the SHA-256 of its log, and its signature."""
        return self._object("GET", f"/runs/{quote(run, safe='')}/acceptance")

    def sign_acceptance(
        self, run: str, *, name: str, verdict: str, log_sha256: str, remark: str = ""
    ) -> dict[str, Any]:
        """Sign the acceptance of a run by ``name``. ``verdict``, ``log_sha256``: as this person saw them."""
        body = {"name": name, "verdict": verdict, "log_sha256": log_sha256, "remark": remark}
        return self._object("POST", f"/runs/{quote(run, safe='')}/acceptance", body)

    def replay(self, run: str, **asked: Any) -> dict[str, Any]:
        """Identify a run again with another ``model``, ``tolerance`` or ``confidence``. Return when it is done."""
        found = self._object("POST", f"/runs/{quote(run, safe='')}/replays", asked)
        while found["state"] in ("waiting", "delayed"):
            time.sleep(0.2)
            found = self._object("GET", f"/runs/{quote(run, safe='')}/replays/{found['name']}")
        return found

    def letterhead(self) -> dict[str, Any]:
        """Return ``company``, ``address`` and ``logo`` (a PNG in base64) of the reports."""
        return self._object("GET", "/letterhead")

    def change_letterhead(self, company: str, address: Sequence[str], logo: bytes | None = None) -> dict[str, Any]:
        """Change the head of the reports. ``logo``: a PNG, b'' for none, None for the present one."""
        text = None if logo is None else b64encode(logo).decode()
        return self._object("POST", "/letterhead", {"company": company, "address": list(address), "logo": text})

    def uploads(self) -> dict[str, Any]:
        """Return the uploads that wait to be identified, and ``limit_bytes``, the largest file."""
        return self._object("GET", "/uploads")

    def upload(self, path: str | Path) -> dict[str, Any]:
        """Upload a log of tdhil, or a trace in CSV. Return it with its ``id``. Raises UsageError for a larger file than
        the limit, and OSError for a file that can't be read.
        """
        source = Path(path)
        size, limit = source.stat().st_size, self.uploads()["limit_bytes"]
        if size > limit:
            raise UsageError(f"{size} bytes: the service takes {limit} at most", where=source.name,
                             next_step="Export the part with the motion")
        headers = {"Content-Type": "application/octet-stream", "Content-Length": str(size)}
        with source.open("rb") as file, self._open(
                "POST", f"/uploads?{urlencode({'name': source.name})}", file, headers) as answer:
            found: dict[str, Any] = json.loads(answer.read())
        return found

    def preview(self, upload: str, **mapping: Any) -> dict[str, Any]:
        """Return what an upload contains, and how it is read with this mapping: ``columns`` such as
        ``["time=t:ms", "speed=n:rpm", "torque=m:Nm"]``, and the other options of ``tdhil replay`` for a trace.
        """
        return self._object("POST", f"/uploads/{quote(upload, safe='')}/preview", mapping)

    def identify_upload(self, upload: str, *, rig: str = "", **mapping: Any) -> dict[str, Any]:
        """Identify an upload. Return its run when this is done. ``rig``: the rig as you state it.

        ``mapping``: as in `preview`, and ``model``, ``tolerance``, ``confidence``, ``operator``, ``note``. Raises
        ServiceError if the recording can't be identified.
        """
        found = self._object("POST", f"/uploads/{quote(upload, safe='')}/identify", {"rig": rig, **mapping})
        while found["state"] in ("delayed", "identifying"):
            time.sleep(0.2)
            found = self._object("GET", f"/uploads/{quote(upload, safe='')}")
        if found["run"] is None:
            raise ServiceError(200, {"error": found["error"]})
        return self.run(found["run"])

    def delete_upload(self, upload: str) -> None:
        """Delete an upload that waits to be identified."""
        self._object("POST", f"/uploads/{quote(upload, safe='')}/delete", {})

    def fleet(self, folder: str = "", *, below: str = "", **settings: Any) -> dict[str, Any]:
        """Identify many logs again: the service's own runs, or a folder of ``--logs``. Return when the work has ended.

        ``settings``: ``model``, ``tolerance``, ``confidence``. The same request again continues with the rest.
        """
        found = self._object("POST", "/fleets", {"folder": folder, "below": below, **settings})
        while found["state"] == "running":
            time.sleep(0.5)
            found = self._object("GET", f"/fleets/{found['id']}")
        return found

    def fleet_rows(self, fleet: str, start: int = 0, limit: int = 200) -> list[dict[str, Any]]:
        """Return one row per log, as `tdhil.fleet.FleetRow`."""
        asked = urlencode({"from": start, "limit": limit})
        found: list[dict[str, Any]] = self._json("GET", f"/fleets/{quote(fleet, safe='')}/rows?{asked}")
        return found

    def wait(
        self, run: str, *, every_s: float = 0.2, timeout_s: float | None = None,
        seen: Callable[[dict[str, Any]], None] = lambda run: None,
    ) -> dict[str, Any]:
        """Return the run once it has ended; ``seen`` receives it at every poll. Raises TimeoutError; the run
        continues.
        """
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            found = self.run(run)
            seen(found)
            if found["state"] in _ENDED:
                return found
            if end_s is not None and time.monotonic() > end_s:
                raise TimeoutError(f"run {run} is {found['state']}")
            time.sleep(every_s)

    def download(self, run: str, name: str, path: str | Path) -> Path:
        """Save ``log.mcap``, ``report.html``, ``report.pdf``, ``result.json`` or ``trace.csv`` of a run as a new
        file. Raises UsageError if it exists, and CommunicationLost, without a file, if the connection ends early.
        """
        if (target := Path(path)).exists():
            raise existing_file(target)
        with (self._open("GET", f"/runs/{quote(run, safe='')}/{quote(name, safe='')}") as answer,
              whole_or_none(target), target.open("xb") as file):
            announced, received = answer.headers.get("Content-Length"), 0
            try:
                while piece := answer.read(2**16):
                    received += file.write(piece)
                if announced not in (None, str(received)):
                    raise HTTPException("the connection ended early")
            except (OSError, HTTPException) as error:
                raise CommunicationLost(
                    f"only a part of {name} arrived ({received} bytes): {str(error) or type(error).__name__}",
                    where=run, next_step="Download it again", entry=MessageCode.SERVER_UNREACHABLE) from error
        return target

    def audit(self, limit: int = 200, *, head: str | None = None) -> dict[str, Any]:
        """Return the latest audit lines, and whether the chain is intact. ``head``: an exported head to check."""
        asked = {"limit": limit} if head is None else {"limit": limit, "head": head}
        return self._object("GET", f"/audit?{urlencode(asked)}")

    def _object(
        self, method: str, path: str, body: Mapping[str, Any] | None = None, headers: Mapping[str, str] | None = None
    ) -> dict[str, Any]:
        found: dict[str, Any] = self._json(method, path, body, headers)
        return found

    def _json(
        self, method: str, path: str, body: Mapping[str, Any] | None = None, headers: Mapping[str, str] | None = None
    ) -> Any:
        with self._open(method, path, body, headers) as answer:
            return json.loads(answer.read())

    def _open(
        self, method: str, path: str, body: Mapping[str, Any] | IO[bytes] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> Any:
        data = json.dumps(body).encode() if isinstance(body, Mapping) else body
        request = urllib.request.Request(
            f"{self._url}{API}{path}", data, {**self._headers, **(headers or {})}, method=method
        )
        try:
            return self._opener.open(request, timeout=self._timeout_s)
        except urllib.error.HTTPError as error:
            with error:
                try:
                    stated = json.loads(error.read())
                except ValueError:
                    stated = {}
            raise ServiceError(error.code, stated if isinstance(stated, dict) else {}) from None
        except (OSError, ValueError) as error:
            raise CommunicationLost(
                f"the service can't be reached ({getattr(error, 'reason', error)})", where=self._url,
                next_step="Is tdhil serve running there? If a shaft turns, use the hard-wired emergency stop",
                entry=MessageCode.SERVER_UNREACHABLE,
            ) from error
