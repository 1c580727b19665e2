"""Identity and rights of a client: by a session cookie, by a machine's token, or on this computer itself.

All data is in memory: no request, and above all no stop, waits for a file here.

* Without accounts, on loopback: every user of this computer has every role.
* With accounts: a login is required. After its end, the page of that login may still stop a run, and nothing else.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from starlette.authentication import AuthCredentials
from starlette.requests import HTTPConnection
from starlette.responses import Response

from tdhil.errors import TdhilError
from tdhil.service.accounts import ROLES, Accounts, AccountsFile, Role, User, matches, role_at_least
from tdhil.service.run_state import NotAllowed, NotLoggedIn, TooManyRuns, TooManyTries
from tdhil.service.schemas import CSRF_HEADER
from tdhil.service.store import read_json, write_json

SESSION_S: Final = 12 * 3600.0
"""Duration of a login, s: one shift."""
STOPS_S: Final = 7 * 86400.0
"""Time after its end in which a session's page can still stop, s."""
READ_S: Final = 1.0
SOCKET_LOOK_S: Final = 2.0
"""Interval at which the rights of an open socket are checked, s."""
COOKIE: Final = "__Host-tdhil"
CSRF_COOKIE: Final = "__Host-tdhil-csrf"
STOPS: Final = frozenset({"stop", "stop_rig"})
"""Routes that are never refused to a known client."""
_MOST_SESSIONS: Final = 5000
_PROXIES: Final = ("forwarded", "x-forwarded-for", "x-real-ip", "via")
_ENGINEER_OPTIONS: Final = ("accept_unverified", "accept_wider_limit", "accept_speed_unit")
Say = Callable[[str], None]


@dataclass(frozen=True)
class Principal:
    """A client. ``name`` appears in the audit; ``session``: id of its login, '' for a token and on this computer.

    ``known``: identified by a password or a token. ``csrf``: the token that a change must contain, '' if none.
    """

    name: str
    roles: frozenset[str]
    known: bool = False
    may_stop: bool = True
    session: str = ""
    csrf: str = ""


LOCAL: Final = Principal("local", frozenset(ROLES))
NOBODY: Final = Principal("nobody", frozenset(), may_stop=False)


@dataclass(frozen=True)
class Session:
    """A login. ``since``: time when its password was set; times in s, as of `time.time`."""

    user: str
    since: str
    begun_s: float
    ends_s: float


class Tries:
    """Limits of password tries in a minute. One address has 5 tries for one name, and 20 for all names.

    All addresses that never logged in with a name have 30 tries together for it. So an attacker elsewhere never blocks
    a login from a known address, but may block one from a new address while the attack lasts.
    """

    WINDOW_S: Final = 60.0
    OF_PAIR, OF_ADDRESS, OF_NAME = 5, 20, 30
    _MOST = 20_000

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._tried: dict[tuple[str, ...], deque[float]] = {}
        self._good: set[tuple[str, str]] = set()
        self._lock = threading.Lock()

    def begin(self, name: str, address: str) -> None:
        """Count one password try before the check of the password. Raises TooManyTries."""
        with self._lock:
            now_s = self._clock()
            if len(self._tried) > self._MOST:
                self._tried = {key: times for key, times in self._tried.items() if now_s - times[-1] < self.WINDOW_S}
            counts = [(("pair", name, address), self.OF_PAIR), (("address", address), self.OF_ADDRESS)]
            if (name, address) not in self._good:
                counts.append((("name", name), self.OF_NAME))
            times = [(self._tried.setdefault(key, deque(maxlen=most)), most) for key, most in counts]
            waits = [self.WINDOW_S - (now_s - one[0]) for one, most in times if len(one) == most]
            if (wait_s := max(waits, default=0.0)) > 0.0:
                raise TooManyTries(max(wait_s, 1.0))
            for one, _ in times:
                one.append(now_s)

    def good(self, name: str, address: str) -> None:
        """Record a correct password."""
        with self._lock:
            if len(self._good) > self._MOST:
                self._good.clear()
            self._good.add((name, address))
            self._tried.pop(("pair", name, address), None)


class RequestPace:
    """Limits of requested runs that show a code, for one user and for one address.

    A run accepts three wrong codes. So a user has at most 120 tries a day for one of a million codes. Each requested
    run appears on the terminal at the rig and in the audit.
    """

    LIMITS: Final = ((600.0, 10, 30), (86_400.0, 40, 120))
    """(window in s, runs of a user, runs of an address)."""
    _MOST = 10_000

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._begun: dict[tuple[str, str], deque[float]] = {}
        self._lock = threading.Lock()

    def begin(self, who: str, address: str, rig: str) -> None:
        """Count one request. Raises TooManyRuns above the limit; such a request is not counted."""
        with self._lock:
            now_s = self._clock()
            longest_s = self.LIMITS[-1][0]
            if len(self._begun) > self._MOST:
                self._begun = {key: times for key, times in self._begun.items() if now_s - times[-1] < longest_s}
            wait_s, counts = 0.0, []
            for key in (("user", who), ("address", address)):
                times = self._begun.get(key, deque())
                counts.append((key, times))
                for window_s, of_user, of_address in self.LIMITS:
                    most = of_user if key[0] == "user" else of_address
                    if len(times) >= most:
                        wait_s = max(wait_s, window_s - (now_s - times[-most]))
            if wait_s > 0.0:
                raise TooManyRuns(max(wait_s, 1.0), rig)
            for key, times in counts:
                times.append(now_s)
                while now_s - times[0] >= longest_s:
                    times.popleft()
                self._begun[key] = times


class Access:
    """The access control of one service, for any thread. ``login``: accounts exist, and a login is required."""

    def __init__(
        self, folder: Path, *, login: bool = False, say: Say = lambda text: None,
        clock: Callable[[], float] = time.time, changed: Callable[[str, str], None] = lambda what, name: None,
    ) -> None:
        self.login = login
        self.accounts = AccountsFile(folder)
        self.tries = Tries()
        self._path = folder / "sessions.json"
        self._say, self._clock, self.changed = say, clock, changed
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._sessions: dict[str, Session] = {}
        for name, one in (read_json(self._path) or {}).items():
            with suppress(TypeError, ValueError):
                kept = Session(**one)
                if isinstance(kept.user, str) and isinstance(kept.since, str):
                    self._sessions[name] = Session(kept.user, kept.since, float(kept.begun_s), float(kept.ends_s))
        self._trouble = ""
        self._end = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Read the accounts, and again every second."""
        self.refresh(first=True)
        self._thread = threading.Thread(target=self._look, name="accounts", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._end.set()
        if self._thread is not None:
            self._thread.join(5.0)

    def _look(self) -> None:
        while not self._end.wait(READ_S):
            self.refresh()

    def refresh(self, *, first: bool = False) -> None:
        """Read the accounts if they have changed. If they can't be read, the former accounts stay in force."""
        try:
            before, found = self.accounts.changed()
        except TdhilError as error:
            if str(error) != self._trouble:
                self._trouble = str(error)
                self._say(f"the accounts can't be read, the former ones stay in force: {error}")
            return
        self._trouble = ""
        if found is not before and not first:
            for what, name in _differences(before, found):
                self.changed(what, name)

    # -- the client --------------------------------------------------------------------------------------------------

    def who(self, connection: HTTPConnection) -> Principal:
        """Return the client, without access to a file. An unknown token gives no rights, also on this computer."""
        accounts = self.accounts.known
        if (token := token_in(connection)) is not None:
            if (found := accounts.of_token(token)) is None:
                return NOBODY
            return Principal(f"{found.name} (token)", role_at_least(found.role), known=True)
        if not self.login:
            if any(name in connection.headers for name in _PROXIES):
                return NOBODY                      # from an unknown place, through a proxy on this computer
            return Principal("local", frozenset({"viewer"})) if accounts else LOCAL
        cookie = _cookie(connection, COOKIE)
        return NOBODY if cookie is None else self._of_session(cookie, accounts)

    def _of_session(self, cookie: str, accounts: Accounts) -> Principal:
        name = _hash(cookie)
        session = self._sessions.get(name)
        user = None if session is None else accounts.users.get(session.user)
        if session is None or user is None or user.since != session.since:
            return NOBODY
        now_s = self._clock()
        if now_s > session.ends_s + STOPS_S:
            return NOBODY
        roles = role_at_least(user.role) if now_s < session.ends_s else frozenset()
        return Principal(user.name, roles, known=True, session=name[:16], csrf=csrf_of(cookie))

    async def authenticate(self, connection: HTTPConnection) -> tuple[AuthCredentials, Principal]:
        """Authenticate a client, as starlette's AuthenticationMiddleware requires."""
        who = self.who(connection)
        return AuthCredentials(sorted(who.roles)), who

    # -- login -------------------------------------------------------------------------------------------------------

    def log_in(self, name: str, password: str, address: str) -> tuple[str, Principal]:
        """Return the cookie's value and its client. The hash takes 0.3 s. Raises TooManyTries and NotLoggedIn."""
        self.tries.begin(name, address)
        user = self.accounts.known.users.get(name)
        good = matches(password, None if user is None else user.password)
        if user is None or not good:
            raise NotLoggedIn("name or password is wrong", where="login")
        self.tries.good(name, address)
        return self.begin_session(user)

    def begin_session(self, user: User) -> tuple[str, Principal]:
        """Begin a session of a user whose identity was checked. Return the cookie's value and the client."""
        cookie, now_s = secrets.token_urlsafe(32), self._clock()
        with self._lock:
            kept = {one: it for one, it in self._sessions.items() if now_s < it.ends_s + STOPS_S}
            while len(kept) >= _MOST_SESSIONS:
                kept.pop(next(iter(kept)))
            self._sessions = {**kept, _hash(cookie): Session(user.name, user.since, now_s, now_s + SESSION_S)}
        self._save()
        return cookie, self._of_session(cookie, self.accounts.known)

    def log_out(self, connection: HTTPConnection) -> None:
        """End the session now. It stays ended after a restart of the service."""
        if (cookie := _cookie(connection, COOKIE)) is not None:
            with self._lock:
                self._sessions = {one: it for one, it in self._sessions.items() if one != _hash(cookie)}
            self._save()

    def ends_s(self, who: Principal) -> float | None:
        """Return the end of the client's session, s, as of `time.time`; None without a session."""
        return next((it.ends_s for one, it in self._sessions.items() if who.session and one.startswith(who.session)),
                    None)

    def _save(self) -> None:
        with self._writing:
            plain = {one: asdict(it) for one, it in self._sessions.items()}
            try:
                write_json(self._path, plain, mode=0o600)
            except OSError as error:
                self._say(f"the logins can't be written and will end with this process: {error}")


def principal(connection: HTTPConnection) -> Principal:
    """Return the client that the middleware identified."""
    found: Principal = connection.scope.get("user", NOBODY)
    return found


def set_cookies(response: Response, connection: HTTPConnection, cookie: str | None) -> None:
    """Set the cookies of a login; None deletes them. The browser forgets them when it is closed."""
    for name, value, hidden in ((COOKIE, cookie or "", True),
                                (CSRF_COOKIE, "" if cookie is None else csrf_of(cookie), False)):
        response.set_cookie(_named(name, connection), value, max_age=None if cookie else 0, path="/", secure=True,
                            httponly=hidden, samesite="strict")


def csrf_of(cookie: str) -> str:
    """Return the token that a page of this session sends with each change. The page's script reads it from a cookie.

    So a page that was opened before a new login sends the new token, and its stop is accepted.
    """
    return hmac.new(cookie.encode(), b"csrf", hashlib.sha256).hexdigest()[:32]


def require(who: Principal, role: Role | None, *, route: str, open_here: bool, csrf: str | None = None) -> None:
    """Check the rights. ``role``: None allows every client; ``csrf``: sent with a change. Raises NotLoggedIn and
    NotAllowed.
    """
    if role is None:
        return
    if role not in who.roles and not (route in STOPS and who.may_stop):
        if who.roles:
            raise NotAllowed(f"{who.name} does not have the role {role}", where=route,
                             next_step=f"Ask a user with the role {role}" if who.known or not open_here else
                             "Users were added. Start the service again, with its other options too:"
                             " tdhil serve --tls-cert FILE --tls-key FILE")
        raise NotLoggedIn(
            "the login has ended" if who.known else "the client is not logged in", where=route,
            next_step="A request through a proxy, or with an unknown token, is refused" if open_here
            else "Log in again; a stop is still accepted" if who.known else "Log in, or send a token",
        )
    if who.csrf and csrf is not None and not hmac.compare_digest(csrf.encode(), who.csrf.encode()):
        raise NotAllowed("this request did not come from a page of this login", where=CSRF_HEADER,
                         next_step="Load the page again")


def require_options(who: Principal, options: Mapping[str, Any]) -> None:
    """Check options that only an engineer may request. Raises NotAllowed."""
    for name in _ENGINEER_OPTIONS:
        if options.get(name) and "engineer" not in who.roles:
            raise NotAllowed(f"{who.name} is not an engineer; only an engineer may accept unverified entries",
                             where=name, next_step="Ask an engineer")


def token_in(connection: HTTPConnection) -> str | None:
    """Return a machine's token. A WebSocket may send it as ?token=…, since browsers add no header to it."""
    if (given := connection.headers.get("authorization")) is not None:
        kind, _, token = given.partition(" ")
        return token.strip() if kind.lower() == "bearer" else ""
    found: str | None = connection.query_params.get("token") if connection.scope["type"] == "websocket" else None
    return found


def address_of(connection: HTTPConnection) -> str:
    """Return the address for the rate limit; for IPv6 the network, since one customer has a whole network."""
    host = "?" if connection.client is None else connection.client.host
    with suppress(ValueError):
        address = ipaddress.ip_address(host.partition("%")[0])
        if address.version == 6:
            return str(address.ipv4_mapped or ipaddress.ip_network((int(address) >> 64 << 64, 64)))
    return host


def _cookie(connection: HTTPConnection, name: str) -> str | None:
    found: str | None = connection.cookies.get(_named(name, connection))
    return found or None


def _named(name: str, connection: HTTPConnection) -> str:
    """Return the cookie's name with the port: a browser sends the cookies of a host to all of its ports."""
    port = None
    with suppress(ValueError):
        port = urlsplit(f"//{connection.headers.get('host', '')}").port
    return f"{name}-{port or 443}"


def _hash(cookie: str) -> str:
    return hashlib.sha256(cookie.encode()).hexdigest()


def _differences(before: Accounts, after: Accounts) -> Iterator[tuple[str, str]]:
    for kind, old, new in (("user", before.users, after.users), ("token", before.tokens, after.tokens)):
        for name in sorted({*old, *new}):
            was, is_now = old.get(name), new.get(name)
            if was != is_now:
                what = "removed" if is_now is None else "added" if was is None else "changed"
                yield f"{kind} {what}", f"{name}" if is_now is None else f"{name} ({is_now.role})"
