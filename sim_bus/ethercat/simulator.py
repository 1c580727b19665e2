"""The simulated drive with its time and its faults, as a pure function of frames, and its loop on a raw socket."""

import socket
import threading
import time
from pathlib import Path

from profiles.ethercat import EthercatProfile
from sim_bus.command_arguments import Unusable
from sim_bus.ethercat.esc import ETHERTYPE
from sim_bus.ethercat.faults import Faults
from sim_bus.ethercat.slave import Cia402Slave
from sim_bus.fault_script import Scripted
from sim_bus.own_time import OwnTime
from sim_bus.params import RigParams
from sim_bus.trace import ShaftTrace

_POLL_S = 0.005
_FRAME_SIZE = 2048


class Simulator:
    """A simulated drive. Its caller states the time: `answer` and `idle` wait for nothing and read no clock.

    Only the host's outputs advance stepped time, unless it is silent for ``silence_s`` (`OwnTime`).
    """

    def __init__(self, params: RigParams | None = None, *, seed: int = 0, trace: Path | None = None,
                 stepped: bool = False, silence_s: float = 1.0, alias: int = 0,
                 profile: EthercatProfile | None = None, faults: tuple[Scripted, ...] = ()) -> None:
        self.trace = ShaftTrace(trace)
        self.slave = Cia402Slave(params or RigParams(), seed=seed, trace=self.trace, stepped=stepped, alias=alias,
                                 profile=profile)
        self._faults = Faults(faults, self.slave, seed)
        self._time = OwnTime(self.slave, silence_s)

    @property
    def faults_waiting(self) -> tuple[str, ...]:
        """Scripted faults that have not begun yet, as they were written."""
        return self._faults.waiting

    def answer(self, frame: bytes, now_s: float) -> bytes:
        """Return the frame as it comes back at ``now_s`` of the caller's clock; empty if it is lost."""
        self.slave.esc.fine_ns = round(1e9 * self._time.heard(now_s))
        return self._faults.answer(frame)

    def idle(self, now_s: float, waited_s: float = _POLL_S) -> None:
        """Record that no frame has come for ``waited_s``. A shorter time counts if the caller had no processor time."""
        if not self._time.runs:
            self._time.waited(waited_s, now_s)
        self.slave.esc.fine_ns = round(1e9 * self._time.follow(now_s))

    def run(self, line: socket.socket, stop: threading.Event) -> None:
        """Serve a raw socket until ``stop`` is set. Then advance to the end of a rehearsal and close the trace."""
        line.settimeout(_POLL_S)
        with self.trace:
            while not stop.is_set():
                try:
                    frame, sender = line.recvfrom(_FRAME_SIZE)
                    if sender[2] != socket.PACKET_OUTGOING and (answer := self.answer(frame, time.monotonic())):
                        line.send(answer)
                except OSError as error:
                    if not isinstance(error, TimeoutError):
                        stop.wait(_POLL_S)          # the interface is down: nothing comes
                    self.idle(time.monotonic())
                    self.trace.flush()
            self._faults.end()


def raw_socket(interface: str) -> socket.socket:
    """Return a raw socket for EtherCAT frames on an interface. Raises Unusable with the reason."""
    family = getattr(socket, "AF_PACKET", None)
    if family is None:
        raise Unusable("no raw Ethernet sockets on this system: a simulated EtherCAT drive needs Linux")
    try:
        line = socket.socket(family, socket.SOCK_RAW, socket.htons(ETHERTYPE))
        line.bind((interface, ETHERTYPE))
    except OSError as error:
        why = error.strerror or str(error)
        raise Unusable(f"no raw socket on {interface}: {why}; it needs root or CAP_NET_RAW") from error
    return line
