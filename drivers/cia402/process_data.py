"""Process data of a CiA 402 drive: its objects, their units, the pure codec between counts and SI, the cyclic objects.

- A drive without torque mode receives only 6040h and 60FFh.
- In velocity mode (vl, 2) the speed setpoint is 6042h and the reported speed 6044h, 16 bits each.
- Torque may be reported in a manufacturer's object.

The unit of torque is per mille of the rated torque (6076h) in the standard; the velocity's count is the profile's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from struct import Struct, error

from drivers.cia402.state_machine import (
    INTERNAL_LIMIT,
    SPEED_ZERO,
    TARGET_REACHED,
    State,
    decode,
    decode_after,
    power_state,
)
from drivers.drive import Mode, PowerState, Sample
from drivers.errors import CommandRejected, ObjectRefused
from profiles.cia402 import Cia402Profile, ObjectType, Position

# Objects, each as (index, subindex, bits).
CONTROLWORD = (0x6040, 0, 16)
STATUSWORD = (0x6041, 0, 16)
MODE = (0x6060, 0, 8)
MODE_DISPLAY = (0x6061, 0, 8)
VELOCITY_ACTUAL = (0x606C, 0, 32)
TARGET_TORQUE = (0x6071, 0, 16)
TORQUE_DEMAND = (0x6074, 0, 16)
TORQUE_ACTUAL = (0x6077, 0, 16)
TARGET_VELOCITY = (0x60FF, 0, 32)
VL_TARGET, VL_ACTUAL = (0x6042, 0, 16), (0x6044, 0, 16)
"""Velocity mode (vl): target velocity, and vl velocity actual value (or control effort) of CiA 402-2."""

MODE_NAMES = {2: "velocity mode", 3: "profile velocity", 4: "profile torque", 9: "cyclic sync velocity",
              10: "cyclic sync torque"}
"""6060h codes that tdhil may use."""
CYCLIC_SYNCHRONOUS = frozenset({9, 10})


@dataclass(frozen=True)
class Units:
    """Value of one LSB on this drive: speed in both directions, reported torque, target torque 6071h, torque offset."""

    speed_rad_s_per_lsb: float
    torque_nm_per_lsb: float
    target_nm_per_lsb: float | None = None      # None: as the reported torque
    offset_nm_per_lsb: float = 0.0              # 0: no torque offset in use


def encode_speed(speed_rad_s: float, units: Units, target: tuple[int, int, int] = TARGET_VELOCITY) -> int:
    """Convert rad/s at the motor shaft to 60FFh or 6042h. Raises CommandRejected out of range or if not finite."""
    counts = _counts(speed_rad_s, units.speed_rad_s_per_lsb, target[2] - 1)
    if counts is None:
        raise _refused(speed_rad_s, f"target velocity {target[0]:04X}h", "rad/s")
    return counts


def encode_torque(torque_nm: float, units: Units) -> int:
    """Convert N·m at the motor shaft to 6071h. Raises CommandRejected outside i16 or if not finite."""
    counts = _counts(torque_nm, units.target_nm_per_lsb or units.torque_nm_per_lsb, 15)
    if counts is None:
        raise _refused(torque_nm, "target torque 6071h", "N·m")
    return counts


def encode_torque_offset(torque_nm: float, units: Units) -> int:
    """Convert N·m at the motor shaft to 60B2h. Raises CommandRejected outside i16, if not finite, or if not mapped."""
    if not units.offset_nm_per_lsb:
        if torque_nm != 0.0:
            raise CommandRejected("a torque offset was commanded, but none is mapped", where="60B2h")
        return 0
    counts = _counts(torque_nm, units.offset_nm_per_lsb, 15)
    if counts is None:
        raise _refused(torque_nm, "torque offset 60B2h", "N·m")
    return counts


def _counts(value: float, per_lsb: float, bits: int) -> int | None:
    """Return the value in LSB; None if it is not finite, or does not fit into this number of bits plus a sign bit."""
    if not math.isfinite(value):
        return None
    counts, end = round(value / per_lsb), 1 << bits
    return counts if -end <= counts < end else None


def _refused(value: float, where: str, unit: str) -> CommandRejected:
    if not math.isfinite(value):
        return CommandRejected(f"setpoint {value} {unit} is not finite", where=where)
    return CommandRejected(f"setpoint {value:g} {unit} is outside the range of the object", where=where)


VL_RELEASED = 0x0070
"""Bits 4 to 6 of the controlword: ramp enabled, not locked, reference used (CiA 402-2, velocity mode)."""


@dataclass(frozen=True)
class CyclicObjects:
    """Objects that a drive's cyclic frames carry."""

    target_torque: bool = True                         # 6071h is a cyclic setpoint
    mode: bool = True                                  # 6060h can be sent in the cycle
    torque: tuple[int, int, int] = TORQUE_ACTUAL       # index, subindex, bits of the reported torque
    vl: bool = False                                   # speed setpoint in 6042h, reported speed in 6044h
    offset: tuple[int, int, int] | None = None         # index, subindex, bits of a torque offset in use
    torque_type: ObjectType = "i16"                    # data type of the reported torque

    @property
    def target_speed(self) -> tuple[int, int, int]:
        """Index, subindex, bits of the speed's setpoint."""
        return VL_TARGET if self.vl else TARGET_VELOCITY

    @property
    def actual_speed(self) -> tuple[int, int, int]:
        """Index, subindex, bits of the reported speed."""
        return VL_ACTUAL if self.vl else VELOCITY_ACTUAL

    @property
    def targets(self) -> tuple[tuple[int, int, int], ...]:
        """Objects that each cycle must set: controlword, torque, speed."""
        return (CONTROLWORD, *(TARGET_TORQUE,) * self.target_torque, self.target_speed)

    @property
    def mode_and_offset(self) -> tuple[tuple[int, int, int], ...]:
        """Further setpoints of the cycle; () if there is none."""
        return (MODE,) * self.mode + (() if self.offset is None else (self.offset,))

    @property
    def actual(self) -> tuple[tuple[int, int, int], ...]:
        """Feedback of one instant: statusword, torque, speed."""
        return STATUSWORD, self.torque, self.actual_speed

    def kinds(self, position: Position | None = None) -> dict[tuple[int, int, int], ObjectType]:
        """Return the data types of torque and angle, which their lengths do not show."""
        known = {self.torque: self.torque_type}
        if position is not None:
            known[position.index, position.sub, bits_of(position.type)] = position.type
        return known

    @property
    def setpoints(self) -> tuple[tuple[int, int, int] | None, ...]:
        """Objects of the setpoints, in the order of `drivers.cia402.bus.CycleSetpoints`; None: no torque offset."""
        return CONTROLWORD, TARGET_TORQUE, self.target_speed, MODE, self.offset


def cyclic_objects(profile: Cia402Profile) -> CyclicObjects:
    """Return the cyclic objects that the profile describes, without a torque offset."""
    actual = profile.torque.actual
    content = CyclicObjects(bool(profile.modes.torque), profile.modes.mapped, vl=profile.speed.vl)
    if actual is None:
        return content
    return replace(content, torque=(actual.index, actual.sub, bits_of(actual.type)), torque_type=actual.type)


# ---------------------------------------------------------------------------------------------------------------------
# Values that a drive reported last, in its own counts, and the Sample in SI at the motor shaft made from them.


_PROFILE_VELOCITY = 3


class Reported:
    """Last reported values, from cyclic frames or single answers; zero before the first."""

    def __init__(self) -> None:
        self.state = State.NOT_READY
        self._started = False          # the drive has shown a state other than not ready since its start
        self.shown_code = 0            # 6061h
        self.shown_s = 0.0             # control time of the last display of the mode
        self._status = 0
        self._speed_raw = 0
        self._torque_raw: float = 0
        self._demand_raw: int | None = None

    def take(self, status: int, speed_raw: int, torque_raw: float | None) -> None:
        """Take 6041h, 606Ch and 6077h (or the manufacturer's object) of one instant; torque None keeps the last
        value.
        """
        self._status, self._speed_raw = status, speed_raw
        self._torque_raw = self._torque_raw if torque_raw is None else torque_raw
        self.state = decode_after(status) if self._started else decode(status)
        self._started = self._started or self.state not in (State.NOT_READY, State.UNKNOWN)

    @property
    def since_start(self) -> bool:
        """True if the drive has shown its state since it started."""
        return self._started

    def restarted(self) -> None:
        """Note that the drive has sent its boot-up message: it may be not ready to switch on."""
        self._started = False

    def take_slow(self, now_s: float, shown_code: int, demand_raw: int | None) -> None:
        """Take 6061h, and 6074h if the drive has it, at this control time."""
        self.shown_s, self.shown_code, self._demand_raw = now_s, shown_code, demand_raw

    def sample(
        self, time_s: float, age_s: float, fresh: bool, units: Units, modes: Mapping[int, Mode],
        position_rad: float | None = None,
    ) -> Sample:
        """Return the sample; ``time_s`` and ``age_s`` in control time, ``modes`` by their codes of 6061h."""
        status = self._status
        power = power_state(self.state)
        reached = bool(status & TARGET_REACHED) and power is PowerState.QUICK_STOP
        zero = bool(status & SPEED_ZERO) and self.shown_code == _PROFILE_VELOCITY and power is PowerState.ENABLED
        demand = self._demand_raw
        return Sample(
            time_s,
            age_s,
            0.0,
            fresh,
            self._speed_raw * units.speed_rad_s_per_lsb,
            self._torque_raw * units.torque_nm_per_lsb,
            None if demand is None else demand * units.torque_nm_per_lsb,
            modes.get(self.shown_code),
            power,
            reached or zero,
            bool(status & INTERNAL_LIMIT),
            status,
            position_rad,
        )


# ---------------------------------------------------------------------------------------------------------------------
# Pure codec between the bytes of an object and a number, for every type that a profile may name (CiA 301, 9.1).


LAYOUTS: dict[str, Struct] = {
    "u8": Struct("<B"), "u16": Struct("<H"), "u32": Struct("<I"), "i8": Struct("<b"), "i16": Struct("<h"),
    "i32": Struct("<i"), "f32": Struct("<f"),
}


def decode_value(kind: ObjectType, data: bytes, where: str) -> float:
    """Return the number in the bytes. Raises ObjectRefused for too few bytes or a number that is not finite."""
    layout = LAYOUTS[kind]
    if len(data) < layout.size:
        raise ObjectRefused(f"{len(data)} bytes where {layout.size} were expected", where=where)
    value = float(layout.unpack_from(data)[0])
    if not math.isfinite(value):
        raise ObjectRefused(f"{value} is not a finite number", where=where)
    return value


def bits_of(kind: ObjectType) -> int:
    """Return the length of an object of this type, bits."""
    return 8 * LAYOUTS[kind].size


def encode_value(kind: ObjectType, value: float, where: str) -> bytes:
    """Return the bytes of a number, rounded for integer types. Raises ObjectRefused if it is out of range."""
    try:
        return LAYOUTS[kind].pack(value if kind == "f32" else round(value))
    except (error, OverflowError, ValueError) as trouble:
        raise ObjectRefused(f"{value:g} is outside the range of the object ({kind})", where=where) from trouble
