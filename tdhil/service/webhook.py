"""Notifications over HTTP: one POST of a JSON object for each event.

With a secret the header ``X-Tdhil-Signature`` holds ``sha256=`` and the HMAC-SHA256 of the body. tdhil follows no
redirect, and reads only the status of the reply.
"""

from __future__ import annotations

import hashlib
import hmac
import http.client
import json
import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from tdhil.service.run_state import option_wrong

TIMEOUT_S: Final = 10.0
"""Longest wait for a connection and for the reply, s."""
SECRET_FILE: Final = "TDHIL_WEBHOOK_SECRET_FILE"
SIGNATURE: Final = "X-Tdhil-Signature"


@dataclass(frozen=True)
class Webhook:
    """Address that receives the messages. ``secret`` is never shown."""

    url: str
    secret: bytes | None = field(default=None, repr=False)
    name: str = "Webhook"

    @staticmethod
    def of(url: str, environment: Mapping[str, str] = os.environ) -> Webhook:
        """Parse and check an address. Raises UsageError; its text contains no password."""
        try:
            parts = urlsplit(url)
            good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        except ValueError:
            good = False
        if not good:
            raise option_wrong("must be http:// or https://, a host, and optionally a port and a path", "--webhook",
                               "Use https://host/path")
        if parts.password is not None or parts.username is not None:
            raise option_wrong("a user or a password must not be in the address", "--webhook",
                               f"Put a secret into a file, and name the file in {SECRET_FILE}")
        secret = None
        if (name := environment.get(SECRET_FILE)) is not None:
            try:
                secret = Path(name).read_bytes().strip()
            except OSError as error:
                raise option_wrong(f"can't be read ({error.strerror or error})", f"{SECRET_FILE} {name}",
                                   "The file must contain only the secret, readable by its owner only") from None
        return Webhook(url, secret)

    @property
    def caution(self) -> str:
        """Return that the messages have no signature, if there is no secret."""
        return "" if self.secret else f" (not signed: {SECRET_FILE} is not set)"

    def at(self, site: str) -> Webhook:
        """Return itself: a message has the path of its page, and the receiver knows the host."""
        return self

    def send(self, message: Mapping[str, Any]) -> None:
        """Send one message. Raises OSError, also for a status that is not 2xx."""
        body = json.dumps(message, ensure_ascii=False, allow_nan=False).encode()
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
        except http.client.HTTPException as error:
            raise OSError(str(error) or type(error).__name__) from error
        finally:
            connection.close()
        if not 200 <= status < 300:
            raise OSError(f"answered with HTTP {status}")

    def __str__(self) -> str:
        parts = urlsplit(self.url)
        return f"{parts.scheme}://{parts.netloc}{parts.path}"
