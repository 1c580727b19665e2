"""Gains of the speed loop in the simulated drive: a host can read but not change them. No driver is used."""

import struct

import pytest

from profiles import SpeedControllerParameters
from profiles.library import load_canopen_profile
from sim_bus.params import DriveParams, RigParams
from sim_bus.speed_controller import speed_loop_settings
from tests.sim_bus.modbus_host import GENERIC, GenericHost, drive

DRIVE = DriveParams(speed_gain_nm_s_rad=82.25, speed_integral_gain_nm_rad=41.125, speed_filter_s=0.01)
ENTRY = {"title": "the manual's", "source": "the manual", "confidence": "likely"}


@pytest.mark.parametrize("profile", [None, "generic/cia402"])
def test_as_objects(bench, profile):
    worn = None if profile is None else load_canopen_profile(profile)
    _, host = bench(params=RigParams(drive=DRIVE), profile=worn)
    seen = [struct.unpack("<f", host.read(0x5FFD, sub).to_bytes(4, "little"))[0] for sub in (1, 2, 3)]
    assert seen == [82.25, 41.125, pytest.approx(0.01)]
    assert host.refused(0x5FFD, 1, 0, 4) == 0x06010002                     # read only


def test_another_profile_does_not_have_these_objects(bench):
    _, host = bench(profile=load_canopen_profile("maxon/epos4"))
    assert host.refused(0x5FFD, 1, 0, 4) == 0x06020000


def test_as_registers():
    host = GenericHost(drive(GENERIC, RigParams(drive=DRIVE)))
    assert host.number(64, "I") == 8_225_000
    assert host.number(66, "I") == 2_000_000
    assert host.number(68, "H") == 100
    assert host.refused(struct.pack(">BHH", 6, 68, 7)) == 2                # read only


@pytest.mark.parametrize(("units", "shown"), [
    (("nm_s_rad", "nm_rad", "s"), (82.25, 41.125, 0.01)),
    (("nm_s_rad", "ms", "ms"), (82.25, 2000.0, 10.0)),
    # 82.25 N·m for 1 rad/s, of 1000 N·m and of 10 rad/s: 8.225 % for 10 %.
    (("percent_per_percent", "s", "hz"), (0.8225, 2.0, 15.91549)),
])
def test_units(units, shown):
    said = {part: {"unit": unit, "parameter": part, **ENTRY}
            for part, unit in zip(("gain", "integral", "filter"), units, strict=True)}
    found = speed_loop_settings(SpeedControllerParameters.model_validate(said), DRIVE, 95.4929659)
    assert found == pytest.approx(dict(zip(said, shown, strict=True)))


def test_no_integral_part_is_an_integral_time_of_zero():
    params = RigParams(drive=DRIVE.model_copy(update={"speed_integral_gain_nm_rad": 0.0}))
    assert GenericHost(drive(GENERIC, params)).number(66, "I") == 0
