"""The audit: requests, confirmations, stops and downloads, with user and time. A chain of lines, sealed with a key.

::

    audit/<year>-<month>.jsonl     one line per entry, with the hash of the line before and its own hash
    audit/head.json                number and hash of the last line, sealed
    audit.lock                     held by the web while it writes a line, so that a reader sees whole entries
    audit.key                      the key, and the anchor: number and hash of the last line; mode 0600

A line's hash is an HMAC-SHA256 with the key. Without the key, each of these changes is detected: a line was changed,
removed, inserted or added; lines were cut off at the end, also with a rewritten or an older head.json; the whole folder
`audit` was deleted or replaced by an older copy.

Limits: a user of this computer who can read ``audit.key`` (the service's own user, root) can write another valid chain.
If ``audit.key`` is deleted together with the folder, a new chain begins. If only the key is deleted, and the lines are
written anew without a key, they count as lines from before the first key. Then the time of the key, and the line "audit
key made", are too late. Only a head that was exported before reveals each of these: `Audit.verify` takes it. So export
it from time to time, to another computer.
"""

from __future__ import annotations

import errno
import hashlib
import hmac
import json
import os
import re
import secrets
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from tdhil.errors import UsageError
from tdhil.service.run_state import now
from tdhil.service.store import read_json, write_json

KEY_FILE: Final = "audit.key"
LOCK_FILE: Final = "audit.lock"
FIRST: Final = "0" * 64
_FILES: Final = "????-??.jsonl"
_HEAD: Final = re.compile(r"([0-9]{1,12}):([0-9a-f]{64})")


@dataclass(frozen=True)
class Entry:
    """One line of the audit. ``details``: data that JSON can express."""

    number: int
    at: str
    who: str
    what: str
    run: str | None
    rig: str | None
    details: Mapping[str, Any] = field(default_factory=dict)
    before: str = FIRST
    hash: str = ""


_Line = tuple[str, int, Entry | str]
"""A line of the chain: its file, its number there (from 1), and its entry, or why it has none."""


@dataclass(frozen=True)
class Broken:
    """Place where the chain is broken: the file, its line (from 1), and the reason."""

    file: str
    line: int
    why: str


@dataclass(frozen=True)
class ChainHead:
    """The last line of a chain: its number and its hash."""

    number: int
    hash: str

    def __str__(self) -> str:
        return f"{self.number}:{self.hash}"

    @staticmethod
    def of(text: str) -> ChainHead:
        """Parse an exported head, ``NUMBER:HASH``. Raises UsageError."""
        found = _HEAD.fullmatch(text.strip())
        if found is None:
            raise UsageError("is not a head of an audit", where=f"head {text[:80]!r}",
                             next_step="Give NUMBER:HASH, as tdhil serve audit prints it")
        return ChainHead(int(found[1]), found[2])


@dataclass(frozen=True)
class _Seal:
    """The key and the anchor. ``plain``: number of lines older than the key; their hashes are made without it."""

    key: bytes
    made: str
    plain: int
    anchor: ChainHead

    def hash_of(self, entry: Entry) -> str:
        """Return the hash that the line must have."""
        plain = {name: value for name, value in asdict(entry).items() if name != "hash"}
        text = json.dumps(plain, ensure_ascii=False, sort_keys=True).encode()
        return hashlib.sha256(text).hexdigest() if entry.number <= self.plain else self._mac(b"line", text)

    def of_head(self, head: ChainHead) -> str:
        """Return the seal of a head."""
        return self._mac(b"head", str(head).encode())

    def _mac(self, kind: bytes, text: bytes) -> str:
        return hmac.new(self.key, kind + b" " + text, hashlib.sha256).hexdigest()


class Audit:
    """The chain of one service. Only one process writes it: the web."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._key_path = folder.parent / KEY_FILE
        self._lock = threading.Lock()
        self._seal: _Seal | None = None
        self._last: ChainHead | None = None

    def begin(self) -> None:
        """Make the key if there is none. Lines from before it are accepted unchecked. Raises OSError."""
        with self._lock, self._alone(write=True):
            self._sealed()

    def note(
        self, who: str, what: str, *, run: str | None = None, rig: str | None = None, **details: Any
    ) -> None:
        """Add a line. It is on the disk when this returns. Raises OSError."""
        with self._lock, self._alone(write=True):
            self._add(self._sealed(), who, what, run, rig, details)

    def head(self) -> ChainHead | None:
        """Return the last line, for export; None if there is none, or if the chain's end is broken."""
        with self._lock, self._alone():
            return self._head(self._seal or self._read(), self.entries())

    def made(self) -> str | None:
        """Return when the key was made; None without a key. A time after the first line means: the key was replaced."""
        seal = self._seal or self._read()
        return None if seal is None else seal.made

    def entries(self) -> Iterator[Entry]:
        """Yield all readable entries in order."""
        yield from _readable(self._lines())

    def last_details(self, what: str, run: str) -> Mapping[str, Any] | None:
        """Return the details of the last entry of this kind for a run whose own hash is right; None without one."""
        marks, found = f'"what": {json.dumps(what)}, "run": {json.dumps(run)},'.encode(), None
        with self._lock, self._alone():
            seal = self._seal or self._read()
            for path in sorted(self._folder.glob(_FILES)):
                with path.open("rb") as file:
                    # only the lines with these words are parsed: an audit has years of lines
                    entries = [one for line in file if marks in line and isinstance(one := _entry(line), Entry)]
                for one in entries:
                    if (one.what, one.run) == (what, run) and seal is not None and hmac.compare_digest(
                            seal.hash_of(one).encode(), one.hash.encode()):
                        found = one.details
        return found

    def verify(self, kept: ChainHead | None = None) -> Broken | None:
        """Return the first place where a line was changed, removed or inserted; None if the chain is intact.

        ``kept``: a head that was exported before. It must be one of the lines.
        """
        with self._lock, self._alone():
            return self._verify(self._seal or self._read(), kept, self._lines())

    def examined(self, kept: ChainHead | None = None) -> tuple[list[Entry], Broken | None, ChainHead | None]:
        """Return `entries`, `verify` and `head` of one reading of the files."""
        with self._lock, self._alone():
            seal, lines = self._seal or self._read(), list(self._lines())
            entries = list(_readable(lines))
            return entries, self._verify(seal, kept, lines), self._head(seal, entries)

    def _head(self, seal: _Seal | None, entries: Iterable[Entry]) -> ChainHead | None:
        found = None if seal is None else self._end(seal, entries)
        return found if found is not None and found.number > 0 else None

    def _verify(self, seal: _Seal | None, kept: ChainHead | None, lines: Iterable[_Line]) -> Broken | None:
        number, before, earlier, at, found = 0, FIRST, FIRST, ("", 0), kept is None
        for file, line, entry in lines:
            if isinstance(entry, str):
                return Broken(file, line, entry)
            if seal is None:
                return Broken(file, line, f"the key of the chain can't be read ({KEY_FILE})")
            if entry.number != number + 1 or entry.before != before:
                return Broken(file, line, "it doesn't follow the line before")
            if not hmac.compare_digest(seal.hash_of(entry).encode(), entry.hash.encode()):
                return Broken(file, line, "it was changed after it was written, or written without the key")
            number, earlier, before, at = entry.number, before, entry.hash, (file, line)
            found = found or ChainHead(number, before) == kept
        if not found and kept is not None:
            return Broken(*at, f"line {kept.number} differs from the exported head")
        if seal is None:
            return None
        # A killed process may leave a line without its head or anchor, but never a head without its line.
        ends = (ChainHead(number, before), ChainHead(number - 1, earlier))
        if seal.anchor not in ends:
            return Broken(*at,
                          f"the chain ends with line {number}, but {KEY_FILE} records line {seal.anchor.number}")
        plain = read_json(self._folder / "head.json") or {}
        head = ChainHead(plain.get("number", 0), plain.get("hash", FIRST))
        mac = plain.get("mac")
        # A head from before the first key has no seal.
        sealed = isinstance(mac, str) and hmac.compare_digest(mac.encode(), seal.of_head(head).encode())
        if head not in ends or not (sealed or head.number <= seal.plain):
            return Broken(*at, f"the chain ends with line {number}, but head.json names another head")
        return None

    @contextmanager
    def _alone(self, *, write: bool = False) -> Iterator[None]:
        """Let no other process write the chain meanwhile: line, head and anchor change one after the other.

        A copy of the chain that can't be locked, such as on a read-only medium, is read without a lock.
        """
        descriptor = None
        with suppress(OSError, ImportError):
            import fcntl

            flags = os.O_RDWR | os.O_CREAT if write else os.O_RDONLY
            descriptor = os.open(self._key_path.with_name(LOCK_FILE), flags | os.O_CLOEXEC, 0o600)
            fcntl.flock(descriptor, fcntl.LOCK_EX if write else fcntl.LOCK_SH)
        try:
            yield
        finally:
            if descriptor is not None:
                os.close(descriptor)

    def _add(
        self, seal: _Seal, who: str, what: str, run: str | None, rig: str | None, details: Mapping[str, Any]
    ) -> None:
        last = self._last or self._end(seal, self.entries()) or seal.anchor        # a broken end is never repaired
        at = now()
        entry = Entry(last.number + 1, at, who[:80], what, run, rig, details, last.hash)
        entry = replace(entry, hash=seal.hash_of(entry))
        with (self._folder / f"{at[:7]}.jsonl").open("ab") as file:
            file.write(json.dumps(asdict(entry), ensure_ascii=False).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        self._last = head = ChainHead(entry.number, entry.hash)
        self._seal = replace(seal, anchor=head)
        write_json(self._folder / "head.json", {**asdict(head), "mac": seal.of_head(head)})
        self._write(self._seal)

    def _sealed(self) -> _Seal:
        """Return the seal; make one if there is none. Raises OSError if it can't be read or written."""
        if self._seal is None:
            self._seal = self._read()
        if self._seal is None:
            if self._key_path.exists():
                raise OSError(errno.EINVAL, "the audit's key can't be read", str(self._key_path))
            last = ChainHead(0, FIRST)
            for entry in self.entries():
                last = ChainHead(entry.number, entry.hash)
            seal = _Seal(secrets.token_bytes(32), now(), last.number, last)
            self._write(seal)
            self._seal = seal
            if last.number:
                self._add(seal, "service", "audit key made", None, None, {"lines_before": last.number})
        return self._seal

    def _read(self) -> _Seal | None:
        plain = read_json(self._key_path)
        try:
            assert plain is not None
            seal = _Seal(bytes.fromhex(plain["key"]), str(plain["made"]), int(plain["plain"]),
                         ChainHead(int(plain["number"]), str(plain["hash"])))
        except (AssertionError, KeyError, TypeError, ValueError):
            return None
        return seal if len(seal.key) == 32 else None

    def _write(self, seal: _Seal) -> None:
        plain = {"key": seal.key.hex(), "made": seal.made, "plain": seal.plain, **asdict(seal.anchor)}
        write_json(self._key_path, plain, mode=0o600)

    @staticmethod
    def _end(seal: _Seal, entries: Iterable[Entry]) -> ChainHead | None:
        """Return the last line, if it is the anchor or follows it; None if the end is broken."""
        last: Entry | None = None
        for entry in entries:
            last = entry
        if last is None:
            return seal.anchor if seal.anchor.number == 0 else None
        found = ChainHead(last.number, last.hash)
        follows = last.number == seal.anchor.number + 1 and last.before == seal.anchor.hash
        good = found == seal.anchor or (
            follows and hmac.compare_digest(seal.hash_of(last).encode(), last.hash.encode()))
        return found if good else None

    def _lines(self) -> Iterator[_Line]:
        for path in sorted(self._folder.glob(_FILES)):
            with path.open("rb") as file:
                for line, text in enumerate(file, start=1):
                    yield path.name, line, _entry(text)


def _readable(lines: Iterable[_Line]) -> Iterator[Entry]:
    return (one for _, _, one in lines if isinstance(one, Entry))


def _entry(text: bytes) -> Entry | str:
    try:
        plain = json.loads(text)
        if text != json.dumps(plain, ensure_ascii=False).encode() + b"\n":
            return "it was changed after it was written"
        found = Entry(**plain)
        right = isinstance(found.number, int) and isinstance(found.hash, str) and isinstance(found.details, Mapping)
        return found if right else "it can't be read"
    except (ValueError, TypeError, RecursionError):
        return "it can't be read"
