"""`tdhil serve`: the web on one port, for as long as somebody lets it run."""

from __future__ import annotations

import ipaddress
import re
import signal
import socket
import ssl
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.errors import ExitCode, UsageError

if TYPE_CHECKING:
    import uvicorn

    from tdhil.service.door import Room

NEEDED = ("starlette", "uvicorn", "websockets", "prometheus_client", "jinja2")
HOST, PORT = "127.0.0.1", 8420
ON_ITS_WAY = 64 * 1024
"""Bytes for one connection that the system takes beyond what it can send now. With more, a viewer on a slow line would
be asked, behind all of that, whether it is still there, and be cut off before it comes to it."""
SILENT_S = 60.0
"""Who has not answered for so long has gone."""
Say = Callable[[str], None]


def require_service() -> None:
    """Raises UsageError where the extra isn't installed, or the system has no locks and sockets as they are needed."""
    if sys.platform == "win32":
        raise UsageError("tdhil serve needs Linux or another POSIX system", next_step="Use tdhil identify here")
    missing = [name.replace("_", "-") for name in NEEDED if find_spec(name) is None]
    if missing:
        raise UsageError(f"the service needs {', '.join(missing)}, not installed here",
                         next_step="Install: pip install 'tdhil[service]'")


@dataclass(frozen=True)
class Tls:
    """A certificate and its key, as PEM files."""

    cert: Path
    key: Path

    def context(self) -> ssl.SSLContext:
        """Raises UsageError where they don't serve."""
        found = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            found.load_cert_chain(self.cert, self.key, password=_no_password)
        except (OSError, ValueError) as error:         # ssl.SSLError is an OSError
            raise UsageError(
                f"certificate and key can't be used ({getattr(error, 'strerror', None) or error})",
                where=f"--tls-cert {self.cert} --tls-key {self.key}",
                next_step="Both are PEM, belong together, and the key has no password",
            ) from error
        return found


def _no_password() -> str:
    raise ValueError("the key has a password")


def require_way(host: str, *, tls: bool, accounts: bool) -> None:
    """Whoever reaches more than this computer, or has users, has TLS and a login. Raises UsageError."""
    if _loopback(host) and not accounts:
        return
    if not tls:
        raise UsageError(
            "there are users, and a password goes over no open line" if accounts else
            "whoever reaches this address could move a shaft: it takes a login, and TLS", where=f"--host {host}",
            next_step="Name --tls-cert and --tls-key" if accounts else
            "Add a user (tdhil serve users add), name --tls-cert and --tls-key; or take 127.0.0.1 and tunnel:"
            " ssh -L 8420:127.0.0.1:8420 HOST",
        )
    if not accounts:
        raise UsageError("whoever reaches this address could move a shaft: it takes a login, and there is no user yet",
                         where=f"--host {host}", next_step="Add one: tdhil serve users add NAME --role admin")


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _names(host: str, more: Sequence[str]) -> frozenset[str]:
    """By which names the service may be reached. Raises UsageError."""
    for name in more:
        with suppress(ValueError):
            ipaddress.ip_address(name)
            continue
        if not re.fullmatch(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*", name):
            raise UsageError("must be a host's name or address, without a port", where=f"--allowed-host {name[:60]}")
    everywhere = host in ("0.0.0.0", "::", "")
    own = socket.gethostname() if everywhere else host
    return frozenset(one.lower() for one in ("127.0.0.1", "localhost", "::1", own, *more))


def serve(
    rigs: Path | None, data: Path, host: str, port: int, say: Say, *, viewers: frozenset[str] = frozenset(),
    mqtt: str | None = None, tls: Tls | None = None, names: Sequence[str] = (),
    logs: Sequence[Path] = (),
) -> int:
    """Serve until SIGINT or SIGTERM; then live runs brake first. The exit code.

    ``viewers``: origins of Foxglove or Lichtblick in a browser, which may read logs as they grow.
    ``mqtt``: the address of a broker that is told states and results.
    ``names``: more names of this host; ``logs``: folders whose logs a fleet may go through, beside the service's runs.

    Raises UsageError for what can't be served, accounts that can't be read among it, and LogUnopened for a folder that
    can't be made.
    """
    require_service()
    from tdhil.service.accounts import AccountsFile

    accounts = bool(AccountsFile(data.resolve()).read())
    require_way(host, tls=tls is not None, accounts=accounts)
    if tls is not None:
        tls.context()
    allowed = _names(host, names)
    for one in viewers:
        if not re.fullmatch(r"[a-z][a-z0-9+.-]*://[^/?#\s]*", one):
            raise UsageError("must be where pages come from: scheme, host and port", where=f"--viewer {one[:100]}",
                             next_step="Such as http://localhost:8080, or file://")
    if rigs is not None and not rigs.is_dir():
        raise UsageError("there is no such folder", where=f"--rigs {rigs}", next_step="It has a file for each rig")
    for folder in logs:
        if not folder.is_dir():
            raise UsageError("there is no such folder", where=f"--logs {folder}", next_step="It has logs of runs in it")

    from tdhil.service.access import Access
    from tdhil.service.audit import Audit
    from tdhil.service.door import Room, raise_limit
    from tdhil.service.mqtt import Broker, Publisher
    from tdhil.service.start_request import Rigs
    from tdhil.service.store import Index, Store
    from tdhil.service.supervisor import Supervisor
    from tdhil.service.web import Web

    broker = None if mqtt is None else Broker.of(mqtt)
    store = Store(data.resolve())
    store.prepare()
    alone = _alone(store.folder)
    supervisor = Supervisor(store, Rigs(rigs), Audit(store.folder / "audit"), Index(store), say=say)
    room = Room.of(raise_limit())
    web = Web(supervisor, hosts=allowed, viewers=viewers, access=Access(store.folder, login=accounts, say=say),
              logs={str(one): one for one in logs})
    publisher = None if broker is None else Publisher(broker, web.told, say)
    listening = _listen(host, port)
    at = listening.getsockname()[1]
    shown = f"[{host}]" if ":" in host else host
    say(f"tdhil serve: {'http' if tls is None else 'https'}://{shown}:{at}   (runs: {store.folder})")
    if not _loopback(host):
        say(f"It answers to {', '.join(sorted(allowed))}; name others with --allowed-host.")
    if supervisor.rigs.built_in:
        say("No rig file is there: two simulated rigs to play with. Nothing real moves.")
    if left_out := supervisor.rigs.left_out:
        say(f"Left out, as no rig's file is called so: {', '.join(left_out)}."
            " It is NAME.yaml, of letters, digits, _, . and -")
    say("A stop over HTTP is no emergency stop: keep the hard-wired one within reach. Ctrl-C brakes what moves.")
    if publisher is not None:
        publisher.start()
    try:
        _uvicorn(web.asgi, listening, supervisor.brake, say, tls, room)
    finally:
        if publisher is not None:
            publisher.close()
        listening.close()
        alone.close()
    left = sorted({*supervisor.live(), *supervisor.not_at_rest})
    if left:
        say(f"NOT at rest, as far as is known: {', '.join(left)}. Use the hard-wired stop.")
        return int(ExitCode.STOP_NOT_CONFIRMED)
    return int(ExitCode.OK)


def require_folder(data: Path) -> None:
    """Who asks of a folder that isn't there has misspelt it. Raises UsageError."""
    if not data.is_dir():
        raise UsageError("there is no such folder", where=f"--data {data}", next_step="Name the service's own")


def check_idle(data: Path, say: Say) -> int:
    """May the program be replaced now? Exit code 4, and who is in the way, where a run of this folder lives, where a
    shaft was not seen at rest and nobody has signed it off, or whatever tdhil of this computer holds a drive. Asks
    files and locks; neither the web nor a drive. Raises UsageError where the folder isn't there.
    """
    from tdhil.service.run_channel import lives
    from tdhil.service.run_state import State
    from tdhil.service.store import Store
    from tdhil.session import holders

    store = Store(data.resolve())
    busy = [f"a drive is held by {one}" for one in holders()]
    if not busy:
        require_folder(data)
    for run in store.ids():
        if lives(store.place(run)):
            busy.append(f"run {run} has not ended")
        elif store.status(run).state is State.STOP_NOT_CONFIRMED and store.signed_off(run) is None:
            busy.append(f"run {run} was not seen at rest, and nobody has signed that it is")
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
        h11_max_incomplete_event_size=2 * HEADER_LIMIT, proxy_headers=False,      # who asks is who is connected
        ssl_certfile=None if tls is None else tls.cert, ssl_keyfile=None if tls is None else tls.key,
    )
    if tls is not None:
        config.load()
        config.ssl = tls.context()             # the one that was looked at, with the ciphers of Python
    door = Door(listening, room, say, tls=config.ssl if tls is not None else None)

    class Server(uvicorn.Server):  # type: ignore[misc]
        """uvicorn behind our own door: it accepts nothing itself."""

        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets=[])
            door.open(partial(config.http_protocol_class, config=config, server_state=self.server_state,
                              app_state=self.lifespan.state))

        async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
            door.close()
            await super().shutdown(sockets)

    server = Server(config)
    former = {number: signal.signal(number, _ender(server, brake, say)) for number in (signal.SIGINT, signal.SIGTERM)}
    object.__setattr__(server, "capture_signals", _nothing_captured)       # SIGTERM brakes before it ends anything
    try:
        server.run(sockets=[listening])
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def _nothing_captured() -> Any:
    from contextlib import nullcontext

    return nullcontext()


def _ender(server: uvicorn.Server, brake: Callable[[str], bool], say: Say) -> Callable[[int, Any], None]:
    """Brakes first, in a thread, with the pages still there to show it; then ends."""
    import threading

    begun = threading.Event()

    def end() -> None:
        if not brake("service ending"):
            say("not every run has come to its end in time")
        server.should_exit = True

    def handler(number: int, frame: Any) -> None:
        if not begun.is_set():
            begun.set()
            threading.Thread(target=end, daemon=True).start()

    return handler


def _listen(host: str, port: int) -> socket.socket:
    from tdhil.service.door import BACKLOG

    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    found = socket.socket(family, socket.SOCK_STREAM)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if hasattr(socket, "TCP_NOTSENT_LOWAT"):       # who reads slowly has little on its way: see ON_ITS_WAY
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, ON_ITS_WAY)
    try:
        found.bind((host, port))
    except (OSError, OverflowError) as error:
        found.close()
        raise UsageError(f"can't be listened on ({getattr(error, 'strerror', None) or error})",
                         where=f"{host}:{port}",
                         next_step="Is tdhil serve running already? Name another --port") from error
    found.listen(BACKLOG)
    return found


def _alone(folder: Path) -> Any:
    """One service a folder: held as long as it runs. Raises UsageError."""
    import fcntl

    try:
        file = (folder / "service.lock").open("a")
    except OSError as error:
        raise UsageError(f"can't be written ({error.strerror or error})", where=f"--data {folder}",
                         next_step="Name a folder that can be") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise UsageError("another tdhil serve has this folder", where=f"--data {folder}",
                         next_step="Use that one, or name another folder") from None
    return file
