"""Bench of the Drive contract (tests/drivers) with driver, simulator and second station on a real interface."""

from __future__ import annotations

import socket
import threading
from types import SimpleNamespace

import can

from drivers.canopen.drive import CanopenDrive
from drivers.clock import SteppedClock
from profiles.library import load_canopen_profile
from sim_bus.canopen.simulator import Simulator
from tests.drivers.drive_benches import LIMITS, CanopenBench, TamperedBus
from tests.rigs import QUIET_RIG

RECEIVE_BYTES = 4 << 20
RATE_HZ = 50.0
"""Rate of the bench. A guest needs milliseconds for any cycle, and the contract applies at every rate."""


class VcanBench(CanopenBench):
    """Bench like CanopenBench, over SocketCAN, with the simulator in a thread like the embedded one."""

    LEAST_FRAMES = 800

    def __init__(self, interface, params=QUIET_RIG, *, seed=0, rate_hz=RATE_HZ, **options):
        def open_bus():
            return can.Bus(interface="socketcan", channel=interface)

        self.limits, self.rated_nm, self.frames = LIMITS, 1000.0, []
        self._theirs, self._second = open_bus(), open_bus()
        # The second station is read rarely, so its buffer must hold unread frames.
        self._second.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
        simulator = Simulator(
            self._theirs, params, seed=seed, stepped=True,
            silence_s=float("inf"),
        )
        self.simulated = SimpleNamespace(simulator=simulator)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=simulator.run, args=(self._ended,), daemon=True)
        self._thread.start()
        assert self._second.recv(10.0) is not None       # its boot-up message, before the driver receives
        self.bus = TamperedBus(open_bus())
        self.drive = CanopenDrive(
            self.bus, load_canopen_profile(self.PROFILE), SteppedClock(), node=1, tap=self._tap, rate_hz=rate_hz,
            **options,
        )

    def close(self):
        if self._ended.is_set():
            return
        self.bus.shutdown()
        self._ended.set()
        self._thread.join()
        self._second.shutdown()
        self._theirs.shutdown()
