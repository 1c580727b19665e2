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


def preflight(brakes: bool):
    return FakeDrive(quick_stop_in_torque_mode=brakes).preflight(DRIVE_LIMITS)


def test_torque_mode_above_a_string():
    assert choose_mode(ANY, STRING, preflight(brakes=True)) is Mode.TORQUE


def test_no_torque_mode_above_a_string_if_the_watchdog_may_remove_the_torque():
    found = preflight(brakes=False)
    assert choose_mode(ANY, LIMITS, found) is Mode.TORQUE
    assert choose_mode(ANY, STRING, found) is Mode.SPEED
    with pytest.raises(PreflightRefused, match="the torque could be removed at once"):
        choose_mode(TORQUE, STRING, found)


def test_the_reaction_of_a_watchdog_says_where_it_may_not_brake():
    assert replace(preflight(brakes=True), safe_action="quick_stop").reaction == "quick stop"
    unsure = replace(preflight(brakes=False), safe_action="quick_stop")
    assert unsure.reaction == "quick stop; in torque mode the shaft may coast"
    assert replace(unsure, switch_while_enabled=False).reaction == "quick stop"
    assert replace(unsure, safe_action="coast").reaction == "torque off, the shaft coasts"
