"""One thread on one CAN bus: every frame in and out passes here, in order.

There is no Notifier and no other thread. The caller that waits for a TPDO or an SDO response takes frames off the bus
itself and passes each one to its handler. So an error of the bus appears in the control loop that caused it, and no
other code sends a frame.
"""

from __future__ import annotations

import contextlib
import errno
import time
from collections.abc import Callable
from enum import Enum
from typing import TYPE_CHECKING, Final

from drivers.canopen.bounded_send import bound_send
from drivers.clock import Clock
from drivers.drive import FrameTap, RawFrame
from drivers.errors import CommunicationLost
from profiles import CYCLE_ANSWER, CYCLE_ASKED, CYCLE_ID, MessageCode

if TYPE_CHECKING:
    import can


# ---------------------------------------------------------------------------------------------------------------------
# Offset between the time stamps of the frames and control time. It is a diagnostic only: no timing depends on it.
#
# SocketCAN stamps frames with the wall clock, which may be set during a run. The time of a sample is the control time
# of its SYNC. Its age is control time too. So a jump of the wall clock does not affect them. Jumps are counted because
# they matter when a candump is compared with the log.


WINDOW_S: Final = 0.5
WINDOW_FRAMES: Final = 4
JUMP_S: Final = 0.1
_EPOCH_S: Final = 1e9
"""Least time stamp from a wall clock, s. Smaller stamps count from the start of the adapter, or are absent (0)."""


class FrameStamps:
    """Offset between wall clock and control time.

    ``offset_s`` is wall clock minus control time; None while it is unknown. A frame that waited in a buffer makes the
    offset look smaller. So the largest offset of each half second counts, because a burst that is read late is shorter.
    """

    def __init__(self) -> None:
        self.offset_s: float | None = None
        self.jumps = 0
        self._best_s = 0.0
        self._frames = 0
        self._begun_s = 0.0

    def take(self, stamp_s: float, now_s: float) -> None:
        """Use one received frame: its stamp, and the control time at which it was read from the bus."""
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
# State of the bus as the adapter reports it: SocketCAN's error frames, and a full transmit queue.
#
# The identifier of an error frame holds classes, its second byte the state of the controller (Linux,
# `linux/can/error.h`). Error frames of other interfaces hold neither; those are only counted.


CONTROLLER, BUS_OFF = 0x04, 0x40
_PASSIVE = 0x10 | 0x20
"""Receiver or transmitter error-passive: more than 127 errors, CiA 301 and ISO 11898-1."""
_FULL = ("buffer full", "queue full", "no buffer space")


class Condition(Enum):
    """Meaning of one error frame for the run."""

    ERROR = "an error on the bus"
    PASSIVE = "the adapter is error-passive"
    OFF = "the adapter is bus-off"


def condition(identifier: int, data: bytes) -> Condition:
    """Return the condition that one error frame reports."""
    if identifier & BUS_OFF:
        return Condition.OFF
    if identifier & CONTROLLER and len(data) > 1 and data[1] & _PASSIVE:
        return Condition.PASSIVE
    return Condition.ERROR


def queue_is_full(error: BaseException) -> bool:
    """Return whether a frame was not sent because the transmit queue is full."""
    numbers = getattr(error, "error_code", None), getattr(error, "errno", None)
    return errno.ENOBUFS in numbers or any(text in str(error).lower() for text in _FULL)


# ---------------------------------------------------------------------------------------------------------------------

Handler = Callable[[bytes], None]
LONGEST_DRAIN_S = 0.25
"""Longest time for one drain, s of wall time. A flooded bus must not block a cycle."""
STOP_DRAIN_S = 0.005
"""Longest time for one drain in a stop, s of wall time: about one cycle at 250 Hz. The quick stop waits no longer."""
PEER_DEAD_S = 4.0
"""Wall time, s, after which a peer without an answer counts as dead in stepped time. No other limit ends the wait."""
PEER_STILL_DEAD_S = 0.05
"""Waiting time for a dead peer, s. It applies until a frame from the peer arrives again."""
ASK_S, ASK_SOON_S, ASK_AGAIN_S = 0.05, 0.002, 0.25
"""Waiting times before tdhil asks the peer whether it has finished, s: the first, one after a failed wait, a repeated
one."""
BABBLE_FRAMES = 2000
"""Number of frames in one drain that shows a flooded bus: more than a 1 Mbit/s bus carries in `LONGEST_DRAIN_S`. With
fewer frames, this computer was delayed."""


class CanLink:
    """Sender and receiver on a python-can bus. ``tap`` gets all frames, ``handlers`` the frames of their identifier."""

    def __init__(self, bus: can.BusABC, clock: Clock, tap: FrameTap | None = None) -> None:
        from can import Message

        self._message = Message
        self._bus = bus
        self._bounded = bound_send(bus)
        self._clock = clock
        self._tap = tap
        self.handlers: dict[int, Handler] = {}
        self.remote_handlers: dict[int, Handler] = {}      # for remote frames, which carry no data
        self._shut = ""                # why transmission has ended
        self.error_frames = 0
        self.passive = 0               # number of error-passive states that the adapter reported
        self.stopping = False          # a stop is under way: no flood may delay its frames
        self.stamps = FrameStamps()
        self.name = str(bus.channel_info)
        self.asks = False              # simulated peer in stepped time: it can report its cycle
        # When `send` returns, the queue holds all frames that the peers send in reply. So an empty queue stays empty.
        self._answers_at_once: bool = getattr(bus, "answers_at_once", False)
        self._question = 0
        self._answered = self._in_vain = self._dead = False

    def send(self, identifier: int, data: bytes, last_check: Callable[[], None] | None = None) -> None:
        """Put one frame on the bus. Raises CommunicationLost if the bus doesn't take it.

        ``last_check`` is called immediately before the frame is sent, and may raise to prevent it.
        """
        message = self._message(arbitration_id=identifier, data=data, is_extended_id=False, check=False)
        if last_check is not None:
            last_check()
        self._put(message)
        if self._tap is not None:
            self._tap(RawFrame(self._clock.now_s(), True, identifier, data))

    def ask(self, identifier: int) -> None:
        """Send a remote frame of one byte (node guarding). ``tap`` gets it as a frame without data."""
        self._put(self._message(
            arbitration_id=identifier, is_remote_frame=True, dlc=1, is_extended_id=False, check=False
        ))
        if self._tap is not None:
            self._tap(RawFrame(self._clock.now_s(), True, identifier, b""))

    def _put(self, message: can.Message) -> None:
        if self._shut:
            raise CommunicationLost(
                f"{self._shut}: transmission has ended",
                where=self.name,
                next_step="Repair the bus and start again. The drive's own watchdog stops the shaft",
                entry=MessageCode.BUS_FAILED,
            )
        try:
            self._bus.send(message, **self._bounded)
        except Exception as error:  # python-can's backends raise CanError, OSError, BrokenPipeError alike
            if queue_is_full(error):
                self._shut_up(f"the transmit queue is full ({error})")
            elif self._bounded:            # a part of the frame may be in the adapter
                self._shut_up(f"the adapter did not take a frame ({error})")
            raise CommunicationLost(
                f"the bus did not accept a frame: {error}",
                where=self.name,
                next_step="Check adapter and cable. The drive's own watchdog stops the shaft",
                entry=MessageCode.BUS_FAILED,
            ) from error

    def receive(self, timeout_s: float) -> tuple[int, bytes] | None:
        """Return the next frame as (identifier, data) after its handler has run; None after ``timeout_s`` of wall
        time.
        """
        try:
            message = self._bus.recv(timeout_s)
        except Exception as error:  # any type of error, as in `_put`
            raise CommunicationLost(
                f"no frame can be received: {error}",
                where=self.name,
                next_step="Check adapter and cable. The drive's own watchdog stops the shaft",
                entry=MessageCode.BUS_FAILED,
            ) from error
        if message is None:
            return None
        if message.is_error_frame:
            self._error_frame(message)
            return -1, b""
        now_s = self._clock.now_s()
        if not self._clock.stepped:
            self.stamps.take(message.timestamp, now_s)
        identifier, data = message.arbitration_id, bytes(message.data)
        if identifier == CYCLE_ID and data[:1] == CYCLE_ANSWER:     # not a part of the run: ``tap`` does not get it
            self._answered |= data[1:] == bytes((self._question,))
            return identifier, data
        if self._tap is not None:
            self._tap(RawFrame(now_s, False, identifier, data))
        # A remote frame (node guarding by another master) carries no state. tdhil uses no 29-bit identifiers.
        handler = (self.remote_handlers if message.is_remote_frame else self.handlers).get(identifier)
        if handler is not None and not message.is_extended_id:
            handler(data)
        return identifier, data

    def _error_frame(self, message: can.Message) -> None:
        """Count an error frame. Raises CommunicationLost for bus-off: the adapter may recover, but not in this run."""
        self.error_frames += 1
        found = condition(message.arbitration_id, bytes(message.data))
        if found is Condition.PASSIVE:
            self.passive += 1
        elif found is Condition.OFF and not self._shut:
            self._shut_up("the adapter is bus-off")
            raise CommunicationLost(
                "the adapter went bus-off: too many errors on the bus",
                where=self.name,
                next_step="Check bit rate, termination and cable. The drive's own watchdog stops the shaft",
                entry=MessageCode.BUS_FAILED,
            )

    def _shut_up(self, why: str) -> None:
        """End transmission and empty the queue: a queued setpoint is out of date when it is sent."""
        self._shut = why
        with contextlib.suppress(Exception):       # not every interface supports it
            self._bus.flush_tx_buffer()

    def try_again(self) -> None:
        """Allow transmission again, to stop a drive that has no watchdog. An old setpoint does no additional harm
        then.
        """
        self._shut = ""

    def drain(self) -> None:
        """Handle all frames that have arrived, without waiting. Raises CommunicationLost if frames keep coming.

        In a stop it ends after `STOP_DRAIN_S` without an error: the next frame of the stop must be sent.
        """
        if self.receive(0.0) is None:
            return
        deadline_s, taken = time.monotonic() + (STOP_DRAIN_S if self.stopping else LONGEST_DRAIN_S), 1
        while self.receive(0.0) is not None:
            taken += 1
            if self.stopping:
                if time.monotonic() > deadline_s:
                    return
            elif taken > BABBLE_FRAMES and time.monotonic() > deadline_s:
                raise CommunicationLost(
                    "frames arrive faster than this computer can read them",
                    where=self.name,
                    next_step="A node floods the bus. Find it with candump; check bit rate and termination",
                    entry=MessageCode.BUS_FLOODED,
                )

    def await_answer(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Handle frames until ``done()`` is true or the expected frame is lost. Return whether ``done()`` was true.

        In real time the frame is lost after ``timeout_s``. A peer that can report its cycle (`asks`) reports that it
        has nothing more to send. Then no clock ends the wait, except for a dead peer (`PEER_DEAD_S`).
        """
        if not self.asks or self._answers_at_once:
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
            # After a freeze of this computer the missed frames are in the buffer. So no wait counts for more than its
            # length.
            waited_s += min(time.monotonic() - begun_s, wait_s)
        self._in_vain = self._dead = False
        return True

    def pump_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Handle frames until ``done()`` is true or ``timeout_s`` of wall time has passed. Return whether it was true.

        A stepped peer that answers at once needs no wait: after the last frame in the queue no other frame comes.
        """
        if self.asks and self._answers_at_once:
            while not done():
                if self.receive(0.0) is None:
                    return False
            return True
        deadline_s = time.monotonic() + timeout_s
        while not done():
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                return False
            self.receive(left_s)
        return True

    def close(self) -> None:
        """Shut the bus down and ignore its errors."""
        with contextlib.suppress(Exception):
            self._bus.shutdown()
