"""The contract between a drive, of whatever make and bus, and everything above it.

All quantities are SI at the motor shaft; torque positive drives speed positive. Nothing above `drivers`
knows of objects, registers, per-mille or rpm. A caller goes down the list once:

    connect → preflight → enable(mode) → exchange(command) … → quick_stop → exchange … → disable → close

`enable`, `quick_stop` and `disable` only say what is wanted; the drive's state machine moves during the
`exchange` calls that follow, one a cycle, so that every cycle is seen, recorded and guarded alike.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, Protocol, runtime_checkable

from drivers.clock import Clock


class Mode(Enum):
    """What the drive regulates."""

    SPEED = "speed"
    TORQUE = "torque"


class PowerState(Enum):
    """The drive's state machine as far as a caller needs it (CiA 402, figure of the state machine)."""

    NOT_READY = "not ready"
    OFF = "off"                    # switch on disabled: no torque
    READY = "ready"                # ready to switch on, or switched on: no torque yet
    ENABLED = "enabled"            # operation enabled: setpoints act
    QUICK_STOP = "quick stop"      # decelerating or holding after a quick stop
    FAULT = "fault"                # fault reaction active, or fault
    UNKNOWN = "no valid state"     # the status word is none that the drive can show: nothing is known of it


class PowerRequest(Enum):
    """Power state that the caller requests."""

    OFF = "off"
    ENABLED = "enabled"
    QUICK_STOP = "quick stop"


class Command(NamedTuple):
    """One cycle's wish: the mode, and the setpoint of each mode (the other one seeds a later switch).

    ``torque_offset_nm`` is added by the drive to what its speed loop asks for; only where `DriveLimits.torque_offset`
    was asked for, in speed mode, and while it is to be enabled: with anything else asked for it goes out as zero.
    """

    mode: Mode
    speed_rad_s: float
    torque_nm: float
    torque_offset_nm: float = 0.0


class Sample(NamedTuple):
    """One cycle's feedback, torque and speed of one instant.

    ``time_s`` is control time of the SYNC (of the middle of the transaction on Modbus, give or take
    ``half_width_s``); ``age_s`` says how long after it the feedback arrived. ``fresh`` is False when the
    cycle brought none: the values are then those of the cycle before.

    ``position_rad`` is the motor shaft's angle at ``time_s``, counted by the drive apart from its speed, and unwrapped
    since the first reading (`drivers.angle`). None where the cycle brought none. In a sample that was polled for
    (`Polled`) it was read right behind the rest.
    """

    time_s: float
    age_s: float
    half_width_s: float
    fresh: bool
    speed_rad_s: float
    torque_nm: float
    torque_demand_nm: float | None
    mode: Mode | None              # as the drive displays it; None while it displays another one
    state: PowerState
    standstill: bool               # as the drive says, where it says so
    limit_active: bool             # internal limit active (statusword bit 11)
    status: int                    # raw statusword, for the log
    position_rad: float | None = None


class RawFrame(NamedTuple):
    """One frame as it stood on the bus; ``time_s`` is control time."""

    time_s: float
    outgoing: bool
    identifier: int
    data: bytes


FrameTap = Callable[[RawFrame], None]


@dataclass(frozen=True)
class Identity:
    """Who is at the other end. ``simulated`` is decided by the simulator's marker alone."""

    vendor: int
    product: int
    revision: int
    serial: int
    name: str
    simulated: bool


@dataclass(frozen=True)
class DriveLimits:
    """What the caller wants the drive itself to enforce, written to it and read back in preflight."""

    speed_rad_s: float
    torque_nm: float
    quick_stop_rad_s2: float
    watchdog_s: float
    accept_no_watchdog: bool = False   # by the operator, by name: a drive whose watchdog is off and stays off
    accept_wider: frozenset[str] = frozenset()     # of `drivers.own_limits.NAMES`: own limits that may be made wider
    accept_shared_watchdog: bool = False   # by the operator, by name: one that any client's requests feed
    temperature_c: float | None = None     # °C; above it the run is stopped, where the drive tells a temperature
    torque_offset: bool = False            # will `Command.torque_offset_nm` be used? refused where the drive has none
    string: bool = False                   # does a drill string hang on the shaft? one that is held is refused


@dataclass(frozen=True)
class ReportingFilters:
    """First-order lags that the drive puts on what it reports, where it tells them; None = not told."""

    speed_lag_s: float | None = None
    torque_lag_s: float | None = None
    source: str = ""


class Outcome(Enum):
    """How a preflight check went."""

    OK = "ok"
    NOTE = "note"                  # worth a line, no obstacle
    REFUSED = "refused"


@dataclass(frozen=True)
class Check:
    """One line of the preflight table."""

    name: str
    wanted: str
    found: str
    outcome: Outcome
    where: str = ""                # object, register or parameter
    next_step: str = ""


@dataclass(frozen=True)
class Preflight:
    """What was found before anything moved."""

    identity: Identity
    checks: tuple[Check, ...]
    modes: frozenset[Mode]
    switch_while_enabled: bool
    quick_stop_in_torque_mode: bool    # does a quick stop decelerate under speed control from torque mode?
    rated_torque_nm: float
    torque_resolution_nm: float
    speed_resolution_rad_s: float
    watchdog_s: float                  # 0: none is armed
    safe_action: str                   # what the drive does by itself when the host falls silent
    filters: ReportingFilters = ReportingFilters()
    torque_setpoint: str = "torque setpoint"     # object or register that takes it
    torque_offset_resolution_nm: float = 0.0     # one count of the torque offset; 0: not asked for, or there is none
    kept_torque_nm: float | None = None          # the drive's own limit, where it was tighter than asked and stayed
    kept_speed_rad_s: float | None = None        # (`drivers.own_limits`)
    quick_stop_holds: bool | None = None   # after a quick stop: held by the drive, let go of; None: nobody knows
    fed_by_any_client: bool = False    # requests of any other client keep the watchdog from acting, as far as is known
    position_resolution_rad: float = 0.0   # one count of the motor's angle; 0: the drive reports none
    position_period_s: float | None = None     # so far apart at most it comes with the cycle; None: `Positioned` alone
    position_gap_s: float = math.inf       # after a longer gap the turns are not known (`drivers.angle.Unwrapped`)

    @property
    def watched(self) -> bool:
        """Does the drive stop by itself when the host falls silent? If not, it was refused, or accepted by name."""
        return self.watchdog_s > 0.0

    @property
    def refused(self) -> tuple[Check, ...]:
        return tuple(check for check in self.checks if check.outcome is Outcome.REFUSED)


@dataclass(frozen=True)
class Counters:
    """What went wrong on the bus so far."""

    cycles: int = 0
    missed: int = 0                # cycles without feedback
    late: int = 0                  # feedback that came after its cycle
    overruns: int = 0              # cycles that began late by more than half a period
    wall_offset_s: float | None = None     # stamps of frames minus control time; None where they bear no wall clock
    error_frames: int = 0          # that the adapter told of
    passive: int = 0               # how often it said that it is error-passive
    wall_jumps: int = 0            # how often that offset jumped: somebody set the wall clock


class Drive(Protocol):
    """One drive on one bus. Every method may raise `drivers.errors.TdhilError`.

    ``close`` gives changed settings back and returns, a line each, those that it couldn't.

    A drive may also be `Polled`, `Telling`, `Positioned`, `Paced`, `KeptAlive`, `Rehearsed` and `Timed`, and one that
    `StopsFeeding`.
    """

    @property
    def clock(self) -> Clock: ...

    @property
    def period_s(self) -> float: ...

    @property
    def counters(self) -> Counters: ...

    def connect(self) -> Identity: ...

    def preflight(self, limits: DriveLimits) -> Preflight: ...

    def reset_fault(self) -> None: ...

    def enable(self, mode: Mode) -> None: ...

    def exchange(self, command: Command) -> Sample: ...

    def quick_stop(self) -> None: ...

    def disable(self) -> None: ...

    def close(self) -> tuple[str, ...]: ...


@runtime_checkable
class Polled(Protocol):
    """A drive that can also be asked for one sample beside the cycle, while a stop gets no feedback from that.

    ``poll`` takes a part of the watchdog's time at most, and asks once more for what `quick_stop` or `disable` asked
    for; it never enables. None without an answer; it may raise TdhilError, too.
    """

    def poll(self) -> Sample | None: ...


@runtime_checkable
class Telling(Protocol):
    """A drive that notices what others do on its bus and what doesn't end a run.

    ``remarks`` gives what was noticed since it was asked last; ``summary`` what there is to say of all of the run.
    A line each, cheap to ask for in every cycle.
    """

    def remarks(self) -> tuple[str, ...]: ...

    def summary(self) -> tuple[str, ...]: ...


@runtime_checkable
class StopsFeeding(Protocol):
    """A drive that a stop can leave to its own watchdog while it goes on being watched.

    After ``stop_feeding`` nothing goes out that the watchdog takes for the host's sign of life: `exchange` goes on with
    what doesn't feed it, be it by listening alone, and so does `Polled.poll`. There is no way back but `close`. Called
    only where a watchdog is armed; it may raise TdhilError, and a second call does nothing.
    """

    def stop_feeding(self) -> None: ...


@runtime_checkable
class RemovesTorque(Protocol):
    """A drive whose `disable` brakes a shaft that still turns, and that can also be told not to.

    ``remove_torque`` moves towards disabled in the cycles that follow, whatever the reported speed is: for a shaft that
    the drive itself accelerates against a quick stop.
    """

    def remove_torque(self) -> None: ...


@runtime_checkable
class KeptAlive(Protocol):
    """A drive whose peer, in stepped time, must hear of a host that reckons for a while; no time passes by it."""

    def keep_alive(self) -> None: ...


@runtime_checkable
class Rehearsed(Protocol):
    """A drive that tells a simulated peer which stage begins: scripted faults wait for that."""

    def announce(self, stage: str) -> None: ...


@runtime_checkable
class Timed(Protocol):
    """A drive that knows whether this computer has been late; in words then, and empty else."""

    def host_late(self) -> str: ...


@runtime_checkable
class Paced(Protocol):
    """A drive whose cycles keep time by this computer's clock, at a rate that nobody has named.

    ``rates_hz`` are those it may be given, the highest first; empty where the rate stands. `set_rate` is for after
    preflight and before anything is enabled; with ``measuring`` a loop that stands still for long is no error.
    ``began_late_s``: by how much the last cycle began late, s.
    """

    @property
    def rates_hz(self) -> tuple[float, ...]: ...

    @property
    def began_late_s(self) -> float: ...

    def set_rate(self, rate_hz: float, *, measuring: bool = False) -> None: ...


class PositionReading(NamedTuple):
    """The motor shaft's angle, counted by the drive independently of the unit of its speed.

    ``time_s`` is control time of the reading, give or take ``half_width_s``. The angle starts over after
    ``wraps_rad`` (None: it never does); its zero means nothing. ``where``: object or register.
    """

    time_s: float
    half_width_s: float
    position_rad: float
    wraps_rad: float | None
    where: str


@runtime_checkable
class Positioned(Protocol):
    """A drive that may also tell the angle of its motor shaft, apart from its speed.

    ``read_position`` is called after `preflight`, between two cycles, in speed mode at a steady speed or a gentle ramp;
    it takes a part of the watchdog's time at most. None: the drive has no angle to tell, or gave no answer.
    """

    def read_position(self) -> PositionReading | None: ...
