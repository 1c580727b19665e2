"""Pure codec between the bytes of an object and a number, for every type that a profile may name (CiA 301, 9.1)."""

import math
from struct import Struct, error

from drivers.errors import ObjectRefused
from profiles.canopen_parameter import ObjectType

_LAYOUTS: dict[str, Struct] = {
    "u8": Struct("<B"), "u16": Struct("<H"), "u32": Struct("<I"), "i8": Struct("<b"), "i16": Struct("<h"),
    "i32": Struct("<i"), "f32": Struct("<f"),
}


def decode_value(kind: ObjectType, data: bytes, where: str) -> float:
    """Bytes → the number in them. Raises ObjectRefused for too few bytes, or what is no finite number."""
    layout = _LAYOUTS[kind]
    if len(data) < layout.size:
        raise ObjectRefused(f"{len(data)} bytes where {layout.size} were expected", where=where)
    value = float(layout.unpack_from(data)[0])
    if not math.isfinite(value):
        raise ObjectRefused(f"{value} is no number to work with", where=where)
    return value


def encode_value(kind: ObjectType, value: float, where: str) -> bytes:
    """A number → its bytes, whole numbers for whole types. Raises ObjectRefused where it doesn't fit."""
    try:
        return _LAYOUTS[kind].pack(value if kind == "f32" else round(value))
    except (error, OverflowError, ValueError) as trouble:
        raise ObjectRefused(f"{value:g} doesn't fit into the object ({kind})", where=where) from trouble
