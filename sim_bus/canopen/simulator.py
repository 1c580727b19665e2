"""The loop that owns the bus: it takes frames and advances plant time. The same loop in a thread, for one process.

In stepped time only the SYNC advances time, unless the host is silent. The host counts as silent after ``silence_s`` of
wall time without a frame while the simulator itself was awake. It also counts as silent at once if the bus reports its
end. Then the simulator continues in its own time, so that the drive's watchdog acts and the shaft comes to standstill.
New frames return it to stepped time. Before the first SYNC time stands still.
"""

import math
import threading
import time
import uuid
from pathlib import Path
from types import TracebackType
from typing import Self

import can

from profiles import CYCLE_ANSWER, CYCLE_ASKED, CYCLE_ID
from profiles.canopen import CanopenProfile
from sim_bus.canopen.faults import Faults
from sim_bus.canopen.node import Cia402Node
from sim_bus.canopen.sender import BUS_ERRORS, Sender
from sim_bus.fault_script import Scripted
from sim_bus.own_time import OwnTime
from sim_bus.params import RigParams
from sim_bus.trace import ShaftTrace

_POLL_OWN_TIME_S = 0.005
_POLL_STEPPED_S = 0.05
_RETRY_S = 0.05


class Simulator:
    """A simulated drive on a bus that the caller opens and shuts down."""

    def __init__(self, bus: can.BusABC, params: RigParams, *, node_id: int = 1, seed: int = 0,
                 trace: Path | None = None, stepped: bool = False, silence_s: float = 1.0,
                 profile: CanopenProfile | None = None, faults: tuple[Scripted, ...] = ()) -> None:
        self._bus = bus
        self._sender = Sender(bus, self._on_send_failed)
        self._trace = ShaftTrace(trace)
        self.node = Cia402Node(
            self._sender, params, node_id=node_id, seed=seed, trace=self._trace, stepped=stepped, profile=profile,
        )
        self._faults = Faults(faults, seed) if faults else None
        if self._faults is not None:
            self._faults.attach(self.node, self._sender)
        self._time = OwnTime(self.node, silence_s)

    @property
    def speed_rad_s(self) -> float:
        """Speed of the true shaft, rad/s."""
        return self.node.inverter.speed_rad_s

    @property
    def time_s(self) -> float:
        """Plant time, s."""
        return self.node.time_us * 1e-6

    @property
    def faults_waiting(self) -> tuple[str, ...]:
        """Scripted faults that have not begun yet, as they were written."""
        return self._faults.waiting if self._faults is not None else ()

    def run(self, stop: threading.Event) -> None:
        """Serve the bus until ``stop`` is set. The trace is closed at the end."""
        with self._trace:
            self.begin()
            while not stop.is_set():
                own_time = self._time.runs
                timeout_s = _POLL_OWN_TIME_S if own_time else min(_POLL_STEPPED_S, self._time.silence_s)
                before_s = time.monotonic() if own_time or self._time.silent_s else 0.0
                try:
                    message = self._bus.recv(timeout_s)
                except BUS_ERRORS as error:
                    self._time.run_on(f"bus lost ({error}): running on in own time", time.monotonic())
                    stop.wait(_POLL_OWN_TIME_S if self._time.runs else _RETRY_S)
                    self._time.follow(time.monotonic())
                    continue
                if message is None:
                    self._nothing_came(timeout_s, before_s, stop)
                else:
                    self.hear(message)
            self.end()

    def begin(self) -> None:
        """Switch the drive on; it sends its boot-up message."""
        self.node.boot()
        self._time.follow(time.monotonic())

    def hear(self, message: can.Message) -> None:
        """Take one frame from the bus. The drive's replies have been sent when this returns."""
        if message.is_extended_id or message.is_error_frame:
            return
        node, identifier = self.node, message.arbitration_id
        if self._sender.lost:
            self._sender.revive()
        self._time.heard(time.monotonic())
        if message.is_remote_frame:
            node.on_remote(identifier)
        elif identifier == CYCLE_ID:
            if node.stepped and message.data[:1] == CYCLE_ASKED:
                self._sender.put(CYCLE_ID, CYCLE_ANSWER + message.data[1:2])
        elif self._faults is not None:
            self._faults.came(identifier, bytes(message.data))
        else:
            node.on_frame(identifier, bytes(message.data))

    def end(self) -> None:
        """Advance to the end of a rehearsal, after the host has left for good."""
        if self._faults is not None:
            self._faults.end()

    def close_trace(self) -> None:
        """Close the trace; safe to repeat."""
        self._trace.close()

    def _nothing_came(self, timeout_s: float, before_s: float, stop: threading.Event) -> None:
        self._trace.flush()
        if self._time.runs:
            if time.monotonic() - before_s < 0.5 * timeout_s:
                stop.wait(timeout_s)          # the bus returned at once, like a closed socketcand client
            self._time.follow(time.monotonic())
            return
        # The first empty wait counts as a whole one. Later ones are measured, because a dead bus returns at once.
        waited_s = time.monotonic() - before_s if self._time.silent_s else timeout_s
        if waited_s < 0.5 * timeout_s:
            stop.wait(timeout_s)
            waited_s += timeout_s
        # A process without processor time can't know whether other stations are silent: no wait counts for more than
        # its length.
        self._time.waited(min(waited_s, timeout_s), time.monotonic())

    def _on_send_failed(self, error: BaseException) -> None:
        self.node.note(f"sending failed: {error}")


class Embedded:
    """A simulator in this process. A subclass passes the frames to it. `check` raises its errors."""

    def __init__(self) -> None:
        self._failure: BaseException | None = None

    def open(self) -> Self:
        """Switch the drive on."""
        raise NotImplementedError

    def _end(self) -> None:
        """End the simulation and release the bus; safe to repeat."""
        raise NotImplementedError

    def check(self) -> None:
        """Raise RuntimeError for an error in the simulation."""
        if self._failure is not None:
            raise RuntimeError("the simulated drive failed") from self._failure

    def close(self) -> None:
        """End the simulation, release the bus and raise its error; safe to repeat."""
        self._end()
        self.check()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 where: TracebackType | None) -> None:
        self._end()
        if error is None:
            self.check()


class EmbeddedSimulator(Embedded):
    """A simulator in a daemon thread of this process, on a python-can ``virtual`` channel of its own.

    ``with EmbeddedSimulator(params) as simulated: bus = can.Bus(interface="virtual", channel=simulated.channel)``.
    ``profile``: profile of the simulated drive. By default it is stepped, and a pause of the host, however long, has no
    effect: host and simulator run in one process, and a run must repeat on a slow machine. In stepped time
    `sim_bus.canopen.inline.InlineSimulator` sends the same frames, several times as fast.
    """

    def __init__(self, params: RigParams | None = None, *, node_id: int = 1, seed: int = 0, trace: Path | None = None,
                 stepped: bool = True, silence_s: float = math.inf, profile: CanopenProfile | None = None,
                 faults: tuple[Scripted, ...] = ()) -> None:
        super().__init__()
        self.channel = f"tdhil-{uuid.uuid4().hex}"
        self._bus = can.Bus(interface="virtual", channel=self.channel)
        self.simulator = Simulator(
            self._bus, params or RigParams(),
            node_id=node_id, seed=seed, trace=trace, stepped=stepped, silence_s=silence_s, profile=profile,
            faults=faults,
        )
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="simulated drive", daemon=True)

    def open(self) -> Self:
        """Start the thread."""
        self._thread.start()
        return self

    def _end(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._bus.shutdown()

    def _run(self) -> None:
        try:
            self.simulator.run(self._stop)
        except BaseException as error:        # kept for the host's thread, which raises it
            self._failure = error
