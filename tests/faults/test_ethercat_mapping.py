"""Frames that are lost while pysoem maps the process data, over a pair of veth interfaces.

The simulated drive returns no frame for `LOST_S` after SOEM has requested one object. SOEM waits 0.7 s for an answer,
and then continues with a length of zero for this object.
"""

import itertools
import multiprocessing
import os
import threading
from contextlib import closing, contextmanager

import pytest

from drivers.clock import SteppedClock
from drivers.drive import Command, Mode
from drivers.errors import CommunicationLost, PreflightRefused
from drivers.ethercat import EthercatDrive, open_segment
from drivers.ethercat.segment import MAP_TRIES, EthercatSegment
from profiles import MessageCode, load_profile
from sim_bus.ethercat import Simulator, raw_socket
from tests.drivers.drive_benches import LIMITS
from tests.path.ethercat_segment import pair, segment
from tests.path.path_runs import HANGS_S

_segment = pytest.fixture(scope="module", autouse=True)(segment)
pytestmark = pytest.mark.heavy

LOST_S = 0.9
FPWR, UPLOAD, DATA = 5, 0x40, 26
"""Command of a datagram, command of an SDO request, and place of the data of a frame's first datagram."""
OUTPUTS, INPUTS = 9, 15
"""Bytes of the process data: setpoints; feedback with torque demand and position."""


class LossySimulator(Simulator):
    """A simulated drive whose frames are lost after SOEM's request for an object, ``times`` at most."""

    def __init__(self, place, times):
        super().__init__(stepped=True)
        self.place, self.times, self.until_s = place, times, 0.0

    def answer(self, frame, now_s):
        sdo = frame[DATA + 8 : DATA + 12]
        # tdhil's own requests have a counter of 0 in the header of the mailbox.
        asked = frame[16] == FPWR and len(sdo) == 4 and sdo[0] == UPLOAD and frame[DATA + 5] >> 4
        if asked and (sdo[2] << 8 | sdo[1], sdo[3]) == self.place and self.times and now_s > self.until_s:
            self.times, self.until_s = self.times - 1, now_s + LOST_S
        answered = super().answer(frame, now_s)
        return b"" if now_s < self.until_s else answered


def serve(end, place, times, host):
    """Simulate until the host says so, in a process of its own."""
    stop = threading.Event()
    with raw_socket(end) as line:
        host.send("")
        threading.Thread(target=lambda: (host.recv(), stop.set()), daemon=True).start()
        LossySimulator(place, times).run(line, stop)
    os._exit(0)                        # the thread may still wait for the host


@contextmanager
def drive_on(place, times=1):
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    with pair() as ends:
        process = context.Process(target=serve, args=(ends[1], place, times, theirs), daemon=True)
        process.start()
        try:
            assert ours.poll(HANGS_S)
            ours.recv()
            with closing(open_segment(ends[0])) as segment:
                drive = EthercatDrive(segment, load_profile("generic/cia402-ethercat"), SteppedClock(), rate_hz=50)
                yield drive, segment
                drive.close()
        finally:
            ours.send("end")
            process.join(HANGS_S)


@pytest.fixture
def mappings(monkeypatch):
    """Return what each mapping of SOEM got wrong."""
    found, wrong_map = [], EthercatSegment._wrong_map

    def seen(self, outputs, inputs):
        found.append(wrong_map(self, outputs, inputs))
        return found[-1]

    monkeypatch.setattr(EthercatSegment, "_wrong_map", seen)
    return found


@pytest.mark.parametrize("place", [(0x1C00, 0), (0x1C12, 0), (0x1600, 1), (0x1A00, 3)])
def test_a_mapping_with_lost_frames_is_repeated(place, mappings):
    """All values are in their places: the position follows the speed, and nothing jumps."""
    with drive_on(place) as (drive, segment):
        drive.connect()
        assert drive.preflight(LIMITS).refused == ()
        assert [bool(one) for one in mappings] == [True, False]
        assert f"where {OUTPUTS} and {INPUTS} are assigned" in mappings[0]
        assert (len(segment.slave.output), len(segment.slave.input)) == (OUTPUTS, INPUTS)
        drive.enable(Mode.SPEED)
        samples = [drive.exchange(Command(Mode.SPEED, float(number > 50), 0.0)) for number in range(250)]
        drive.quick_stop()
        for _ in range(100):
            drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    assert all(one.fresh for one in samples[1:])
    assert samples[-1].speed_rad_s == pytest.approx(1.0, abs=0.1)
    for one, two in itertools.pairwise(samples):
        travel_rad = 0.5 * (one.speed_rad_s + two.speed_rad_s) * (two.time_s - one.time_s)
        assert two.position_rad - one.position_rad == pytest.approx(travel_rad, abs=0.02)
        assert abs(two.speed_rad_s - one.speed_rad_s) < 0.1


def test_a_mapping_that_is_never_read_is_refused_with_the_reason(mappings):
    with drive_on((0x1A00, 3), times=MAP_TRIES) as (drive, _):
        drive.connect()
        # Each attempt may read other lengths: they depend on the moment at which frames return.
        with pytest.raises((PreflightRefused, CommunicationLost), match="can't be mapped, in 5 attempts") as caught:
            drive.preflight(LIMITS)
        assert caught.value.entry in (MessageCode.PDO_NOT_POSSIBLE, MessageCode.COMMUNICATION_LOST)
        assert "Check the cable" in caught.value.next_step
        assert len(mappings) == MAP_TRIES
