"""Sending of frames: a sender that tolerates a failing bus, a cheap message, and canopen's network above it."""

from collections.abc import Callable, Sequence

import can
import canopen

BUS_ERRORS = (can.CanError, OSError, ValueError)
"""Errors that python-can's buses raise when they fail; a closed socket gives ValueError in `select`."""


class Frame(can.Message):
    """A data frame with an 11-bit identifier, cheap to copy: python-can's virtual bus deep-copies what it sends."""

    __slots__ = ()

    def __init__(self, can_id: int, data: bytes) -> None:
        super().__init__(arbitration_id=can_id, data=bytearray(data), is_extended_id=False, check=False)

    def __deepcopy__(self, memo: dict[int, object] | None) -> can.Message:
        return can.Message(arbitration_id=self.arbitration_id, data=bytearray(self.data), is_extended_id=False)


class Sender:
    """Sender of frames. After an error it drops frames until `revive`; ``on_lost`` is called once."""

    def __init__(self, bus: can.BusABC, on_lost: Callable[[BaseException], None]) -> None:
        self._bus_send = bus.send
        self._on_lost = on_lost
        self.lost = False
        self.script: Callable[[int, bytes], Sequence[tuple[int, bytes | bytearray]]] | None = None
        """Function that returns the frames to send instead, if faults are scripted."""

    def revive(self) -> None:
        """Send again: a frame from the bus was received."""
        self.lost = False

    def send(self, can_id: int, data: bytes) -> None:
        """Send one data frame, or the frames that the script returns for it."""
        if self.script is None:
            self.put(can_id, data)
            return
        for one, body in self.script(can_id, data):
            self.put(one, bytes(body))

    def put(self, can_id: int, data: bytes) -> None:
        """Put one data frame on the bus."""
        if self.lost:
            return
        try:
            self._bus_send(Frame(can_id, data))
        except BUS_ERRORS as error:
            self.lost = True
            self._on_lost(error)


class PassiveNetwork(canopen.Network):  # type: ignore[misc, unused-ignore]
    """A network without a connection: ``notify`` feeds it, and it sends through our sender, in one thread."""

    def __init__(self, sender: Sender) -> None:
        super().__init__()
        self._sender = sender

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send an answer of canopen's servers; they never request remote frames."""
        self._sender.send(can_id, bytes(data))
