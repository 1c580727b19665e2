"""Frozen host, recorded by candump: it sends no frames while frozen, and no stale setpoint afterwards.

Cyclic transmission of the kernel (python-can's send_periodic on SocketCAN) or of another process would continue for a
frozen process. The tests use real time with slow cycles and a long watchdog, for a loaded computer. They check order
and content, and wall times with bounds that only a lost frame or a wrong clock would exceed.
"""

from __future__ import annotations

import signal
import statistics
import time

import pytest

from tdhil.recording.log_reader import read_frames
from tests.path.path_runs import QUICK_STOP_RAD_S2, SETTLING_S, host, tdhil, wait_for
from tests.rigs import PATIENT_LIMITS, rig_file
from tests.vcan.candump_log import DRIVES, HOST_BEAT, HOSTS, RPDO1, SYNC, enables, watching
from tests.vcan.vcan_runs import TURNING_RAD_S, assert_safe, simulated

pytestmark = pytest.mark.usefixtures("no_bus_of_the_user")
RATE_HZ = 4.0
STAMP_S = 1.0 / RATE_HZ
"""Tolerance between the log's time of a sent frame and the kernel's time stamp, for 95 % of the frames: one cycle."""


def lost(drive):
    return drive.shaft.events("host heartbeat lost")


def test_a_frozen_host_is_silent_and_sends_no_stale_setpoint_afterwards(tmp_path, vcan, tool):
    rig = rig_file(tmp_path, f"rate_hz: {RATE_HZ}\n", PATIENT_LIMITS)
    on = ("-i", "socketcan", "-c", vcan)
    with watching(tool("candump"), tmp_path / "candump.log", vcan) as candump:
        with simulated(tmp_path, vcan, stepped=False) as drive, host(tmp_path, *on, "--rig", rig) as running:
            moves = wait_for("motion", lambda: drive.simulator.speed_rad_s > TURNING_RAD_S, running.child)
            assert moves, running.err
            running.signal(signal.SIGSTOP)
            time.sleep(0.1)                    # its last frame is then on the bus
            frozen_s = time.time()
            wait_for("the end of the stop", lambda: lost(drive) and drive.rests())
            woken_s = time.time()
            running.signal(signal.SIGCONT)
            done = running.finish()
            shaft = assert_safe(drive)
        seen = candump.frames

    before = {frame.identifier for frame in seen if frame.stamp_s < frozen_s}
    assert {SYNC, RPDO1, HOST_BEAT} <= before
    frozen = [frame for frame in seen if frozen_s < frame.stamp_s < woken_s]
    assert {frame.identifier for frame in frozen} <= DRIVES      # no heartbeat, SYNC, RPDO or SDO of the host
    assert frozen                                                # candump recorded the drive all the time
    (lost_s,) = shaft.events("host heartbeat lost")
    assert shaft.at_rest_from() - lost_s <= shaft.speed_at(lost_s) / QUICK_STOP_RAD_S2 + SETTLING_S

    awake = [frame for frame in seen if frame.stamp_s > woken_s]
    assert {frame.identifier for frame in awake} & HOSTS         # it continued
    # It may have been frozen with a prepared setpoint, after its last check of the clock. None acts without a SYNC.
    setpoint = None
    for frame in seen:
        setpoint = frame if frame.identifier == RPDO1 else setpoint
        if frame.identifier == SYNC and frame.stamp_s > woken_s:
            assert not enables(setpoint), [(one.stamp_s - woken_s, one.line) for one in awake[:20]]
    assert done.code == 5, done.err
    assert done.document["error"]["kind"] == "CommunicationLost"
    assert "Traceback" not in done.err
    assert tdhil("replay", done.log).code in (3, 9)

    # Control time of the frames in the log and wall clock of the kernel agree, except for a constant.
    logged = [frame for frame in read_frames(done.log) if frame.outgoing]
    sent = [frame for frame in seen if frame.identifier in HOSTS]
    assert [(frame.identifier, frame.data) for frame in logged] == [(frame.identifier, frame.data) for frame in sent]
    offsets = [frame.stamp_s - line.time_s for frame, line in zip(sent, logged, strict=True)]
    middle_s = statistics.median(offsets)
    off = sorted(abs(offset - middle_s) for offset in offsets)
    assert off[int(0.95 * len(off))] <= STAMP_S
