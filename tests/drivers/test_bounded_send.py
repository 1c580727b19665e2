"""Adapter that accepts no frames: `send` of python-can must end, and no more frames are sent."""

import os
import socket
import threading
from contextlib import contextmanager, suppress

import can
import pytest
from can.interfaces.socketcand import SocketCanDaemonBus

from drivers.canopen.bounded_send import SEND_S, bound_send
from drivers.canopen.bus import CanLink
from drivers.clock import MonotonicClock
from drivers.errors import CommunicationLost

pty = pytest.importorskip("pty", reason="a serial line of two ends")
HANGS_S = 10.0
"""Time after which the other end closes, s. A send without a limit then fails in another way."""
MOST_FRAMES = 100_000


@contextmanager
def closing_in_the_end(close):
    timer = threading.Timer(HANGS_S, close)
    timer.start()
    yield
    timer.cancel()


@pytest.fixture
def slcan():
    """slcan adapter that reads nothing: the other end of its serial line."""
    adapter, line = pty.openpty()
    bus = can.Bus(interface="slcan", channel=os.ttyname(line), sleep_after_open=0.0)
    end = os.fdopen(adapter, "rb")
    with closing_in_the_end(end.close):
        yield bus
    end.close()                        # a write to it then ends at once
    with suppress(can.CanError):
        bus.shutdown()
    bus.serialPortOrig.close()
    os.close(line)


def fill(link):
    """Send until the adapter accepts no more frames. Return the error."""
    for _ in range(MOST_FRAMES):
        try:
            link.send(0x201, bytes(8))
        except CommunicationLost as error:
            return error
    raise AssertionError("the adapter takes everything")


def causes(error):
    while error is not None:
        yield type(error).__name__
        error = error.__cause__


def test_a_serial_adapter_that_reads_nothing_ends_the_send(slcan):
    error = fill(CanLink(slcan, MonotonicClock()))
    assert "SerialTimeoutException" in causes(error)
    assert "did not accept a frame" in error.what and "watchdog stops the shaft" in error.next_step


def test_nothing_more_is_sent_behind_a_part_of_a_frame(slcan):
    link = CanLink(slcan, MonotonicClock())
    fill(link)
    sent = []
    slcan.send = lambda *args, **options: sent.append(args)
    with pytest.raises(CommunicationLost, match="the adapter did not take a frame"):
        link.send(0x201, bytes(8))
    assert not sent


class Port:
    """Serial port whose adapter reads nothing from the buffer."""

    out_waiting = 27
    write_timeout = None

    def flush(self):
        raise AssertionError("waits without an end")


@pytest.mark.parametrize("name", ["serialPortOrig", "ser", "_ser"])
def test_a_flush_has_an_end(name):
    port = Port()
    bus = type("Bus", (), {name: port})()
    assert bound_send(bus) == {"timeout": SEND_S}
    assert port.write_timeout == SEND_S
    with pytest.raises(TimeoutError, match="27 bytes were not sent"):
        port.flush()
    port.out_waiting = 0
    port.flush()


def test_a_socketcand_server_that_reads_nothing_ends_the_send():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        host, number = server.getsockname()
        answers = iter((b"< hi >", b"< ok >", b"< ok >"))

        class Greeted(SocketCanDaemonBus):
            def _expect_msg(self, msg):
                assert next(answers).decode() == msg

        bus = Greeted("can0", host, number)
        other, _ = server.accept()
        with closing_in_the_end(other.close):
            link = CanLink(bus, MonotonicClock())
            error = fill(link)
        assert "TimeoutError" in causes(error) and "did not accept a frame" in error.what
        with pytest.raises(CommunicationLost) as nothing:      # a part of a frame may be on its way
            link.send(0x201, bytes(8))
        assert nothing.value.__cause__ is None
        bus.shutdown()
        other.close()


def test_an_interface_that_does_not_block_is_left_as_it_is():
    with can.Bus(interface="virtual", channel="left as it is") as bus:
        assert bound_send(bus) == {}
