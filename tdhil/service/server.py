"""`tdhil serve`: the web service on one port, until SIGINT or SIGTERM."""

from __future__ import annotations

import ipaddress
import re
import signal
import socket
import ssl
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.errors import ExitCode, MessageCode, UsageError
from tdhil.service.limits import UPLOAD_LIMIT
from tdhil.service.run_state import option_wrong

if TYPE_CHECKING:
    import uvicorn

    from tdhil.service.door import Room

NEEDED = ("starlette", "uvicorn", "websockets", "prometheus_client", "jinja2")
HOST, PORT = "127.0.0.1", 8420
ON_ITS_WAY = 64 * 1024
"""Bytes of unsent data that the system buffers per connection. On a slow line a larger buffer would delay a keep-alive
ping, and the viewer would be disconnected before it reads the ping."""
SILENT_S = 60.0
"""Time without a reply after which a viewer counts as disconnected, s."""
Say = Callable[[str], None]


def require_service() -> None:
    """Raise UsageError if the extra is not installed, or the system lacks the needed locks and sockets."""
    if sys.platform == "win32":
        raise UsageError("tdhil serve needs Linux or another POSIX system", next_step="Use tdhil identify here")
    missing = [name.replace("_", "-") for name in NEEDED if find_spec(name) is None]
    if missing:
        raise UsageError(f"the service needs {', '.join(missing)}, not installed here",
                         next_step="Install it in the clone of tdhil: pip install '.[service]'",
                         entry=MessageCode.PACKAGE_MISSING)


@dataclass(frozen=True)
class Tls:
    """A certificate and its key, as PEM files."""

    cert: Path
    key: Path

    def context(self) -> ssl.SSLContext:
        """Return the TLS context. Raises UsageError if the files are unusable."""
        found = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            found.load_cert_chain(self.cert, self.key, password=_no_password)
        except (OSError, ValueError) as error:         # ssl.SSLError is an OSError
            raise option_wrong(f"certificate and key can't be used ({getattr(error, 'strerror', None) or error})",
                               f"--tls-cert {self.cert} --tls-key {self.key}",
                               "Both must be PEM and belong together, and the key must have no password") from error
        return found


def _no_password() -> str:
    raise ValueError("the key has a password")


def require_way(host: str, *, tls: bool, accounts: bool) -> None:
    """Raise UsageError if an address beyond this computer, or a service with users, has no TLS or no login."""
    if _loopback(host) and not accounts:
        return
    if not tls:
        raise UsageError(
            "there are users, and a password must not be sent without TLS" if accounts else
            "every computer that reaches this address could move a shaft: it needs a login and TLS",
            where=f"--host {host}",
            next_step="Add --tls-cert and --tls-key" if accounts else
            "Add a user (tdhil serve users add), --tls-cert and --tls-key; or use 127.0.0.1 and a tunnel:"
            " ssh -L 8420:127.0.0.1:8420 HOST",
            entry=MessageCode.SERVICE_NEEDS_LOGIN,
        )
    if not accounts:
        raise UsageError("every computer that reaches this address could move a shaft: it needs a login, but there is"
                         " no user yet", where=f"--host {host}",
                         next_step="Add one: tdhil serve users add NAME --role admin",
                         entry=MessageCode.SERVICE_NEEDS_LOGIN)


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _names(host: str, more: Sequence[str]) -> frozenset[str]:
    """Return the names under which the service may be reached. Raises UsageError."""
    for name in more:
        with suppress(ValueError):
            ipaddress.ip_address(name)
            continue
        if not re.fullmatch(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*", name):
            raise option_wrong("must be a host's name or address, without a port", f"--allowed-host {name[:60]}")
    return frozenset(one.lower() for one in ("127.0.0.1", "localhost", "::1", _reachable(host), *more))


def _reachable(host: str, more: Sequence[str] = ()) -> str:
    """Return the name of the service in a link. For a ``host`` that means every address: a name of this host."""
    if host not in ("0.0.0.0", "::", ""):
        return host
    return more[0] if more else socket.gethostname()


@dataclass(frozen=True)
class Receivers:
    """Addresses that receive news of the runs.

    ``mqtt``: broker for states and results. ``webhook``: receiver of a message for each ended run and each change of a
    rig. ``mail``: server and recipients of the same messages.
    """

    mqtt: str | None = None
    webhook: str | None = None
    mail: str | None = None


def serve(
    rigs: Path | None, data: Path, host: str, port: int, say: Say, *, viewers: frozenset[str] = frozenset(),
    receivers: Receivers | None = None, tls: Tls | None = None, names: Sequence[str] = (), logs: Sequence[Path] = (),
    upload_limit: int = UPLOAD_LIMIT,
) -> int:
    """Serve until SIGINT or SIGTERM; then live runs are stopped first. Return the exit code.

    ``viewers``: origins of Foxglove or Lichtblick in a browser, which may read logs as they grow.
    ``names``: more names of this host; ``logs``: folders of logs for fleet requests, besides the service's runs;
    ``upload_limit``: largest uploaded recording, bytes.

    Raises UsageError for unusable arguments or unreadable accounts, and LogUnopened for a folder that can't be made.
    """
    require_service()
    from tdhil.service.accounts import AccountsFile

    accounts = bool(AccountsFile(data.resolve()).read())
    require_way(host, tls=tls is not None, accounts=accounts)
    if tls is not None:
        tls.context()
    allowed = _names(host, names)
    for origin in viewers:
        if not re.fullmatch(r"[a-z][a-z0-9+.-]*://[^/?#\s]*", origin):
            raise option_wrong("must be an origin of pages: scheme, host and port", f"--viewer {origin[:100]}",
                               "For example http://localhost:8080, or file://")
    if rigs is not None:
        require_folder(rigs, "--rigs", "Create it, or name another folder of rig files")
    for one in logs:
        require_folder(one, "--logs", "Name a folder of logs")

    from tdhil.service.access import Access
    from tdhil.service.audit import Audit
    from tdhil.service.door import Room, raise_limit
    from tdhil.service.mail import Mail
    from tdhil.service.mqtt import Broker, Publisher
    from tdhil.service.notifications import RUNS, Notifier, Receiver
    from tdhil.service.run_filter import RunFilter
    from tdhil.service.start_request import Rigs
    from tdhil.service.store import Index, Store
    from tdhil.service.supervisor import Supervisor
    from tdhil.service.web import Web
    from tdhil.service.webhook import Webhook

    receivers = receivers or Receivers()
    broker = None if receivers.mqtt is None else Broker.of(receivers.mqtt)
    messages: list[Receiver] = [kind.of(url) for kind, url in ((Webhook, receivers.webhook), (Mail, receivers.mail))
                                if url is not None]
    store = Store(data.resolve())
    store.prepare()
    alone = _alone(store.folder)
    supervisor = Supervisor(store, Rigs(rigs), Audit(store.folder / "audit"), Index(store), say=say)
    room = Room.of(raise_limit())
    web = Web(supervisor, hosts=allowed, viewers=viewers, access=Access(store.folder, login=accounts, say=say),
              logs={str(one): one for one in logs}, upload_limit=upload_limit)
    senders: list[Publisher | Notifier] = [] if broker is None else [Publisher(broker, web.broker_messages, say)]
    listening = _listen(host, port)
    at = listening.getsockname()[1]
    linked = _reachable(host, names)
    shown = f"[{linked}]" if ":" in linked else linked
    site = f"{'http' if tls is None else 'https'}://{shown}:{at}"
    say(f"tdhil serve: {site}   (runs: {store.folder})")
    if not _loopback(host):
        say(f"Accepted host names: {', '.join(sorted(allowed))}. Add others with --allowed-host.")
    if supervisor.rigs.built_in:
        say("There is no rig file. Two simulated rigs are available. No real shaft moves.")
    if left_out := supervisor.rigs.left_out:
        say(f"Ignored, because the name is not that of a rig file: {', '.join(left_out)}."
            " Use NAME.yaml, with letters, digits, _, . and -")
    say("A stop over HTTP is no emergency stop: keep the hard-wired emergency stop within reach. Ctrl-C stops all"
        " runs.")
    senders += [Notifier(one.at(site), lambda: web.find_runs(RunFilter(), limit=RUNS), web.trends_around, say)
                for one in messages]
    for sender in senders:
        sender.start()
    try:
        _uvicorn(web.asgi, listening, supervisor.brake, say, tls, room)
    finally:
        for sender in senders:
            sender.close()
        listening.close()
        alone.close()
    left = sorted({*supervisor.may_turn(), *supervisor.not_at_rest})
    if left:
        say(f"Standstill NOT confirmed: {', '.join(left)}. Use the hard-wired emergency stop.")
        return int(ExitCode.STOP_NOT_CONFIRMED)
    return int(ExitCode.OK)


def require_folder(folder: Path, option: str = "--data", next_step: str = "Name the service's folder") -> None:
    """Raise UsageError if the folder of an option does not exist: its name is probably misspelt."""
    if not folder.is_dir():
        raise UsageError("this folder does not exist", where=f"{option} {folder}", next_step=next_step,
                         entry=MessageCode.FILE_NOT_FOUND)


def check_idle(data: Path, say: Say) -> int:
    """Return as an exit code whether the program may be replaced now. The code is 4 if a run of this folder is alive,
    if a stop is neither confirmed nor signed off, or if any tdhil of this computer holds a drive. The reasons are
    printed. Only files and locks are read, no web and no drive. Raises UsageError if the folder does not exist.
    """
    from tdhil.service.run_channel import lives
    from tdhil.service.run_state import State
    from tdhil.service.store import CONNECTION_FILE, Store
    from tdhil.session import holders

    store = Store(data.resolve())
    busy = [f"a drive is held by {one}" for one in holders()]
    if not busy:
        require_folder(data)
    for run in store.ids():
        try:
            if lives(store.place(run)):
                busy.append(f"run {run} has not ended")
            elif store.status(run).state is State.STOP_NOT_CONFIRMED and store.signed_off(run) is None:
                busy.append(f"the stop of run {run} is neither confirmed nor signed off")
        except Exception as error:             # a broken folder of one run: the others are still checked
            if (store.runs / run / CONNECTION_FILE).exists():
                busy.append(f"run {run} used a drive, and its state can't be read ({error})")
            else:
                say(f"run {run} is left out: its files can't be read, and it used no drive ({error})")
    for one in busy:
        say(f"not idle: {one}")
    return int(ExitCode.REFUSED if busy else ExitCode.OK)


def _uvicorn(
    app: Any, listening: socket.socket, brake: Callable[[str], bool], say: Say, tls: Tls | None, room: Room
) -> None:
    import uvicorn

    from tdhil.service.door import HEADER_LIMIT, Door

    config = uvicorn.Config(
        app, log_level="warning", access_log=False, http="h11", ws="websockets-sansio",
        ws_max_size=4096, ws_ping_interval=10.0, ws_ping_timeout=SILENT_S, timeout_graceful_shutdown=2, lifespan="on",
        server_header=False, date_header=True,
        h11_max_incomplete_event_size=2 * HEADER_LIMIT, proxy_headers=False,      # client address: the connection's
        ssl_certfile=None if tls is None else tls.cert, ssl_keyfile=None if tls is None else tls.key,
    )
    if tls is not None:
        config.load()
        config.ssl = tls.context()             # the checked context, with the ciphers of Python
    door = Door(listening, room, say, tls=config.ssl if tls is not None else None)

    class Server(uvicorn.Server):  # type: ignore[misc]
        """uvicorn server that accepts no connection itself: tdhil's `Door` does."""

        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets=[])
            door.open(partial(config.http_protocol_class, config=config, server_state=self.server_state,
                              app_state=self.lifespan.state))

        async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
            door.close()
            await super().shutdown(sockets)

    server = Server(config)
    former = {number: signal.signal(number, _ender(server, brake, say)) for number in (signal.SIGINT, signal.SIGTERM)}
    object.__setattr__(server, "capture_signals", nullcontext)       # SIGTERM stops the runs first
    try:
        server.run(sockets=[listening])
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def _ender(server: uvicorn.Server, brake: Callable[[str], bool], say: Say) -> Callable[[int, Any], None]:
    """Return a handler that stops the runs in a thread while pages are still served, then ends the server."""
    import threading

    begun = threading.Event()

    def end() -> None:
        try:
            if not brake("service ending"):
                say("some runs have not ended in time")
        finally:                               # a failed stop must not keep the service from ending
            server.should_exit = True

    def handler(number: int, frame: Any) -> None:
        if not begun.is_set():
            begun.set()
            threading.Thread(target=end, daemon=True).start()

    return handler


def _listen(host: str, port: int) -> socket.socket:
    from tdhil.service.door import BACKLOG

    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    found = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if hasattr(socket, "TCP_NOTSENT_LOWAT"):       # small buffer for slow readers: see ON_ITS_WAY
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, ON_ITS_WAY)
    try:
        found.bind((host, port))
    except (OSError, OverflowError) as error:
        found.close()
        raise option_wrong(f"this address can't be opened ({getattr(error, 'strerror', None) or error})",
                           f"{host}:{port}", "Is tdhil serve running already? Name another --port") from error
    found.listen(BACKLOG)
    return found


def _alone(folder: Path) -> Any:
    """Lock the folder while the service runs: one service per folder. Raises UsageError."""
    import fcntl

    try:
        file = (folder / "service.lock").open("a")
    except OSError as error:
        raise UsageError(f"can't be written ({error.strerror or error})", where=f"--data {folder}",
                         next_step="Name a writable folder", entry=MessageCode.FILE_NOT_WRITABLE) from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise UsageError("another tdhil serve uses this folder", where=f"--data {folder}",
                         next_step="Use that service, or name another folder", entry=MessageCode.NOT_READY) from None
    return file
