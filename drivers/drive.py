"""The contract between a drive, of any make and bus, and all rooms above it.

All quantities are SI at the motor shaft; positive torque drives positive speed. No room above `drivers` uses objects,
registers, per-mille or rpm. A caller follows this list once:

    connect → preflight → enable(mode) → exchange(command) … → quick_stop → exchange … → disable → close

`enable`, `quick_stop` and `disable` only set the request. The drive's state machine moves during the `exchange` calls
that follow, one step a cycle. So every cycle is seen, recorded and guarded alike.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple, Protocol, runtime_checkable

from drivers.clock import Clock

LEAST_CYCLES = 5
"""Least time of the drive's watchdog, cycles. It must not trip because of one or two lost frames or replies."""
LOCAL_CYCLES = 3
"""Number of cycles after which the loss of remote control counts. One damaged frame or reply does not matter."""
REPEAT_MODE_CYCLES = 25
"""Number of cycles after which a mode that is not displayed is requested again. One lost frame must not end a run."""


class Mode(Enum):
    """Quantity that the drive controls."""

    __hash__ = object.__hash__     # Enum's own is Python code, too slow for a look-up in every cycle

    SPEED = "speed"
    TORQUE = "torque"


class PowerState(Enum):
    """State of the drive as far as a caller needs it (CiA 402, figure of the state machine)."""

    __hash__ = object.__hash__     # Enum's own is Python code, too slow for a look-up in every cycle

    NOT_READY = "not ready"
    OFF = "off"                    # switch on disabled: no torque
    READY = "ready"                # ready to switch on, or switched on: no torque yet
    ENABLED = "enabled"            # operation enabled: setpoints act
    QUICK_STOP = "quick stop"      # decelerating or holding after a quick stop
    FAULT = "fault"                # no torque
    UNKNOWN = "no valid state"     # the status word is invalid: the state is unknown
    FAULT_REACTION = "fault reaction"      # decelerating after a fault, or holding: the power stage is on


class PowerRequest(Enum):
    """Power state that the caller requests."""

    OFF = "off"
    ENABLED = "enabled"
    QUICK_STOP = "quick stop"


class Command(NamedTuple):
    """Request of one cycle: the mode, and the setpoint of each mode (the other one is used at a later switch).

    The drive adds ``torque_offset_nm`` to the output of its speed loop. It acts only if `DriveLimits.torque_offset` was
    set, in speed mode, and with an enable request; otherwise zero is sent.
    """

    mode: Mode
    speed_rad_s: float
    torque_nm: float
    torque_offset_nm: float = 0.0


class Sample(NamedTuple):
    """One cycle's feedback, torque and speed of one instant.

    ``time_s`` is control time of the SYNC (on Modbus: of the middle of the transaction, with the uncertainty
    ``half_width_s``). ``age_s`` is the delay of the feedback after it. ``fresh`` is False if the cycle brought no
    feedback: the values are then those of the cycle before.

    ``position_rad`` is the motor shaft's angle at ``time_s``, counted by the drive apart from its speed, and unwrapped
    since the first reading (`drivers.angle`). It is None if the cycle brought no angle. In a polled sample (`Polled`)
    the angle is read directly after the other values.
    """

    time_s: float
    age_s: float
    half_width_s: float
    fresh: bool
    speed_rad_s: float
    torque_nm: float
    torque_demand_nm: float | None
    mode: Mode | None              # displayed mode; None for any other one
    state: PowerState
    standstill: bool               # as reported by the drive, if it reports it
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
    """Identity of the peer. Only the simulator's marker decides ``simulated``.

    ``firmware``: software version that the drive reports; '' if it reports none.
    """

    vendor: int
    product: int
    revision: int
    serial: int
    name: str
    simulated: bool
    firmware: str = ""


@dataclass(frozen=True)
class DriveLimits:
    """Limits that the drive itself must enforce; preflight writes them and reads them back."""

    speed_rad_s: float
    torque_nm: float
    quick_stop_rad_s2: float
    watchdog_s: float
    accept_no_watchdog: bool = False   # override of the operator: the watchdog is off and stays off
    accept_wider: frozenset[str] = frozenset()     # of `drivers.own_limits.NAMES`: own limits that may be made wider
    accept_shared_watchdog: bool = False   # override of the operator: any client feeds the watchdog
    temperature_c: float | None = None     # °C; limit of a reported temperature
    torque_offset: bool = False            # `Command.torque_offset_nm` is used; refused without one
    string: bool = False                   # a drill string is attached; trapped torque is refused
    noise_scale_rad_s: float = 0.0         # its shares count as noise at standstill, if it is above ``speed_rad_s``

    @property
    def standstill_scale_rad_s(self) -> float:
        """Return the speed whose shares count as noise at standstill: a slow run does not quieten the signal."""
        return max(self.speed_rad_s, self.noise_scale_rad_s)


@dataclass(frozen=True)
class ReportingFilters:
    """First-order lags of the reported signals, s; None if the drive does not report them."""

    speed_lag_s: float | None = None
    torque_lag_s: float | None = None
    source: str = ""


@dataclass(frozen=True)
class ReportedSetting:
    """One parameter of the drive's speed loop, as read in preflight."""

    title: str                         # the manual's number and name
    where: str                         # object or register
    raw: float                         # counts
    value: float                       # in `unit`
    unit: str                          # as in the profile's ``speed_controller``
    confidence: str                    # of that entry


@dataclass(frozen=True)
class SpeedLoopPresent:
    """Gains of the drive's own speed loop before the run, at the motor shaft; None if the drive does not report one.

    A reported setting has no value in SI if its unit is a share, or is unknown.
    """

    gain: ReportedSetting | None = None
    integral: ReportedSetting | None = None
    filter: ReportedSetting | None = None
    gain_nm_s_rad: float | None = None     # P
    integral_nm_rad: float | None = None   # I
    filter_s: float | None = None          # time constant of the filter of the speed


class Outcome(Enum):
    """Result of a preflight check."""

    OK = "ok"
    NOTE = "note"                  # reported, but no obstacle
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


NOT_RESTORED: Final = "it is not confirmed that the drive is disabled, so the former value was not restored"
"""Why `Drive.close` left a setting of this run in the drive."""
REACTIONS: Final = {
    "quick_stop": "quick stop", "ramp_stop": "stop on the ramp", "fault_reaction": "fault reaction of the drive",
    "coast": "torque off, the shaft coasts", "none": "NONE, the drive does not stop by itself",
}
"""Reactions of a drive to a silent host, in words, by their names in profiles."""
BRAKING_REACTIONS: Final = ("quick_stop", "ramp_stop")
"""Reactions that brake in speed mode."""


@dataclass(frozen=True)
class Preflight:
    """Findings before motion."""

    identity: Identity
    checks: tuple[Check, ...]
    modes: frozenset[Mode]
    switch_while_enabled: bool
    quick_stop_in_torque_mode: bool    # quick stop from torque mode decelerates under speed control
    rated_torque_nm: float
    torque_resolution_nm: float
    speed_resolution_rad_s: float
    watchdog_s: float                  # 0: none is armed
    safe_action: str                   # reaction of the drive to a silent host, a key of `REACTIONS`
    filters: ReportingFilters = ReportingFilters()
    speed_loop: SpeedLoopPresent | None = None   # None: the profile names no parameter of it that is read
    torque_setpoint: str = "torque setpoint"     # object or register that takes it
    torque_offset_resolution_nm: float = 0.0     # one count of the torque offset; 0: not requested, or there is none
    kept_torque_nm: float | None = None          # the drive's own limit, if it was tighter and stayed
    kept_speed_rad_s: float | None = None        # (`drivers.own_limits`)
    quick_stop_holds: bool | None = None   # the drive holds the shaft after a quick stop; None: unknown
    fed_by_any_client: bool = False    # any other client feeds the watchdog, as far as is known
    position_resolution_rad: float = 0.0   # one count of the motor's angle; 0: the drive reports none
    position_period_s: float | None = None     # longest interval in the cycle; None: `Positioned` only
    position_gap_s: float = math.inf       # after a longer gap the turns are unknown (`drivers.angle.Unwrapped`)

    @property
    def watched(self) -> bool:
        """True if the drive stops by itself when the host is silent. If not, the operator has accepted it by name."""
        return self.watchdog_s > 0.0

    @property
    def reaction(self) -> str:
        """Reaction of the drive to a silent host, in words.

        The watchdog acts as the drive's own quick stop does. In torque mode only some drives brake.
        """
        said = REACTIONS.get(self.safe_action, self.safe_action)
        unsure = (self.safe_action in BRAKING_REACTIONS and Mode.TORQUE in self.modes and self.switch_while_enabled
                  and not self.quick_stop_in_torque_mode)
        return f"{said}; in torque mode the shaft may coast" if unsure else said

    @property
    def refused(self) -> tuple[Check, ...]:
        return tuple(check for check in self.checks if check.outcome is Outcome.REFUSED)


@dataclass(frozen=True)
class Counters:
    """Errors on the bus since the start."""

    cycles: int = 0
    missed: int = 0                # cycles without feedback
    late: int = 0                  # feedback that came after its cycle
    overruns: int = 0              # cycles that began late by more than half a period
    wall_offset_s: float | None = None     # frame stamps minus control time; None without wall clock
    error_frames: int = 0          # reported by the adapter
    passive: int = 0               # error-passive reports of the adapter
    wall_jumps: int = 0            # jumps of that offset: the wall clock was set


class Drive(Protocol):
    """One drive on one bus. Every method may raise `drivers.errors.TdhilError`.

    ``close`` restores changed settings and returns, one line each, those that could not be restored.

    A drive may also be `Polled`, `ReportsOthers`, `Positioned`, `Paced`, `KeptAlive`, `Rehearsed` and `Timed`, and
    one that `StopsFeeding`.
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
    """A drive that can also be polled for one sample beside the cycle, for a stop without cyclic feedback.

    ``poll`` takes at most a part of the watchdog's time, and repeats the request of `quick_stop` or `disable`. It never
    enables. It returns None without an answer, and may raise TdhilError.
    """

    def poll(self) -> Sample | None: ...


@runtime_checkable
class ReportsOthers(Protocol):
    """A drive that detects foreign traffic on its bus that does not end a run.

    ``remarks`` returns the remarks since the last call; ``summary`` returns those on the whole run. One line each; a
    call in every cycle is cheap.
    """

    def remarks(self) -> tuple[str, ...]: ...

    def summary(self) -> tuple[str, ...]: ...


@runtime_checkable
class StopsFeeding(Protocol):
    """A drive that a stop can leave to its own watchdog while its feedback is still read.

    After ``stop_feeding`` no frame is sent that feeds the watchdog. `exchange` and `Polled.poll` continue without such
    frames, if necessary by listening only. Only `close` ends this state. It is called only with an armed watchdog, may
    raise TdhilError, and does nothing the second time.
    """

    def stop_feeding(self) -> None: ...


@runtime_checkable
class RemovesTorque(Protocol):
    """A drive whose `disable` brakes a shaft that still turns, and that can also disable without braking.

    ``remove_torque`` moves towards disabled in the following cycles at any reported speed: for a shaft that the drive
    itself accelerates against a quick stop.
    """

    def remove_torque(self) -> None: ...


@runtime_checkable
class KeptAlive(Protocol):
    """A drive whose peer, in stepped time, needs a sign of life during long computations. It does not advance time."""

    def keep_alive(self) -> None: ...


@runtime_checkable
class Rehearsed(Protocol):
    """A drive that sends the stage of the run to a simulated peer, whose scripted faults wait for it."""

    def announce(self, stage: str) -> None: ...


@runtime_checkable
class Timed(Protocol):
    """A drive that detects delays of this computer; ``host_late`` describes them, empty if there is none."""

    def host_late(self) -> str: ...


@runtime_checkable
class Paced(Protocol):
    """A drive whose cycles follow this computer's clock, at a rate that the operator has not fixed.

    ``rates_hz`` are the possible rates, the highest first; empty if the rate is fixed. `set_rate` is called after
    preflight and before anything is enabled; with ``measuring`` a long delay is no error. ``began_late_s``: delay of
    the start of the last cycle, s.
    """

    @property
    def rates_hz(self) -> tuple[float, ...]: ...

    @property
    def began_late_s(self) -> float: ...

    def set_rate(self, rate_hz: float, *, measuring: bool = False) -> None: ...


class PositionReading(NamedTuple):
    """The motor shaft's angle, counted by the drive independently of the unit of its speed.

    ``time_s`` is control time of the reading, with the uncertainty ``half_width_s``. The angle wraps at ``wraps_rad``
    (None: never); its zero has no meaning. ``where``: object or register.
    """

    time_s: float
    half_width_s: float
    position_rad: float
    wraps_rad: float | None
    where: str


@runtime_checkable
class Positioned(Protocol):
    """A drive that may also report the angle of its motor shaft, independent of its speed.

    ``read_position`` is called after `preflight`, between two cycles, in speed mode at a steady speed or on a slow
    ramp. It takes at most a part of the watchdog's time. None: the drive has no angle, or did not answer.
    """

    def read_position(self) -> PositionReading | None: ...
