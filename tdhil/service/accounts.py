"""Accounts: users with passwords, machines with tokens; `accounts.json` in the service's folder.

The file keeps scrypt hashes of passwords and hashes of tokens. The web reads the file once a second in a thread. If it
can't be read, the last content stays in force. No request waits for a disk.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import re
import secrets
import threading
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, get_args

from tdhil.errors import LogError, MessageCode, UsageError
from tdhil.service.run_state import NotThere, now
from tdhil.service.store import write_json

Role = Literal["viewer", "operator", "engineer", "admin"]
ROLES: Final[tuple[Role, ...]] = get_args(Role)
"""Roles from least to most rights; each includes the rights of those before it."""
FILE: Final = "accounts.json"
NAME: Final = re.compile(r"[a-z0-9][a-z0-9._-]{0,31}")
_RESERVED: Final = frozenset({"local", "service", "somebody", "nobody", "terminal"})
"""Reserved names: the audit uses them for entries that are not from users."""
SHORTEST: Final = 10
"""Shortest password, characters."""
LONGEST: Final = 200
_N, _R, _P, _BYTES = 2**15, 8, 3, 32
_MOST_N, _MOST_R, _MOST_P = 2**17, 16, 8
TOKEN: Final = "tdhil_"


def role_at_least(role: Role) -> frozenset[str]:
    """Return the role and all roles below it."""
    return frozenset(ROLES[: ROLES.index(role) + 1])


@dataclass(frozen=True)
class User:
    """A user. ``password``: hash from `scrypt`; ``since``: time when it was set. Earlier sessions are invalid."""

    name: str
    role: Role
    password: str
    since: str


@dataclass(frozen=True)
class Token:
    """A machine's token. ``sha256``: hash of the token; the token itself was shown once."""

    name: str
    role: Role
    sha256: str
    since: str


@dataclass(frozen=True)
class Accounts:
    """All users and tokens, by name."""

    users: Mapping[str, User] = field(default_factory=dict)
    tokens: Mapping[str, Token] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.users or self.tokens)

    def of_token(self, token: str) -> Token | None:
        """Return the entry of this token; None if it is unknown."""
        digest = hashlib.sha256(token.encode()).hexdigest()
        return next((one for one in self.tokens.values() if hmac.compare_digest(one.sha256, digest)), None)


def scrypt(password: str) -> str:
    """Return the hash of a password, ``scrypt$N$r$p$salt$key`` (RFC 7914): 32 MB, about 0.3 s."""
    salt = secrets.token_bytes(16)
    return f"scrypt${_N}${_R}${_P}${salt.hex()}${_derive(password, salt, _N, _R, _P).hex()}"


def matches(password: str, kept: str | None) -> bool:
    """Return whether the password is correct. An unknown name takes as long, so that the time reveals no names."""
    nobody = f"scrypt${_N}${_R}${_P}${bytes(16).hex()}${bytes(_BYTES).hex()}"
    kind, n, r, p, salt, key = (kept or nobody).split("$")
    found = _derive(password[:LONGEST], bytes.fromhex(salt), int(n), int(r), int(p))
    good = kept is not None and kind == "scrypt" and len(password) <= LONGEST
    return hmac.compare_digest(found, bytes.fromhex(key)) and good


def _derive(password: str, salt: bytes, n: int, r: int, p: int) -> bytes:
    given = unicodedata.normalize("NFKC", password).encode("utf-8", "surrogatepass")
    return hashlib.scrypt(given, salt=salt, n=n, r=r, p=p, dklen=_BYTES, maxmem=2 * 128 * n * r + 2**20)


class AccountNameRefused(UsageError):
    """The name of an account is refused."""

    entry = MessageCode.ACCOUNT_WRONG


class PasswordRefused(UsageError):
    """A new password is refused."""

    entry = MessageCode.ACCOUNT_WRONG


def require_password(password: str, name: str) -> None:
    """Raise PasswordRefused for a password that is too easy to guess."""
    if not SHORTEST <= len(password) <= LONGEST:
        raise PasswordRefused(f"must have {SHORTEST} to {LONGEST} characters", where="password",
                              next_step="Use a few words that don't belong together")
    if password.lower().strip("0123456789 !.") in (name, "password", "tdhil") or len(set(password)) < 5:
        raise PasswordRefused("is too easy to guess", where="password",
                              next_step="Use a few words that don't belong together")


def _require_name(name: str) -> None:
    if not NAME.fullmatch(name) or name in _RESERVED:
        raise AccountNameRefused("must be 1 to 32 of a-z, 0-9, '.', '_' and '-', and none of the audit's own names"
                                 f" ({', '.join(sorted(_RESERVED))})", where=f"name {name[:40]!r}")


# ---------------------------------------------------------------------------------------------------------------------


class AccountsFile:
    """The accounts file; any thread and any process may use it. A change holds a lock."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        self._stamp: tuple[int, ...] | None = None
        self._known = Accounts()
        self._lock = threading.RLock()

    @property
    def known(self) -> Accounts:
        """Return the accounts of the last reading, without access to the file."""
        return self._known

    def read(self) -> Accounts:
        """Read the accounts from the present file. Raises UsageError if it can't be read; `known` stays unchanged."""
        with self._lock:
            try:
                looked = self.path.stat()
                stamp = (looked.st_mtime_ns, looked.st_size, looked.st_ino)
                if stamp != self._stamp:
                    self._known, self._stamp = _accounts_of(self.path.read_bytes()), stamp
            except (FileNotFoundError, NotADirectoryError):
                if self._stamp is not None:        # the file existed before: its deletion does not remove the users
                    raise UsageError("the accounts file has disappeared", where=str(self.path),
                                     next_step="Restore it") from None
            except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
                raise UsageError(f"the accounts can't be read ({str(error)[:100]})", where=str(self.path),
                                 next_step="Restore a copy, or delete it and add the users again") from error
            return self._known

    def changed(self) -> tuple[Accounts, Accounts]:
        """Return the accounts before and now; they differ if another process changed them. Raises UsageError."""
        with self._lock:
            return self._known, self.read()

    def add_user(self, name: str, role: Role, password: str) -> User:
        """Add a user. Raises UsageError for an unacceptable name or password."""
        _require_name(name)
        require_password(password, name)
        made = User(name, role, scrypt(password), now())
        with self._changing() as accounts:
            if name in accounts.users:
                raise UsageError("this user already exists", where=name,
                                 next_step="Remove the user first, or set a password", entry=MessageCode.ACCOUNT_WRONG)
            self._write(replace(accounts, users={**accounts.users, name: made}))
        return made

    def set_password(self, name: str, password: str) -> User:
        """Set a password, and end all sessions of the user. Raises NotThere and UsageError."""
        require_password(password, name)
        kept = scrypt(password)
        with self._changing() as accounts:
            made: User = replace(_there(accounts.users, name), password=kept, since=now())
            self._write(replace(accounts, users={**accounts.users, name: made}))
        return made

    def remove_user(self, name: str, *, keep_admin: bool = False) -> None:
        """Remove a user. Raises NotThere; with ``keep_admin`` UsageError for the last admin."""
        with self._changing() as accounts:
            gone = _there(accounts.users, name)
            left = {one: user for one, user in accounts.users.items() if one != name}
            if keep_admin and gone.role == "admin" and all(one.role != "admin" for one in left.values()):
                raise UsageError("is the last admin", where=name, next_step="Use tdhil serve users remove",
                                 entry=MessageCode.ACCOUNT_WRONG)
            self._write(replace(accounts, users=left))

    def add_token(self, name: str, role: Role) -> str:
        """Add a token and return it. Only its hash is stored. Raises UsageError."""
        _require_name(name)
        token = TOKEN + secrets.token_urlsafe(32)
        made = Token(name, role, hashlib.sha256(token.encode()).hexdigest(), now())
        with self._changing() as accounts:
            if name in accounts.tokens:
                raise UsageError("this token already exists", where=name, next_step="Remove it first",
                                 entry=MessageCode.ACCOUNT_WRONG)
            self._write(replace(accounts, tokens={**accounts.tokens, name: made}))
        return token

    def remove_token(self, name: str) -> None:
        """Remove a token. Raises NotThere."""
        with self._changing() as accounts:
            _there(accounts.tokens, name)
            self._write(replace(accounts, tokens={one: it for one, it in accounts.tokens.items() if one != name}))

    @contextmanager
    def _changing(self) -> Iterator[Accounts]:
        """Lock the file against other changes, also from a terminal. Raises LogError if the folder can't be written."""
        import fcntl

        try:
            descriptor = os.open(self.path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise LogError(f"can't be written ({error.strerror or error})", where=str(self.path.parent),
                           next_step="Check the folder of the service") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield self.read()
        finally:
            os.close(descriptor)

    def _write(self, accounts: Accounts) -> None:
        with self._lock:                   # so that this does not count as another process's change
            try:
                write_json(self.path, {
                    "users": {name: _plain(one) for name, one in sorted(accounts.users.items())},
                    "tokens": {name: _plain(one) for name, one in sorted(accounts.tokens.items())},
                }, mode=0o600)
                if os.geteuid() == 0:      # written by root: the service's own user must be able to read it
                    owner = self.path.parent.stat()
                    for path in (self.path, self.path.with_suffix(".lock")):
                        os.chown(path, owner.st_uid, owner.st_gid)
            except OSError as error:
                raise LogError(f"can't be written ({error.strerror or error})", where=str(self.path)) from error
            self.read()


def _plain(one: User | Token) -> dict[str, Any]:
    return {name: value for name, value in asdict(one).items() if name != "name"}


def _there(found: Mapping[str, Any], name: str) -> Any:
    if name not in found:
        raise NotThere("this account does not exist", where=name[:40],
                       next_step=f"Accounts: {', '.join(found) or 'none'}")
    return found[name]


def _accounts_of(data: bytes) -> Accounts:
    """Parse the accounts. Raises ValueError, TypeError or KeyError for other data."""
    plain = json.loads(data)
    users = {name: User(name, **one) for name, one in plain["users"].items()}
    tokens = {name: Token(name, **one) for name, one in plain["tokens"].items()}
    everybody: tuple[User | Token, ...] = (*users.values(), *tokens.values())
    for one in everybody:
        if not NAME.fullmatch(one.name) or one.role not in ROLES or not isinstance(one.since, str):
            raise ValueError(f"{one.name[:40]!r} is not a valid account")
    for user in users.values():
        kind, n, r, p, salt, key = user.password.split("$")
        sane = 0 < int(n) <= _MOST_N and 0 < int(r) <= _MOST_R and 0 < int(p) <= _MOST_P
        if kind != "scrypt" or not sane or len(bytes.fromhex(salt)) < 16 or len(bytes.fromhex(key)) != _BYTES:
            raise ValueError(f"the password hash of {user.name} is not valid")
    for token in tokens.values():
        if not re.fullmatch(r"[0-9a-f]{64}", token.sha256):
            raise ValueError(f"the hash of token {token.name} is not valid")
    return Accounts(users, tokens)
