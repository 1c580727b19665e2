"""Driver and simulator with separate conversions: each error in their agreement is found before motion.

In one case the drive is wrong and the profile right. In the other, the simulated drive uses the shipped profile
and the driver reads a profile with an error.
"""

import pytest

from drivers.drive import DriveLimits
from drivers.errors import PreflightRefused
from profiles.library import load_modbus_profile, load_profile, profile_names
from profiles.modbus import ModbusProfile
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from sim_bus.modbus.wrong_maps import parse
from sim_bus.params import RigParams
from tests.drivers.modbus_bench import driven

LIMITS = DriveLimits(
    speed_rad_s=15.0, torque_nm=300.0, quick_stop_rad_s2=1.0, watchdog_s=0.5,
    accept_wider=frozenset({"torque", "speed", "quick-stop"}),         # or a tighter register is left unchanged
)
PROFILE = load_modbus_profile("generic/modbus")
READ_BACK = [f"reads_back_something_else:{name}" for name in (
    "rated_torque", "rated_power", "rated_speed", "speed_limit", "speed_limit_reverse", "torque_limit",
    "quick_stop_deceleration", "time_out", "time_out_reaction", "check_pattern", "check_sign",
)]


SHOWN = [(name, echo.setpoint) for name in profile_names()
         if isinstance(profile := load_profile(name), ModbusProfile) for echo in profile.echoes]


def refused(*wrongs, worn=PROFILE, read=PROFILE):
    simulated = EmbeddedModbusDrive(RigParams(), worn, wrongs=tuple(map(parse, wrongs)))
    drive = driven(simulated, read)
    try:
        drive.connect()
        found = drive.preflight(LIMITS)
        assert all(check.next_step and check.where for check in found.refused)
        return found.refused
    except PreflightRefused as error:
        return (error,)
    finally:
        assert abs(simulated.speed_rad_s) < 0.01
        simulated.close()


def test_no_refusal_without_an_error():
    assert refused() == ()


@pytest.mark.parametrize("wrong", [
    "word_order", "scale_10", "address_off_by_one", "sign", "unsigned", "write_not_applied", *READ_BACK,
])
def test_each_wrong_is_refused(wrong):
    assert refused(wrong)


def mistaken(profile, setpoint, change):
    """Return the profile with one changed number of one setpoint."""
    signal = getattr(profile.cycle, f"{setpoint}_setpoint").model_copy(update=change)
    cycle = profile.cycle.model_copy(update={f"{setpoint}_setpoint": signal})
    return profile.model_copy(update={"cycle": cycle})


@pytest.mark.heavy(but_first=16)
@pytest.mark.parametrize("factor", [0.1, 0.5, 2.0, 10.0])
@pytest.mark.parametrize(("name", "setpoint"), SHOWN)
def test_a_profile_with_a_wrong_count_of_a_setpoint(name, setpoint, factor):
    profile = load_modbus_profile(name)
    entry = getattr(profile.cycle, f"{setpoint}_setpoint")
    wrong = mistaken(profile, setpoint, {"per_lsb": factor * entry.per_lsb})
    names = {check.name for check in refused(worn=profile, read=wrong)}
    assert f"{setpoint} setpoint as received by the drive" in names


@pytest.mark.parametrize("name", sorted({name for name, _ in SHOWN}))
def test_a_profile_that_mixes_up_what_an_echo_shows(name):
    """The error may also be in the echo: setpoint and echo have to agree."""
    profile = load_modbus_profile(name)
    echoes = tuple(echo.model_copy(update={"per_lsb": 10.0 * echo.per_lsb}) for echo in profile.echoes)
    names = [check.name for check in refused(worn=profile, read=profile.model_copy(update={"echoes": echoes}))]
    assert names == [f"{echo.setpoint} setpoint as received by the drive" for echo in echoes]
    assert refused(worn=profile, read=profile) == ()


@pytest.mark.parametrize(("speed_rad_s", "coarse"), [(4.0, True), (6.0, False)])
def test_an_echo_too_coarse_for_the_limits_is_reported(speed_rad_s, coarse):
    """0.1 % of 10000 rpm is 1.05 rad/s. 1.5 counts are compared with half of three quarters of the limit."""
    profile = load_modbus_profile("danfoss/fc302")
    simulated = EmbeddedModbusDrive(RigParams(), profile)
    simulated.machine.parameters.put("maximum_reference", 10_000.0)
    drive = driven(simulated, profile)
    drive.connect()
    limits = DriveLimits(speed_rad_s=speed_rad_s, torque_nm=300.0, quick_stop_rad_s2=1.0, watchdog_s=0.5)
    notes = [check.name for check in drive.preflight(limits).checks if "too coarse" in check.found]
    assert notes == ["speed setpoint as received by the drive, resolution"] * coarse
