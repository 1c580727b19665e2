"""What the cyclic frames of a drive hold, where it departs from CiA 402's usual objects (see `objects`).

- A drive without torque mode is sent 6040h and 60FFh only; where its 6060h can't be mapped, there is no RPDO2.
- One whose speed mode is vl (2) is told its speed in 6042h and tells it in 6044h, 16 bits each.
- Torque may be reported in a manufacturer's object. One of 32 bits leaves no room for the statusword beside the
  speed: then TPDO1 is torque and speed, and TPDO2 brings the statusword with every SYNC.
"""

from dataclasses import dataclass
from struct import Struct

from drivers.canopen.state_machine import ENABLE_OPERATION
from drivers.cia402.objects import (
    RPDO1,
    TARGET_VELOCITY,
    TORQUE_ACTUAL,
    TPDO1,
    TPDO2_MODE,
    TPDO2_MODE_DEMAND,
    VELOCITY_ACTUAL,
    VL_ACTUAL,
    VL_TARGET,
)
from profiles.canopen import CanopenProfile

RPDO1_SPEED = Struct("<Hi")
"""6040h controlword u16 | 60FFh target velocity i32."""

RPDO1_VL = Struct("<Hh")
"""6040h controlword u16 | 6042h vl target velocity i16."""
VL_RELEASED = 0x0070
"""Bits 4 to 6 of the controlword: ramp enabled, not locked, reference used (CiA 402-2, velocity mode)."""

_BITS = {"i16": 16, "i32": 32, "f32": 32}
_FEEDBACK = {"i16": TPDO1, "i32": Struct("<Hii"), "f32": Struct("<Hfi")}
_FEEDBACK_VL = {"i16": Struct("<Hhh"), "i32": Struct("<Hih"), "f32": Struct("<Hfh")}


@dataclass(frozen=True)
class Shape:
    """Which frames a drive is sent and sends."""

    target_torque: bool = True                         # is 6071h in RPDO1?
    mode: bool = True                                  # is there an RPDO2 with 6060h?
    torque: tuple[int, int, int] = TORQUE_ACTUAL       # index, subindex, bits of the reported torque
    vl: bool = False                                   # is the speed told in 6042h and shown in 6044h?
    feedback: Struct = TPDO1                           # statusword, torque, speed; wide: of both TPDOs, put together

    @property
    def target_speed(self) -> tuple[int, int, int]:
        """Index, subindex, bits of the speed's setpoint."""
        return VL_TARGET if self.vl else TARGET_VELOCITY

    @property
    def actual_speed(self) -> tuple[int, int, int]:
        """Index, subindex, bits of the reported speed."""
        return VL_ACTUAL if self.vl else VELOCITY_ACTUAL

    @property
    def wide(self) -> bool:
        """Torque of 32 bits: the statusword comes in TPDO2."""
        return self.torque[2] == 32

    def setpoints(self, word: int, torque_raw: int, speed_raw: int) -> bytes:
        """RPDO1. In velocity mode an enabled drive follows its setpoint only where the word releases it."""
        if self.target_torque:
            return RPDO1.pack(word, torque_raw, speed_raw)
        if self.vl:
            return RPDO1_VL.pack(word | VL_RELEASED if word == ENABLE_OPERATION else word, speed_raw)
        return RPDO1_SPEED.pack(word, speed_raw)

    def data_size(self) -> int:
        """Bytes of TPDO1."""
        return self.feedback.size - 2 if self.wide else self.feedback.size

    def slow(self, with_demand: bool) -> Struct:
        """TPDO2, without the statusword that stands before it in a wide shape."""
        return TPDO2_MODE_DEMAND if with_demand else TPDO2_MODE


STANDARD = Shape()


def shape_of(profile: CanopenProfile) -> Shape:
    """What the profile says of it."""
    torque, target, vl = profile.torque.actual, bool(profile.modes.torque), profile.speed.vl
    feedback = _FEEDBACK_VL if vl else _FEEDBACK
    if torque is None:
        return Shape(target, profile.modes.mapped, vl=vl, feedback=feedback["i16"])
    place = (torque.index, torque.sub, _BITS[torque.type])
    return Shape(target, profile.modes.mapped, place, vl=vl, feedback=feedback[torque.type])


__all__ = ["STANDARD", "Shape", "shape_of"]
