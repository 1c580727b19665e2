"""Notifications by e-mail: one message for each event, in plain text.

With ``smtps://`` the connection is encrypted from its begin, with ``smtp://`` by STARTTLS where the server offers it. A
password is never sent without encryption.
"""

from __future__ import annotations

import os
import re
import smtplib
import socket
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from email.message import EmailMessage
from email.utils import formatdate, make_msgid
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from profiles import visible
from profiles.quantities import printed_interval
from tdhil.service.password_file import read_password
from tdhil.service.run_state import option_wrong

TIMEOUT_S: Final = 20.0
"""Longest wait for each reply of the server, s."""
PASSWORD_FILE: Final = "TDHIL_MAIL_PASSWORD_FILE"
SENDER: Final = "TDHIL_MAIL_FROM"
LONGEST_SUBJECT: Final = 150
"""Longest subject, characters."""
_ADDRESS: Final = re.compile(r"[^\s@,<>\"()\[\]\\:;]+@[A-Za-z0-9.-]+")
_EVENTS: Final = {
    "run.ended": "run ended", "run.failed": "run FAILED", "rig.changed": "results changed",
    "rig.drifts": "results drift",
}
_MEANING: Final = {
    "run.ended": "The run ended as requested.", "run.failed": "The run did not end as requested. Look at its page.",
    "rig.changed": "The result of this run differs from the results before it.",
    "rig.drifts": "The results of this rig drift.",
}


@dataclass(frozen=True)
class Mail:
    """Server and recipients. ``site``: address of the service's pages. ``password`` is never shown."""

    host: str
    port: int
    recipients: tuple[str, ...]
    sender: str
    user: str | None = None
    encrypted: bool = False
    password: str | None = field(default=None, repr=False)
    site: str = ""
    name: str = "Mail"
    caution: str = ""

    @staticmethod
    def of(url: str, environment: Mapping[str, str] = os.environ) -> Mail:
        """Parse and check ``smtp[s]://[user@]host[:port]/recipient[,recipient]``. Raises UsageError."""
        try:
            parts = urlsplit(url)
            port, host, user = parts.port, parts.hostname, parts.username
        except ValueError:
            parts, port, host, user = urlsplit(""), None, None, None
        recipients = tuple(unquote(one).strip() for one in parts.path.strip("/").split(","))
        wrong = [one for one in recipients if not _ADDRESS.fullmatch(one)]
        if parts.scheme not in ("smtp", "smtps") or not host or port == 0 or wrong or parts.query or parts.fragment:
            raise option_wrong("must be smtp:// or smtps://, a host, and the recipients after a slash", "--mail",
                               "Use smtp://mail.example/chief@example.com,driller@example.com")
        if parts.password is not None:
            raise option_wrong("a password must not be in the address", "--mail",
                               f"Put it into a file, and name the file in {PASSWORD_FILE}")
        sender = environment.get(SENDER) or f"tdhil@{socket.getfqdn()}"
        if not _ADDRESS.fullmatch(sender):
            raise option_wrong("must be one address", f"{SENDER} {sender[:60]!r}")
        encrypted = parts.scheme == "smtps"
        return Mail(host, port or (465 if encrypted else 25), recipients, sender,
                    unquote(user) if user else None, encrypted,
                    read_password(PASSWORD_FILE, environment) if user else None)

    def at(self, site: str) -> Mail:
        """Return the same with the address of the service's pages."""
        return replace(self, site=site)

    def send(self, message: Mapping[str, Any]) -> None:
        """Send one message to all recipients. Raises OSError (SMTPException is one)."""
        context = ssl.create_default_context()
        with (smtplib.SMTP_SSL(self.host, self.port, timeout=TIMEOUT_S, context=context) if self.encrypted
              else smtplib.SMTP(self.host, self.port, timeout=TIMEOUT_S)) as server:
            server.ehlo()
            encrypted = self.encrypted
            if not encrypted and server.has_extn("starttls"):
                server.starttls(context=context)
                server.ehlo()
                encrypted = True
            if self.user is not None and self.password is not None:
                if not encrypted:
                    raise OSError("the server offers no encryption: the password is not sent")
                server.login(self.user, self.password)
            refused = server.send_message(self._written(message))
        if refused:
            raise OSError(f"refused for {', '.join(refused)}")

    def _written(self, message: Mapping[str, Any]) -> EmailMessage:
        """Return the e-mail on a message of `notifications`."""
        found, event = EmailMessage(), str(message["event"])
        marks = "".join(f" {mark.upper()}" for mark in ("simulated", "rehearsal", "uploaded") if message.get(mark))
        value, low, high = (message.get(name) for name in ("inertia_kg_m2", "low_kg_m2", "high_kg_m2"))
        interval = "" if value is None or low is None or high is None else f" ({printed_interval(low, high)})"
        figure = "" if value is None else f"J = {value:.4g}{interval} kg·m²"
        found["Subject"] = visible(
            f"tdhil: {message['rig']}{marks}: {_EVENTS.get(event, event)}{f', {figure}' if figure else ''}"
        )[:LONGEST_SUBJECT]
        found["From"], found["To"] = self.sender, ", ".join(self.recipients)
        found["Date"] = formatdate(localtime=True)
        found["Message-ID"] = make_msgid(domain=self.sender.rpartition("@")[2])
        found["Auto-Submitted"] = "auto-generated"         # RFC 3834: no automatic reply
        rows = [
            ("rig", f"{message['rig']}{marks}"), ("run", message["run"]), ("state", message.get("state")),
            ("exit code", message.get("exit_code")), ("verdict", message.get("verdict")), ("result", figure),
            ("quantity", message.get("quantity")), ("text", message.get("text")), ("requested", message.get("asked")),
            ("ended", message.get("ended")), ("page", f"{self.site}{message['path']}"),
        ]
        lines = [_MEANING.get(event, event), "", *(f"{name + ':':<11}{value}" for name, value in rows
                                                   if value not in (None, ""))]
        found.set_content(visible("\n".join(lines), keep="\n") + "\n")
        return found

    def __str__(self) -> str:
        return f"{', '.join(self.recipients)} by {self.host}:{self.port}"
