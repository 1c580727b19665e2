"""What the cyclic frames of a drive hold, where it departs from CiA 402's usual objects (see `objects`).

- A drive without torque mode is sent 6040h and 60FFh only; where its 6060h can't be mapped, there is no RPDO2.
- Torque may be reported in a manufacturer's object. One of 32 bits leaves no room for the statusword beside the
  speed: then TPDO1 is torque and speed, and TPDO2 brings the statusword with every SYNC.
"""

from dataclasses import dataclass
from struct import Struct

from drivers.cia402.objects import RPDO1, TORQUE_ACTUAL, TPDO1, TPDO2_MODE, TPDO2_MODE_DEMAND
from profiles.schema import CanopenProfile

RPDO1_SPEED = Struct("<Hi")
"""6040h controlword u16 | 60FFh target velocity i32."""

_BITS = {"i16": 16, "i32": 32, "f32": 32}
_FEEDBACK = {"i16": TPDO1, "i32": Struct("<Hii"), "f32": Struct("<Hfi")}


@dataclass(frozen=True)
class Shape:
    """Which frames a drive is sent and sends."""

    target_torque: bool = True                         # is 6071h in RPDO1?
    mode: bool = True                                  # is there an RPDO2 with 6060h?
    torque: tuple[int, int, int] = TORQUE_ACTUAL       # index, subindex, bits of the reported torque
    feedback: Struct = TPDO1                           # statusword, torque, speed; wide: of both TPDOs, put together

    @property
    def wide(self) -> bool:
        """Torque of 32 bits: the statusword comes in TPDO2."""
        return self.torque[2] == 32

    def data_size(self) -> int:
        """Bytes of TPDO1."""
        return self.feedback.size - 2 if self.wide else self.feedback.size

    def slow(self, with_demand: bool) -> Struct:
        """TPDO2, without the statusword that stands before it in a wide shape."""
        return TPDO2_MODE_DEMAND if with_demand else TPDO2_MODE


STANDARD = Shape()


def shape_of(profile: CanopenProfile) -> Shape:
    """What the profile says of it."""
    torque, target = profile.torque.actual, bool(profile.modes.torque)
    if torque is None:
        return Shape(target, profile.modes.mapped)
    place = (torque.index, torque.sub, _BITS[torque.type])
    return Shape(target, profile.modes.mapped, place, _FEEDBACK[torque.type])


__all__ = ["RPDO1", "RPDO1_SPEED", "STANDARD", "Shape", "shape_of"]
