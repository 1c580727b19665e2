"""Rows of the fault table that guard, bench and runner handle, each on a scripted drive, in each stage.

The tests check the end of the run: a shaft at standstill and disabled, or left to the watchdog of a lost drive;
the first cause; the exit code.
"""

import signal
from dataclasses import dataclass, replace

import pytest

from drivers.drive import Command, Counters, Mode, PowerState
from drivers.errors import CommandRejected, CommunicationLost, DriveFault, LimitHit, ModeNotConfirmed, PreflightRefused
from tdhil.errors import ExitCode, Interrupted, LogError, exit_code
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.settings import ExcitationRequest
from tdhil.runner.task import STAGES
from tests.runner.fake_drive import LIMITS, NAN, PERIOD_S, FakeDrive, World

IN_STAGE = 60
"""Cycles from the start of a stage to its fault."""
AT_REST_S = 12.0
"""Longest time from the fault to standstill: 10 rad/s at 2 rad/s², plus the detection time."""


@dataclass
class Ended:
    """A run and its results."""

    here: World
    result: object
    fault_s: float

    @property
    def code(self):
        return exit_code(self.result.cause)

    @property
    def speeds(self):
        """Return the true speeds of the shaft in each cycle up to the end of the run."""
        return self.here.speeds

    def assert_stopped(self, cause, code, what="", *, soon=True):
        """Assert the stop sequence: never disabled in motion, and without torque at the end.

        ``soon``: the fault has an effect at once. Some faults have an effect only in a later stage.
        """
        assert isinstance(self.result.cause, cause), self.result.cause
        assert self.code is code
        assert what in str(self.result.cause)
        drive, stop = self.here.drive, self.result.stop
        assert stop.confirmed, stop.trouble
        assert stop.at_rest_s - self.fault_s < AT_REST_S or not soon
        assert drive.speed == 0.0
        assert all(speed == 0.0 for speed in drive.disabled_at)
        assert drive.state in (PowerState.OFF, PowerState.FAULT)
        assert drive.closed

    def assert_left_to_the_watchdog(self, cause=CommunicationLost, code=ExitCode.COMMUNICATION):
        assert isinstance(self.result.cause, cause), self.result.cause
        assert self.code is code
        assert not self.result.stop.confirmed
        assert "disable" not in self.here.drive.calls
        assert "quick_stop" in self.here.drive.calls


def run(stage, begin, drive=None, limits=LIMITS, **options):
    """Run, and call ``begin(world)`` ``IN_STAGE`` cycles after the start of a stage."""
    here = World(drive or FakeDrive(), limits)
    at = []

    here.speeds = []

    def on_cycle(name, cycles):
        here.speeds.append(here.drive.speed)
        wait = 120 if name == "setup" else IN_STAGE        # in setup: once the probe has begun
        if name == stage and cycles >= wait and not at:
            at.append(here.drive.clock.now_s())
            begin(here)

    here.display.on_cycle = on_cycle
    result = here.runner(ExcitationRequest(periods=2), **options).run()
    assert at, f"stage {stage} was never reached: {result.cause}"
    return Ended(here, result, at[0])


def from_now_on(change):
    """Return a ``begin`` that applies this change to every later sample, until the host stops."""
    def begin(here):
        here.drive.misbehave = lambda drive, sample: sample if "quick_stop" in drive.calls else change(drive, sample)
    return begin


each_stage = pytest.mark.parametrize("stage", STAGES)
in_motion = pytest.mark.parametrize("stage", STAGES[1:])
in_torque = pytest.mark.parametrize("stage", ["torque", "hold", "acquire"])


@pytest.mark.heavy(but_first=5)
@each_stage
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 143)])
@pytest.mark.parametrize("times", [1, 2])
def test_rows_1_2_3_signals(stage, number, code, times):
    def begin(here):
        for _ in range(times):
            here.stop_request.ask(number)

    run(stage, begin).assert_stopped(Interrupted, ExitCode(code))


def test_row_2_a_signal_during_the_stop_changes_nothing():
    def begin(here):
        here.stop_request.ask(signal.SIGINT)
        plain = here.drive.quick_stop

        def again():
            here.stop_request.ask(signal.SIGTERM)
            plain()

        here.drive.quick_stop = again

    run("acquire", begin).assert_stopped(Interrupted, ExitCode.INTERRUPTED)


@pytest.mark.heavy(but_first=3)
@each_stage
def test_row_5_an_exception(stage):
    def begin(here):
        def mistake(*_):
            raise ZeroDivisionError("a mistake of ours")

        here.log.on_cycle = mistake

    run(stage, begin).assert_stopped(ZeroDivisionError, ExitCode.INTERNAL)


@pytest.mark.heavy(but_first=2)
@in_motion
def test_row_6_a_stop_that_is_not_confirmed(stage):
    def begin(here):
        here.drive.brakes, here.drive.coulomb, here.drive.viscous = False, 0.0, 0.0
        here.stop_request.ask(signal.SIGINT)

    ended = run(stage, begin)
    assert not ended.result.stop.confirmed
    assert "disable" not in ended.here.drive.calls
    assert ended.here.drive.disabled_at == []


class Slow(FakeDrive):
    """Drive whose cycles are late, once it is switched on."""

    late_every = 0
    overruns = 0

    def exchange(self, command):
        sample = super().exchange(command)
        if self.late_every and self.cycles % self.late_every == 0:
            self.overruns += 1
        return sample

    @property
    def counters(self):
        return Counters(self.cycles, self.missed, 0, self.overruns)


@pytest.mark.heavy(but_first=2)
@in_motion
def test_row_8_a_loop_that_is_late_again_and_again(stage):
    def begin(here):
        here.drive.late_every = 2

    run(stage, begin, Slow()).assert_stopped(CommunicationLost, ExitCode.COMMUNICATION, "the control loop was late")


def test_row_8_a_loop_that_is_late_now_and_then():
    ended = run("acquire", lambda here: setattr(here.drive, "late_every", 10), Slow())
    assert ended.result.cause is None
    assert ended.result.stages[-1].outcome == "degraded"
    assert "began late" in ended.result.stages[-1].detail


@pytest.mark.heavy(but_first=3)
@each_stage
def test_row_10_a_log_that_can_not_be_written(stage):
    def begin(here):
        def full(*_):
            raise LogError("the disk is full", where="run.mcap")

        here.log.on_cycle = full

    ended = run(stage, begin)
    ended.assert_stopped(LogError, exit_code(LogError("x")))


@pytest.mark.heavy(but_first=2)
@in_motion
def test_rows_12_13_15_the_bus_is_lost(stage):
    def begin(here):
        def gone(drive, sample):
            raise CommunicationLost("the bus did not accept a frame")

        here.drive.misbehave = gone

    run(stage, begin).assert_left_to_the_watchdog()


class Lossy(FakeDrive):
    """Drive that loses one frame in a given number."""

    every = 0

    def exchange(self, command):
        sample = super().exchange(command)
        if not self.every or self.cycles % self.every:
            return sample
        self.missed += 1
        return sample._replace(fresh=False)


@pytest.mark.heavy(but_first=1)
@in_motion
@pytest.mark.parametrize(("every", "outcome"), [(10, "degraded"), (1000, "ok")])
def test_row_17_lost_frames(stage, every, outcome):
    ended = run(stage, lambda here: setattr(here.drive, "every", every), Lossy())
    assert ended.result.cause is None
    found = {one.name: one.outcome for one in ended.result.stages}
    assert found[stage] == outcome
    assert ended.here.drive.disabled_at == [0.0]


class Doubled(FakeDrive):
    """Drive whose feedback is duplicated, or arrives after its cycle."""

    late = 0

    @property
    def counters(self):
        return Counters(self.cycles, self.missed, self.late)

    def exchange(self, command):
        self.late += self.cycles % 10 == 0 and self.doubling
        return super().exchange(command)

    doubling = False


def test_row_18_duplicated_or_late_feedback_is_found():
    ended = run("acquire", lambda here: setattr(here.drive, "doubling", True), Doubled())
    assert ended.result.cause is None
    assert ended.result.stages[-1].outcome == "degraded"
    assert "late or twice" in ended.result.stages[-1].detail


@pytest.mark.heavy(but_first=2)
@in_motion
def test_row_19_no_feedback_any_more(stage):
    ended = run(stage, from_now_on(lambda drive, sample: sample._replace(fresh=False)))
    ended.assert_stopped(CommunicationLost, ExitCode.COMMUNICATION, "no feedback for 13 cycles")


def test_row_19_the_same_feedback_again_and_again():
    """The frames are fresh and contain old values, during the excitation, while the setpoint changes."""
    kept = []

    def frozen(drive, sample):
        kept.append(sample)
        return sample._replace(speed_rad_s=kept[0].speed_rad_s, torque_nm=kept[0].torque_nm)

    ended = run("acquire", from_now_on(frozen))
    ended.assert_stopped(CommunicationLost, ExitCode.COMMUNICATION, "frozen")


@pytest.mark.heavy
@in_motion
@pytest.mark.parametrize(
    ("error", "code"),
    [(CommunicationLost("the drive's heartbeat has been missing for 0.60 s"), ExitCode.COMMUNICATION),
     (DriveFault("the drive restarted during the run (boot-up message)"), ExitCode.DRIVE_FAULT),
     (CommunicationLost("another master put the drive into NMT state pre-operational"), ExitCode.COMMUNICATION),
     (DriveFault("EMCY 7305h, sensor"), ExitCode.DRIVE_FAULT)],
    ids=["20", "21", "22", "23"],
)
def test_rows_20_to_23_what_the_driver_raises(stage, error, code):
    """The drive raises once, as in the contract, and the stop continues to exchange."""
    told = []

    def begin(here):
        def raising(drive, sample):
            if not told:
                told.append(error)
                raise error
            return sample

        here.drive.misbehave = raising

    run(stage, begin).assert_stopped(type(error), code, error.what)
    assert told


@pytest.mark.heavy(but_first=4)
@in_motion
@pytest.mark.parametrize("state", [PowerState.OFF, PowerState.READY, PowerState.QUICK_STOP, PowerState.FAULT])
def test_rows_31_33_a_drive_that_leaves_its_state(stage, state):
    def begin(here):
        here.drive.state = here.drive.wish = state         # without torque it coasts for longer than every lag

    ended = run(stage, begin)
    assert isinstance(ended.result.cause, DriveFault)
    assert state.value in str(ended.result.cause)
    assert ended.result.cause.where.startswith("statusword")
    assert ended.here.drive.speed == pytest.approx(0.0, abs=0.05)
    # Before J is known, a slow shaft stops within the lags of its report. A lost signal would look the same.
    hidden = stage == "speed" and state in (PowerState.OFF, PowerState.READY)
    assert ended.result.stop.confirmed is not hidden
    assert ended.code is ExitCode.DRIVE_FAULT              # of the cause; or 8 for an unconfirmed stop


def test_row_31_a_drive_that_is_never_enabled():
    here = World(FakeDrive(misbehave=lambda drive, sample: sample._replace(state=PowerState.READY)))
    result = here.runner().run()
    assert isinstance(result.cause, DriveFault)
    assert "was not enabled within 3 s" in str(result.cause)
    assert here.drive.speed == 0.0


def test_row_32_a_mode_that_is_not_confirmed():
    def stays(drive, sample):
        return sample._replace(mode=Mode.SPEED)

    ended = run("speed", lambda here: setattr(here.drive, "misbehave", stays))
    ended.assert_stopped(ModeNotConfirmed, ExitCode.DRIVE_FAULT, "torque mode", soon=False)


@in_torque
def test_row_33_the_drive_s_internal_limit(stage):
    ended = run(stage, from_now_on(lambda drive, sample: sample._replace(limit_active=True)))
    ended.assert_stopped(LimitHit, ExitCode.LIMIT, "internal limit")
    assert "bit 11" in ended.result.cause.where


@in_torque
def test_row_34_the_load_is_lost(stage):
    def begin(here):
        here.drive.coulomb, here.drive.viscous, here.drive.inertia = 0.0, 0.0, 5.0

    ended = run(stage, begin)
    # At a steady speed, the slow control of the host compensates the loss for as long as stage 4 may take.
    ended.assert_stopped(LimitHit, ExitCode.LIMIT, soon=stage != "hold")
    # Two cycles at the torque limit. The speed limit of the drive itself, set in preflight, covers this.
    assert max(ended.speeds) <= 10.0 + 2.0 * PERIOD_S * 400.0 / 5.0


@pytest.mark.heavy(but_first=4)
@in_motion
@pytest.mark.parametrize(
    ("change", "what"),
    [({"speed_rad_s": 10.2}, "above the limit of 10 rad/s"), ({"torque_nm": 600.0}, "torque 600 N·m is above"),
     ({"speed_rad_s": -0.4}, "turns backwards")],
)
def test_row_35_limits(stage, change, what):
    ended = run(stage, from_now_on(lambda drive, sample: sample._replace(**change)))
    ended.assert_stopped(LimitHit, ExitCode.LIMIT, what)


def test_row_35_the_time_limit():
    ended = run("speed", lambda here: None, limits=replace(LIMITS, time_s=20.0))
    assert isinstance(ended.result.cause, LimitHit)
    assert ended.code is ExitCode.LIMIT
    assert ended.result.stop.confirmed


def test_row_35_the_travel_of_the_probe():
    here = World(FakeDrive(misbehave=lambda drive, sample: sample._replace(
        speed_rad_s=0.09 if drive.state is PowerState.ENABLED else 0.0)), replace(LIMITS, probe_travel_rad=0.05))
    result = here.runner().run()
    assert isinstance(result.cause, PreflightRefused)
    assert "without a clear direction" in str(result.cause)
    assert result.stop.confirmed


def test_row_36_an_inverted_encoder():
    here = World(FakeDrive(direction=-1.0))
    result = here.runner().run()
    assert isinstance(result.cause, PreflightRefused)
    assert exit_code(result.cause) is ExitCode.REFUSED
    assert "turned backwards" in str(result.cause)
    assert result.stop.confirmed


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("value", [NAN, float("inf"), -float("inf"), 1e9])
def test_row_37_a_setpoint_that_is_none_never_reaches_the_bus(mode, value):
    here = World()
    here.turn(5.0, mode)
    sent = len(here.drive.commands)
    for command in (Command(mode, value, 0.0), Command(mode, 0.0, value)):
        with pytest.raises(CommandRejected):
            here.bench.cycle(command)
    assert len(here.drive.commands) == sent


@pytest.mark.heavy(but_first=2)
@in_motion
def test_row_37_a_setpoint_that_is_none_ends_the_run(stage):
    here = World()
    fed, plain = [], ControlLoop.cycle

    def poisoned(bench, command):
        if here.display.stage == stage and here.display.seen == IN_STAGE and not fed:
            fed.append(bench.now_s)
            command = command._replace(torque_nm=NAN)
        return plain(bench, command)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ControlLoop, "cycle", poisoned)
        result = here.runner(ExcitationRequest(periods=2)).run()
    Ended(here, result, fed[0]).assert_stopped(CommandRejected, ExitCode.INTERNAL, "not finite")
    assert all(command.torque_nm == command.torque_nm for command in here.drive.commands)


def test_the_first_cause_is_kept():
    """Failures during the stop are reported as well."""
    def begin(here):
        here.stop_request.ask(signal.SIGINT)
        plain, left = here.drive.quick_stop, [2]

        def reluctant():
            if left[0]:
                left[0] -= 1
                raise DriveFault("EMCY while stopping")
            plain()

        here.drive.quick_stop = reluctant

    ended = run("hold", begin)
    ended.assert_stopped(Interrupted, ExitCode.INTERRUPTED)
    assert "EMCY while stopping" in ended.result.stop.trouble[0]
    assert ("stop", "EMCY while stopping") in ended.here.log.events
