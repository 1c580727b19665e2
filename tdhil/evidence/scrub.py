"""Removal of data that identify a person, a computer or a place from texts and from plain data."""

from __future__ import annotations

import getpass
import json
import re
import socket
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from tdhil.config import STATED

SECRET: Final = re.compile(
    r"pass(word|wd|phrase)?|secret|token|api_?key|credential|authori[sz]ation|private", re.IGNORECASE)
"""Names of settings whose values are secrets."""
GONE: Final = "<removed>"

_PERSON = frozenset(STATED) - {"note"}
_HOMES = re.compile(r"((?:/home|/Users|[A-Za-z]:\\+Users)[/\\]+)[^/\\\s'\":;,]+")
_LOGIN = re.compile(r"(\w+://)[^/@\s]+@")
_ASSIGNED = re.compile(rf"((?:{SECRET.pattern})\w*\s*[:=]\s*)[^\s,}}]+", re.IGNORECASE)
_SHORTEST_NAME = 4
"""Shortest name that is removed, characters; a shorter one occurs within other words."""


class Scrub:
    """Removes data of the sender: home folders, the names of user and computer, operators, logins, secrets."""

    def __init__(self, *, home: str, names: Iterable[str]) -> None:
        self._home = home if len(home) > 1 else ""
        words = sorted({re.escape(name) for name in names if len(name) >= _SHORTEST_NAME}, key=len, reverse=True)
        self._names = re.compile(rf"(?<![A-Za-z0-9])(?:{'|'.join(words)})(?![A-Za-z0-9])") if words else None

    @classmethod
    def of_this_computer(cls) -> Scrub:
        """Return the scrubber for this computer. Names with another meaning in a log (root, user) are kept."""
        return cls(home=str(Path.home()), names=names_of_this_computer())

    def text(self, text: str) -> str:
        """Scrub one text."""
        if self._home:
            text = text.replace(self._home, "~")
        text = _HOMES.sub(r"\1<user>", text)
        text = _LOGIN.sub(rf"\1{GONE}@", text)
        text = _ASSIGNED.sub(lambda found: found[1] + GONE, text)
        return self._names.sub("<name>", text) if self._names is not None else text

    def value(self, value: Any, key: str = "") -> Any:
        """Scrub plain data at all levels."""
        if value not in (None, "") and isinstance(key, str) and (SECRET.search(key) or key in _PERSON):
            return GONE
        if isinstance(value, str):
            return self.text(value)
        if isinstance(value, Mapping):
            return {self.text(str(name)): self.value(one, str(name)) for name, one in value.items()}
        if isinstance(value, list | tuple):
            return [self.value(one) for one in value]
        return value

    def message(self, channel: int, payload: bytes) -> bytes:
        """Scrub the texts of a log's message; its numbers stay."""
        from google.protobuf.descriptor import FieldDescriptor

        from tdhil.recording import CHANNELS, CLASSES, COMMAND, EXCITATION, RAW_FRAMES, SAMPLE, VIRTUAL_STRING

        if channel in RAW_FRAMES | {SAMPLE, COMMAND, EXCITATION, VIRTUAL_STRING}:
            return payload
        message = CLASSES[CHANNELS[channel][1]].FromString(payload)
        for field in message.DESCRIPTOR.fields:
            if field.type != FieldDescriptor.TYPE_STRING:
                continue
            text = getattr(message, field.name)
            try:
                text = json.dumps(self.value(json.loads(text)), ensure_ascii=False) if field.name == "json" else None
            except ValueError:
                text = None
            setattr(message, field.name, self.text(getattr(message, field.name)) if text is None else text)
        scrubbed: bytes = message.SerializeToString()
        return scrubbed


def names_of_this_computer() -> tuple[str, ...]:
    """Return the names of the user and of this computer, without those that have another meaning in a log."""
    names = []
    with suppress(Exception):      # no entry for this user, and no variables
        names.append(getpass.getuser())
    with suppress(OSError):
        names.append(socket.gethostname())
    return tuple(name for name in names if name not in ("root", "user", "localhost"))
