"""Braking probe in a run: drives that misread a negative torque, and runs that need no negative torque."""

from dataclasses import dataclass, replace

import pytest

from drivers.drive import Mode, PowerState
from drivers.errors import PreflightRefused
from tdhil.errors import ExitCode, exit_code
from tdhil.runner.settings import ExcitationRequest
from tdhil.runner.stages.braking_probe import NOT_YET
from tests.runner.fake_drive import LIMITS, FakeDrive
from tests.runner.line_drive import Line, LineDrive, run_line

MISREAD = {
    "unsigned": lambda torque: torque if torque >= 0.0 else 400.0,        # a large number, held by the torque limit
    "magnitude": abs,
}
SAID = {"unsigned": "inverts a negative torque setpoint", "magnitude": "torque does not slow the shaft"}


class Misreading(FakeDrive):
    """Drive that reads the torque setpoint with ``read``."""

    read = staticmethod(float)
    fastest = 0.0

    def _move(self, command):
        super()._move(command._replace(torque_nm=self.read(command.torque_nm)))
        self.fastest = max(self.fastest, self.speed) if self.mode is Mode.TORQUE else 0.0


@dataclass
class MisreadingLine(LineDrive):
    """The same drive over a line, with the lags and noise of the simulated drive."""

    how: str = "unsigned"

    def _take(self, command):
        super()._take(command._replace(torque_nm=MISREAD[self.how](command.torque_nm)))


def torque_below_zero(drive):
    return [command.torque_nm for command in drive.commands if command.torque_nm < 0.0]


@pytest.mark.parametrize("how", ["unsigned", "magnitude"])
def test_a_drive_that_reads_no_sign_is_found_at_low_speed(world, how):
    here = world(Misreading())
    here.drive.read = MISREAD[how]
    result = here.runner().run()
    assert exit_code(result.cause) is ExitCode.REFUSED
    assert isinstance(result.cause, PreflightRefused)
    assert SAID[how] in str(result.cause)
    assert "braking probe, torque setpoint" in str(result.cause)
    assert [(stage.name, stage.outcome) for stage in result.stages][-1] == ("torque", "aborted")
    assert here.drive.fastest < 4.5                    # 2.9 rad/s before, and the speed limit is 10
    assert result.stop.confirmed
    assert here.drive.disabled_at == [0.0]
    assert here.drive.state is PowerState.OFF


@pytest.mark.heavy
@pytest.mark.parametrize(("how", "rate_hz", "seed"), [
    ("unsigned", 10, 1), ("unsigned", 50, 2), ("magnitude", 10, 3), ("magnitude", 50, 4),
])
def test_through_lags_and_noise(how, rate_hz, seed):
    run = run_line(MisreadingLine(Line(1.0 / rate_hz), seed=seed, how=how))
    assert isinstance(run.outcome.cause, PreflightRefused), run.outcome.cause
    assert SAID[how] in str(run.outcome.cause)
    assert run.outcome.stop.confirmed
    assert run.drive.top_rad_s < 0.8 * LIMITS.speed_max_rad_s
    assert all(abs(speed) < 0.05 for speed in run.drive.disabled_at)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("friction", [(60.0, 8.0), (0.0, 4.0), (0.0, 0.0)])
def test_nothing_below_zero_is_sent_before_the_probe(world, friction):
    here = world(FakeDrive(coulomb=friction[0], viscous=friction[1]))
    early = []

    def poll(stage, cycles):
        if here.guard_text() == NOT_YET:
            early.extend(torque_below_zero(here.drive))

    here.guard_text = lambda: "" if any("braking torque tried" in text for _, text in here.log.events) else NOT_YET
    here.display.on_cycle = poll
    assert here.runner().run().cause is None
    assert early == []
    assert any("the shaft slowed down" in text for _, text in here.log.events)
    assert torque_below_zero(here.drive)


def test_a_shaft_too_light_to_try_is_never_braked_by_torque(world):
    here = world(FakeDrive(inertia=2.0))
    assert here.runner(ExcitationRequest(periods=2)).run().cause is None
    assert any("no braking torque in this run" in text for _, text in here.log.events)
    assert torque_below_zero(here.drive) == []


@pytest.mark.heavy
def test_a_plan_that_needs_untested_braking_torque(world):
    here = world(FakeDrive(inertia=5.0, coulomb=3.0, viscous=0.5))
    cause = here.runner(ExcitationRequest(periods=2)).run().cause
    assert isinstance(cause, PreflightRefused)
    assert "the plan needs braking torque" in str(cause)
    assert "Lower limits.torque_nm to" in str(cause)
    assert torque_below_zero(here.drive) == []
    advised = float(str(cause).split("limits.torque_nm to ")[1].split()[0])
    here = world(FakeDrive(inertia=5.0, coulomb=3.0, viscous=0.5),
                 replace(LIMITS, torque_nm=0.9 * advised, probe_torque_nm=20.0))
    assert here.runner(ExcitationRequest(periods=2)).run().cause is None


@pytest.mark.heavy
def test_in_speed_mode_there_is_no_braking_probe(world):
    here = world()
    assert here.runner(ExcitationRequest(mode="speed", periods=2)).run().cause is None
    assert not any("braking" in text for _, text in here.log.events)
