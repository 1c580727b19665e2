"""The contract between a CiA 402 drive and the bus that carries it.

A bus carries two things: objects (read and written one by one), and one cyclic frame in each direction. It also lets
the drive supervise the host. `drivers.cia402.drive` does everything else with these. A new bus fills in the eleven
abstract methods of `Cia402Bus`; the other methods have a default for a bus on which nothing else can happen::

    take → map_cyclic → arm → start → (listen_until → begin → send → receive) … → release → close

Setpoints and inputs are in counts of the objects. A bus scales nothing and knows no state of the drive. In the cyclic
synchronous modes (CST, CSV) the setpoint of each `send` acts at once, so the host's ramp is what the drive follows. The
bus treats them like any other mode.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple

from drivers.cia402.objects import Objects
from drivers.cia402.process_data import CyclicObjects, Reported
from drivers.cia402.state_machine import ENABLE_OPERATION
from drivers.cia402.supervision import DriveWatch, Group
from drivers.clock import Clock, Ticks
from drivers.drive import DriveLimits, Identity
from drivers.errors import ObjectRefused
from drivers.preflight import PreflightTable
from profiles.cia402 import Position


class CycleSetpoints(NamedTuple):
    """Setpoints of one cycle, in counts. ``mode_changes``: 6060h must be sent, even if it is not sent cyclically."""

    word: int                      # 6040h
    torque: int                    # 6071h
    speed: int                     # 60FFh or 6042h
    mode: int                      # 6060h
    offset: int                    # torque offset, if mapped
    mode_changes: bool

    @property
    def enables(self) -> bool:
        """True if the controlword enables the operation."""
        return self.word & ENABLE_OPERATION == ENABLE_OPERATION

    def stopped(self, word: int) -> CycleSetpoints:
        """Return setpoints with this controlword, and torque, speed and torque offset of zero; the mode stays."""
        return self._replace(word=word, torque=0, speed=0, offset=0)


class CycleInputs(NamedTuple):
    """Feedback of one cycle, in counts. ``age_s``: delay after the instant that it belongs to, s.

    ``doubted``: more than one feedback frame came for this cycle. ``angle``: None if the cycle brought none.
    """

    age_s: float
    fresh: bool = False
    doubted: bool = False
    status: int = 0                # 6041h
    torque: float = 0              # 6077h, or the manufacturer's object
    speed: int = 0                 # 606Ch or 6044h
    angle: float | None = None


class Traffic(NamedTuple):
    """Errors on the bus since the start; see `drivers.drive.Counters`."""

    late: int = 0
    error_frames: int = 0
    passive: int = 0
    wall_offset_s: float | None = None
    wall_jumps: int = 0


PAUSE_S = 0.01
"""Wall time between two objects for a drive that needs it, s."""
FeedbackSetting = tuple[str, int, int, bytes]
"""Object that defines content or timing of the feedback: title, index, sub-index, required bytes."""


class Cia402Bus(ABC):
    """One drive on one bus."""

    place = "drive"
    """Name of the drive on its bus, for messages."""
    feedback_place = "drive"
    """Name of the feedback frame, for messages."""
    feedback_timing: tuple[int, int] | None = None
    """Index and sub-index of the object that sets how often the feedback comes; None: nothing can change it."""
    angle_mapped = False
    """True if the cyclic frames carry the motor's angle."""
    interpolates = False
    """True if a mode in use is cyclic synchronous: the drive then interpolates between the setpoints (60C2h)."""

    def __init__(self, objects: Objects, watch: DriveWatch, clock: Clock, period_s: float) -> None:
        self.objects = objects
        self.watch = watch
        self.clock = clock
        self.period_s = period_s
        self.reported = Reported()     # mode display and torque demand arrive at their own time
        self.ticks = Ticks(clock, period_s)
        self.on_write: Callable[[int, int], None] = lambda index, sub: None
        """Called with index and sub-index of an object that another master wrote."""
        self.on_answer: Callable[[int, int, bytes | None], None] = lambda index, sub, data: None
        """Called with each answer to a read request, of any client; None: refused."""

    # -- before motion ---------------------------------------------------------------------------------------

    @abstractmethod
    def take(self) -> None:
        """Put the drive into the state in which it is configured (pre-operational)."""

    def confirm(self, identity: Identity) -> None:
        """Refuse a drive that is not unique on its bus, after its identity was read. Raises PreflightRefused."""
        return

    @abstractmethod
    def map_cyclic(
        self, table: PreflightTable, content: CyclicObjects, demand: bool, position: Position | None
    ) -> Sequence[FeedbackSetting]:
        """Map the cyclic frames: ``content``, and the torque demand and the angle if there is room for them.

        Return the settings of the feedback frames that another master could change.
        """

    @abstractmethod
    def arm(self, table: PreflightTable, limits: DriveLimits) -> float:
        """Set the timing, arm the watchdog and read it back. Return the period of feeding it, s; 0: not armed."""

    def setting(self, index: int) -> tuple[str, Group] | None:
        """Return title and group of an object of the bus that preflight has set, for reading it back in motion.

        None: not an object of the bus. An empty title: not to be read back.
        """
        return None

    @abstractmethod
    def start(self) -> None:
        """Make the cyclic frames act, and supervise the drive from now on."""

    def set_period(self, period_s: float) -> Sequence[tuple[int, int, bytes]]:
        """Change the period of the cycle between preflight and motion, and end the supervision until `start`.

        Return (index, sub-index, bytes) of the objects that were changed.
        """
        self.period_s = period_s
        self.watch.stop()
        return ()

    def refuse_motion(self) -> None:
        """Refuse motion if another node feeds the drive's watchdog. Raises PreflightRefused."""
        return

    # -- the cycle -------------------------------------------------------------------------------------------

    @abstractmethod
    def listen_until(self, tick_s: float) -> None:
        """Wait until this control time, s, and handle incoming frames meanwhile."""

    def begin(self, try_again: bool) -> float:
        """Begin a cycle: raise the errors so far, and feed the watchdog if it is due. Return the control time, s.

        ``try_again``: transmit even after an error of the bus. By default the setpoints themselves feed the watchdog.
        """
        self.check()
        return self.clock.now_s()

    @abstractmethod
    def send(self, setpoints: CycleSetpoints) -> None:
        """Send the setpoints; they act in this cycle."""

    @abstractmethod
    def receive(self, now_s: float, sync: bool) -> CycleInputs:
        """Complete the cycle and return the feedback. With ``sync``, start the exchange of the frames first."""

    def check(self) -> None:
        """Raise the oldest error of the drive that was not raised yet."""
        self.watch.check()

    @property
    def others_drive(self) -> bool:
        """True if setpoints of another master were received since the start."""
        return False

    @abstractmethod
    def feed(self) -> None:
        """Feed the drive's watchdog now."""

    def feed_when_due(self, now_s: float) -> None:
        """Feed the drive's watchdog if it is due."""
        self.feed()

    def feed_between(self) -> None:
        """Feed the drive's watchdog between two cycles, without effect on the next due time."""
        self.feed()

    @abstractmethod
    def stop_feeding(self) -> None:
        """Never feed the drive's watchdog again."""

    # -- beside the cycle ------------------------------------------------------------------------------------

    def ask(self, index: int, sub: int) -> None:
        """Send a read request without waiting; `on_answer` gets the answer. Raises CommunicationLost."""
        try:
            data: bytes | None = self.objects.read_bytes(index, sub)
        except ObjectRefused:
            data = None
        self.on_answer(index, sub, data)

    def put(self, index: int, sub: int, data: bytes) -> None:
        """Send a write request of at most four bytes without waiting for the answer. Raises CommunicationLost."""
        with suppress(ObjectRefused):
            self.objects.write_bytes(index, sub, data)

    @abstractmethod
    def disable_setpoints(self) -> int:
        """Disable all cyclic setpoints in the drive, ours and other masters'. Return how many. Raises nothing."""

    def pause(self) -> None:
        """Wait a short wall time for a drive that needs it between two objects."""
        if not self.clock.stepped:
            time.sleep(PAUSE_S)

    def hurry(self, stopping: bool) -> None:
        """Note whether a stop is under way. Then frames that arrive must not delay those that are sent."""
        return

    def reach(self) -> None:
        """Put a drive that left operation into a state in which its objects can be read, and feed its watchdog."""
        self.feed()

    def keep_stepping(self) -> None:
        """Set the cycle of a simulated drive again, which may have restarted."""
        return

    def changed(self, index: int, sub: int) -> None:
        """Handle the change of an object that is read back, by another master."""
        return

    def intervals_s(self, period_s: float) -> tuple[float, float]:
        """Return the times between two displays of the mode and between two angles at this period, s."""
        return period_s, period_s

    def late_since(self, since_s: float) -> list[float]:
        """Return the delays of answers that came after the end of their cycles, s, for arrivals since ``since_s``."""
        return []

    def traffic(self) -> Traffic:
        """Return the errors on the bus since the start."""
        return Traffic()

    def summary(self) -> tuple[str, ...]:
        """Return what other masters sent during the run, one line each."""
        return ()

    # -- afterwards ------------------------------------------------------------------------------------------

    def release(self) -> None:
        """Put the drive into the state in which it is configured, after it was disabled.

        Raises CommunicationLost, or DriveFault if the drive refuses.
        """
        self.take()

    @abstractmethod
    def close(self) -> None:
        """Close the bus."""
