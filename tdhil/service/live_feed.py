"""Live data of a run for pages: its log, read as it grows, and its status. The run itself is not affected.

There is one feed per run, for any number of viewers. A viewer that is too slow is disconnected, and connects again.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import anyio
import numpy as np

from tdhil.errors import TdhilError
from tdhil.recording import LogNews, LogTail
from tdhil.service.run_state import State, Status

EVERY_S: Final = 0.1
HEARTBEAT_S: Final = 0.5
SPACING_S: Final = 0.04                # control time between two displayed samples
MOST: Final = 12_000                   # samples kept for late viewers; above it, every other one is dropped
EVENTS: Final = 500
INERTIAS: Final = 2000                 # interim answers kept for late viewers
WAITING: Final = 100                   # messages for one viewer, some ten seconds' worth

Viewer = asyncio.Queue[dict[str, Any] | None]


class LivePicture:
    """Data of the run so far, thinned for display. A pure data structure."""

    def __init__(self) -> None:
        self.samples = np.empty((0, 3))
        self.events: list[dict[str, Any]] = []
        self.stages: list[dict[str, Any]] = []
        self.inertias: list[dict[str, Any]] = []
        self.limits: dict[str, float | None] | None = None
        self.rehearsed_faults: list[str] = []
        self.stepped = False
        self.epoch_ns = 0
        self.last_s: float | None = None
        self.arrived_s: float | None = None      # monotonic clock, s
        self._spacing_s = SPACING_S
        self._next_s = -math.inf

    def take(self, news: LogNews, at_s: float) -> dict[str, Any]:
        """Add new data. Return the part that viewers receive."""
        shown: dict[str, Any] = {}
        if len(news.samples):
            self.last_s, self.arrived_s = float(news.samples[-1, 0]), at_s
            self.epoch_ns = self.epoch_ns or news.epoch_ns
            rows = []
            for row, time_s in enumerate(news.samples[:, 0].tolist()):
                if time_s >= self._next_s or time_s < self._next_s - 2.0 * self._spacing_s:
                    rows.append(row)
                    self._next_s = time_s + self._spacing_s
            if rows:
                kept = news.samples[rows]
                self.samples = np.concatenate((self.samples, kept))
                shown["samples"] = columns(kept)
                if len(self.samples) > MOST:
                    self.samples, self._spacing_s = self.samples[::2], 2.0 * self._spacing_s
        if news.events:
            shown["events"] = [{"time_s": one.time_s, "kind": one.kind, "text": one.text} for one in news.events]
            self.events = (self.events + shown["events"])[-EVENTS:]
        if news.stages:
            shown["stages"] = [asdict(one) for one in news.stages]
            self.stages += shown["stages"]
        if news.inertias:
            shown["inertias"] = [asdict(one) for one in news.inertias]
            self.inertias = (self.inertias + shown["inertias"])[-INERTIAS:]
        if news.configuration is not None:
            run = news.configuration.get("run", {})
            self.stepped = run.get("stepped") is True
            if (faults := [str(one) for one in run.get("faults") or ()]) != self.rehearsed_faults:
                self.rehearsed_faults = shown["rehearsed_faults"] = faults
            limits = (run.get("bench") or {}).get("limits")
            if isinstance(limits, dict) and limits != self.limits:
                self.limits = shown["limits"] = limits
        return shown

    def whole(self) -> dict[str, Any]:
        """Return all data so far, for a new viewer."""
        return {"samples": columns(self.samples), "events": self.events, "stages": self.stages,
                "inertias": self.inertias, "limits": self.limits, "rehearsed_faults": self.rehearsed_faults}

    def age_s(self, wall_s: float, mono_s: float) -> float | None:
        """Return the age of the latest sample, s; in stepped time, which runs ahead, the time since its arrival."""
        if self.last_s is None or self.arrived_s is None:
            return None
        if self.stepped or not self.epoch_ns:
            return max(0.0, mono_s - self.arrived_s)
        return max(0.0, wall_s - (self.epoch_ns / 1e9 + self.last_s))


def columns(samples: np.ndarray[Any, Any]) -> list[list[float | None]]:
    """Return [time], [speed], [torque], rounded for display; None for a value that is not finite."""
    return [[round(value, 5) if math.isfinite(value) else None for value in column] for column in samples.T.tolist()]


class Feed:
    """Feed of one run. `watch` returns a queue that starts with all data so far. None in it means: connect again."""

    def __init__(
        self, path: Path, status: Callable[[], Status], tell_viewed: Callable[[], None] = lambda: None
    ) -> None:
        """Make a feed. ``tell_viewed`` reports to the run, once, that a page shows it. It may raise TdhilError."""
        self._tail = LogTail(path)
        self._tell_viewed, self._viewed = tell_viewed, False
        self._read_status = status
        self.picture = LivePicture()
        self.status: Status | None = None
        self.viewers: set[Viewer] = set()
        self._task: asyncio.Task[None] | None = None
        self._stamp: object = None

    def watch(self) -> Viewer:
        queue: Viewer = asyncio.Queue(WAITING)
        rests = self._task is None or self._task.done()
        if rests:                      # the last viewer has left, so the known status is old
            self.status = None
        status = None if self.status is None else self.status.plain()
        queue.put_nowait(self._dated({"type": "hello", **self.picture.whole(), "status": status}))
        self.viewers.add(queue)
        if rests:
            self._task = asyncio.get_running_loop().create_task(self._run())
        return queue

    def leave(self, queue: Viewer) -> None:
        self.viewers.discard(queue)

    async def _run(self) -> None:
        sent_s = 0.0
        self.status = await anyio.to_thread.run_sync(self._present)       # first: reading the log takes longer
        if self.status is not None:
            self._publish(self._dated({"type": "news", "status": self.status.plain()}))
        while self.viewers:
            news, status = await anyio.to_thread.run_sync(self._look)
            shown = self.picture.take(news, time.monotonic())
            if status is not None and status != self.status:
                self.status = status
                shown["status"] = status.plain()
            now_s = time.monotonic()
            if shown or now_s - sent_s >= HEARTBEAT_S:
                sent_s = now_s
                self._publish(self._dated({"type": "news", **shown}))
            await asyncio.sleep(0.0 if news.more else EVERY_S)

    def _present(self) -> Status | None:
        try:
            return self._read_status()
        except Exception:              # the run is being written or deleted: the next check decides
            return None

    def _look(self) -> tuple[LogNews, Status | None]:
        status = self._present()
        if status is not None and status.state is State.MOVING and not self._viewed:
            with suppress(TdhilError):
                self._tell_viewed()
                self._viewed = True
        return self._tail.read(), status

    def _dated(self, message: dict[str, Any]) -> dict[str, Any]:
        age_s = self.picture.age_s(time.time(), time.monotonic())
        return {**message, "age_s": None if age_s is None else round(age_s, 3), "time_s": self.picture.last_s}

    def _publish(self, message: dict[str, Any]) -> None:
        for queue in tuple(self.viewers):
            try:
                queue.put_nowait(message)
            except asyncio.QueueFull:
                self.leave(queue)
                while not queue.empty():
                    queue.get_nowait()
                queue.put_nowait(None)


class Feeds:
    """Feeds that have viewers, and the feeds that had viewers last."""

    def __init__(self, most: int = 20) -> None:
        self._feeds: dict[str, Feed] = {}
        self._most = most

    def of(self, run: str, make: Callable[[], Feed]) -> Feed:
        feed = self._feeds.pop(run, None) or make()
        self._feeds[run] = feed
        for old in [one for one, feed in self._feeds.items() if not feed.viewers][: -self._most]:
            del self._feeds[old]
        return feed

    @property
    def viewers(self) -> int:
        return sum(len(feed.viewers) for feed in self._feeds.values())
