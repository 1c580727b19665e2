"""The CiA 402 objects that tdhil uses, and the pure codec between them and SI.

Cyclic data, little endian, one instant for torque and speed::

    RPDO1  6040h controlword u16 | 6071h target torque i16 ‰ | 60FFh target velocity i32 LSB
    TPDO1  6041h statusword  u16 | 6077h torque actual i16 ‰ | 606Ch velocity actual i32 LSB
    RPDO2  6060h modes of operation i8
    TPDO2  6061h modes of operation display i8 [| 6074h torque demand i16 ‰]

‰ is of the rated torque (6076h); the velocity's LSB is the profile's. What a drive has differently is in `shape`.
"""

import math
import struct
from dataclasses import dataclass

from drivers.errors import CommandRejected

RPDO1 = struct.Struct("<Hhi")
TPDO1 = struct.Struct("<Hhi")
RPDO2 = struct.Struct("<b")
TPDO2_MODE = struct.Struct("<b")
TPDO2_MODE_DEMAND = struct.Struct("<bh")

RPM = 2.0 * math.pi / 60.0
"""rad/s in one rev/min."""

# (index, subindex, bits), as mapped into PDOs.
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
"""Velocity mode (vl): target velocity, and what CiA 402-2 calls vl velocity actual value (or control effort)."""

MODE_NAMES = {2: "velocity mode", 3: "profile velocity", 4: "profile torque", 9: "cyclic sync velocity",
              10: "cyclic sync torque"}
"""6060h codes that tdhil may use."""


@dataclass(frozen=True)
class Units:
    """What one LSB means on this drive: of the speed both ways, of the reported torque, of the target torque 6071h."""

    speed_rad_s_per_lsb: float
    torque_nm_per_lsb: float
    target_nm_per_lsb: float | None = None      # None: as reported


def encode_speed(speed_rad_s: float, units: Units, target: tuple[int, int, int] = TARGET_VELOCITY) -> int:
    """Rad/s at the motor shaft → 60FFh, or 6042h. Raises CommandRejected outside of it or if not finite."""
    index, _, bits = target
    return _encode(speed_rad_s, units.speed_rad_s_per_lsb, bits - 1, f"target velocity {index:04X}h", "rad/s")


def encode_torque(torque_nm: float, units: Units) -> int:
    """N·m at the motor shaft → 6071h. Raises CommandRejected outside i16 or if not finite."""
    per_lsb = units.target_nm_per_lsb or units.torque_nm_per_lsb
    return _encode(torque_nm, per_lsb, 15, "target torque 6071h", "N·m")


def _encode(value: float, per_lsb: float, bits: int, where: str, unit: str) -> int:
    if not math.isfinite(value):
        raise CommandRejected(f"setpoint {value} {unit} is not finite", where=where)
    raw = round(value / per_lsb)
    if not -(1 << bits) <= raw < 1 << bits:
        raise CommandRejected(f"setpoint {value:g} {unit} doesn't fit into the object", where=where)
    return raw


def mapping_entry(mapped: tuple[int, int, int]) -> int:
    """Object → the u32 of a PDO mapping parameter (CiA 301: index, subindex, length in bits)."""
    index, subindex, bits = mapped
    return index << 16 | subindex << 8 | bits


def consumer_heartbeat(node: int, time_ms: int) -> int:
    """The u32 of 1016h: node-ID in bits 16 to 23, time in ms below."""
    return node << 16 | time_ms


def lsb_decimals(per_lsb: float) -> int:
    """How many decimals show one LSB without false precision."""
    return max(0, math.ceil(-math.log10(per_lsb)))
