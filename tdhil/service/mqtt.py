"""States and results of the rigs for other systems, over MQTT. tdhil subscribes to nothing and accepts no command.

::

    <prefix>/status                  online; offline when the service has ended, or the broker has lost it
    <prefix>/rigs/<rig>/state        state of the rig, and state and stage of its run
    <prefix>/rigs/<rig>/result       its latest result, as in the list of runs

JSON, retained, QoS 1. Only the latest message counts, so nothing is queued: after a lost connection all topics are sent
again. The publisher has its own threads; nothing else waits for it.
"""

from __future__ import annotations

import json
import os
import ssl
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import unquote, urlsplit

from tdhil.errors import MessageCode, UsageError
from tdhil.service.password_file import read_password
from tdhil.service.run_state import option_wrong

if TYPE_CHECKING:
    from paho.mqtt.client import Client

EVERY_S: Final = 1.0
"""Polling interval, s."""
RETRY_S: Final = (1, 60)
"""Shortest and longest interval between two tries to reach a broker, s."""
PORTS: Final = {"mqtt": 1883, "mqtts": 8883}
USER, PASSWORD, PASSWORD_FILE, CA_FILE = (
    f"TDHIL_MQTT_{name}" for name in ("USER", "PASSWORD", "PASSWORD_FILE", "CA_FILE"))
ONLINE, OFFLINE = "online", "offline"
_KEEPALIVE_S, _CONNECT_S, _GOODBYE_S = 30, 5.0, 1.0
Say = Callable[[str], None]


@dataclass(frozen=True)
class Broker:
    """Address of a broker, and the prefix of the topics. ``password`` is never shown."""

    host: str
    port: int
    tls: bool
    prefix: str
    user: str | None = None
    password: str | None = field(default=None, repr=False)
    ca_file: str | None = None

    @staticmethod
    def of(url: str, environment: Mapping[str, str] = os.environ) -> Broker:
        """Parse ``mqtt[s]://[user@]host[:port][/prefix]``. Raises UsageError; its text contains no password."""
        try:
            parts = urlsplit(url)
            port, host = parts.port, parts.hostname
        except ValueError:
            raise option_wrong("is not a valid address", "--mqtt", "Use mqtt://host:1883/site") from None
        if parts.password is not None:
            raise option_wrong("a password must not be on the command line, which every user can read", "--mqtt",
                               f"Put it into a file, and name the file in {PASSWORD_FILE}")
        if parts.scheme not in PORTS or not host or parts.query or parts.fragment:
            raise option_wrong("must be mqtt:// or mqtts://, a host, and optionally a port and a prefix", "--mqtt",
                               "Use mqtt://host:1883/site")
        prefix = unquote(parts.path).strip("/") or "tdhil"
        if set(prefix) & set("+#\0") or prefix.startswith("$") or "//" in prefix:
            raise UsageError("a prefix must not contain +, # or //, nor begin with $", where=f"--mqtt …/{prefix}")
        user = unquote(parts.username) if parts.username else environment.get(USER)
        password = read_password(PASSWORD_FILE, environment)
        return Broker(host, port or PORTS[parts.scheme], parts.scheme == "mqtts", prefix, user,
                      environment.get(PASSWORD) if password is None else password, environment.get(CA_FILE))

    def __str__(self) -> str:
        return f"{'mqtts' if self.tls else 'mqtt'}://{self.host}:{self.port}/{self.prefix}"


class Publisher:
    """Publisher of the values of ``look`` to a broker: each topic when its value changes, from `start` to `close`.

    Raises UsageError if the extra is missing, or a TLS file can't be read.
    """

    def __init__(self, broker: Broker, look: Callable[[], Mapping[str, Any]], say: Say = lambda text: None) -> None:
        if find_spec("paho") is None:
            raise UsageError("--mqtt needs paho-mqtt, not installed here",
                             next_step="Install it in the clone of tdhil: pip install '.[mqtt]'",
                             entry=MessageCode.PACKAGE_MISSING)
        self._broker, self._look, self._say = broker, look, say
        self._published: dict[str, str] = {}
        self._connected, self._end = threading.Event(), threading.Event()
        self._silent = False               # whether the lost connection was reported
        self._client = self._make()
        self._thread = threading.Thread(target=self._run, name="mqtt", daemon=True)

    def _make(self) -> Client:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        found = Client(CallbackAPIVersion.VERSION2)
        found.connect_timeout = _CONNECT_S
        found.reconnect_delay_set(*RETRY_S)
        found.will_set(f"{self._broker.prefix}/status", OFFLINE, qos=1, retain=True)
        if self._broker.user is not None:
            found.username_pw_set(self._broker.user, self._broker.password)
        if self._broker.tls:
            try:
                found.tls_set(self._broker.ca_file)
            except (OSError, ssl.SSLError) as error:
                raise option_wrong(f"can't be read as certificates ({getattr(error, 'strerror', None) or error})",
                                   f"{CA_FILE} {self._broker.ca_file}") from None
        found.on_connect = self._on_connect
        # paho gives no reason: an untrusted certificate causes the same call.
        why = "can't be reached" + (", or its certificate isn't trusted" if self._broker.tls else "")
        found.on_connect_fail = lambda client, data: self._away(why)
        found.on_disconnect = lambda client, data, flags, reason, properties: self._away(str(reason))
        return found

    def start(self) -> None:
        """Start publishing. Returns at once, also if the broker can't be reached."""
        if self._broker.password is not None and not self._broker.tls:
            self._say("MQTT: the password is sent to the broker unencrypted. Use mqtts:// to encrypt it")
        self._client.connect_async(self._broker.host, self._broker.port, _KEEPALIVE_S)
        self._client.loop_start()
        self._thread.start()

    def close(self) -> None:
        """Publish "offline" if the broker is connected. This takes at most 1 s."""
        self._end.set()
        if self._connected.is_set():
            with suppress(RuntimeError, ValueError):
                self._publish("status", OFFLINE).wait_for_publish(_GOODBYE_S)
        self._client.disconnect()

    # -- in paho's thread --------------------------------------------------------------------------------------------

    def _on_connect(self, client: Client, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            self._away(str(reason))
            return
        self._silent = False
        self._published.clear()            # retained messages may be out of date
        self._connected.set()
        self._say(f"MQTT: states and results are sent to {self._broker}")

    def _away(self, why: str) -> None:
        self._connected.clear()
        if not self._silent and not self._end.is_set():
            self._silent = True
            self._say(f"MQTT: {self._broker}: {why}; tdhil tries again. Runs are not affected")

    # -- in the publisher's own thread -------------------------------------------------------------------------------

    def _run(self) -> None:
        said = ""
        while not self._end.wait(EVERY_S):
            if self._connected.is_set():
                try:
                    self._publish_news()
                    trouble = ""
                except Exception as error:     # one poll failed: the next poll reports again
                    trouble = f"MQTT: {type(error).__name__}: {error}"
                if trouble not in ("", said):
                    self._say(trouble)
                said = trouble

    def _publish_news(self) -> None:
        news = {"status": ONLINE} | {
            topic: json.dumps(plain, allow_nan=False) for topic, plain in self._look().items()}
        gone = dict.fromkeys(self._published.keys() - news.keys(), "")      # an empty message deletes a retained one
        for topic, text in (news | gone).items():
            if self._published.get(topic) != text and self._connected.is_set():
                self._publish(topic, text)
                self._published[topic] = text
        for topic in gone:
            self._published.pop(topic, None)

    def _publish(self, topic: str, text: str) -> Any:
        return self._client.publish(f"{self._broker.prefix}/{topic}", text, qos=1, retain=True)
