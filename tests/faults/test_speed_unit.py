"""Profile with a wrong unit of speed that no object of the drive contradicts; checks of the true shaft.

The profile states 0.01 rpm per count, but the drive uses 0.1 rpm, and no maximum speed is written. The shaft turns
ten times as fast as commanded, and the reported speed is ten times too small. The tests use the whole path from
stage 1 to the stop, through frames, in stepped time. The simulator gives the true motion.
"""

import math
from dataclasses import replace
from importlib.resources import files

import pytest

from drivers.canopen.drive import CanopenDrive
from drivers.clock import SteppedClock
from drivers.errors import CommunicationLost, PreflightRefused
from profiles.library import load_canopen_profile, load_modbus_profile
from sim_bus.canopen.inline import InlineSimulator
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from sim_bus.params import RigParams
from tdhil.errors import exit_code
from tdhil.runner import speed_check
from tdhil.runner.five_stages import Runner
from tdhil.runner.settings import ExcitationRequest, StopRequest
from tdhil.runner.task import Task
from tests.drivers.modbus_bench import driven
from tests.rigs import LIMITS
from tests.runner.fake_drive import FakeDisplay, FakeLog

RATE_HZ = 100.0
"""Cycles per second on CANopen, which is sufficient since the checked motions take seconds."""


class Enough(Exception):
    """End of a test: the check of the unit of speed is complete."""


class Log(FakeLog):
    """Log that ends the run once the unit of speed is checked, or with ``on`` at the end of the stage."""

    on = False

    def configure(self, **run):
        super().configure(**run)
        if "speed_unit" in run and not self.on:
            raise Enough


class Unmarked:
    """Simulated drive without the marker object, so that tdhil treats it as a real one."""

    def __init__(self, drive):
        self._drive = drive

    def __getattr__(self, name):
        return getattr(self._drive, name)

    def read_position(self):
        return self._drive.read_position()

    def connect(self):
        return replace(self._drive.connect(), simulated=False)

    def preflight(self, limits):
        found = self._drive.preflight(limits)
        return replace(found, identity=replace(found.identity, simulated=False))


class Waking(Unmarked):
    """Host that was frozen: it reads a distant angle from a drive that has stopped in the meantime."""

    def __init__(self, drive, reading):
        super().__init__(drive)
        self._left = reading

    def read_position(self):
        self._left -= 1
        found = super().read_position()
        return found if self._left > 0 else found._replace(position_rad=found.position_rad + 20.0)

    def exchange(self, command):
        if self._left <= 0:
            self._left = math.inf
            raise CommunicationLost("the drive's watchdog stopped it", where="a test")
        return self._drive.exchange(command)


class Rig:
    """One bus: the drive, the profile of the host, and the motion of the true shaft."""

    def __init__(self, drive, true_speed, close, node=None):
        self.drive, self.true_speed, self.close, self.node = drive, true_speed, close, node
        self.log, self.asked = Log(), []

    def run(self, *, simulated=True, confirm_speed=None, limits=LIMITS):
        seen = []

        def on_cycle(_stage, _count):
            seen.append(abs(self.true_speed()))

        def on_started(name):
            if name in ("torque", "hold", "acquire"):
                raise Enough

        display = FakeDisplay(on_cycle=on_cycle, on_started=on_started)
        options = {} if confirm_speed is None else {"confirm_speed": confirm_speed}
        drive = self.drive if simulated else Unmarked(self.drive)
        self.outcome = Runner(
            drive, lambda _: Task(limits, ExcitationRequest()), self.log, StopRequest(), display, lambda *_: None,
            **options,
        ).run()
        self.highest_rad_s, self.last_rad_s = max(seen), seen[-1]
        return self.outcome

    def says(self, answer):
        """Return a `ConfirmSpeed` of an operator who observes the shaft for five seconds."""

        def confirm(speed_rad_s, why, idle):
            for _ in range(round(5.0 / self.drive.period_s)):
                idle()
            self.asked.append((speed_rad_s, abs(self.true_speed()), why))
            if not answer:
                raise PreflightRefused("the shaft was not seen to turn as the drive reports", where="prompt")

        return confirm


def profile_of(tmp_path, name, load, *changes):
    text = (files("profiles") / f"{name}.yaml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "wrong.yaml"
    path.write_text(text.replace("eds: cia402.eds", "eds: null"))
    return load(str(path))


def canopen(tmp_path, factor, *changes, worn=False):
    """Return a CANopen rig. ``factor``: error of the host's unit. ``worn``: whether the drive has the changes too."""
    wrong = (
        ("  rpm_per_lsb: 0.1\n", f"  rpm_per_lsb: {0.1 / factor:.6g}\n"),
        ("max_motor_speed_rpm_per_lsb: 1.0", "max_motor_speed_rpm_per_lsb: null"),
    )
    of_drive = profile_of(tmp_path, "generic/cia402", load_canopen_profile, *changes) if worn else None
    simulated = InlineSimulator(RigParams(), seed=3, profile=of_drive).open()
    profile = profile_of(tmp_path, "generic/cia402", load_canopen_profile, *wrong, *changes)
    drive = CanopenDrive(simulated.bus, profile, SteppedClock(), node=1, rate_hz=RATE_HZ)
    return Rig(drive, lambda: simulated.simulator.speed_rad_s, simulated.close, simulated.simulator.node)


def modbus(tmp_path, factor, *changes):
    told = f"per_lsb: {0.01 / factor:.6g}, unit: rpm"
    wrong = (
        ("register: {address: 1, type: i32}, per_lsb: 0.01, unit: rpm", "register: {address: 1, type: i32}, " + told),
        ("register: {address: 17, type: i32}, per_lsb: 0.01, unit: rpm", "register: {address: 17, type: i32}, " + told),
        # Signs before motion: the echo of the setpoint, and the limits of speed.
        ("  - {setpoint: speed, register: {address: 48, type: i32}, per_lsb: 0.001, unit: rpm, "
         "source: this project's own map, confidence: verified}\n", ""),
        ("    set_to: speed_limit\n", ""),
        ("    set_to: speed_limit_reverse\n", ""),
    )
    simulated = EmbeddedModbusDrive(RigParams(), load_modbus_profile("generic/modbus"), seed=3)
    profile = profile_of(tmp_path, "generic/modbus", load_modbus_profile, *wrong, *changes)

    def true_speed():
        return simulated.speed_rad_s

    return Rig(driven(simulated, profile), true_speed, simulated.close)


SPEED = "speed:\n  rpm_per_lsb"


def angle(keys):
    """Make the drive count its angle before the conversion of the speed unit."""
    return f"position:\n  {keys}\n  source: a test\n  confidence: verified\n{SPEED}"


NO_ANGLE = {
    canopen: (SPEED, f"position: null\n{SPEED}"),
    modbus: ("position:\n  register: {address: 52, type: i32}\n  counts_per_turn: 4096\n"
             "  source: this project's own map\n  confidence: verified\n", ""),
}


@pytest.fixture
def made(tmp_path):
    open_rigs = []

    def make(bus, factor=10.0, *changes, **options):
        open_rigs.append(bus(tmp_path, factor, *changes, **options))
        return open_rigs[-1]

    yield make
    for rig in open_rigs:
        rig.close()


both = pytest.mark.parametrize("bus", [canopen, modbus])


def assert_stopped_in_time(rig):
    assert rig.highest_rad_s < LIMITS.speed_max_rad_s
    assert rig.outcome.stop is not None
    assert rig.outcome.stop.confirmed
    assert rig.last_rad_s < 0.05


@pytest.mark.long(but_first=5)
@pytest.mark.heavy
@pytest.mark.parametrize(("bus", "factor"), [
    (canopen, 10.0), (canopen, 2.0 * math.pi), (canopen, 3.0), (canopen, 2.0), (modbus, 10.0), (modbus, 2.0),
])
def test_the_angle_shows_a_unit_that_is_too_small(made, seen, bus, factor):
    rig = made(bus, factor)
    cause = rig.run().cause
    assert exit_code(cause) == 4
    assert "unit of speed is too small by a factor of" in cause.what
    assert float(cause.what.rsplit(" ", 1)[1]) == pytest.approx(factor, rel=0.06)
    assert "speed scaling in the profile" in cause.next_step
    assert_stopped_in_time(rig)
    if factor == 10.0:
        seen(74, f"{cause.what}; the true shaft reached {rig.highest_rad_s:.1f} rad/s of 10", code=4)


@pytest.mark.heavy
@both
def test_a_unit_that_is_too_large(made, bus):
    """A shaft that is ten times too slow is no danger, but gives a wrong J. It turns at the slow speed only."""
    rig = made(bus, 0.25)
    cause = rig.run().cause
    assert exit_code(cause) == 4
    assert "too large by a factor of 4" in cause.what
    assert_stopped_in_time(rig)


@pytest.mark.heavy
@both
def test_without_an_angle_the_operator_says_no(made, seen, bus):
    rig = made(bus, 10.0, NO_ANGLE[bus])
    cause = rig.run(simulated=False, confirm_speed=rig.says(False)).cause
    assert exit_code(cause) == 4
    (reported, true, why), = rig.asked
    assert reported == pytest.approx(2.0 * math.pi / 12.0, rel=0.05)        # the question states once every 12 s
    assert true == pytest.approx(10.0 * reported, rel=0.1)
    assert "reports no position" in why
    assert_stopped_in_time(rig)
    seen(75, f"{cause.what}; the true shaft reached {rig.highest_rad_s:.1f} rad/s of 10", code=4)


@pytest.mark.heavy
@both
def test_without_an_angle_and_with_nobody_there(made, seen, bus):
    rig = made(bus, 10.0, NO_ANGLE[bus])
    cause = rig.run(simulated=False).cause
    assert exit_code(cause) == 4
    assert "no operator can confirm that the shaft turns" in cause.what
    assert_stopped_in_time(rig)
    seen(76, f"{cause.what}; the true shaft reached {rig.highest_rad_s:.1f} rad/s of 10", code=4)


@pytest.mark.heavy
@both
def test_the_operator_confirms_a_right_unit(made, bus):
    rig = made(bus, 1.0, NO_ANGLE[bus])
    assert isinstance(rig.run(simulated=False, confirm_speed=rig.says(True)).cause, Enough)
    (reported, true, _), = rig.asked
    assert true == pytest.approx(reported, rel=0.1)
    assert rig.log.run["speed_unit"]["seen_by"] == "operator"


@pytest.mark.heavy
@both
def test_with_the_override_there_is_no_question(made, bus):
    rig = made(bus, 1.0, NO_ANGLE[bus])
    limits = replace(LIMITS, accept_speed_unit=True)
    assert isinstance(rig.run(simulated=False, limits=limits).cause, Enough)
    assert rig.log.run["speed_unit"]["seen_by"] == "--accept-speed-unit"
    (warning,) = speed_check.speed_warnings(rig.log.run)
    assert "--accept-speed-unit" in warning


@pytest.mark.heavy(but_first=1)
@both
def test_the_override_does_not_accept_a_shaft_that_would_be_too_fast(made, bus):
    rig = made(bus, 10.0)
    cause = rig.run(simulated=False, limits=replace(LIMITS, accept_speed_unit=True)).cause
    assert exit_code(cause) == 4
    assert "too small by a factor of 10" in cause.what
    assert_stopped_in_time(rig)


@pytest.mark.heavy
@both
def test_the_override_accepts_wrong_counts_without_a_hazard(made, bus):
    """The unit of speed is right, and the profile states twice the counts of the encoder."""
    old, new = {
        canopen: (SPEED, angle("counts_per_turn: 16384")),
        modbus: ("counts_per_turn: 4096", "counts_per_turn: 8192"),
    }[bus]
    rig = made(bus, 1.0, (old, new))
    cause = rig.run(simulated=False).cause
    assert exit_code(cause) == 4
    assert "too large by a factor of 2" in cause.what
    assert "counts per turn" in cause.next_step
    again = made(bus, 1.0, (old, new))
    assert isinstance(again.run(simulated=False, limits=replace(LIMITS, accept_speed_unit=True)).cause, Enough)


@pytest.mark.heavy
@both
def test_a_simulated_drive_without_an_angle_continues_with_a_note(made, bus):
    rig = made(bus, 1.0, NO_ANGLE[bus])
    assert isinstance(rig.run().cause, Enough)
    assert not rig.asked
    assert any("not checked" in text for _, text in rig.log.events)


@pytest.mark.heavy
@both
def test_a_right_unit_is_seen_to_be_right_without_a_pause(made, bus):
    rig, plain = made(bus, 1.0), made(bus, 1.0, NO_ANGLE[bus])
    for one in (rig, plain):
        one.log.on = True
        assert isinstance(one.run().cause, Enough)
    assert rig.log.run["speed_unit"]["ratio"] == pytest.approx(1.0, abs=0.005)
    assert speed_check.speed_warnings(rig.log.run) == ()
    # The check takes no cycle. On Modbus its requests take time on the line, which shifts the noise.
    assert rig.log.cycles == pytest.approx(plain.log.cycles, abs=0 if bus is canopen else 20)


ANGLES = {
    "a counter of turns": "counts_per_turn: 1\n  type: i32",
    "one turn only": "counts_per_turn: 4096\n  wrap_counts: 4096\n  type: u16",
    "a float": "counts_per_turn: 1\n  type: f32",
}


@pytest.mark.long(but_first=3)
@pytest.mark.heavy
@pytest.mark.parametrize("kind", ANGLES)
@pytest.mark.parametrize("factor", [1.0, 10.0])
def test_other_angles(made, kind, factor):
    rig = made(canopen, factor, (SPEED, angle("index: 0x2100\n  " + ANGLES[kind])), worn=True)
    cause = rig.run().cause
    if factor == 1.0:
        assert isinstance(cause, Enough)
        assert rig.log.run["speed_unit"]["ratio"] == pytest.approx(1.0, abs=0.03)
    else:
        assert "too small by a factor of" in cause.what
        assert float(cause.what.rsplit(" ", 1)[1]) == pytest.approx(factor, rel=0.06)
        assert_stopped_in_time(rig)


def spoiled(rig, read):
    """Replace 6064h of the simulated drive by ``read`` of the true count."""
    live = rig.node.store.live
    true = live[0x6064 << 8]
    live[0x6064 << 8] = lambda: read(true())


@pytest.mark.heavy
def test_an_angle_that_counts_backwards(made, seen):
    rig = made(canopen, 1.0)
    spoiled(rig, lambda counts: -counts)
    cause = rig.run(simulated=False).cause
    assert exit_code(cause) == 4
    assert "a sign is inverted" in cause.what
    assert "607Eh" in cause.next_step
    assert_stopped_in_time(rig)
    seen(77, cause.what, code=4)


@pytest.mark.heavy
def test_an_angle_that_stands_still_is_put_to_the_operator(made, seen):
    rig = made(canopen, 10.0)
    spoiled(rig, lambda counts: 1234)
    cause = rig.run(simulated=False, confirm_speed=rig.says(False)).cause
    assert exit_code(cause) == 4
    (_, _, why), = rig.asked
    assert "does not move" in why
    assert_stopped_in_time(rig)
    seen(78, f"{why}; {cause.what}", code=4)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("bus", "reading"), [(canopen, 3), (canopen, 40), (modbus, 12)])
def test_an_angle_read_after_a_freeze_is_no_wrong_unit(made, bus, reading):
    """The message states the cause of the drive's stop."""
    rig = made(bus, 1.0)
    rig.drive = Waking(rig.drive, reading)
    cause = rig.run().cause
    assert isinstance(cause, CommunicationLost), cause
    assert "watchdog" in cause.what


@pytest.mark.heavy
def test_a_constant_angle_of_a_simulated_drive(made):
    rig = made(canopen, 1.0)
    spoiled(rig, lambda counts: 0)
    cause = rig.run().cause
    assert exit_code(cause) == 4
    assert "does not move" in cause.what


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("increments", "turns"), [(1, 1), (8192, 0), (0, 1)])
def test_zero_increments_per_turn_give_no_angle(made, increments, turns):
    rig = made(canopen, 1.0)
    rig.node.store.values[0x608F01] = increments
    rig.node.store.values[0x608F02] = turns
    assert isinstance(rig.run(simulated=False, confirm_speed=rig.says(True)).cause, Enough)
    assert len(rig.asked) == 1
