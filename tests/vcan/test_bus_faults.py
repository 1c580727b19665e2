"""Faults of the bus, made with can-utils and ip: another master, a replay, lost frames, a lost interface.

The tests use stepped time. With each fault, the true shaft must come to standstill in the simulator's trace. The host
must end with an exit code of faults.md and without a traceback, and the log must replay. vcan has no bit errors, so
error-passive and bus-off are not possible on it.
"""

from __future__ import annotations

import math
import subprocess
import time
from contextlib import contextmanager

import pytest

from tests.path.path_runs import tdhil
from tests.vcan.candump_log import HOSTS, SYNC, TPDO1, enables, watching
from tests.vcan.vcan_runs import assert_safe, run, run_into, simulated

pytestmark = pytest.mark.usefixtures("no_bus_of_the_user")


def assert_told(done, by_itself, *codes) -> None:
    assert by_itself, f"the host did not notice: {done.err}"
    assert done.code in codes, (done.code, done.err)
    assert "Traceback" not in done.err
    assert tdhil("replay", done.log).code in (3, 9)


# -- a foreign master (cansend) --------------------------------------------------------------------------------


def test_a_foreign_nmt_stop(tmp_path, vcan, tool):
    """After NMT stop the drive receives no setpoint and no quick stop. Its own watchdog brakes."""
    with simulated(tmp_path, vcan) as drive:
        done, by_itself = run_into(lambda: run(tool("cansend"), vcan, "000#0201"), tmp_path, drive, vcan)
        assert_safe(drive)
    assert_told(done, by_itself, 5)
    assert "NMT state stopped" in done.err
    assert "at standstill" in done.document["stop"] or "hard-wired emergency stop" in done.document["stop"]


def test_a_second_station_under_the_drive_s_id(tmp_path, vcan, tool):
    with simulated(tmp_path, vcan) as drive:
        done, by_itself = run_into(lambda: run(tool("cansend"), vcan, "701#7F"), tmp_path, drive, vcan)
        assert_safe(drive)
    assert_told(done, by_itself, 5)
    assert "second master" in done.err
    assert "the shaft is at standstill" in done.document["stop"]


def test_a_second_master_sends_setpoints_and_syncs(tmp_path, vcan, tool):
    """It sends 9 rad/s with an enable word, and its own SYNCs: a few of them within a second of plant time."""
    velocity = round(9.0 / (0.1 * math.pi / 30.0))
    word = b"\x0f\x00" + b"\x00\x00" + velocity.to_bytes(4, "little")
    many = ("-g", "0", "-n", "10")

    def meddle():
        run(tool("cangen"), vcan, *many, "-I", "201", "-L", "8", "-D", word.hex())
        run(tool("cangen"), vcan, *many, "-I", "080", "-L", "0")

    with simulated(tmp_path, vcan) as drive:
        done, by_itself = run_into(meddle, tmp_path, drive, vcan)
        assert_safe(drive)
    assert_told(done, by_itself, 5, 6, 7)


# -- replay (canplayer) ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("times", [1, 20])
def test_old_feedback_is_replayed(tmp_path, vcan, tool, times):
    """The feedback of the drive is recorded in motion and replayed at once during the run."""
    with watching(tool("candump"), tmp_path / "candump.log", vcan) as candump, simulated(tmp_path, vcan) as drive:

        def replay():
            recorded = [frame.line for frame in candump.frames if frame.identifier == TPDO1][-100:]
            record = tmp_path / "recorded.log"
            record.write_text("\n".join(recorded) + "\n")
            run(tool("canplayer"), "-t", "-l", times, "-I", record, f"{vcan}={vcan}")

        done, by_itself = run_into(replay, tmp_path, drive, vcan)
        assert_safe(drive)
    assert_told(done, by_itself, 5, 6, 7)


# -- frames that don't arrive (cangw) --------------------------------------------------------------------------


@contextmanager
def bridged(ip, cangw, vcan):
    """Connect a second interface for the drive by the kernel's gateway; yield its name and `only`."""
    other = "vcan9"
    run(ip, "link", "add", other, "type", "vcan")
    run(ip, "link", "set", other, "up", "txqueuelen", "1000")

    def only(there=(), back=()):
        """Replace both directions, with options of cangw; None: no frame passes in this direction."""
        run(cangw, "-F")
        for way, options in (((vcan, other), there), ((other, vcan), back)):
            if options is not None:
                run(cangw, "-A", "-s", way[0], "-d", way[1], "-e", *options)

    try:
        only()
        yield other, only
    finally:
        subprocess.run([cangw, "-F"], check=False)
        run(ip, "link", "del", other)


def but(identifier: int) -> tuple[str, str]:
    """Return options that pass every frame except for those with this identifier."""
    return "-f", f"{identifier:03X}~7FF"


@pytest.mark.parametrize(("lost", "there", "back", "codes"), [
    ("all", None, None, (8,)),
    ("the host's heartbeat", but(0x77F), (), (5, 6, 8)),
    ("feedback", (), but(0x181), (5,)),
    ("the drive's heartbeat", (), but(0x701), (5,)),
], ids=lambda value: value if isinstance(value, str) else "")
def test_frames_are_lost_on_the_way(tmp_path, vcan, tool, ip, lost, there, back, codes):
    with bridged(ip, tool("cangw"), vcan) as (other, only), simulated(tmp_path, other) as drive:
        done, by_itself = run_into(lambda: only(there, back), tmp_path, drive, vcan)
        shaft = assert_safe(drive)
    assert_told(done, by_itself, *codes)
    if lost in ("all", "the host's heartbeat"):
        assert shaft.events("host heartbeat lost")
        # Enabled until the next host, or disabled by this host after standstill.
        assert shaft.state[-1] in ("quick stop active", "switch on disabled")


def test_only_setpoints_are_lost(tmp_path, vcan, tool, ip):
    """The drive keeps its last setpoint and receives no quick stop in this frame. An SDO or its watchdog ends it."""
    with bridged(ip, tool("cangw"), vcan) as (other, only), simulated(tmp_path, other) as drive:
        done, _ = run_into(lambda: only(but(0x201), ()), tmp_path, drive, vcan)
        shaft = assert_safe(drive)
    assert done.code in (5, 7, 8, 130), done.err
    if done.code == 8:
        assert "hard-wired emergency stop" in done.err
        assert shaft.events("host heartbeat lost")
    else:
        assert "the shaft is at standstill" in done.document["stop"]
    assert shaft.state[-1] in ("quick stop active", "switch on disabled")


# -- the interface is lost (ip link) -------------------------------------------------------------------------------


def test_the_interface_goes_down_and_up(tmp_path, vcan, tool, ip):
    """The host ends with 8, as with an unplugged adapter. After the return of the bus it sends no more frames."""
    with simulated(tmp_path, vcan) as drive:
        try:
            done, by_itself = run_into(lambda: run(ip, "link", "set", vcan, "down"), tmp_path, drive, vcan)
            assert_safe(drive)
        finally:
            run(ip, "link", "set", vcan, "up")
        with watching(tool("candump"), tmp_path / "after.log", vcan) as candump:
            time.sleep(0.5)
        assert not {frame.identifier for frame in candump.frames} & HOSTS
    assert_told(done, by_itself, 8)


def test_the_interface_is_up_again_before_the_host_has_noticed(tmp_path, vcan, tool, ip):
    """The interface is down briefly. No enabling setpoint may follow; a new run is needed."""
    back_s = []

    def blink():
        run(ip, "link", "set", vcan, "down")
        time.sleep(0.2)
        back_s.append(time.time())
        run(ip, "link", "set", vcan, "up")

    with watching(tool("candump"), tmp_path / "candump.log", vcan) as candump, simulated(tmp_path, vcan) as drive:
        done, by_itself = run_into(blink, tmp_path, drive, vcan)
        assert_safe(drive)
    before = [frame for frame in candump.frames if frame.stamp_s <= back_s[0]]
    after = [frame for frame in candump.frames if frame.stamp_s > back_s[0]]
    assert any(enables(frame) for frame in before)
    assert any(frame.identifier == SYNC for frame in before)
    assert not any(enables(frame) for frame in after)
    assert_told(done, by_itself, 8)
