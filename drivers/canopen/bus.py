"""One thread on one CAN bus: every frame in and out passes here, in order.

There is no Notifier and no other thread. Whoever waits, for a TPDO or for an SDO response, pulls frames off
the bus himself and hands on those meant for others; so an error of the bus surfaces in the control loop
that caused it, and nothing is ever sent behind the loop's back.
"""

from __future__ import annotations

import contextlib
import errno
import time
from collections.abc import Callable
from enum import Enum
from typing import TYPE_CHECKING, Final

from drivers.clock import Clock
from drivers.drive import FrameTap, RawFrame
from drivers.errors import CommunicationLost
from profiles import CYCLE_ANSWER, CYCLE_ASKED, CYCLE_ID

if TYPE_CHECKING:
    import can


# ---------------------------------------------------------------------------------------------------------------------
# The stamps that frames bear, mapped to control time: only to know where the two stand, nothing is timed by them.
#
# SocketCAN stamps with the wall clock, which somebody may set while a run goes on. A sample's time is the control time
# of its SYNC, its age is control time too; so a jump changes nothing, but it is noticed, for whoever lays a candump
# beside the log.


WINDOW_S: Final = 0.5
WINDOW_FRAMES: Final = 4
JUMP_S: Final = 0.1
_EPOCH_S: Final = 1e9
"""Stamps below it count from a start of the adapter's (or there are none: 0); they are no wall clock's."""


class FrameStamps:
    """``offset_s`` is wall clock minus control time; None as long as it isn't known.

    A frame that waited in a buffer looks as if the offset were smaller. So of each half second the largest counts:
    a burst that was taken late is over long before.
    """

    def __init__(self) -> None:
        self.offset_s: float | None = None
        self.jumps = 0
        self._best_s = 0.0
        self._frames = 0
        self._begun_s = 0.0

    def take(self, stamp_s: float, now_s: float) -> None:
        """One received frame: its stamp, and the control time at which it was taken off the bus."""
        if stamp_s < _EPOCH_S:
            return
        offset_s = stamp_s - now_s
        if self._frames == 0:
            self._best_s, self._begun_s = offset_s, now_s
        elif offset_s > self._best_s:
            self._best_s = offset_s
        self._frames += 1
        if self._frames >= WINDOW_FRAMES and now_s - self._begun_s >= WINDOW_S:
            if self.offset_s is not None and abs(self._best_s - self.offset_s) > JUMP_S:
                self.jumps += 1
            self.offset_s = self._best_s
            self._frames = 0


# ---------------------------------------------------------------------------------------------------------------------
# What the adapter says of the bus: SocketCAN's error frames, and a transmit queue that is full.
#
# An error frame's identifier holds classes, its second byte the controller's state (Linux, `linux/can/error.h`). Other
# interfaces send error frames without either: those are counted only.


CONTROLLER, BUS_OFF = 0x04, 0x40
_PASSIVE = 0x10 | 0x20
"""Receiver or transmitter error-passive: more than 127 errors, CiA 301 and ISO 11898-1."""
_FULL = ("buffer full", "queue full", "no buffer space")


class Condition(Enum):
    """What one error frame means for the run."""

    ERROR = "an error on the bus"
    PASSIVE = "the adapter is error-passive"
    OFF = "the adapter is bus-off"


def condition(identifier: int, data: bytes) -> Condition:
    """Of one error frame."""
    if identifier & BUS_OFF:
        return Condition.OFF
    if identifier & CONTROLLER and len(data) > 1 and data[1] & _PASSIVE:
        return Condition.PASSIVE
    return Condition.ERROR


def queue_is_full(error: BaseException) -> bool:
    """Did a frame not go out because those before it are still waiting?"""
    numbers = getattr(error, "error_code", None), getattr(error, "errno", None)
    return errno.ENOBUFS in numbers or any(text in str(error).lower() for text in _FULL)


# ---------------------------------------------------------------------------------------------------------------------

Handler = Callable[[bytes], None]
LONGEST_DRAIN_S = 0.25
"""Of wall time. A cycle must not be held up for ever by a bus on which something babbles."""
PEER_DEAD_S = 4.0
"""In stepped time a peer that has answered no question for so long, of wall time, is dead; nothing else ends a wait."""
PEER_STILL_DEAD_S = 0.05
"""A dead one is given so long from then on, until it is heard again."""
ASK_S, ASK_SOON_S, ASK_AGAIN_S = 0.05, 0.002, 0.25
"""It is asked after so long in which what is waited for didn't come; sooner if that was so the last time."""
BABBLE_FRAMES = 2000
"""More than a bus of 1 Mbit/s carries in that time: with fewer it was this computer that stood still."""


class CanLink:
    """Sends and receives on a python-can bus; ``tap`` sees every frame, ``handlers`` those of their identifier."""

    def __init__(self, bus: can.BusABC, clock: Clock, tap: FrameTap | None = None) -> None:
        from can import Message

        self._message = Message
        self._bus = bus
        self._clock = clock
        self._tap = tap
        self.handlers: dict[int, Handler] = {}
        self.remote_handlers: dict[int, Handler] = {}      # of remote frames, which carry no data
        self._shut = ""                # why nothing is sent any more
        self.error_frames = 0
        self.passive = 0               # how often the adapter said that it is error-passive
        self.stamps = FrameStamps()
        self.name = str(bus.channel_info)
        self.asks = False              # the peer is a simulated one in stepped time, and may be asked where a cycle is
        self._question = 0
        self._answered = self._in_vain = self._dead = False

    def send(self, identifier: int, data: bytes, last_check: Callable[[], None] | None = None) -> None:
        """Put one frame on the bus. Raises CommunicationLost if the bus doesn't take it.

        ``last_check`` is called when nothing but sending is left to be done, and may raise to prevent it.
        """
        message = self._message(arbitration_id=identifier, data=data, is_extended_id=False, check=False)
        if last_check is not None:
            last_check()
        self._put(message)
        if self._tap is not None:
            self._tap(RawFrame(self._clock.now_s(), True, identifier, data))

    def ask(self, identifier: int) -> None:
        """Put a remote frame of one byte on the bus (node guarding); tapped as a frame without data."""
        self._put(self._message(
            arbitration_id=identifier, is_remote_frame=True, dlc=1, is_extended_id=False, check=False
        ))
        if self._tap is not None:
            self._tap(RawFrame(self._clock.now_s(), True, identifier, b""))

    def _put(self, message: can.Message) -> None:
        if self._shut:
            raise CommunicationLost(
                f"{self._shut}: nothing is sent any more",
                where=self.name,
                next_step="Mend the bus and start anew; the drive's own watchdog stops the shaft",
            )
        try:
            self._bus.send(message)
        except Exception as error:  # python-can's backends raise CanError, OSError, BrokenPipeError alike
            if queue_is_full(error):
                self._shut_up(f"the transmit queue is full ({error})")
            raise CommunicationLost(
                f"the bus did not take a frame: {error}",
                where=self.name,
                next_step="Check adapter and cable; the drive's own watchdog stops the shaft",
            ) from error

    def receive(self, timeout_s: float) -> tuple[int, bytes] | None:
        """The next frame as (identifier, data), already handed on; None after ``timeout_s`` of wall time."""
        try:
            message = self._bus.recv(timeout_s)
        except Exception as error:  # see send
            raise CommunicationLost(
                f"nothing can be received any more: {error}",
                where=self.name,
                next_step="Check adapter and cable; the drive's own watchdog stops the shaft",
            ) from error
        if message is None:
            return None
        if message.is_error_frame:
            self._error_frame(message)
            return -1, b""
        if not self._clock.stepped:
            self.stamps.take(message.timestamp, self._clock.now_s())
        identifier, data = message.arbitration_id, bytes(message.data)
        if identifier == CYCLE_ID and data[:1] == CYCLE_ANSWER:     # no part of the run: it may come or not
            self._answered |= data[1:] == bytes((self._question,))
            return identifier, data
        if self._tap is not None:
            self._tap(RawFrame(self._clock.now_s(), False, identifier, data))
        # A remote frame (another master's node guarding) carries no state; 29-bit identifiers are no CANopen of ours.
        handler = (self.remote_handlers if message.is_remote_frame else self.handlers).get(identifier)
        if handler is not None and not message.is_extended_id:
            handler(data)
        return identifier, data

    def _error_frame(self, message: can.Message) -> None:
        """Raises CommunicationLost for a bus-off, from which the adapter may come back: not in this run."""
        self.error_frames += 1
        found = condition(message.arbitration_id, bytes(message.data))
        if found is Condition.PASSIVE:
            self.passive += 1
        elif found is Condition.OFF and not self._shut:
            self._shut_up("the adapter is bus-off")
            raise CommunicationLost(
                "the adapter went bus-off: too many errors on the bus",
                where=self.name,
                next_step="Check bit rate, termination and cable; the drive's own watchdog stops the shaft",
            )

    def _shut_up(self, why: str) -> None:
        """What waits in a queue is old by the time it goes out, and so is what would be put behind it."""
        self._shut = why
        with contextlib.suppress(Exception):       # not every interface can
            self._bus.flush_tx_buffer()

    def try_again(self) -> None:
        """Send all the same: for a stop of a drive that no watchdog stops, where an old setpoint is no worse."""
        self._shut = ""

    def drain(self) -> None:
        """Handle all that has arrived, without waiting. Raises CommunicationLost if there is no end of it."""
        deadline_s, taken = time.monotonic() + LONGEST_DRAIN_S, 0
        while self.receive(0.0) is not None:
            taken += 1
            if taken > BABBLE_FRAMES and time.monotonic() > deadline_s:
                raise CommunicationLost(
                    "frames come faster than they can be taken",
                    where=self.name,
                    next_step="Something babbles on the bus: look with candump, check bit rate and termination",
                )

    def await_answer(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Handle frames until ``done()``, or until it is clear that what is waited for was lost; whether it was done.

        In real time that is so after ``timeout_s``; with a peer that may be asked (`asks`), as soon as it says that it
        has nothing more to say: no clock decides then, but whether it is dead.
        """
        if not self.asks:
            return self.pump_until(done, timeout_s)
        waited_s, limit_s = 0.0, PEER_STILL_DEAD_S if self._dead else PEER_DEAD_S
        ask_s = ASK_SOON_S if self._in_vain else ASK_S
        self._question, self._answered = (self._question + 1) % 256, False
        while not done():
            if self._answered or waited_s >= limit_s:
                self._in_vain, self._dead = True, not self._answered
                return False
            if waited_s >= ask_s:
                self._put(self._message(
                    arbitration_id=CYCLE_ID, data=CYCLE_ASKED + bytes((self._question,)), is_extended_id=False,
                    check=False,
                ))
                ask_s = waited_s + ASK_AGAIN_S
            wait_s, begun_s = min(ask_s, limit_s) - waited_s, time.monotonic()
            self.receive(wait_s)
            # Whoever was frozen meanwhile has heard nobody: what he missed is there, and no wait counts for more.
            waited_s += min(time.monotonic() - begun_s, wait_s)
        self._in_vain = self._dead = False
        return True

    def pump_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Handle frames until ``done()`` or until ``timeout_s`` of wall time has passed; whether it was done."""
        deadline_s = time.monotonic() + timeout_s
        while not done():
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                return False
            self.receive(left_s)
        return True

    def close(self) -> None:
        """Shut the bus down; its errors no longer matter."""
        with contextlib.suppress(Exception):
            self._bus.shutdown()
