"""A drive in fault at start: `--reset-fault`, which preflight advises, works with every shipped profile."""

import pytest

from drivers.clock import SteppedClock
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from tests.drivers.modbus_turning import MODBUS
from tests.rigs import DRIVE_LIMITS, QUIET_RIG


def connected(profile):
    """Return a drive in fault, and a connected host."""
    simulated = EmbeddedModbusDrive(QUIET_RIG, profile)
    simulated.machine.trip()
    drive = ModbusDrive(
        EmbeddedLink(simulated.serve, SteppedClock()), profile, unit=1, given=dict(simulated.untold),
        rated_torque_nm=None if profile.rated_torque else simulated.rated_torque_nm,
    )
    drive.connect()
    return simulated, drive


def state_of(drive):
    return next(check for check in drive.preflight(DRIVE_LIMITS).checks if check.name == "state")


@pytest.mark.parametrize("profile", MODBUS, ids=lambda one: one.name)
def test_the_advised_reset_works(profile):
    simulated, drive = connected(profile)
    refused = state_of(drive)
    assert "fault" in refused.found and "--reset-fault" in refused.next_step
    assert simulated.machine.words.faulted, "preflight must not reset a fault"
    drive.reset_fault()
    assert not simulated.machine.words.faulted
    assert "fault" not in state_of(drive).found
