"""Driver and simulator, each with its own arithmetic: whatever is wired wrong is caught before the shaft could move."""

import pytest

from drivers.clock import SteppedClock
from drivers.drive import Limits
from drivers.errors import PreflightRefused
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.embedded import EmbeddedLink
from profiles.library import load_modbus_profile
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from sim_bus.modbus.wrongs import parse
from sim_bus.params import RigParams

LIMITS = Limits(speed_rad_s=15.0, torque_nm=300.0, quick_stop_rad_s2=1.0, watchdog_s=0.5)
PROFILE = load_modbus_profile("generic/modbus")
READ_BACK = [f"reads_back_something_else:{name}" for name in (
    "rated_torque", "rated_power", "rated_speed", "speed_limit", "speed_limit_reverse", "torque_limit",
    "quick_stop_deceleration", "time_out", "time_out_reaction", "check_pattern", "check_sign",
)]


def refused(*wrongs):
    simulated = EmbeddedModbusDrive(RigParams(), PROFILE, wrongs=tuple(map(parse, wrongs)))
    clock = SteppedClock()
    drive = ModbusDrive(EmbeddedLink(simulated.serve, clock), PROFILE, unit=1)
    try:
        drive.connect()
        return drive.preflight(LIMITS).refused
    except PreflightRefused as error:
        return (error,)
    finally:
        assert abs(simulated.speed_rad_s) < 0.01
        simulated.close()


def test_none_where_nothing_is_wrong():
    assert refused() == ()


@pytest.mark.parametrize("wrong", [
    "word_order", "scale_10", "address_off_by_one", "sign", "unsigned", "write_not_applied", *READ_BACK,
])
def test_each_wrong_is_refused(wrong):
    assert refused(wrong)
