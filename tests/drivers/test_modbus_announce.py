"""Stages are sent in one request, and only to a peer with the simulator's marker."""

import struct

import pytest

from drivers.clock import SteppedClock
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from profiles.library import load_modbus_profile
from profiles.simulator_marker import MARKER_REGISTER, MARKER_STAGE_REGISTER, STAGE_NUMBERS
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from sim_bus.params import RigParams


class Peer:
    """Embedded drive; ``becomes`` gets each write to the stage register. None is no reply."""

    def __init__(self, profile, *, becomes=lambda reply, complete_s: (reply, complete_s)):
        self.told = []
        simulated = EmbeddedModbusDrive(RigParams(), profile)

        def serve(unit, pdu, now_s):
            reply, complete_s = simulated.serve(unit, pdu, now_s)
            if pdu[0] in (6, 16) and pdu[1:3] == struct.pack(">H", MARKER_STAGE_REGISTER):
                self.told.append((pdu[0], int.from_bytes(pdu[-2:], "big")))
                return becomes(reply, complete_s)
            return reply, complete_s

        self.serve = serve
        self.clock = SteppedClock()
        self.drive = ModbusDrive(EmbeddedLink(self._asked, self.clock), profile, unit=1)

    def _asked(self, unit, pdu, now_s):
        return self.serve(unit, pdu, now_s)


@pytest.mark.parametrize(("name", "function"), [("generic/modbus", 6), ("yaskawa/ga700", 16)])
def test_each_stage_in_one_request(name, function):
    peer = Peer(load_modbus_profile(name))
    peer.drive.announce("setup")                    # before the peer is identified: sent afterwards
    assert peer.told == []
    peer.drive.connect()
    for stage in ("speed", "nothing such", "acquire"):
        peer.drive.announce(stage)
    assert peer.told == [(function, STAGE_NUMBERS[stage]) for stage in ("setup", "speed", "acquire")]


@pytest.mark.parametrize("becomes", [
    lambda _reply, complete_s: (None, complete_s), lambda _reply, complete_s: (b"\x86\x02", complete_s),
    lambda _reply, complete_s: (b"\x06", complete_s),
])
def test_a_failed_announcement_is_ignored(becomes):
    peer = Peer(load_modbus_profile("generic/modbus"), becomes=becomes)
    peer.drive.connect()
    began_s = peer.clock.now_s()
    peer.drive.announce("hold")
    assert peer.told == [(6, STAGE_NUMBERS["hold"])]
    assert peer.clock.now_s() - began_s < 0.06      # it does not delay the cycles of the run


def test_a_real_drive_receives_no_stages():
    peer = Peer(load_modbus_profile("generic/modbus"))
    simulated = peer.serve

    def without_marker(unit, pdu, now_s):
        if pdu[:3] == struct.pack(">BH", 3, MARKER_REGISTER):
            return b"\x83\x02", now_s + 0.001
        return simulated(unit, pdu, now_s)

    peer.serve = without_marker
    peer.clock.stepped = False                      # stepped time would refuse a drive without the marker
    assert not peer.drive.connect().simulated
    for stage in STAGE_NUMBERS:
        peer.drive.announce(stage)
    assert peer.told == []
