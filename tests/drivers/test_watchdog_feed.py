"""How often the host feeds the drive's watchdog: five times in its time, whatever that is."""

from dataclasses import replace

import pytest

from drivers.clock import MonotonicClock
from drivers.drive import Command, Mode
from tests.drivers.on_wire import LIMITS, prepared
from tests.rigs import DRIVE_LIMITS

WATCHED_S = 4.0


@pytest.mark.parametrize(("watchdog_s", "every_s"), [(0.1, 0.02), (0.2, 0.04), (0.4, 0.08), (0.5, 0.1), (2.0, 0.1)])
def test_a_heartbeat_goes_out_five_times_in_the_watchdogs_time(wire, peer, profile, watchdog_s, every_s):
    """And at least every 0.1 s, where that is long."""
    drive = prepared(wire, profile, replace(LIMITS, watchdog_s=watchdog_s))
    wire.sent.clear()
    for cycle in range(round(WATCHED_S / drive.period_s)):
        if cycle % 25 == 0:
            wire.put(0x701, b"\x05")
        drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    assert len(wire.of(0x77F)) == pytest.approx(WATCHED_S / every_s, abs=1.0)


def test_to_be_kept_alive_costs_no_cycle(wire, peer, profile):
    """One more sign of life, at once; the next is due when it was."""
    drive = prepared(wire, profile, DRIVE_LIMITS)
    wire.put(0x701, b"\x05")
    drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    wire.sent.clear()
    for _ in range(3):
        drive.keep_alive()
    assert len(wire.of(0x77F)) == 3 and not wire.of(0x80)


def test_a_period_that_the_profile_does_not_have_is_not_written(wire, peer, profile):
    """Even where the drive has an object of that number: nobody has said what it does there."""
    without = profile.model_copy(update={"cyclic": profile.cyclic.model_copy(update={"has_period": False})})
    prepared(wire, without, DRIVE_LIMITS, MonotonicClock())
    assert not [index for index, _, _ in peer.writes if index == 0x1006]
