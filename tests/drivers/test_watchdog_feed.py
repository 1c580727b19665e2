"""Feeding of the drive's watchdog: five times within any watchdog time."""

from dataclasses import replace

import pytest

from drivers.clock import MonotonicClock
from drivers.drive import Command, Mode
from tests.drivers.on_wire import LIMITS, prepared
from tests.rigs import DRIVE_LIMITS

WATCHED_S = 4.0


@pytest.mark.parametrize(("watchdog_s", "every_s"), [(0.1, 0.02), (0.2, 0.04), (0.4, 0.08), (0.5, 0.1), (2.0, 0.1)])
def test_a_heartbeat_goes_out_five_times_in_the_watchdogs_time(wire, peer, profile, watchdog_s, every_s):
    """For a long watchdog time it is at least every 0.1 s."""
    drive = prepared(wire, profile, replace(LIMITS, watchdog_s=watchdog_s))
    wire.sent.clear()
    for cycle in range(round(WATCHED_S / drive.period_s)):
        if cycle % 25 == 0:
            wire.put(0x701, b"\x05")
        drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    assert len(wire.of(0x77F)) == pytest.approx(WATCHED_S / every_s, abs=1.0)


def test_an_extra_sign_of_life_takes_no_cycle(wire, peer, profile):
    """An extra sign of life is sent at once, and the time of the next one does not change."""
    drive = prepared(wire, profile, DRIVE_LIMITS)
    wire.put(0x701, b"\x05")
    drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    wire.sent.clear()
    for _ in range(3):
        drive.keep_alive()
    assert len(wire.of(0x77F)) == 3 and not wire.of(0x80)


def test_a_period_that_the_profile_does_not_have_is_not_written(wire, peer, profile):
    """The drive may have an object with that number, but its meaning is unknown."""
    without = profile.model_copy(update={"cyclic": profile.cyclic.model_copy(update={"has_period": False})})
    prepared(wire, without, DRIVE_LIMITS, MonotonicClock())
    assert not [index for index, _, _ in peer.writes if index == 0x1006]
