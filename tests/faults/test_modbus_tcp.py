"""Rows 4, 41 and 43 over TCP in real time: the host is killed, or the connection fails in motion.

Drive and host are separate processes. For faults of the network, a relay is between them.
The tests do not measure wall time: the trace of the shaft is in plant time.
"""

import contextlib
import select
import signal
import socket
import struct

import pytest

from tests.drivers.modbus_peers import TcpPeer
from tests.path.path_runs import QUICK_STOP_RAD_S2, SETTLING_S, host, modbus_peer, tail_time, wait_for
from tests.rigs import PATIENT_LIMITS, PATIENT_S, rig_file

pytestmark = pytest.mark.real_time

TURNING_RAD_S = 1.0         # the sign probe stays below this speed and ends at standstill
LATE_S = 0.3
"""Allowance for a computer that is busy with other tests and checks its watchdog late."""
RATE_HZ = 4.0
"""Slow rate, so that a busy computer causes no fault in real time. Three cycles without feedback end a run."""


class Relay(TcpPeer):
    """Relay that forwards all data, until ``fault`` is set: reset, half-open, or foreign (once)."""

    def __init__(self, port):
        super().__init__(None)
        self.fault, self.port_behind = "", port

    def serve(self, connection):
        with socket.create_connection(("127.0.0.1", self.port_behind)) as drive:
            self.carry(connection, drive)

    def carry(self, host, drive):
        while not self.over.is_set():
            for one in select.select([host, drive], [], [], 0.02)[0]:
                data = one.recv(4096)
                if not data:
                    return
                if self.fault == "half-open":
                    continue
                if self.fault == "foreign" and one is drive:
                    self.fault = ""
                    number, rest = struct.unpack(">H", data[:2])[0], data[2:]
                    data = struct.pack(">H", number ^ 0x5555) + rest
                (drive if one is host else host).sendall(data)
            if self.fault == "reset":
                host.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                return


class Bench:
    """Simulated drive, and the command line that controls it."""

    def __init__(self, folder, stack):
        self.folder, self.trace, self.stack = folder, folder / "shaft.csv", stack
        self.drive = stack.enter_context(modbus_peer(self.trace))
        self.port = int(self.drive.port)

    def start(self, port):
        self.host = self.stack.enter_context(host(
            self.folder, "--host", "127.0.0.1", "--port", port, "--rate", RATE_HZ,
            "--rig", rig_file(self.folder, PATIENT_LIMITS), cwd=self.folder,
        ))

    @property
    def shaft(self):
        return self.drive.shaft

    def wait_until_turning(self):
        def turning():
            shaft = self.shaft
            return len(shaft.time_s) > 0 and shaft.speed_rad_s[-1] > TURNING_RAD_S

        assert wait_for("the shaft to turn", turning, self.host.child), self.host.err
        return float(self.shaft.time_s[-1])

    def silent_from(self):
        """Return the plant time by which all requests of the host are served. The host is dead or disconnected.

        The drive has polled its line between two more flushes of the trace.
        """
        for _ in range(2):
            seen_s = tail_time(self.trace)
            wait_for("some more rows", lambda seen_s=seen_s: tail_time(self.trace) > seen_s)
        return tail_time(self.trace)

    def wait_at_rest(self, since_s):
        """Wait for standstill within watchdog time and ramp after ``since_s``, the time of the last request."""
        def resting():
            shaft = self.shaft
            return shaft.time_s[-1] > max(since_s, shaft.at_rest_from()) + 1.0

        wait_for("the shaft to come to rest", resting)
        shaft = self.shaft
        ramp_s = shaft.speed_rad_s.max() / QUICK_STOP_RAD_S2
        standstill_s = shaft.at_rest_from() - since_s
        assert standstill_s < PATIENT_S + LATE_S + ramp_s + SETTLING_S
        shaft.assert_never_let_go()
        return round(standstill_s, 2)


@pytest.fixture
def bench(tmp_path):
    with contextlib.ExitStack() as stack:
        yield Bench(tmp_path, stack)


@pytest.mark.heavy
def test_a_killed_host(bench, seen):
    bench.start(bench.port)
    bench.wait_until_turning()
    bench.host.signal(signal.SIGKILL)
    bench.host.finish()
    standstill_s = bench.wait_at_rest(bench.silent_from())
    assert bench.shaft.events("host silent")
    seen(4, "SIGKILL over Modbus TCP: the drive's time-out stops the shaft", standstill_s)


@pytest.mark.parametrize("fault", [
    pytest.param("reset", marks=pytest.mark.long),        # test_modbus_scripted resets one too
    pytest.param("half-open", marks=pytest.mark.heavy),
])
def test_a_connection_that_dies(bench, fault, seen):
    with Relay(bench.port) as relay:
        bench.start(relay.port)
        bench.wait_until_turning()
        relay.fault = fault
        at_s = bench.silent_from()
        done = bench.host.finish()
        connections = relay.connections
    standstill_s = bench.wait_at_rest(at_s)
    assert done.code == 8, done.err
    assert connections == 1, "connected again while the drive was enabled"
    error = done.document["error"]
    assert error["kind"] in ("LinkLost", "CommunicationLost", "NoReply")
    assert "127.0.0.1" in error["message"] or "no feedback" in error["message"]
    assert "Traceback" not in done.err
    assert bench.shaft.events("host silent")
    seen(43, f"{fault}: {error['message']}", standstill_s, code=8)


@pytest.mark.heavy
def test_a_foreign_transaction_id_costs_a_sample_and_the_connection(bench, seen):
    with Relay(bench.port) as relay:
        bench.start(relay.port)
        bench.wait_until_turning()
        relay.fault = "foreign"
        wait_for("a new connection", lambda: relay.connections == 2, bench.host.child)
        at_s = float(bench.shaft.time_s[-1])
        wait_for("the run to go on", lambda: bench.shaft.time_s[-1] > at_s + 1.0, bench.host.child)
        assert bench.host.child.poll() is None
        bench.host.signal(signal.SIGTERM)
        done = bench.host.finish()
        assert relay.connections == 2
    assert done.code == 143, done.err
    assert "at standstill" in done.document["stop"]
    bench.shaft.assert_never_let_go()
    seen(41, "the reply is dropped, the connection renewed, the run goes on", None, code=143)
