"""Stop with reports that contradict each other, show no state, or show a shaft that accelerates."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from drivers import Mode, PowerState
from drivers.drive import Command, PositionReading
from drivers.errors import PreflightRefused, SensorFault, TdhilError
from tdhil.runner.excitation import RigGuess
from tdhil.runner.observer import Observer
from tdhil.runner.settings import ControlAssumptions
from tdhil.runner.stages.setup import probe_sign
from tdhil.runner.standstill import Standstill
from tests.runner.fake_drive import LIMITS, PERIOD_S, SPEED_RESOLUTION
from tests.runner.guarded import sample
from tests.runner.reporting_drive import Reporting
from tests.runner.string_drive import StringWorld

STRING = replace(LIMITS, load="string", torque_ramp_nm_s=40.0)


class Removing(Reporting):
    """Drive whose torque can also be removed."""

    def remove_torque(self):
        self.calls.append("remove_torque")
        self.wish = PowerState.OFF


def known(world, speed=5.0, limits=LIMITS, kind=Removing, **options):
    """Turn the shaft, with J and friction known from stage 2."""
    here = world(kind(**options), limits)
    here.turn(speed)
    drive = here.drive
    here.guard.know(RigGuess(drive.inertia, drive.viscous, drive.coulomb, 0.2))
    if drive.with_position:
        here.guard.observer.position(1e-3, math.inf)
        here.guard.observer.compare_position(1.0)
    here.bench.hold(Command(Mode.SPEED, speed, 0.0), 3.0)
    return here


def doubted(here, speed=5.0):
    """Turn until the guard raises a doubt."""
    with pytest.raises(Exception, match=r"contradict|lighter|faster"):
        here.bench.hold(Command(Mode.SPEED, speed, 0.0), 5.0)
    assert here.guard.observer.doubt is not None


def never_disabled(drive):
    return "disable" not in drive.calls and "remove_torque" not in drive.calls and drive.disabled_at == []


# -- a speed in doubt ----------------------------------------


def test_a_speed_that_is_lost_disables_nothing(world):
    """The shaft comes to standstill, but no trusted report shows it."""
    here = known(world)
    here.drive.sees = 0.0
    doubted(here)
    report = here.stop_sequence().run()
    assert not report.confirmed and not report.disabled and report.at_rest_s is None
    assert never_disabled(here.drive)
    assert "standstill cannot be confirmed" in report.trouble[-1] and "not disabled" in report.trouble[-1]


def test_with_a_position_that_lives_standstill_is_confirmed(world):
    here = known(world, with_position=True)
    here.drive.sees = 0.0
    doubted(here)
    report = here.stop_sequence().run()
    assert report.confirmed and here.drive.disabled_at == [0.0]


def test_with_a_position_that_moves_standstill_is_not_confirmed(world):
    """The reported speed is zero, but the position shows motion."""
    here = known(world, with_position=True)
    here.drive.sees = 0.0
    doubted(here)
    here.drive.pushes_nm = here.drive.coulomb + 5.0 * here.drive.viscous
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert "disable" not in here.drive.calls


def test_in_torque_mode_zero_torque_comes_before_the_quick_stop(world):
    here = known(world)
    here.turn(5.0, Mode.TORQUE)
    here.drive.sees = 3.0
    with pytest.raises(Exception, match="contradict"):
        here.bench.hold(Command(Mode.TORQUE, 0.0, 100.0), 5.0)
    begun = len(here.drive.commands)
    here.stop_sequence().run()
    first = here.drive.commands[begun:begun + 5]
    assert all(one.mode is Mode.TORQUE and one.torque_nm == 0.0 for one in first)
    assert "quick_stop" in here.drive.calls and "disable" not in here.drive.calls


def test_a_doubt_keeps_the_watchdog_fed(world):
    """The drive's watchdog brakes under speed control, too."""
    here = known(world)
    unfed = []
    here.drive.stop_feeding = lambda: unfed.append(True)
    here.drive.sees = 3.0
    doubted(here)
    here.stop_sequence().run()
    assert unfed == []


def reports_sensor_fault(here, **then):
    """The drive reports EMCY 7305h in one cycle; then its reports change to ``then``."""
    def fault(drive, sample):
        drive.misbehave = None
        raise SensorFault("EMCY 7305h, sensor")

    here.drive.misbehave = fault
    with pytest.raises(SensorFault):
        here.bench.cycle(Command(Mode.SPEED, 5.0, 0.0))
    vars(here.drive).update(then)
    return here


def test_a_speed_of_zero_after_a_fault_of_the_sensor_disables_nothing(world):
    here = world(Removing(), LIMITS)
    here.turn(5.0)
    report = reports_sensor_fault(here, sees=0.0).stop_sequence().run()
    assert not report.confirmed and report.at_rest_s is None and never_disabled(here.drive)


def test_a_speed_that_comes_down_after_a_fault_of_the_sensor_is_believed(world):
    here = world(Removing(), LIMITS)
    here.turn(5.0)
    report = reports_sensor_fault(here).stop_sequence().run()
    assert report.confirmed and here.drive.disabled_at == [0.0]


def test_once_the_inertia_is_known_the_balance_decides_on_a_fault_of_the_sensor(world):
    alive, lost = known(world), known(world)
    assert reports_sensor_fault(alive).stop_sequence().run().confirmed
    assert not reports_sensor_fault(lost, sees=0.0).stop_sequence().run().confirmed
    assert never_disabled(lost.drive)


def trips(here, state, **then):
    """The drive removes its torque in motion and changes its reports to ``then``, in one cycle."""
    def trip(drive, sample):
        drive.misbehave = None
        drive.state = drive.wish = state
        vars(drive).update(then)
        return drive.report()

    here.drive.misbehave = trip
    with pytest.raises(TdhilError):
        here.bench.hold(Command(Mode.SPEED, 5.0, 0.0), 1.0)
    return here.stop_sequence().run()


@pytest.mark.parametrize("state", [PowerState.FAULT, PowerState.OFF])
@pytest.mark.parametrize("knows", [True, False])
def test_a_drive_that_trips_and_shows_zero_at_once_confirms_nothing(world, state, knows):
    """The sensor failed together with the drive, or the drive reports no speed without torque. The shaft coasts."""
    lost, alive = (known(world) if knows else world(Removing(), LIMITS) for _ in range(2))
    if not knows:
        lost.turn(5.0)
        alive.turn(5.0)
    report = trips(lost, state, sees=0.0)
    assert not report.confirmed and report.at_rest_s is None
    assert trips(alive, state).confirmed


class EndsOff(Removing):
    """Drive that removes its torque at the end of its quick stop. Its reported speed lags by ``lag_s``."""

    lag_s, seen_rad_s, trips_at_rad_s = 0.4, 0.0, 0.0

    def report(self):
        if self.state is PowerState.QUICK_STOP and self.speed <= self.trips_at_rad_s:
            self.state = self.wish = PowerState.OFF
            self.sees = 0.0 if self.trips_at_rad_s else None
        true = self.speed if self.sees is None else self.sees
        self.seen_rad_s += (true - self.seen_rad_s) * PERIOD_S / self.lag_s
        return super().report()._replace(speed_rad_s=self.seen_rad_s)


def interrupted(world, trips_at_rad_s):
    """Stop a drive of this kind before J is known."""
    here = world(EndsOff(), LIMITS)
    here.drive.trips_at_rad_s = trips_at_rad_s
    here.turn(5.0)
    here.bench.hold(Command(Mode.SPEED, 5.0, 0.0), 3.0)
    return here.stop_sequence(ends_off=True).run()


def test_a_quick_stop_that_ends_with_the_torque_off_is_confirmed_before_j_is_known(world):
    """The lagging report still shows speed when the drive removes its torque: Ctrl-C in stage 2 was "not confirmed"."""
    report = interrupted(world, 0.0)
    assert report.confirmed, report.trouble


@pytest.mark.parametrize("trips_at_rad_s", [4.0, 2.5])
def test_a_trip_within_the_ramp_whose_speed_is_lost_is_not_confirmed(world, trips_at_rad_s):
    report = interrupted(world, trips_at_rad_s)
    assert not report.confirmed and report.at_rest_s is None


def test_a_drive_that_stays_in_its_fault_reaction_is_not_disabled(world):
    """The power stage is on and may hold torque at standstill: 000Fh is not 0008h."""
    report = trips(known(world), PowerState.FAULT_REACTION)
    assert not report.confirmed and not report.disabled


def test_a_fault_of_the_sensor_before_any_motion_leaves_the_stop_as_it_is(world):
    here = world(Removing(), LIMITS)
    here.bench.enable(Mode.SPEED, Command(Mode.SPEED, 0.0, 0.0))
    report = reports_sensor_fault(here, speed=0.0).stop_sequence().run()
    assert report.confirmed and here.drive.disabled_at == [0.0]


@pytest.mark.parametrize(("turns_rad_s", "rests"), [(0.3, False), (0.0, True)])
def test_a_position_that_creeps_is_no_standstill(turns_rad_s, rests):
    """Three counts of a speed in whole revolutions per minute are 0.3 rad/s; the position shows the motion."""
    observer = Observer(LIMITS, 0.02, 0.105)
    observer.position(1e-3, math.inf)
    rest = Standstill(observer, 0.314, 1.5, 0.2)
    found = False
    for k in range(300):
        seen = sample(turns_rad_s, 0.0, time_s=0.02 * k)._replace(
            position_rad=turns_rad_s * 0.02 * k, state=PowerState.OFF)
        observer.see(Command(Mode.SPEED, 0.0, 0.0), seen)
        found = found or rest.see(seen)
    assert found is rests


def test_the_standstill_speed_of_a_fast_motor_is_no_motion(world):
    here = world(limits=replace(LIMITS, speed_max_rad_s=157.0))
    here.turn(5.0)
    here.drive.misbehave = lambda drive, seen: seen._replace(speed_rad_s=max(seen.speed_rad_s, 0.3))
    assert not here.stop_sequence().run().confirmed          # 0.5 % of the limit would be 0.785 rad/s


# -- no valid state ----------------------------------------


@pytest.mark.parametrize("with_position", [False, True])
def test_a_drive_that_shows_no_state_gets_its_quick_stop_again_and_again(world, with_position):
    """All feedback is zero. A jump of the position to zero is no motion."""
    here = known(world, with_position=with_position)
    here.drive.no_state = True
    here.drive.calls.clear()
    begun_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert not report.confirmed and not report.disabled
    assert never_disabled(here.drive)
    assert here.drive.calls.count("quick_stop") >= 0.5 * (here.bench.now_s - begun_s)


def test_a_state_that_returns_is_enough(world):
    here = known(world)
    here.drive.no_state = True
    cycles = here.drive.cycles

    def back(drive, sample):
        drive.no_state = drive.cycles < cycles + round(4.0 / PERIOD_S)
        return sample

    here.drive.misbehave = back
    report = here.stop_sequence().run()
    assert report.confirmed and here.drive.disabled_at == [0.0]


# -- polls ----------------------------------------


def test_a_poll_that_contradicts_the_cycle_prevents_disabling(world):
    here = known(world)
    here.drive.polled = 2.0
    report = here.stop_sequence().run()
    assert not report.confirmed and never_disabled(here.drive)
    assert here.drive.polls > 0
    assert any("a single request 2.000 rad/s" in line for line in report.trouble)


def test_a_poll_precedes_disabling(world):
    here = known(world)
    report = here.stop_sequence().run()
    assert report.confirmed and here.drive.polls >= 1


# -- a shaft that accelerates ----------------------------------------


@pytest.mark.parametrize("with_position", [False, True])
def test_a_runaway_loses_its_torque_and_nothing_is_confirmed(world, with_position):
    here = known(world, with_position=with_position)
    here.drive.pushes_nm = 400.0
    report = here.stop_sequence().run()
    assert not report.confirmed and report.at_rest_s is None
    assert here.drive.calls.count("remove_torque") == 1
    assert here.drive.disabled_at[0] <= 1.2 * LIMITS.speed_max_rad_s
    assert any("accelerates against the quick stop" in line for line in report.trouble)


def test_a_drive_that_only_knows_disable_is_disabled(world):
    here = known(world, kind=Reporting)
    here.drive.pushes_nm = 400.0
    report = here.stop_sequence().run()
    assert not report.confirmed and len(here.drive.disabled_at) == 1


@pytest.mark.parametrize("more", ["position", "demand"])
def test_a_torque_report_that_lies_is_no_runaway(world, more):
    """The torque report is 300 N·m too high in the stop, and the shaft slows down. Position or demand show it."""
    here = known(world, with_position=more == "position")

    def too_much(drive, one):
        demand = one.torque_nm if more == "demand" else None
        return one._replace(torque_nm=one.torque_nm + 300.0 * (drive.state is PowerState.QUICK_STOP),
                            torque_demand_nm=demand)

    here.drive.misbehave = too_much
    report = here.stop_sequence().run()
    assert "remove_torque" not in here.drive.calls, report.trouble
    assert all(abs(speed) < 0.05 for speed in here.drive.disabled_at)


def test_above_a_string_the_torque_stays_on_below_the_limit(world):
    """The shaft turns at a third of its limit and is driven, but no faster. The string must not be released."""
    here = known(world, speed=3.0, limits=STRING, with_position=True)
    here.drive.pushes_nm = here.drive.coulomb + 6.0 * here.drive.viscous       # up to 6 rad/s of 10
    report = here.stop_sequence().run()
    assert not report.confirmed and not report.disabled
    assert here.drive.speed > 3.0
    assert never_disabled(here.drive)


def test_above_a_string_it_is_removed_beyond_the_limit(world):
    here = known(world, limits=STRING, with_position=True)
    here.drive.pushes_nm = 400.0
    follow = here.drive.follow_s
    here.drive.follow_s = 1e9              # nothing brakes it under speed control either
    report = here.stop_sequence().run()
    here.drive.follow_s = follow
    assert not report.confirmed
    assert here.drive.calls.count("remove_torque") == 1
    assert here.drive.disabled_at[0] > STRING.speed_max_rad_s


# -- a motion without a report -------------------------------------------


def test_a_sign_probe_that_saw_no_motion_waits_until_the_shaft_has_run_out(world):
    """The encoder is dead: the torque of the probe has turned the shaft, and only friction stops it."""
    here = world(Reporting(sees=0.0, brakes=False, viscous=4.0))
    here.bench.enable(Mode.TORQUE, Command(Mode.TORQUE, 0.0, 0.0))
    with pytest.raises(PreflightRefused, match="did not move"):
        probe_sign(here.bench, LIMITS, Mode.TORQUE, SPEED_RESOLUTION)
    assert here.drive.speed > 1.0 and not here.guard.observer.moved
    wait_s, begun_s = here.guard.observer.unseen_s, here.bench.now_s
    here.drive.pushes_nm = 0.0             # a quick stop with a speed report of zero does not brake
    report = here.stop_sequence().run()
    assert wait_s > 3.0 and here.bench.now_s - begun_s >= wait_s
    assert all(abs(speed) < 0.05 for speed in here.drive.disabled_at), report


def test_a_release_whose_speed_follows_is_not_doubted():
    here = StringWorld(replace(STRING, quick_stop_rad_s2=2.0), twist_nm=300.0, stiffness=30.0)
    report = here.stop_sequence().run()
    assert report.confirmed and here.guard.observer.doubt is None


# -- a shaft that coasts -------------------------------------------


@pytest.mark.heavy
def test_above_a_string_a_speed_that_is_lost_gets_no_speed_control(world):
    """Speed control or the watchdog would drive the shaft. The torque is zero until friction stops it; then disable."""
    here = known(world, limits=STRING)
    here.drive.sees = 0.0
    doubted(here)
    begun = len(here.drive.commands)
    report = here.stop_sequence().run()
    assert not report.confirmed and report.at_rest_s is None and report.disabled
    assert "quick_stop" not in here.drive.calls and here.drive.calls.count("remove_torque") == 1
    assert {one.mode for one in here.drive.commands[begun:]} == {Mode.TORQUE}
    assert here.drive.commands[-1].torque_nm == 0.0
    assert abs(here.drive.disabled_at[0]) < 0.05, "friction has enough time to stop it"
    assert any("standstill was not seen" in line for line in report.trouble)


def test_noise_of_the_torque_report_does_not_end_the_run_out(world):
    """One sample beyond 4 % of the limit gave the turning shaft back to speed control, without its speed signal."""
    noise = random.Random(1)
    here = known(world, limits=STRING)
    here.drive.sees = 0.0
    doubted(here)
    here.drive.pushes_nm = 300.0
    here.drive.misbehave = lambda drive, one: one._replace(torque_nm=one.torque_nm + noise.gauss(0.0, 8.0))
    report = here.stop_sequence().run()
    assert not report.confirmed and "quick_stop" not in here.drive.calls
    assert abs(here.drive.disabled_at[0]) < 0.05


def test_a_drive_that_does_not_follow_torque_mode_gets_the_quick_stop(world):
    here = known(world, limits=STRING)
    here.drive.sees = 0.0
    doubted(here)
    here.drive.modes = (Mode.SPEED,)
    here.drive.mode = Mode.SPEED
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert "quick_stop" in here.drive.calls


def test_a_torque_that_stays_in_spite_of_zero_gets_the_quick_stop(world):
    here = known(world, limits=STRING)
    here.drive.sees = 0.0
    doubted(here)
    here.drive.misbehave = lambda drive, one: one._replace(torque_nm=200.0)
    report = here.stop_sequence().run()
    assert not report.confirmed and "quick_stop" in here.drive.calls


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("limits", [LIMITS, STRING])
def test_an_inverted_sign_coasts_to_standstill_without_speed_control(world, limits):
    here = world(Removing(direction=-1.0, viscous=4.0), limits)
    here.bench.enable(Mode.TORQUE, Command(Mode.TORQUE, 0.0, 0.0))
    with pytest.raises(PreflightRefused, match="turned backwards"):
        probe_sign(here.bench, limits, Mode.TORQUE, SPEED_RESOLUTION)
    report = here.stop_sequence().run()
    assert report.confirmed and report.disabled, report.trouble
    assert "quick_stop" not in here.drive.calls
    assert abs(here.drive.disabled_at[0]) < 0.05


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("limits", [LIMITS, STRING])
def test_an_inverted_sign_whose_shaft_does_not_coast_to_standstill_is_not_disabled_in_motion(world, limits):
    here = world(Removing(direction=-1.0, viscous=0.0, coulomb=0.0), limits)
    here.bench.enable(Mode.TORQUE, Command(Mode.TORQUE, 0.0, 0.0))
    with pytest.raises(PreflightRefused):
        probe_sign(here.bench, limits, Mode.TORQUE, SPEED_RESOLUTION)
    assert abs(here.drive.speed) > 0.05
    report = here.stop_sequence().run()
    assert report.confirmed and "quick_stop" in here.drive.calls
    assert all(abs(speed) < 0.05 for speed in here.drive.disabled_at)


@pytest.mark.heavy
def test_above_a_string_a_probe_that_saw_no_motion_gets_no_speed_control(world):
    here = world(Removing(sees=0.0, viscous=4.0), STRING)
    here.bench.enable(Mode.TORQUE, Command(Mode.TORQUE, 0.0, 0.0))
    with pytest.raises(PreflightRefused, match="did not move"):
        probe_sign(here.bench, STRING, Mode.TORQUE, SPEED_RESOLUTION)
    wait_s, begun_s = here.guard.observer.unseen_s, here.bench.now_s
    here.stop_sequence().run()
    assert "quick_stop" not in here.drive.calls
    assert here.bench.now_s - begun_s >= wait_s


def test_a_lag_of_half_the_kept_time_is_no_error_of_the_observer():
    """The response to every kept command may still be missing."""
    observer = Observer(STRING, 0.02, SPEED_RESOLUTION, assumptions=ControlAssumptions(largest_speed_lag_s=2.0))
    observer.know(RigGuess(104.0, 8.0, 60.0, 0.2))
    observer.begin_stop()
    for k in range(500):
        observer.see(Command(Mode.SPEED, 0.1 * math.sin(0.02 * k), 0.0),
                     sample(0.0, 300.0, time_s=0.02 * k)._replace(state=PowerState.ENABLED))


def test_positions_with_two_zeros_are_not_combined():
    """A position that is read in the stop has its own zero. Then the positions of the cycle return."""
    observer = Observer(LIMITS, 0.02, SPEED_RESOLUTION)
    observer.know(RigGuess(104.0, 8.0, 60.0, 0.2))
    observer.position(1e-3, math.inf)
    observer.compare_position(1.0)

    def turn(begin, end, with_position=True):
        for k in range(begin, end):
            angle_rad = 100.0 + 3.0 * 0.02 * k if with_position else None
            observer.see(Command(Mode.SPEED, 3.0, 0.0), sample(3.0, 84.0, time_s=0.02 * k)._replace(
                state=PowerState.ENABLED, position_rad=angle_rad))

    turn(0, 200)
    turn(200, 260, with_position=False)
    observer.see_reading(PositionReading(5.2, 0.0, 3.0 * 5.2, None, "6064h"))
    turn(260, 500)
    assert observer.doubt is None and observer.rate_rad_s == pytest.approx(3.0, rel=0.01)
