"""The bench of the Drive contract (tests/drivers) with driver, simulator and second station on a real interface."""

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
"""A guest takes milliseconds for a cycle, whatever its period; what the contract asks for holds at every rate."""


class VcanBench(CanopenBench):
    """As CanopenBench, over SocketCAN; the simulator in a thread as the embedded one is."""

    LEAST_FRAMES = 800

    def __init__(self, interface, params=QUIET_RIG, *, seed=0, rate_hz=RATE_HZ, **options):
        def open_bus():
            return can.Bus(interface="socketcan", channel=interface)

        self.limits, self.rated_nm, self.frames = LIMITS, 1000.0, []
        self._theirs, self._second = open_bus(), open_bus()
        # The second station is asked seldom: what it has not fetched must find room.
        self._second.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
        simulator = Simulator(
            self._theirs, params, seed=seed, stepped=True,
            silence_s=float("inf"),
        )
        self.simulated = SimpleNamespace(simulator=simulator)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=simulator.run, args=(self._ended,), daemon=True)
        self._thread.start()
        assert self._second.recv(10.0) is not None       # its boot-up, before the driver listens
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
