"""The Foxglove WebSocket protocol, read only: the log of a rig's run as it grows, for Foxglove and Lichtblick.

A viewer receives the log's own bytes under the log's own schemas. Each channel starts at the beginning of the run, also
after a late subscription. Each viewer reads the file at its own pace: no viewer delays another or needs a queue. If a
viewer is late by more than `LATE_S`, the messages of every cycle are left out until it has caught up. A status states
their number. Source: github.com/foxglove/ws-protocol, docs/spec.md.
"""

from __future__ import annotations

import json
import time
from base64 import b64encode
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from struct import Struct
from typing import Any, Final

import anyio

from tdhil.recording import (
    CHANNELS,
    COMMAND,
    RAW_FRAMES,
    REHEARSAL,
    SAMPLE,
    VIRTUAL_STRING,
    LogChunks,
    LogTail,
    messages_in,
    schema_name,
    schema_of,
)

PROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Accepted WebSocket sub-protocols. The part used here is the same in both."""
EVERY_S: Final = 0.1
LOOK_S: Final = 1.0
"""Interval of the check whether a run without new data is still the rig's run, s."""
LATE_S: Final = 10.0
FIRST_S: Final = 60.0
"""Time allowed to send the part of the log before the subscription, s."""
_EACH_CYCLE: Final = frozenset({SAMPLE, COMMAND, VIRTUAL_STRING}) | RAW_FRAMES
_DATA: Final = Struct("<BIQ")              # opcode 1, subscription, log time in ns; then the message
_INFO, _WARNING, _ERROR = 0, 1, 2
_WAITS: Final = "run"


@dataclass(frozen=True)
class Running:
    """The present run of a rig."""

    run: str
    log: Path
    simulated: bool
    rehearsal: bool = False


@dataclass
class _ChannelReader:
    """Reader of channels that were subscribed together. It joins the other readers once it has caught up."""

    tail: LogTail
    wanted: dict[int, int]                 # subscription by channel number
    until_s: float                         # monotonic clock; a reader that is late after this time is too slow
    left_out: int = 0


@dataclass
class Relay:
    """Connection to one viewer of one rig. ``current`` returns the rig's run; it is called in a thread.

    ``simulated``: whether the rig is simulated; used until a run states it.
    """

    rig: str
    current: Callable[[], Running | None]
    send_text: Callable[[str], Awaitable[None]]
    send_bytes: Callable[[bytes], Awaitable[None]]
    simulated: bool = False
    clock: Callable[[], float] = time.monotonic
    _wanted: dict[int, int] = field(default_factory=dict)
    _new: set[int] = field(default_factory=set)            # channels that no reader has yet
    _readers: list[_ChannelReader] = field(default_factory=list)

    async def hear(self, said: str | bytes) -> None:
        """Handle a message of the viewer: subscribe or unsubscribe. Any other message is refused with a text."""
        try:
            asked: Any = json.loads(said) if isinstance(said, str) else {"op": "a binary message"}
            if asked["op"] == "subscribe":
                for one in asked["subscriptions"]:
                    subscription, channel = int(one["id"]), int(one["channelId"])
                    if channel not in CHANNELS or not 0 <= subscription < 2**32:
                        await self._status(_ERROR, f"channel {channel} does not exist")
                    elif channel in self._wanted:
                        await self._status(_WARNING, f"channel {channel} is already subscribed")
                    else:
                        self._wanted[channel] = subscription
                        self._new.add(channel)
            elif asked["op"] == "unsubscribe":
                gone = {int(one) for one in asked["subscriptionIds"]}
                for channel in [one for one, wanted_by in self._wanted.items() if wanted_by in gone]:
                    del self._wanted[channel]
                    self._new.discard(channel)
                    for reader in self._readers:
                        reader.wanted.pop(channel, None)
            else:
                await self._status(_ERROR, f"{str(asked['op'])[:40]}: this connection is read only")
        except (ValueError, TypeError, KeyError, RecursionError):
            await self._status(_ERROR, "this is not a message of the protocol")

    async def run(self) -> None:
        """Send messages until the task is cancelled."""
        running = await anyio.to_thread.run_sync(self.current)
        await self._introduce(running)
        while True:
            if running is not None:
                await self._follow(running)
                await self._status(_INFO, f"rig {self.rig}: the run has ended; waiting for the next one", _WAITS)
            running = await self._next(running)
            await self._say({"op": "removeStatus", "statusIds": [_WAITS]})
            await self._introduce(running)

    # -- messages to the viewer --------------------------------------------------------------------------------------

    async def _introduce(self, running: Running | None) -> None:
        """Send name and channels. Each run is a new session, so that a viewer starts anew with each run."""
        simulated = " SIMULATED" if (self.simulated if running is None else running.simulated) else ""
        run, rehearsal = (None, "") if running is None else (running.run, f" {REHEARSAL}" * running.rehearsal)
        metadata = {"rig": self.rig, "run": run or "", "simulated": str(bool(simulated)).lower(),
                    "rehearsal": str(bool(rehearsal)).lower()}
        await self._say({"op": "serverInfo", "name": f"tdhil, rig {self.rig}{simulated}{rehearsal}", "capabilities": [],
                         "metadata": metadata, "sessionId": run or "no run"})
        await self._say({"op": "advertise", "channels": [
            {"id": number, "topic": topic, "encoding": "protobuf", "schemaName": schema_name(message),
             "schema": b64encode(schema_of(message)).decode(), "schemaEncoding": "protobuf"}
            for number, (topic, message) in CHANNELS.items()]})
        if running is None:
            await self._status(_INFO, f"rig {self.rig} has no run; waiting for one", _WAITS)

    async def _next(self, before: Running | None) -> Running:
        while True:
            found: Running | None = await anyio.to_thread.run_sync(self.current)
            if found is not None and (before is None or found.run != before.run):
                return found
            await anyio.sleep(5.0 * EVERY_S)

    async def _follow(self, running: Running) -> None:
        """Send the run's log until it is closed, or until the rig has another run and all data are sent."""
        self._readers, self._new = [], set(self._wanted)
        looked_s, gone = self.clock(), False
        while True:
            if self._new:
                wanted, self._new = {one: self._wanted[one] for one in self._new}, set()
                self._readers.append(_ChannelReader(LogTail(running.log), wanted, self.clock() + FIRST_S))
            more = False
            for reader in self._readers:
                more |= await self._forward(reader)
            self._join()
            if not more and not self._new:
                ended = bool(self._readers) and all(one.tail.closed for one in self._readers)
                if ended or gone:
                    return
                if self.clock() - looked_s >= LOOK_S:
                    found = await anyio.to_thread.run_sync(self.current)
                    looked_s, gone = self.clock(), found is None or found.run != running.run
                await anyio.sleep(EVERY_S)

    async def _forward(self, reader: _ChannelReader) -> bool:
        """Send new messages of the reader's channels. Return whether more can be read at once."""
        looked_s = self.clock()
        came: LogChunks = await anyio.to_thread.run_sync(reader.tail.read_chunks)
        for chunk in came.chunks:
            late = self.clock() > reader.until_s
            for message in messages_in(chunk):
                subscription = reader.wanted.get(message.number)
                if subscription is None:
                    continue
                if late and message.number in _EACH_CYCLE:
                    reader.left_out += 1
                    continue
                await self.send_bytes(_DATA.pack(1, subscription, message.log_time_ns) + message.payload)
        if not came.more:
            reader.until_s = max(reader.until_s, looked_s + LATE_S)
            if reader.left_out:
                await self._status(_WARNING, f"viewer too slow: {reader.left_out} messages of every cycle left out")
                reader.left_out = 0
        return came.more

    def _join(self) -> None:
        self._readers = [one for one in self._readers if one.wanted]
        for one in self._readers[1:]:
            if one.tail.offset == self._readers[0].tail.offset:
                self._readers[0].wanted |= one.wanted
                self._readers.remove(one)

    async def _status(self, level: int, text: str, name: str | None = None) -> None:
        await self._say({"op": "status", "level": level, "message": text} | ({} if name is None else {"id": name}))

    async def _say(self, message: dict[str, Any]) -> None:
        await self.send_text(json.dumps(message))
