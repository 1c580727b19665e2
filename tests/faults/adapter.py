"""python-can bus between host and virtual bus that shows the faults of adapters and kernels."""

import errno
from collections import deque

import can


class Adapter:
    """Adapter that calls ``on_frame`` before every transmitted frame. ``sent`` counts those that reach the bus."""

    def __init__(self, bus):
        self._bus = bus
        self.channel_info = bus.channel_info
        self.coming = deque()
        self.error = None              # raised by send and recv from now on
        self.full = False              # the transmit queue is full: ENOBUFS
        self.queued = None             # a list: frames go there, not on the bus
        self.on_frame = lambda message: None
        self.tried, self.sent = [], []

    def send(self, message, timeout=None):
        self.on_frame(message)
        self.tried.append(message)
        if self.error is not None:
            raise self.error
        if self.full:
            raise can.CanOperationError("Failed to transmit: [Errno 105] No buffer space available", errno.ENOBUFS)
        if self.queued is not None:
            self.queued.append(message)
            return
        self.sent.append(message)
        self._bus.send(message)

    def recv(self, timeout):
        if self.error is not None:
            raise self.error
        if self.coming:
            return self.coming.popleft()
        return self._bus.recv(timeout)

    def error_frame(self, classes, state=0):
        """Return an error frame of SocketCAN: classes in the identifier, the controller's state in byte 1."""
        self.coming.append(can.Message(arbitration_id=classes, data=[0, state, 0, 0, 0, 0, 0, 0], is_error_frame=True))

    def deliver(self):
        """Transmit the queue late."""
        queued, self.queued = self.queued or [], None
        for message in queued:
            self._bus.send(message)
        return queued

    def shutdown(self):
        self._bus.shutdown()
