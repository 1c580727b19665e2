"""CanopenDrive on the bus of a scripted drive: through its preflight, enabled, turning."""

from dataclasses import replace

from drivers.canopen.drive import CanopenDrive
from drivers.clock import SteppedClock
from drivers.drive import Command, Mode
from tests.rigs import DRIVE_LIMITS

LIMITS = replace(DRIVE_LIMITS, torque_nm=300.0, watchdog_s=0.4)
TURN = Command(Mode.SPEED, 1.0, 0.0)


def prepared(wire, profile, limits=LIMITS, clock=None, **options):
    """Return a drive after a preflight without a refusal. Without a clock it is stepped."""
    drive = CanopenDrive(wire, profile, clock or SteppedClock(), node=1, **options)
    drive.connect()
    assert drive.preflight(limits).refused == ()
    return drive


def enabled(wire, profile, *arguments, **options):
    drive = prepared(wire, profile, *arguments, **options)
    drive.enable(Mode.SPEED)
    return drive


def cycles(drive, wire, count=20, command=TURN):
    """Run cycles with the heartbeat of the drive in each, and return the last sample."""
    for _ in range(count):
        wire.put(0x701, b"\x05")
        sample = drive.exchange(command)
    return sample
