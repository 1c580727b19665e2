"""A number in registers, as the drive itself stores it: two's complement, halves in the line's order, saturation.

Written for the simulated drive alone, on integers; the host has its own.
"""


from dataclasses import dataclass
from typing import Literal, NamedTuple

# ---------------------------------------------------------------------------------------------------------------------
# What comes back on the line for one request: as a rule the drive's reply, and what a scripted fault made of it.


class DriveReply(NamedTuple):
    """``pdu`` None: nothing comes. What TCP or RTU alone has is left alone by the other."""

    pdu: bytes | None
    late_s: float = 0.0
    """After the moment at which it was due."""
    transaction_bits: int = 0
    """TCP: bits of the transaction that are wrong."""
    crc_bits: int = 0
    """RTU: bits of the CRC that are wrong. Where frames have none, the reply is lost: no receiver passes it on."""
    connection: Literal["", "reset", "half-open"] = ""
    """TCP: what becomes of the connection on which the request came."""


NONE = DriveReply(None)


# ---------------------------------------------------------------------------------------------------------------------

_BITS = {"u16": 16, "i16": 16, "u32": 32, "i32": 32}


@dataclass(frozen=True, slots=True)
class RegisterLayout:
    """Address and type of a number."""

    address: int
    kind: str = "u16"
    table: str = "holding"
    high_first: bool = True

    @property
    def signed(self) -> bool:
        """It has a sign."""
        return self.kind[0] == "i"

    @property
    def lowest(self) -> int:
        """The smallest number that fits."""
        return -(1 << _BITS[self.kind] - 1) if self.signed else 0

    @property
    def highest(self) -> int:
        """The largest number that fits."""
        return (1 << _BITS[self.kind] - int(self.signed)) - 1

    @property
    def addresses(self) -> range:
        """The registers it takes."""
        return range(self.address, self.address + _BITS[self.kind] // 16)

    def saturated(self, value: float) -> int:
        """The nearest whole number that fits; an unsigned register takes the magnitude."""
        whole = round(value if self.signed else abs(value))
        return self.lowest if whole < self.lowest else min(whole, self.highest)

    def words(self, number: int) -> tuple[int, ...]:
        """The registers' contents for a number that fits."""
        if _BITS[self.kind] == 16:
            return (number % 0x10000,)
        high, low = divmod(number % 0x1_0000_0000, 0x10000)
        return (high, low) if self.high_first else (low, high)

    def number(self, words: tuple[int, ...]) -> int:
        """The number that the registers hold."""
        plain = 0
        for word in words if self.high_first else reversed(words):
            plain = plain * 0x10000 + word
        return plain - (self.highest - self.lowest + 1) if plain > self.highest else plain
