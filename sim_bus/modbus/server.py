"""The simulated Modbus drive in real time: plant and watchdog follow the monotonic clock, also without requests."""

import select
import threading
import time

from sim_bus.modbus.codec import BROADCAST, NONE, DriveReply
from sim_bus.modbus.faults import Faults
from sim_bus.modbus.lines import ReceivedRequest, RequestListener
from sim_bus.modbus.machine import Machine

_POLL_S = 0.005
_ANY_UNIT = 255
"""Unit of a TCP host without a gateway (messaging guide, section 4.4.1.2)."""


class DriveServer:
    """One drive on one line, with its scripted faults; `run` is the only thread."""

    def __init__(self, machine: Machine, unit: int, listener: RequestListener, *, gateway: bool,
                 faults: Faults | None = None) -> None:
        self._machine = machine
        self._unit = unit
        self._listener = listener
        self._ask = (
            (lambda pdu, connection: DriveReply(machine.request(pdu, connection))) if faults is None else faults.request
        )
        self._whole = (unit, BROADCAST, _ANY_UNIT) if gateway else (unit,)
        self._began_s = time.monotonic()

    def run(self, stop: threading.Event) -> None:
        """Serve until ``stop`` is set."""
        self._began_s = time.monotonic()
        while not stop.is_set():
            ready, _, _ = select.select(self._listener.sources(), [], [], _POLL_S)
            for source in ready:
                self._listener.ready(source, self._serve)
            self._listener.send_late()
            self._catch_up()
            self._machine.flush()

    def _serve(self, request: ReceivedRequest) -> DriveReply:
        self._catch_up()
        if request.unit in self._whole:
            return self._ask(request.pdu, request.connection)
        if request.unit == BROADCAST:
            self._ask(request.pdu, request.connection)
        return NONE

    def _catch_up(self) -> None:
        self._machine.run_until(time.monotonic() - self._began_s)
