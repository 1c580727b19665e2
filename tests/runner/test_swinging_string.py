"""String that oscillates below a stiff speed loop: it is damped before a measurement, and raises no doubt of a sign."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.drive import Command, Mode, PowerState, Sample
from drivers.errors import LimitHit, PreflightRefused
from profiles.quantities import in_nm
from tdhil.estimation import RoughFriction
from tdhil.recording import LagPrior
from tdhil.recording.builder import RecordingBuilder
from tdhil.runner.excitation import RigGuess
from tdhil.runner.settings import ControlAssumptions, ExcitationRequest
from tdhil.runner.stage_planner import StagePlanner
from tdhil.runner.stages import speed as stage_2
from tdhil.runner.stages.braking_probe import (
    Before,
    BrakingAnswer,
    BrakingListener,
    NoPulse,
    Pulse,
    plan_pulse,
    slow_down,
    slow_speed,
)
from tdhil.runner.stages.speed import LEVEL_S, OSCILLATING_LEVEL_S, SpeedResult, inertia_before_echo
from tdhil.runner.stages.steady import Calmed, Swing, calm_string, is_stick_slip, swing_of, widest
from tdhil.runner.string_release import SwingDamper
from tdhil.runner.task import Task
from tests import rigs
from tests.runner.fake_drive import PERIOD_S, FakeDrive, FakeLog, World
from tests.soft_torque.chain_in_time import recorded, reference_case

LIMITS = replace(rigs.LIMITS, torque_nm=4000.0, time_s=1800.0, quick_stop_rad_s2=1.0, probe_torque_nm=2000.0,
                 load="string", torque_ramp_nm_s=100.0)
STEPS = 10


@dataclass
class RingingDrive(FakeDrive):
    """Two masses on a spring under a stiff PI loop. The reported demand is that of the cycle before.

    ``unsigned``: a negative torque setpoint acts as full torque forward. ``bit_nm`` and ``bit_s``: an oscillation at
    the bit that does not decay.
    """

    inertia: float = 1500.0
    viscous: float = 8.0
    coulomb: float = 60.0
    load: float = 500.0
    stiffness: float = 473.0
    damping: float = 1.0
    gain: float = 12000.0
    integral_gain: float = 12000.0
    unsigned: bool = False
    bit_nm: float = 0.0
    bit_s: float = 5.3
    bottom: float = 0.0
    twist: float = 0.0
    wound_nm: float = 0.0
    demand: float = 0.0
    shown: float = 0.0

    def _move(self, command: Command) -> None:
        self.shown = self.demand
        for _ in range(STEPS):
            self._step(command, PERIOD_S / STEPS)

    def _step(self, command: Command, dt: float) -> None:
        if self.state is PowerState.OFF:
            self.demand = 0.0
        elif self.mode is Mode.SPEED or self.state is PowerState.QUICK_STOP:
            asked = command.speed_rad_s if self.state is PowerState.ENABLED else 0.0
            error = asked - self.speed
            self.wound_nm = max(-4000.0, min(4000.0, self.wound_nm + self.integral_gain * error * dt))
            self.demand = max(-4000.0, min(4000.0, self.gain * error + self.wound_nm))
        else:
            self.demand = 4000.0 if self.unsigned and command.torque_nm < 0.0 else command.torque_nm
            self.wound_nm = self.demand
        self.torque = self.demand
        spring = self.stiffness * self.twist + self.damping * (self.speed - self.bottom)
        push = self.torque - spring - self.viscous * self.speed
        if self.speed != 0.0 or abs(push) > self.coulomb:
            push -= math.copysign(min(self.coulomb, abs(push) if self.speed == 0.0 else self.coulomb),
                                  self.speed or push)
            self.speed += push / self.inertia * dt
        bit = self.bit_nm * math.sin(2.0 * math.pi * self.clock.now_s() / self.bit_s) if self.speed > 1.0 else 0.0
        self.bottom += (spring + bit - 4.0 * self.bottom) / self.load * dt
        self.twist += (self.speed - self.bottom) * dt

    def report(self) -> Sample:
        resting = self.state is PowerState.QUICK_STOP and abs(self.speed) < 1e-3
        return Sample(
            self.clock.now_s(), 0.0, 0.0, True, self.speed, self.torque, self.shown, self.mode, self.state, resting,
            False, 0x27,
        )


def ringing(**drive):
    """Bench whose shaft turns at 3 rad/s above a string with an oscillation of about 1 kN·m."""
    here = World(RingingDrive(**drive), LIMITS)
    here.bench.enable(Mode.SPEED, Command(Mode.SPEED, 0.0, 0.0))
    here.bench.hold(Command(Mode.SPEED, 3.0, 0.0), 8.0)
    return here


def test_ramps_before_their_echo_give_the_inertia_above_the_string(world):
    """Each ramp between two speeds is shorter than the round-trip time. The pipe has nearly no inertia."""
    limits = replace(LIMITS, load="string", torque_ramp_nm_s=40.0, echo_s=2.0, wave_impedance_nm_s_rad=1e-3)
    here = World(limits=limits)
    here.turn(4.0)
    here.bench.guard.observer.doubt = None
    found = inertia_before_echo(here.bench, limits, (3.0, 4.0), RoughFriction(8.0, 60.0, 1.0))
    assert found is not None and found.inertia_kg_m2 == pytest.approx(here.drive.inertia, rel=0.1)
    assert inertia_before_echo(here.bench, limits, (3.0, 4.0), None) is None


def test_a_compliant_top_damps_an_oscillation_that_a_stiff_one_sustains():
    stiff = ringing()
    held = stiff.bench.hold(Command(Mode.SPEED, 3.0, 0.0), 20.0)
    left_stiff = swing_of(held[-300:], PERIOD_S).torque_nm
    here = ringing()
    calmed = calm_string(here.bench, LIMITS, 3.0, 0.1)
    assert left_stiff > 400.0
    assert calmed.swing.torque_nm < 80.0
    assert len(calmed.samples) * PERIOD_S < 40.0
    assert len(calmed.setpoints_rad_s) == len(calmed.samples)
    assert max(abs(speed - 3.0) for speed in calmed.setpoints_rad_s) <= 1.0 + 1e-9


@pytest.mark.heavy
def test_a_right_sign_above_an_oscillating_string_is_accepted():
    here = World(RingingDrive(), LIMITS)
    run = here.runner(ExcitationRequest(periods=2)).run()
    assert run.cause is None, run.cause
    assert any("the shaft slowed down" in text for _, text in here.log.events)
    assert run.stop.confirmed
    assert "torque_answer" not in here.log.facts


@pytest.mark.heavy
def test_a_wrong_sign_above_an_oscillating_string_is_refused():
    here = World(RingingDrive(unsigned=True), LIMITS)
    run = here.runner(ExcitationRequest(periods=2)).run()
    assert isinstance(run.cause, PreflightRefused), run.cause
    assert "inverts a negative torque setpoint" in str(run.cause)
    assert run.stop.confirmed
    assert all(abs(speed) < 0.05 for speed in here.drive.disabled_at)


def test_stick_slip_is_reported_with_its_period():
    here = ringing(bit_nm=1500.0)
    with pytest.raises(LimitHit, match=r"stick-slip at 3\.00 rad/s: .* every 5\.[1-5] s") as hit:
        calm_string(here.bench, LIMITS, 3.0, 0.5)
    assert "speed loop" not in str(hit.value)
    assert "Lift the bit off bottom" in str(hit.value)


def test_an_oscillation_that_noise_sustains_is_no_stick_slip():
    """It is as regular, but the bit always turns. By ζ and the mean speed, stick-slip would have 3 kN·m."""
    limits = replace(LIMITS, wave_impedance_nm_s_rad=1000.0)
    here = ringing(bit_nm=400.0)
    calmed = calm_string(here.bench, limits, 3.0, 0.5)
    assert calmed.swing.regular > 0.6
    assert 80.0 < calmed.swing.torque_nm < 1800.0
    assert any(kind == "string" and "does not decay" in text for kind, text in here.log.events)


@pytest.mark.heavy
def test_an_oscillation_is_stick_slip_only_if_the_bit_stops():
    """A bit below 3,000 m of pipe and a stiff loop sticks at 120 rpm and turns at 179 and 205 rpm (other simulator).

    The bit noise is 0.8 kN·m. The torque amplitude exceeds 0.6 ζω in all cases, which used to count as stick-slip.
    """
    rpm = np.array([[120.0, 179.0, 205.0]])
    time, torque, top, bit = recorded(**reference_case(noise_nm=800.0, rpm=rpm, periods=9.0))
    late = time > time[-1] - 24.0
    pipe = replace(LIMITS, wave_impedance_nm_s_rad=296.5, echo_s=1.888)
    for k, speed in enumerate((rpm[0] * math.pi / 30.0).tolist()):
        rows = zip(time[late], torque[late, k], top[late, k], strict=True)
        swing = swing_of([seen(t_nm, speed=w, time_s=t) for t, t_nm, w in rows], 0.02)
        sticks = bool((bit[late, k] == 0.0).any())
        assert swing.regular >= 0.6 and swing.torque_nm > 0.6 * 296.5 * speed
        assert is_stick_slip(swing, pipe, speed, 0.0) is sticks
        assert sticks is (k == 0)


def seen(torque_nm=200.0, demand_nm=None, speed=3.0, time_s=0.0):
    return Sample(time_s, 0.0, 0.0, True, speed, torque_nm, demand_nm, Mode.TORQUE, PowerState.ENABLED, False, False, 0)


PULSE = Pulse(200.0, -600.0, 20, 0, 0.3, 6.0)
CALM = [seen(200.0 + 5.0 * (-1) ** n) for n in range(50)]


def test_the_demand_of_the_speed_loop_at_the_switch_is_no_answer():
    listener = BrakingListener(PULSE, CALM, PERIOD_S, 0.1, demand_nm=500.0)
    assert listener.hear(seen(demand_nm=500.0)) is None
    assert listener.hear(seen(demand_nm=-600.0)) is None
    assert listener.hear(seen(demand_nm=500.0)) is BrakingAnswer.FASTER


def test_a_demand_that_stays_high_is_an_answer_after_the_time_to_follow():
    listener = BrakingListener(PULSE, CALM, PERIOD_S, 0.1, demand_nm=500.0)
    assert [listener.hear(seen(demand_nm=4000.0)) for _ in range(5)] == [None] * 4 + [BrakingAnswer.FASTER]


def test_a_demand_that_had_followed_the_switch_is_an_answer_at_once():
    assert BrakingListener(PULSE, CALM, PERIOD_S, 0.1,
                           demand_nm=210.0).hear(seen(demand_nm=4000.0)) is BrakingAnswer.FASTER


def test_the_torque_itself_is_an_answer_for_any_demand():
    listener = BrakingListener(PULSE, CALM, PERIOD_S, 0.1, demand_nm=500.0)
    assert BrakingAnswer.FASTER in [listener.hear(seen(3000.0, demand_nm=None)) for _ in range(3)]
    assert listener.why == f"the reported torque went from {in_nm(200.0)} to {in_nm(3000.0)}"


def test_there_is_no_pulse_if_the_oscillation_hides_its_response():
    guess = RigGuess(2000.0, 20.0, 90.0)
    calm = plan_pulse(LIMITS, guess, ControlAssumptions(), Before(2.9, 200.0, 0.03, 60.0), PERIOD_S)
    swings = plan_pulse(LIMITS, guess, ControlAssumptions(), Before(2.9, 200.0, 0.03, 500.0), PERIOD_S)
    assert isinstance(calm, Pulse)
    assert isinstance(swings, NoPulse)
    assert "oscillation of ±500 N·m" in swings.why
    assert isinstance(plan_pulse(replace(LIMITS, load="none"), guess, ControlAssumptions(),
                                 Before(2.9, 200.0, 0.03), PERIOD_S), Pulse)


@pytest.mark.parametrize("period_s", [2.5, 5.3, 9.0])
def test_the_period_of_an_oscillation_is_found(period_s):
    time_s = np.arange(0.0, 24.0, PERIOD_S)
    swing = swing_of([seen(200.0 + 500.0 * math.sin(2.0 * math.pi * t / period_s), time_s=t) for t in time_s], PERIOD_S)
    assert swing.torque_nm == pytest.approx(500.0, rel=0.05)
    assert swing.period_s == pytest.approx(period_s, abs=0.3)
    assert swing.regular > 0.9


def test_noise_is_not_regular():
    noise = np.random.default_rng(1).normal(0.0, 300.0, 24 * 50)
    swing = swing_of([seen(200.0 + one, time_s=n * PERIOD_S) for n, one in enumerate(noise)], PERIOD_S)
    assert swing.regular < 0.6
    assert swing_of([], PERIOD_S) == Swing(0.0, 0.0, 0.0, 0.0)


def test_yielding_stays_within_its_bounds_and_forward():
    damper = SwingDamper(4000.0, 10.0, 0.4, PERIOD_S)
    rng = np.random.default_rng(2)
    speeds = [damper.step(float(torque)) for torque in rng.normal(0.0, 4000.0, 2000)]
    assert min(speeds) >= 0.0
    assert max(speeds) <= 1.4 + 1e-9
    assert damper.step(math.nan) == 0.4


def test_no_plan_fits_a_window_that_the_oscillation_fills():
    here = World(FakeDrive(), LIMITS)
    here.guard.disturbed = Swing(1200.0, 3.2, 5.3, 0.9).words
    speed = SpeedResult(None, None, RigGuess(1500.0, 8.0, 60.0), None, None, (), swing=Swing(1200.0, 3.2, 5.3, 0.9))
    planner = StagePlanner(here.bench, here.log, here.display, print)
    with pytest.raises(LimitHit, match=r"±1200 N·m every 5\.3 s, the top with ±3\.20 rad/s") as hit:
        planner.plan(Task(LIMITS, ExcitationRequest(), {}), speed, Mode.TORQUE, LagPrior())
    assert "off bottom" in hit.value.next_step
    assert "speed loop" not in str(hit.value)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("bit_nm", [0.0, 400.0])
def test_an_oscillation_that_begins_before_the_probe_is_found(bit_nm):
    limits = replace(LIMITS, wave_impedance_nm_s_rad=1000.0)
    here = ringing(bit_nm=bit_nm)
    before = SpeedResult(None, SimpleNamespace(speed_rad_s=3.0), RigGuess(1500.0, 8.0, 60.0), None, None, ())
    slow, found = slow_down(here.bench, limits, before, ControlAssumptions(), 0.01)
    mean = float(np.mean([sample.speed_rad_s for sample in slow]))
    if bit_nm == 0.0:
        assert found is before
        assert (mean, here.guard.disturbed) == (pytest.approx(slow_speed(limits), abs=0.05), "")
    else:
        assert found.wander_rad_s > 0.1
        assert mean == pytest.approx(slow_speed(limits, found.wander_rad_s), abs=0.4)      # it yields
        assert mean > slow_speed(limits) + 0.5
        assert "the string below oscillates with ±" in here.guard.disturbed


@pytest.mark.parametrize(("torque_nm", "level_s"), [(0.0, LEVEL_S), (1200.0, OSCILLATING_LEVEL_S)])
def test_above_an_oscillating_string_an_operating_point_takes_longer(world, monkeypatch, torque_nm, level_s):
    here, swing = world(limits=LIMITS), Swing(torque_nm, 0.5, 5.3, 0.9)
    here.turn(3.0)
    damper = SwingDamper(LIMITS.torque_nm, LIMITS.speed_max_rad_s, 3.0, PERIOD_S)
    monkeypatch.setattr(stage_2, "calm_string", lambda *_: Calmed([], [], swing, damper))
    held = stage_2._settle_and_hold(here.bench, LIMITS, 3.0, 0.1, ControlAssumptions())
    assert len(held.level) * PERIOD_S == pytest.approx(level_s)
    assert OSCILLATING_LEVEL_S > 4.0 * swing.period_s > LEVEL_S


def test_the_larger_oscillation_counts():
    near, far = Swing(900.0, 0.2, 0.0, 0.0), Swing(300.0, 0.5, 0.0, 0.0)
    assert widest(near, far) is far is widest(far, near) is widest(None, far)
    assert widest(None, None) is None


def test_a_plan_that_ends_without_braking_torque_needs_none():
    """The remaining negative torque is a rounding error."""
    limits = replace(LIMITS, speed_min_rad_s=15.0, speed_max_rad_s=26.0, torque_nm=15000.0)
    for coulomb_nm in (3000.0, 3330.0, 3340.0, 3401.7):
        here = World(FakeDrive(), limits)
        here.guard.no_braking = "no pulse was safe"
        speed = SpeedResult(None, None, RigGuess(1500.0, 0.0, coulomb_nm), None, None, (),
                            swing=Swing(300.0, 0.5, 5.3, 0.9))
        planned = StagePlanner(here.bench, here.log, here.display, print).plan(
            Task(limits, ExcitationRequest(), {}), speed, Mode.TORQUE, LagPrior()
        )
        assert planned.plan.torque_min_nm >= -1e-6 * limits.torque_nm


@pytest.mark.parametrize(("echo_s", "kind", "told"), [(1.4, "multisine", 1), (1.4, "prbs", 0), (0.0, "multisine", 0)])
def test_above_an_oscillating_string_a_better_motion_is_advised_before_stage_5(echo_s, kind, told):
    limits = replace(LIMITS, speed_min_rad_s=15.0, speed_max_rad_s=26.0, echo_s=echo_s)
    here = World(FakeDrive(), limits)
    speed = SpeedResult(None, None, RigGuess(1500.0, 8.0, 60.0), None, None, (), swing=Swing(300.0, 0.5, 5.3, 0.9))
    said = []
    planner = StagePlanner(here.bench, here.log, here.display, said.append)
    planner.plan(Task(limits, ExcitationRequest(kind=kind), {}), speed, Mode.TORQUE, LagPrior())
    assert sum("--excitation prbs uses only the time before an echo" in one for one in said) == told


class KeepingLog(FakeLog):
    """Log that keeps the parts of a recording."""

    def __init__(self) -> None:
        super().__init__()
        self.builder, self.commanded = RecordingBuilder(), []

    def cycle(self, command, sample) -> None:
        super().cycle(command, sample)
        self.builder.add(sample)
        self.commanded.append(command.torque_nm)

    @property
    def commanded_nm(self):
        return np.array(self.commanded)

    def recording(self, *, complete):
        self.builder.excitation(*self.motions[-1])
        return self.builder.recording(complete=complete)


@pytest.mark.heavy
def test_a_run_with_ramps_before_the_echo_measures_the_torque_response():
    here = World(RingingDrive(), replace(LIMITS, wave_impedance_nm_s_rad=486.0, echo_s=2.0))
    here.log = KeepingLog()
    run = here.runner(ExcitationRequest(kind="prbs", periods=3)).run()
    assert run.cause is None, run.cause
    assert here.log.facts["torque_answer"].lag_s < 0.01


def test_the_damper_yields_to_the_oscillation_about_the_mean_within_its_limits():
    damper = SwingDamper(4000.0, 10.0, 2.0, PERIOD_S)
    assert [damper.step(500.0) for _ in range(100)] == [2.0] * 100            # friction changes no mean speed
    first, later = damper.step(900.0), [damper.step(900.0) for _ in range(25)][-1]
    assert 2.0 > first > later > 2.0 - 0.1 * 10.0                             # smoothed over 0.2 s
    assert damper.step(math.nan) == 2.0                                       # a missing report is no oscillation
    assert [damper.step(4000.0) for _ in range(50)][-1] == 1.0                # a tenth of the speed limit
    assert [damper.step(-4000.0) for _ in range(50)][-1] == 3.0
    slow = SwingDamper(4000.0, 10.0, 0.5, PERIOD_S)
    for _ in range(100):
        slow.step(0.0)
    assert [slow.step(4000.0) for _ in range(50)][-1] == 0.0                  # never backwards
