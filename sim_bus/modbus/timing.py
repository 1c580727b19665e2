"""How long a request and its reply take on the line. Pure; seconds.

RTU: a character is 11 bits (start, 8, parity, stop; or two stops), a frame is unit + PDU + two of CRC, and its end is
known after 3.5 characters of silence, 1.75 ms above 19,200 baud (Modbus over serial line, section 2.5.1.1). TCP: no
characters, but a latency each way, with a jitter on top.

::

    |silence| request | silence | turn-around | reply | silence | next request
"""

from dataclasses import dataclass
from typing import Self

from profiles.modbus import Line

CHARACTER_BITS = 11
_FRAME = 3
"""Unit and CRC, in characters."""
_FIXED_SILENCE_S = 0.00175
_FIXED_ABOVE_BAUD = 19200
TCP_LATENCY_S = 0.0005
TCP_JITTER_S = 0.0003


@dataclass(frozen=True, slots=True)
class LineTiming:
    """One line with a drive at its end."""

    character_s: float = 0.0
    silence_s: float = 0.0
    """Between two frames."""
    turn_around_s: float = 0.0
    """From the end of a request, as the drive sees it, to the first character of its reply."""
    latency_s: float = 0.0
    """Each way."""
    jitter_s: float = 0.0
    """The most that is added to the latency, each way."""

    @classmethod
    def rtu(cls, baud: int, turn_around_s: float) -> Self:
        """A serial line."""
        character_s = CHARACTER_BITS / baud
        silence_s = _FIXED_SILENCE_S if baud > _FIXED_ABOVE_BAUD else 3.5 * character_s
        return cls(character_s=character_s, silence_s=silence_s, turn_around_s=turn_around_s)

    @classmethod
    def tcp(cls, turn_around_s: float, latency_s: float = TCP_LATENCY_S, jitter_s: float = TCP_JITTER_S) -> Self:
        """A network."""
        return cls(turn_around_s=turn_around_s, latency_s=latency_s, jitter_s=jitter_s)

    @classmethod
    def of(cls, line: Line) -> Self:
        """The line that a profile describes: TCP where it has that."""
        if "tcp" in line.transports:
            return cls.tcp(line.turn_around_s)
        return cls.rtu(line.baud, line.turn_around_s)

    def way_s(self, pdu_bytes: int, chance: float) -> float:
        """From the first to the last character of a frame, and over the network; ``chance`` in [0, 1) is its jitter."""
        return (pdu_bytes + _FRAME) * self.character_s + self.latency_s + chance * self.jitter_s

    def acts_after_s(self, pdu_bytes: int, chance: float) -> float:
        """From the first character of a request until the drive acts on it and begins to reply."""
        return self.way_s(pdu_bytes, chance) + self.silence_s + self.turn_around_s
