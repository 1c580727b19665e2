"""Virtual bus that records sent frames."""

import can
from can.interfaces.virtual import VirtualBus


class WatchedBus(VirtualBus):
    """Virtual bus. ``sent``: (identifier, data) of every frame."""

    def __init__(self, channel: str) -> None:
        super().__init__(channel=channel)
        self.sent: list[tuple[int, bytes]] = []

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        self.sent.append((message.arbitration_id, bytes(message.data)))
        super().send(message, timeout)

    @property
    def identifiers(self) -> set[int]:
        return {identifier for identifier, _ in self.sent}

    @property
    def only_reads(self) -> bool:
        """Return whether all frames are SDO uploads: initiate (40h) and segments (60h, 70h), CiA 301."""
        return {data[0] for _, data in self.sent} <= {0x40, 0x60, 0x70}
