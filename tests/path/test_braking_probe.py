"""Drive that reads a negative torque setpoint as a large one, on the whole path: found at low speed, in stage 3.

Here the drive reads setpoints correctly until it regulates torque. Preflight at standstill cannot find the error, so
the braking probe is the first check that can.
"""

import numpy as np
import pytest

from profiles.library import load_profile, profile_names
from profiles.modbus import ModbusProfile
from sim_bus.application_objects import ApplicationObjects
from sim_bus.inverter import Controller
from sim_bus.modbus.registers import Map
from tests.path.path_runs import Shaft, identify
from tests.rigs import rig_file

PROFILES = {name: load_profile(name) for name in profile_names()}
VENDORS = [name for name, one in PROFILES.items() if isinstance(one, ModbusProfile) and one.modes.torque]

HALFWAY_RAD_S = 7.5
"""Bound of the speed of stage 2 in speed mode, which is up to 7.2 rad/s; the limit is 10 rad/s."""

LOW_RAD_S = 5.0
"""Bound of the speed in torque mode, where the probe is at 2.9 rad/s."""


def assert_found(done, shaft, where):
    assert done.code == 4, done.err
    message = done.document["error"]["message"]
    assert f"braking probe, {where}" in message
    assert "inverts a negative torque setpoint" in message
    assert "Correct the profile or the drive's settings" in message
    assert "Traceback" not in done.err
    assert done.outcomes[-1] == ("torque", "aborted")
    assert np.max(shaft.speed_rad_s) < HALFWAY_RAD_S
    stage_3 = int(np.argmax(shaft.speed_rad_s)) + np.searchsorted(
        -shaft.speed_rad_s[int(np.argmax(shaft.speed_rad_s)) :], -3.2)      # slowed down to the speed of the probe
    assert np.max(shaft.speed_rad_s[stage_3:]) < LOW_RAD_S
    shaft.assert_at_rest()


def run(tmp_path, *arguments):
    trace = tmp_path / "shaft.csv"
    done = identify(tmp_path, "--simulate", "--seed", 1, "--trace", trace, *arguments)
    return done, Shaft.read(trace)


@pytest.fixture
def regulates_torque(monkeypatch):
    """Return whether the drive regulated a forward torque in motion in stage 3."""
    speeds = {"fast": False}
    plain = Controller.torque

    def torque(self, *arguments):
        speeds["fast"] = speeds["fast"] or self.filtered_rad_s > 2.0
        plain(self, *arguments)

    monkeypatch.setattr(Controller, "torque", torque)
    return lambda: speeds["fast"]


@pytest.mark.long(but_first=3)
@pytest.mark.heavy
@pytest.mark.parametrize("name", VENDORS)
def test_over_modbus(name, regulates_torque, monkeypatch, tmp_path):
    register = PROFILES[name].cycle.torque_setpoint.register_
    modulus = 1 << int(register.type[1:])
    plain = Map._set_torque

    def unsigned(self, counts):
        plain(self, counts % modulus if regulates_torque() else counts)

    monkeypatch.setattr(Map, "_set_torque", unsigned)
    done, shaft = run(tmp_path, "--profile", name)
    assert_found(done, shaft, f"register {register.address}")


@pytest.mark.heavy
def test_over_canopen(regulates_torque, monkeypatch, tmp_path):
    plain = ApplicationObjects._set_target_torque

    def unsigned(self, counts):
        plain(self, counts % 0x10000)

    monkeypatch.setattr(ApplicationObjects, "_set_target_torque", unsigned)
    done, shaft = run(tmp_path, "--rig", rig_file(tmp_path, "rate_hz: 50\n"))
    assert_found(done, shaft, "6071h")
