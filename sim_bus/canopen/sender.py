"""Frames out: one sender that survives a dying bus, a cheap message, canopen's network on top of it."""

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
    """Sends; after an error frames are dropped until `revive`, and ``on_lost`` has been called once."""

    def __init__(self, bus: can.BusABC, on_lost: Callable[[BaseException], None]) -> None:
        self._bus_send = bus.send
        self._on_lost = on_lost
        self.lost = False
        self.script: Callable[[int, bytes], Sequence[tuple[int, bytes | bytearray]]] | None = None
        """Replacement of an outgoing frame, if faults are scripted."""

    def revive(self) -> None:
        """The bus has been heard again."""
        self.lost = False

    def send(self, can_id: int, data: bytes) -> None:
        """Sends one data frame, or what the script makes of it."""
        if self.script is None:
            self.put(can_id, data)
            return
        for one, body in self.script(can_id, data):
            self.put(one, bytes(body))

    def put(self, can_id: int, data: bytes) -> None:
        """Puts one data frame on the bus."""
        if self.lost:
            return
        try:
            self._bus_send(Frame(can_id, data))
        except BUS_ERRORS as error:
            self.lost = True
            self._on_lost(error)


class PassiveNetwork(canopen.Network):  # type: ignore[misc, unused-ignore]
    """A network that is never connected: it is fed by ``notify`` and sends through our sender, in one thread."""

    def __init__(self, sender: Sender) -> None:
        super().__init__()
        self._sender = sender

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send an answer of canopen's servers; they never request remote frames."""
        self._sender.send(can_id, bytes(data))
