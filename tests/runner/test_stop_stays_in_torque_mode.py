"""Stop of a drive that stays in torque mode, where its quick stop does not brake."""

from itertools import pairwise

import pytest

from drivers.drive import Mode, PowerState
from drivers.errors import ModeNotConfirmed
from tdhil.runner.standstill import AT_REST_SHARE
from tdhil.runner.stop import MODE_S, TORQUE_FALLS_S, mode_not_left
from tests.runner.fake_drive import LIMITS, PERIOD_S, FakeDrive
from tests.runner.string_drive import RESIDUAL_NM, STRING, StringWorld

STAYS = {"modes": frozenset({Mode.TORQUE}), "mode": Mode.TORQUE, "quick_stop_in_torque_mode": False}
WAIT = round(MODE_S / PERIOD_S)


def turning(world, **options):
    here = world(FakeDrive(**STAYS, **options))
    here.turn(5.0, Mode.TORQUE)
    here.drive.commands.clear()
    return here


def wound_up(**options):
    here = StringWorld(twist_nm=300.0, torque=300.0, **STAYS, **options)
    here.bench.last = here.drive.report()
    return here


def requests(here):
    return [call for call in here.drive.calls if call in ("quick_stop", "disable")]


def test_friction_stops_it_at_zero_torque(world):
    here = turning(world)
    report = here.stop_sequence().run()
    assert report.confirmed and report.stayed_in_torque_mode, report.trouble
    assert here.drive.disabled_at == [0.0]
    assert requests(here) == ["disable"]
    assert {command.torque_nm for command in here.drive.commands} == {0.0}
    assert "stayed in torque mode" in report.trouble[0]


def test_a_drive_that_changes_to_speed_mode_is_no_such_drive(world):
    here = world(FakeDrive(quick_stop_in_torque_mode=False))
    here.turn(5.0, Mode.TORQUE)
    report = here.stop_sequence().run()
    assert report.confirmed and not report.stayed_in_torque_mode
    assert report.trouble == ()


def test_a_quick_stop_that_brakes_in_torque_mode_is_not_waited_for(world):
    here = turning(world)
    here.drive.quick_stop_in_torque_mode = True
    report = here.stop_sequence().run()
    assert report.confirmed and not report.stayed_in_torque_mode
    assert requests(here) == ["quick_stop", "disable"]


def test_without_standstill_the_quick_stop_remains_and_the_report_is_urgent(world):
    """Without friction the shaft continues to turn at zero torque."""
    here = turning(world, coulomb=0.0, viscous=0.0)
    report = here.stop_sequence().run()
    assert not report.confirmed and report.stayed_in_torque_mode
    assert requests(here)[0] == "quick_stop"
    assert here.drive.disabled_at == []
    assert any("quick stop instead, which may not brake" in line for line in report.trouble)


def test_trapped_torque_is_released_on_the_ramp():
    here = wound_up()
    report = here.stop_sequence().run()
    assert report.confirmed and report.stayed_in_torque_mode, report.trouble
    assert report.trapped_nm == pytest.approx(300.0, rel=0.05)
    assert requests(here) == ["disable"]
    assert abs(here.drive.disabled_at[0]) <= AT_REST_SHARE * STRING.speed_max_rad_s
    assert abs(here.drive.string_nm) < 2.0 * RESIDUAL_NM
    torques = [command.torque_nm for command in here.drive.commands]
    falls = [before - after for before, after in pairwise(torques)]
    assert torques[:WAIT] == [300.0] * WAIT
    assert max(falls) <= STRING.torque_ramp_nm_s * PERIOD_S + 1e-9
    assert min(falls) >= 0.0
    assert here.drive.lowest_speed > -0.1 * STRING.speed_max_rad_s


def test_torque_that_accelerates_the_shaft_falls_at_once():
    """The load is lost: on the ramp, 300 N·m would drive the shaft beyond each limit."""
    here = wound_up(stiffness=1e-3, speed=4.0, viscous=0.0)
    here.drive.angle = 0.0
    report = here.stop_sequence().run()
    torques = [command.torque_nm for command in here.drive.commands]
    begun = next(k for k, torque in enumerate(torques) if torque < 290.0)
    assert torques[begun + round(1.5 * TORQUE_FALLS_S / PERIOD_S)] == 0.0
    assert report.stayed_in_torque_mode


@pytest.mark.parametrize("changes", [{"state": PowerState.FAULT}, {"mode": Mode.SPEED}], ids=str)
def test_a_drive_that_leaves_torque_mode_on_the_ramp_gets_the_quick_stop(changes):
    here = wound_up()
    here.drive.misbehave = lambda drive, s: s._replace(**changes) if 100 < drive.cycles < 105 else s
    report = here.stop_sequence().run()
    assert "quick_stop" in here.drive.calls
    assert any("quick stop instead" in line for line in report.trouble)


def test_a_run_without_another_cause_ends_with_that(world):
    """The drive follows all setpoints of the run. It changes its mode no longer in the stop."""
    here = world(FakeDrive(quick_stop_in_torque_mode=False))
    limited = here.runner()
    plain = here.drive.exchange

    def exchange(command):
        if here.display.stage == "acquire":
            here.drive.modes = frozenset({Mode.TORQUE})
        return plain(command)

    here.drive.exchange = exchange
    outcome = limited.run()
    assert isinstance(outcome.cause, ModeNotConfirmed)
    assert str(outcome.cause) == str(mode_not_left())
    assert outcome.stop.confirmed
    assert here.log.failures == [outcome.cause]
    assert here.drive.disabled_at[-1] == 0.0
    assert LIMITS.has_drill_string is False
