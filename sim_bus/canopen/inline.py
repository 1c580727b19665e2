"""A stepped simulator in the host's own thread: there is no other thread, and no wait for one.

::

    host   bus.send(SYNC) ──► the drive receives it, replies, and advances by one period
                          ◄── returns
           bus.recv()     ◄── TPDO1, TPDO2, heartbeat …, in the order in which the drive sent them

All replies to a frame are in the queues of the stations when `send` returns. So the cycle of an answer does not depend
on the computer's scheduling, and a run repeats to the last frame of its log. The drive is that of
`sim_bus.canopen.simulator.EmbeddedSimulator`: it sends the same frames in the same order.

Only the SYNC advances plant time, so a pause of the host of any length has no effect. A drive that leaves stepped time
(5FFEh:2) catches up with the wall clock when it receives a frame.
"""

import time
import uuid
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock
from typing import Self

import can

from profiles.canopen import CanopenProfile
from sim_bus.canopen.simulator import Embedded, Simulator
from sim_bus.fault_script import Scripted
from sim_bus.params import RigParams


class InlineBus(can.BusABC):
    """A station on the line of an `InlineSimulator`, which creates it."""

    answers_at_once = True
    """True: when `send` returns, all replies of the other stations are in their queues. A host reads this attribute."""

    def __init__(self, channel: str, stations: "list[InlineBus]", hear: Callable[[can.Message], None]) -> None:
        super().__init__(channel)
        self.channel_info = f"Virtual bus channel {channel}"
        self._stations = stations
        self._hear = hear
        self.heard: SimpleQueue[can.Message] = SimpleQueue()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame. The other stations have it and the drive has replied when this returns.

        Raises CanOperationError on a bus that is shut down.
        """
        if self._is_shutdown:
            self._refuse_shut()
        if len(self._stations) > 1:
            for station in self._stations:
                if station is not self:
                    station.heard.put(_stamped(deepcopy(msg)))
        self._hear(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame; None after ``timeout`` s of wall time. Raises CanOperationError on a bus that is shut
        down.
        """
        if self._filters is None and not self._is_shutdown:
            heard = self.heard
            if not heard.empty():
                return heard.get_nowait()
            if timeout is not None and timeout <= 0.0:
                return None
        return super().recv(timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._refuse_shut()
        try:
            return self.heard.get(timeout=None if timeout is None else max(0.0, timeout)), False
        except Empty:
            return None, False

    def shutdown(self) -> None:
        """End the exchange of frames; safe to repeat."""
        super().shutdown()
        if self in self._stations:
            self._stations.remove(self)

    def _refuse_shut(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError("Cannot operate on a closed bus")


class _DrivesEnd(InlineBus):
    """The drive's end for sending. It has no queue: each frame from another station goes to the drive at once."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame to all stations. The first one gets the frame itself, because the drive makes a new frame for
        each sending.
        """
        for number, station in enumerate(self._stations):
            station.heard.put(_stamped(deepcopy(msg) if number else msg))


def _stamped(message: can.Message) -> can.Message:
    message.timestamp = time.time()
    return message


class InlineSimulator(Embedded):
    """A stepped simulator that acts whenever a station sends. ``bus`` is one station; `station` makes more.

    After an error the simulator is silent, like a thread that has ended; `Embedded.check` and `Embedded.close` raise
    the error. An exception from outside (KeyboardInterrupt) is passed on. Then no more frames are accepted, because it
    may have come in the middle of a step.
    """

    def __init__(self, params: RigParams | None = None, *, node_id: int = 1, seed: int = 0, trace: Path | None = None,
                 profile: CanopenProfile | None = None, faults: tuple[Scripted, ...] = ()) -> None:
        super().__init__()
        self.channel = f"tdhil-{uuid.uuid4().hex}"
        self._stations: list[InlineBus] = []
        self._drives_end = _DrivesEnd(self.channel, self._stations, self._hear)
        self.simulator = Simulator(
            self._drives_end, params or RigParams(), node_id=node_id, seed=seed, trace=trace, stepped=True,
            profile=profile, faults=faults,
        )
        self._one_at_a_time = Lock()
        self._on = self._cut_short = False
        self.bus = self.station()

    def station(self) -> InlineBus:
        """Return another bus on the same line; it does not receive earlier frames."""
        bus = InlineBus(self.channel, self._stations, self._hear)
        self._stations.append(bus)
        return bus

    def open(self) -> Self:
        """Switch the drive on. Frames sent before are lost."""
        with self._one_at_a_time:
            self._on = True
            self._do(self.simulator.begin)
        return self

    def _end(self) -> None:
        try:
            with self._one_at_a_time:
                if self._on:
                    self._do(self.simulator.end)
                self._off()
        finally:
            for bus in (*self._stations, self._drives_end):
                bus.shutdown()

    def _hear(self, message: can.Message) -> None:
        with self._one_at_a_time:
            if self._on:
                try:
                    self.simulator.hear(message)
                except BaseException as error:
                    self._failed(error)
            elif self._cut_short:
                raise can.CanOperationError("the simulated drive was interrupted")

    def _do(self, act: Callable[[], None]) -> None:
        try:
            act()
        except BaseException as error:
            self._failed(error)

    def _failed(self, error: BaseException) -> None:
        """Fall silent. An exception from outside that is not an error of the simulation is passed on."""
        own = isinstance(error, Exception)
        if own:
            self._failure = error
        else:
            self._cut_short = True
        self._off()
        if not own:
            raise error

    def _off(self) -> None:
        self._on = False
        self.simulator.close_trace()
