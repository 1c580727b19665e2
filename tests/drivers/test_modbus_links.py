"""Both links with faulty peers, over the loopback and over a pty: every fault gives a typed error."""

import contextlib
import select
import socket
import struct
import threading
import time
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.clock import MonotonicClock, SteppedClock
from drivers.errors import CommunicationLost, PreflightRefused
from drivers.modbus.link import EmbeddedLink
from drivers.modbus.pdu import BadReply, LinkLost, NoReply
from drivers.modbus.rtu import RtuLink, permission_command, refusal
from drivers.modbus.tcp import MOST_RENEWED, TcpLink
from tests.drivers.modbus_peers import CLOSE, HANGS_S, RESET, SerialPeer, TcpPeer, crc, rtu, tcp

ASK = bytes.fromhex("03 0010 0002")
GOOD = bytes.fromhex("03 04 0250 04d2")
OTHER = bytes.fromhex("03 04 dead beef")
SHORT_S = 0.1       # for a missing reply
LONG_S = HANGS_S    # for a reply that arrives


def head(request):
    return struct.unpack_from(">H", request)[0], request[6]


def good(request):
    """Return the right reply over TCP."""
    return tcp(*head(request), GOOD)


class Hasty(MonotonicClock):
    """Clock that can jump: a reply that is not there yet is too late, independent of the load of this computer."""

    skipped_s = 0.0

    def now_s(self):
        return super().now_s() + self.skipped_s

    def skip(self):
        self.skipped_s += 2.0 * LONG_S


class Line:
    """Link and its peer, with the bytes of the reply for each kind of line."""

    def __init__(self, kind, behave):
        self.kind = kind
        self.peer = (TcpPeer if kind == "tcp" else SerialPeer)(behave)

    def __enter__(self):
        self.peer.__enter__()
        self.clock = clock = Hasty()
        if self.kind == "tcp":
            self.link = TcpLink("127.0.0.1", self.peer.port, clock)
        else:
            self.link = RtuLink(self.peer.device, clock, baud=115200, parity="N")
        return self

    def __exit__(self, *error):
        self.link.close()
        self.peer.__exit__()

    def wait_until_it_lies_there(self):
        """Wait until the kernel has delivered the written bytes to the other end of a pty or socket."""
        link, end_s = self.link, time.monotonic() + HANGS_S
        while not (link._port.in_waiting if self.kind == "rtu" else select.select((link._socket,), (), (), 0)[0]):
            assert time.monotonic() < end_s
            time.sleep(0.001)

    def ask(self, timeout_s=LONG_S, pdu=ASK):
        return self.link.transact(1, pdu, timeout_s)


KINDS = pytest.mark.parametrize("kind", ["tcp", "rtu"])


def reply(kind, request, pdu=GOOD, unit=None):
    if kind == "rtu":
        return rtu(request[0] if unit is None else unit, pdu)
    transaction, sender = head(request)
    return tcp(transaction, sender if unit is None else unit, pdu)


@KINDS
def test_a_transaction(kind):
    with Line(kind, lambda number, request: [reply(kind, request)]) as line:
        before_s = line.link.clock.now_s()
        found = line.ask()
        assert found.pdu == GOOD
        assert before_s <= found.sent_s <= found.received_s <= line.link.clock.now_s()
        request = line.peer.requests[0]
        assert request == (tcp(1, 1, ASK) if kind == "tcp" else rtu(1, ASK))
        assert line.link.description


def test_the_crc_of_the_specification():
    """The frame 02 07 of the serial-line guide has CRC 41 12."""
    assert crc(bytes.fromhex("0207")) == bytes.fromhex("4112")


@KINDS
@pytest.mark.parametrize("code", [1, 2, 3, 4, 6])
def test_exceptions_are_replies(kind, code):
    with Line(kind, lambda number, request: [reply(kind, request, bytes((0x83, code)))]) as line:
        assert line.ask().pdu == bytes((0x83, code))


@KINDS
def test_a_reply_in_pieces(kind):
    def behave(number, request):
        whole = reply(kind, request)
        return [part for k in range(len(whole)) for part in (whole[k : k + 1], 0.003)]

    with Line(kind, behave) as line:
        assert line.ask().pdu == GOOD
        assert line.ask().pdu == GOOD


@KINDS
def test_silence(kind):
    with Line(kind, lambda number, request: [] if number == 0 else [reply(kind, request)]) as line:
        with pytest.raises(NoReply) as caught:
            line.ask(SHORT_S)
        assert isinstance(caught.value, CommunicationLost)
        assert caught.value.where == line.link.description
        assert caught.value.next_step
        assert line.ask().pdu == GOOD
        assert line.link.late == 0


@KINDS
def test_a_late_reply_is_not_taken_for_the_next(kind):
    """The late reply arrives after the time-out, with other data."""
    over = threading.Event()

    def behave(number, request):
        return [over, reply(kind, request, OTHER)] if number == 0 else [reply(kind, request)]

    with Line(kind, behave) as line:
        with pytest.raises(NoReply):
            line.ask(SHORT_S)
        over.set()
        line.wait_until_it_lies_there()
        assert [line.ask().pdu for _ in range(3)] == [GOOD] * 3
        assert line.link.late == 1


@KINDS
def test_a_reply_so_late_that_the_next_request_is_out(kind):
    """The old reply arrives directly before the new one, with the same unit, function and length."""
    kept = []

    def behave(number, request):
        if number == 0:
            kept.append(reply(kind, request, OTHER))
            return []
        late = [kept.pop(), 0.015] if kept else []
        return [*late, reply(kind, request)]

    with Line(kind, behave) as line:
        line.link._usual_s = LONG_S        # the wait for the right reply is as long as an earlier good reply took
        with pytest.raises(NoReply):
            line.ask(SHORT_S)
        assert [line.ask().pdu for _ in range(3)] == [GOOD] * 3
        assert line.link.late == 1


@KINDS
def test_an_unrequested_reply_is_discarded(kind):
    over = threading.Event()

    def behave(number, request):
        return [reply(kind, request)] + ([over, reply(kind, request, OTHER)] if number == 0 else [])

    with Line(kind, behave) as line:
        assert line.ask().pdu == GOOD
        over.set()
        line.wait_until_it_lies_there()
        assert line.ask().pdu == GOOD
        assert line.link.late == 1
        assert line.ask().pdu == GOOD


@KINDS
@pytest.mark.parametrize("wrong", ["unit", "function"])
def test_a_reply_of_another_unit(kind, wrong):
    def behave(number, request):
        if number:
            return [reply(kind, request)]
        return [reply(kind, request, GOOD if wrong == "unit" else b"\x04" + GOOD[1:], 2 if wrong == "unit" else None)]

    with Line(kind, behave) as line:
        with pytest.raises(BadReply, match=wrong):
            line.ask()
        assert line.ask().pdu == GOOD


def test_a_wrong_transaction_id_costs_the_connection():
    def behave(number, request):
        transaction, unit = head(request)
        return [tcp(transaction + 7 if number == 0 else transaction, unit, OTHER if number == 0 else GOOD)]

    with Line("tcp", behave) as line:
        with pytest.raises(BadReply, match="transaction id 8, not 1"):
            line.ask()
        assert line.peer.connections == 1
        assert line.ask().pdu == GOOD
    assert line.peer.connections == 2


@pytest.mark.parametrize("rubbish", [b"HTTP/1.1 400 Bad Request\r\n", bytes(6) + b"\x01\x03", b"\0\1\0\0\xff\xff\1\3"])
def test_frames_that_are_not_modbus(rubbish):
    with Line("tcp", lambda number, request: [rubbish if number == 0 else good(request)]) as line:
        with pytest.raises(BadReply, match="not a Modbus frame"):
            line.ask()
        assert line.ask().pdu == GOOD


@pytest.mark.parametrize("bit", [0, 9, 20, 35, 50, 71])
def test_a_crc_error_on_the_line(bit):
    def behave(number, request):
        frame = bytearray(rtu(1, GOOD))
        if number == 0:
            frame[bit // 8] ^= 1 << bit % 8
        return [bytes(frame)]

    with Line("rtu", behave) as line:
        with pytest.raises((BadReply, NoReply)):
            line.ask(SHORT_S)
        assert line.ask().pdu == GOOD


@pytest.mark.parametrize("length", range(1, 9))
def test_a_short_reply_on_the_line(length):
    came, got = threading.Event(), []

    def behave(number, request):
        return [rtu(1, GOOD)] if number else [rtu(1, GOOD)[:length], came, line.clock.skip]

    with Line("rtu", behave) as line:
        read = line.link._read

        def noted():
            got.append(data := read())
            if sum(map(len, got)) >= length:
                came.set()
            return data

        line.link._read = noted
        with pytest.raises(BadReply):
            line.ask()
        assert line.ask().pdu == GOOD


@pytest.mark.parametrize("ending", [RESET, CLOSE])
def test_a_connection_that_ends_is_not_opened_again(ending):
    with Line("tcp", lambda number, request: [ending] if number == 1 else [good(request)]) as line:
        assert line.ask().pdu == GOOD
        for _ in range(3):
            with pytest.raises(LinkLost):
                line.ask()
        assert line.peer.connections == 1
        assert len(line.peer.requests) == 2


def test_nothing_queues_up_on_a_connection_that_takes_nothing():
    """The other end neither reads nor acknowledges, as with an unplugged cable, so its buffers are full."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        link = TcpLink("127.0.0.1", listener.getsockname()[1], MonotonicClock())
        link._socket.setblocking(False)
        with pytest.raises(BlockingIOError):
            while True:
                link._socket.send(bytes(1000))
        with pytest.raises((NoReply, LinkLost)):
            link.transact(1, ASK, SHORT_S)
        with pytest.raises((NoReply, LinkLost)):
            link.transact(1, ASK, SHORT_S)
        assert link._transaction == 0       # neither was sent
        link.close()


def test_the_adapter_is_unplugged():
    with Line("rtu", lambda number, request: [rtu(1, GOOD)] if number == 0 else [CLOSE]) as line:
        assert line.ask().pdu == GOOD
        line.peer.over.set()
        line.peer.join()
        line.peer.end()
        for _ in range(2):
            with pytest.raises(LinkLost):
                line.ask(SHORT_S)


def test_no_server_listens():
    with socket.socket() as taken, pytest.raises(PreflightRefused, match="nothing listens") as caught:
        taken.bind(("127.0.0.1", 0))           # and no other server listens there
        port = taken.getsockname()[1]
        TcpLink("127.0.0.1", port, MonotonicClock())
    assert str(port) in caught.value.where
    assert caught.value.next_step


def test_an_address_that_does_not_reply(monkeypatch):
    def silent(*_, **__):
        raise TimeoutError("timed out")

    monkeypatch.setattr("drivers.modbus.tcp.socket.create_connection", silent)
    with pytest.raises(PreflightRefused, match="no answer to the connection") as caught:
        TcpLink("192.0.2.1", 502, MonotonicClock())
    assert "ping 192.0.2.1" in caught.value.next_step


def test_on_other_systems_the_kernel_is_not_asked_for_what_was_not_acknowledged(monkeypatch):
    with TcpPeer(lambda number, request: [good(request)]) as peer:
        link = TcpLink("127.0.0.1", peer.port, MonotonicClock())
        monkeypatch.setattr("fcntl.ioctl", lambda *_: pytest.fail("Linux alone knows this"))
        monkeypatch.setattr("drivers.modbus.tcp.sys.platform", "win32")
        try:
            assert link.transact(1, ASK, LONG_S).pdu == GOOD
        finally:
            monkeypatch.undo()
            link.close()


def test_sending_has_the_time_of_its_reply_after_any_earlier_wait(monkeypatch):
    waits, plain = [], socket.socket.sendall

    def watched(self, data):
        if self is link._socket:
            waits.append(self.gettimeout())
        return plain(self, data)

    with TcpPeer(lambda number, request: [good(request)]) as peer:
        link = TcpLink("127.0.0.1", peer.port, MonotonicClock(), connect_s=1.0)
        monkeypatch.setattr(socket.socket, "sendall", watched, raising=False)
        link.transact(1, ASK, LONG_S)
        link.close()
    assert waits == [LONG_S]


def test_a_request_that_cannot_be_sent_in_time_gets_no_reply(monkeypatch):
    def full(self, data):
        raise TimeoutError("timed out")

    with TcpPeer(lambda number, request: []) as peer:
        link = TcpLink("127.0.0.1", peer.port, MonotonicClock())
        monkeypatch.setattr(socket.socket, "sendall", full, raising=False)
        with pytest.raises(NoReply) as caught:
            link.transact(1, ASK, SHORT_S)
        link.close()
    assert caught.value.what == "the connection accepts no data"


def test_no_such_device(tmp_path):
    with pytest.raises(PreflightRefused, match="the device does not exist") as caught:
        RtuLink(str(tmp_path / "ttyUSB7"), MonotonicClock())
    assert caught.value.next_step


def test_a_file_is_no_line(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("not a device")
    with pytest.raises(PreflightRefused, match="not a serial device"):
        RtuLink(str(path), MonotonicClock())


def test_a_device_in_use():
    peer = SerialPeer(lambda number, request: [])
    first = RtuLink(peer.device, MonotonicClock(), parity="N")
    with pytest.raises(PreflightRefused, match="another program"):
        RtuLink(peer.device, MonotonicClock(), parity="N")
    first.close()
    peer.end()


@pytest.mark.parametrize("parity", ["N", "E", "O"])
@pytest.mark.parametrize("baud", [9600, 19200, 115200])
def test_settings_of_the_line(parity, baud):
    """A pty accepts all settings without any effect."""
    with SerialPeer(lambda number, request: [rtu(1, GOOD)]) as peer:
        link = RtuLink(peer.device, MonotonicClock(), baud=baud, parity=parity, stop_bits=2)
        assert link.transact(1, ASK, LONG_S).pdu == GOOD
        assert f"{baud} baud 8{parity}2" in link.description
        link.close()


def test_permission_names_the_command(tmp_path):
    path = tmp_path / "ttyUSB0"
    path.touch()
    error = refusal(str(path), PermissionError(13, "Permission denied"))
    assert "permission denied" in error.what
    assert "sudo " in error.next_step
    assert permission_command("there is none").startswith("sudo usermod -a -G dialout")


@settings(max_examples=150, deadline=None)
@given(st.lists(st.binary(max_size=12) | st.sampled_from([tcp(1, 1, GOOD), tcp(1, 1, b"\x83\x02"), tcp(1, 2, GOOD)])))
def test_any_bytes_over_tcp_give_a_reply_or_a_typed_error(pieces):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        link = TcpLink("127.0.0.1", listener.getsockname()[1], MonotonicClock())
        other, _ = listener.accept()
        with other:
            other.sendall(b"".join(pieces))
            other.shutdown(socket.SHUT_WR)
            with contextlib.suppress(BadReply, LinkLost):
                assert link.transact(1, ASK, LONG_S).pdu[0] & 0x7F == 3
        link.close()


class JunkPort:
    """Port with the interface of a serial port: the reply arrives after a write."""

    def __init__(self, data):
        self.data, self.coming = data, b""

    @property
    def in_waiting(self):
        return len(self.coming)

    def write(self, frame):
        self.coming, self.data = self.data, b""

    def read(self, size):
        found, self.coming = self.coming[:size], self.coming[size:]
        if not found:
            threading.Event().wait(0.001)
        return found

    def close(self):
        pass


@pytest.fixture
def line_of_junk():
    """Return a serial line with a port that the test sets."""
    peer = SerialPeer(lambda number, request: [])
    link = RtuLink(peer.device, MonotonicClock(), parity="N")
    link.close()
    peer.end()
    link._lost = ""
    return link


def test_a_reply_during_the_listening_time_is_late(line_of_junk):
    pieces = iter([b"", rtu(1, OTHER)])
    line_of_junk._port = SimpleNamespace(in_waiting=0, read=lambda _: next(pieces, b""))
    line_of_junk._owed, line_of_junk._listen_s = True, LONG_S
    line_of_junk._come_into_step()
    assert (line_of_junk.late, line_of_junk._owed, line_of_junk._listen_s) == (1, False, 0.0)


def test_a_line_that_was_lost_stays_lost(line_of_junk):
    """The adapter may return with another drive, or within a frame."""
    def broken(_frame):
        raise OSError(5, "Input/output error")

    line_of_junk._port = SimpleNamespace(in_waiting=0, write=broken)
    for _ in range(2):
        with pytest.raises(LinkLost, match="Input/output error"):
            line_of_junk.transact(1, ASK, 0.01)
        line_of_junk._port = JunkPort(rtu(1, GOOD))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=12) | st.sampled_from([rtu(1, GOOD), rtu(1, b"\x83\x02"), rtu(2, GOOD)])))
def test_any_bytes_over_a_serial_line_give_a_reply_or_a_typed_error(pieces):
    peer = SerialPeer(lambda number, request: [])
    link = RtuLink(peer.device, MonotonicClock(), parity="N")
    link.close()
    peer.end()
    link._lost, link._port = "", JunkPort(b"".join(pieces))
    with contextlib.suppress(BadReply, NoReply):
        assert link.transact(1, ASK, 0.01).pdu in (GOOD, b"\x83\x02")
    link._port = JunkPort(rtu(1, GOOD))
    assert link.transact(1, ASK, LONG_S).pdu == GOOD


def test_the_embedded_line_drops_late_replies():
    clock = MonotonicClock()
    link = EmbeddedLink(lambda unit, pdu, now_s: (GOOD, now_s + 1.0), clock)
    with pytest.raises(NoReply):
        link.transact(1, ASK, 0.01)
    assert link.late == 1


def test_queued_data_are_discarded_when_the_connection_is_closed():
    """A setpoint that is still queued must not reach the drive after the end of the host."""
    setpoint = bytes.fromhex("0001 0000 0006 01 06 0001 0fa0")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        link = TcpLink(*server.getsockname(), MonotonicClock())
        drive, _ = server.accept()
        with drive:
            link._socket.setblocking(False)
            with pytest.raises(BlockingIOError):        # until the buffers of both systems are full
                while True:
                    link._socket.send(1000 * setpoint)
            link.close()
            drive.settimeout(HANGS_S)
            with pytest.raises(ConnectionResetError):   # an orderly close would deliver all data first
                while drive.recv(100_000):
                    pass


def test_replies_that_come_twice_cost_nothing():
    """A gateway sends each reply twice. The second one has a transaction id that is already complete."""
    with TcpPeer(lambda number, request: [good(request), good(request)]) as peer:
        link = TcpLink("127.0.0.1", peer.port, MonotonicClock())
        for _ in range(50):
            assert link.transact(1, ASK, LONG_S).pdu == GOOD
        link.close()
        assert peer.connections == 1
        assert 40 <= link.late <= 49


def test_foreign_replies_cost_the_connection_a_few_times_only():
    """After that, foreign replies are dropped, and the link waits for the right one."""
    with TcpPeer(lambda number, request: [tcp(0xF000 + number, 1, OTHER), good(request)]) as peer:
        link = TcpLink("127.0.0.1", peer.port, MonotonicClock())
        answered = 0
        for _ in range(20):
            with contextlib.suppress(BadReply):
                answered += link.transact(1, ASK, LONG_S).pdu == GOOD
        link.close()
        assert peer.connections <= MOST_RENEWED + 1
        assert answered == 20 - MOST_RENEWED


def test_the_connection_before_is_closed_when_another_is_opened():
    """A drive may accept one connection only."""
    with TcpPeer(lambda number, request: [tcp(0xF000 + number, 1, OTHER), good(request)]) as peer:
        link = TcpLink("127.0.0.1", peer.port, MonotonicClock())
        before = link._socket
        for _ in range(2):
            with contextlib.suppress(BadReply):
                link.transact(1, ASK, LONG_S)
        assert before.fileno() == -1
        link.close()


def test_opening_anew_never_takes_longer_than_a_reply_may(monkeypatch):
    """After a foreign reply, the new connection is not accepted. The cycle continues, so a stop is possible."""
    with (
        TcpPeer(lambda number, request: [tcp(0xF000, 1, OTHER)]) as peer,
        socket.create_server(("127.0.0.1", 0), backlog=0) as full, contextlib.ExitStack() as waiting,
    ):
        link = TcpLink("127.0.0.1", peer.port, MonotonicClock(), connect_s=0.5)
        with pytest.raises(BadReply):
            link.transact(1, ASK, LONG_S)
        link.clock = SteppedClock()
        link._peer = full.getsockname()
        for _ in range(4):             # its queue is full from here on, and further connections get no reply
            one = waiting.enter_context(socket.socket())
            one.setblocking(False)
            one.connect_ex(link._peer)
        waited, plain = [], select.select

        def watched(readers, writers, errors, timeout_s):
            waited.append(timeout_s)
            return plain(readers, writers, errors, timeout_s)

        monkeypatch.setattr("drivers.modbus.tcp.select.select", watched)
        for _ in range(5):
            with pytest.raises(NoReply):
                link.transact(1, ASK, 0.02)
        assert waited == [0.02] * 5
        link.clock.wait_until(0.6)
        with pytest.raises(LinkLost):  # and it is finally given up
            link.transact(1, ASK, 0.02)
        link.close()


class Babble:
    """Serial port on a line that is never silent: another device transmits without a pause."""

    in_waiting = 1

    def __init__(self, clock):
        self.clock = clock
        self.written = []

    def read(self, _count):
        self.clock.skipped_s += 0.005
        return b"\x55"

    def write(self, data):
        self.written.append(data)


def test_a_line_that_is_never_quiet_does_not_hold_a_request_back():
    with Line("rtu", lambda request: b"") as line:
        port, line.link._port = line.link._port, Babble(line.clock)
        begun_s = line.clock.now_s()
        for count in (1, 2):
            with pytest.raises(BadReply):
                line.ask(SHORT_S)
            assert len(line.link._port.written) == count
        assert line.clock.now_s() - begun_s < 2.0
        line.link._port = port
