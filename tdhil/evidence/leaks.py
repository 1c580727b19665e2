"""Texts that must not leave a site: paths, addresses of computers and persons, logins, keys and passwords.

One table serves both directions. `without_leaks` removes them from a text; `leaks_in` finds what is left in any bytes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

_SECRET = r"(?:pass(?:word|wd|phrase)|secret|token|api_?key|credential|authori[sz]ation)\w*"


@dataclass(frozen=True)
class Leak:
    """A kind of text that identifies a person or a computer. ``mark``: what stands in its place."""

    kind: str
    pattern: re.Pattern[str]
    mark: str


def _leak(kind: str, pattern: str, mark: str) -> Leak:
    return Leak(kind, re.compile(pattern, re.IGNORECASE), mark)


LEAKS: Final = (
    _leak("private key", r"-----BEGIN [A-Z ]{0,30}PRIVATE KEY-----(?:.{0,8000}?-----END [A-Z ]{0,30}PRIVATE KEY-----)?",
          "<key>"),
    _leak("access key", r"\b(?:AKIA|ASIA)[0-9A-Z]{16}\b|\bgh[opsu]_[0-9A-Za-z]{20,}|\btdhil_[0-9A-Za-z_-]{20,}",
          "<key>"),
    _leak("web token", r"\beyJ[\w-]{8,}\.[\w-]{8,}\.[\w-]{8,}|\bbearer\s+[\w.~+/-]{12,}=*", "<key>"),
    _leak("password", rf"(?<![\w<]){_SECRET}[\"']?\s*[:=]\s*[\"']?(?!<key>|null|false|true)[^\s\"',;}}<]+", "<key>"),
    _leak("address with a login", r"\b[a-z][a-z0-9+.-]*://[^/@\s\"'<>]+@[^\s\"'<>]*", "<address>"),
    _leak("e-mail address", r"\b[\w.+-]+@[\w-]+(?:\.[\w-]+)+", "<address>"),
    _leak("path", r"(?<![\w.)\]>/:*^])/(?:[^/\s\"':;,()<>|`]+/)+[^/\s\"':;,()<>|`]*|(?<!\w)~/[^\s\"':;,()<>]+",
          "<path>"),
    _leak("path", r"(?<!\w)[a-z]:(?:\\+|/)(?![/\s])[^\s\"':;,()<>|]+|\\\\[\w.-]+\\[^\s\"':;,()<>|]+", "<path>"),
    _leak("path", r"file://[^\s\"'<>]+", "<path>"),
    _leak("IP address", r"(?<![\w.])(?:(?:25[0-5]|2[0-4]\d|1?\d?\d)\.){3}(?:25[0-5]|2[0-4]\d|1?\d?\d)(?![\w.]*\w)",
          "<address>"),
    _leak("IP address", r"(?<![\w:.])(?:[0-9a-f]{1,4}:){4,7}[0-9a-f]{1,4}(?![\w:])|"
          r"(?<![\w:])[0-9a-f]{1,4}(?::[0-9a-f]{1,4})*::(?:[0-9a-f]{1,4}(?::[0-9a-f]{1,4})*)?(?![\w:])", "<address>"),
    _leak("MAC address", r"(?<![\w:-])[0-9a-f]{2}(?:([:-])[0-9a-f]{2})(?:\1[0-9a-f]{2}){4}(?![\w:-])", "<address>"),
    _leak("name of a computer", r"(?<![\w.-])[\w-]+(?:\.[\w-]+)*\.(?:local|lan|internal|intranet|corp|localdomain)\b",
          "<address>"),
    _leak("file", r"(?<![\w./-])(?!(?:rig|run|plant|string|calibration|excitation|result)\.)[\w+-][\w.+-]*"
          r"\.(?:ya?ml|mcap|csv)\b(?!\w)", "<file>"),
)
"""Kinds of leaks, in the order of their removal."""


def without_leaks(text: str) -> str:
    """Return the text with a mark in place of each leak. A text without leaks is returned unchanged."""
    for one in LEAKS:
        text = one.pattern.sub(one.mark, text)
    return text


def leaks_in(texts: Iterable[str]) -> tuple[str, ...]:
    """Return the kinds of leaks in these texts, each once. The text itself is not returned: a message may show it."""
    found: dict[str, None] = {}
    for text in texts:
        for one in LEAKS:
            if one.kind not in found and one.pattern.search(text):
                found[one.kind] = None
    return tuple(found)


_PRINTABLE: Final = re.compile(rb"[\x20-\x7e\t\r\n\x80-\xff]{6,}")


def texts_in(data: bytes) -> list[str]:
    """Return the runs of printable characters in a record that declares a schema or a channel."""
    return [found.decode("utf-8", "replace") for found in _PRINTABLE.findall(data)]
