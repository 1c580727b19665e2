"""Simulated drive that sends an object without an end: reported before motion, and without effect in motion."""

import pytest

from drivers.errors import CommunicationLost, PreflightRefused
from sim_bus.objects import key_of
from tests.drivers.drive_benches import Run


class EndlessUploads:
    """Bus that turns each reply to an upload into endless segments of one byte."""

    def __init__(self, bus):
        self.segments = self.aborts = 0
        self._send, bus.change = bus._bus.send, self._changed
        bus._bus.send = self._heard
        self._bus = bus

    def _heard(self, message):
        if message.arbitration_id != 0x601 or message.data[0] >> 5 not in (3, 4):
            return self._send(message)
        if message.data[0] >> 5 == 3:
            self.segments += 1
            self._bus.put(0x581, bytes((message.data[0] & 0x10 | 6 << 1,)) + b"x" + bytes(6))
        else:
            self.aborts += 1
        return None

    def _changed(self, message):
        if message.arbitration_id == 0x581 and message.data[0] >> 5 == 2:
            message.data[0], message.data[4:] = 0x40, bytes(4)
        return [message]


def test_a_name_of_70000_bytes_is_refused_before_motion(bench):
    bench.simulated.simulator.node.store.values[key_of(0x1008)] = "x" * 70_000
    with pytest.raises(CommunicationLost, match="1008h: node 1 announces 70000 bytes, and the limit is 1024"):
        Run(bench).ready()
    assert sum(frame.outgoing and frame.data[0] >> 5 == 3 for frame in bench.frames if frame.identifier == 0x601) == 0
    assert bench.true_speed_rad_s == 0.0
    bench.simulated.simulator.node.store.values[key_of(0x1008)] = "x" * 900
    Run(bench).ready()


def test_uploads_without_an_end_are_refused_before_motion(bench):
    endless = EndlessUploads(bench.bus)
    with pytest.raises(PreflightRefused, match="1000h: node 1 sends more than 8 bytes") as caught:
        Run(bench).ready()
    assert caught.value.entry is PreflightRefused.entry            # a drive is there
    assert endless.aborts >= 1 and endless.segments == 9 * endless.aborts


def test_the_stop_does_not_depend_on_them(bench):
    run = Run(bench)
    run.turning()
    assert bench.true_speed_rad_s > 1.0
    endless = EndlessUploads(bench.bus)
    run.go(2.0, speed=5.0)
    run.stop()
    assert abs(bench.true_speed_rad_s) < 1e-3 and endless.segments == 0
