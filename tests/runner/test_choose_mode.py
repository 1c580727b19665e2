"""Torque mode or speed mode: what the drive, the load and the request decide."""

from dataclasses import replace

import pytest

from drivers.drive import Mode
from drivers.errors import PreflightRefused
from tdhil.runner.preconditions import choose_mode
from tdhil.runner.settings import ExcitationRequest
from tests.rigs import DRIVE_LIMITS
from tests.runner.fake_drive import LIMITS, FakeDrive

ANY, TORQUE = ExcitationRequest(), ExcitationRequest(mode="torque")
STRING = replace(LIMITS, load="string")


def preflight(brakes: bool, displays: bool):
    found = FakeDrive(quick_stop_in_torque_mode=brakes).preflight(DRIVE_LIMITS)
    return replace(found, displays_mode=displays)


@pytest.mark.parametrize(("brakes", "displays"), [(True, True), (True, False), (False, True)])
def test_torque_mode_above_a_string(brakes, displays):
    assert choose_mode(ANY, STRING, preflight(brakes, displays)) is Mode.TORQUE


def test_no_torque_mode_above_a_string_if_the_stop_cannot_see_speed_mode():
    found = preflight(brakes=False, displays=False)
    assert choose_mode(ANY, LIMITS, found) is Mode.TORQUE
    assert choose_mode(ANY, STRING, found) is Mode.SPEED
    with pytest.raises(PreflightRefused, match="does not report its mode"):
        choose_mode(TORQUE, STRING, found)
