"""What comes back on the line for one request: as a rule the drive's reply, and what a scripted fault made of it."""

from typing import Literal, NamedTuple


class Reply(NamedTuple):
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


NONE = Reply(None)
