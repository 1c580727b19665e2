"""A python-can bus that is a port of our own hub: receiving moves the hub, so that no second thread is needed."""

import time
from collections import deque

import can

from sim_bus.canopen.socketcand import Hub
from sim_bus.socketcand import WireFrame


class HubPort(can.BusABC):
    """The local end. When the last client leaves, `recv` raises `can.CanOperationError` once: the bus has ended."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._queue: deque[can.Message] = deque()
        hub.tap(self._deliver)
        self.channel_info = f"hub {hub.host}:{hub.port}"
        super().__init__(channel=hub.channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """To all clients; what a client doesn't take at once waits in the hub."""
        if not (msg.is_remote_frame or msg.is_error_frame):
            self._hub.send(WireFrame(msg.arbitration_id, msg.is_extended_id, bytes(msg.data)))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        queue = self._queue
        if not queue:
            self._hub.poll(1.0 if timeout is None else timeout)
            if not queue and self._hub.all_gone:
                self._hub.all_gone = False
                raise can.CanOperationError("the last client has left")
        return (queue.popleft(), True) if queue else (None, True)

    def _deliver(self, frame: WireFrame) -> None:
        self._queue.append(can.Message(
            timestamp=time.time(), arbitration_id=frame.can_id, is_extended_id=frame.extended, data=frame.data,
            is_remote_frame=frame.remote_length is not None, dlc=frame.remote_length,
        ))

    def shutdown(self) -> None:
        """Ends the hub as well."""
        super().shutdown()
        self._hub.close()
