"""A host that is frozen, seen from outside: candump shows that nothing of it goes on, and what comes when it wakes.

What would go on behind a frozen process is what the kernel sends for it (python-can's send_periodic on SocketCAN) or
another process of its own. Real time, slow cycles and a long watchdog, for a loaded machine: what is asserted is order
and content; wall times stand in bounds that only a lost frame or a wrong clock would break.
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
"""How far the log's time of a sent frame may lie from the kernel's stamp of it, all but one in twenty: one cycle."""


def lost(drive):
    return drive.shaft.events("host heartbeat lost")


def test_a_frozen_host_is_silent_and_wakes_with_nothing_stale(tmp_path, vcan, tool):
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
    assert {frame.identifier for frame in frozen} <= DRIVES      # no heartbeat, no SYNC, no RPDO, no SDO of the host's
    assert frozen                                                # candump saw the drive all the while
    (lost_s,) = shaft.events("host heartbeat lost")
    assert shaft.at_rest_from() - lost_s <= shaft.speed_at(lost_s) / QUICK_STOP_RAD_S2 + SETTLING_S

    awake = [frame for frame in seen if frame.stamp_s > woken_s]
    assert {frame.identifier for frame in awake} & HOSTS         # it did wake
    # It may have been frozen with a setpoint in hand, past its last look at the clock. None acts without a SYNC.
    setpoint = None
    for frame in seen:
        setpoint = frame if frame.identifier == RPDO1 else setpoint
        if frame.identifier == SYNC and frame.stamp_s > woken_s:
            assert not enables(setpoint), [(one.stamp_s - woken_s, one.line) for one in awake[:20]]
    assert done.code == 5, done.err
    assert done.document["error"]["kind"] == "CommunicationLost"
    assert "Traceback" not in done.err
    assert tdhil("replay", done.log).code in (3, 9)

    # Control time on the log's frames against the kernel's wall clock on the same ones, but for the constant between.
    logged = [frame for frame in read_frames(done.log) if frame.outgoing]
    sent = [frame for frame in seen if frame.identifier in HOSTS]
    assert [(frame.identifier, frame.data) for frame in logged] == [(frame.identifier, frame.data) for frame in sent]
    offsets = [frame.stamp_s - line.time_s for frame, line in zip(sent, logged, strict=True)]
    middle_s = statistics.median(offsets)
    off = sorted(abs(offset - middle_s) for offset in offsets)
    assert off[int(0.95 * len(off))] <= STAMP_S
