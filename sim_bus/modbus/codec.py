"""A number in registers, as the drive stores it: two's complement, halves in the line's order, saturation.

The module is written for the simulated drive alone, on integers; the host has its own.
"""


from dataclasses import dataclass
from typing import Literal, NamedTuple

# ---------------------------------------------------------------------------------------------------------------------
# Data that comes back on the line for one request: usually the drive's reply, or the data after a scripted fault.


class DriveReply(NamedTuple):
    """One reply. ``pdu`` None: no reply. Fields of TCP alone have no effect on RTU, and vice versa."""

    pdu: bytes | None
    late_s: float = 0.0
    """Delay after the time at which the reply was due, s."""
    transaction_bits: int = 0
    """TCP: wrong bits of the transaction id."""
    crc_bits: int = 0
    """RTU: wrong bits of the CRC. On a line without frames the reply is lost, because no receiver would pass it on."""
    connection: Literal["", "reset", "half-open"] = ""
    """TCP: end of the connection on which the request came."""


NONE = DriveReply(None)
BROADCAST = 0
"""Unit address of a request to all units, which none answers."""


# ---------------------------------------------------------------------------------------------------------------------

_BITS = {"u16": 16, "i16": 16, "u32": 32, "i32": 32}
_LOWEST = {kind: -(1 << bits - 1) if kind[0] == "i" else 0 for kind, bits in _BITS.items()}
_HIGHEST = {kind: (1 << bits) - 1 + _LOWEST[kind] for kind, bits in _BITS.items()}


@dataclass(frozen=True, slots=True)
class RegisterLayout:
    """Address and type of a number."""

    address: int
    kind: str = "u16"
    table: str = "holding"
    high_first: bool = True

    @property
    def signed(self) -> bool:
        """True if the type has a sign."""
        return self.kind[0] == "i"

    @property
    def lowest(self) -> int:
        """Smallest number that fits."""
        return _LOWEST[self.kind]

    @property
    def highest(self) -> int:
        """Largest number that fits."""
        return _HIGHEST[self.kind]

    @property
    def addresses(self) -> range:
        """Addresses of its registers."""
        return range(self.address, self.address + _BITS[self.kind] // 16)

    def saturated(self, value: float) -> int:
        """Return the nearest whole number that fits. An unsigned register takes the magnitude."""
        lowest = _LOWEST[self.kind]
        whole = round(value if lowest else abs(value))
        return min(max(whole, lowest), _HIGHEST[self.kind])

    def words(self, number: int) -> tuple[int, ...]:
        """Return the contents of the registers for a number that fits."""
        if _BITS[self.kind] == 16:
            return (number % 0x10000,)
        high, low = divmod(number % 0x1_0000_0000, 0x10000)
        return (high, low) if self.high_first else (low, high)

    def number(self, words: tuple[int, ...]) -> int:
        """Return the number in the registers."""
        plain = 0
        for word in words if self.high_first else reversed(words):
            plain = plain * 0x10000 + word
        return plain - (1 << _BITS[self.kind]) if plain > self.highest else plain
