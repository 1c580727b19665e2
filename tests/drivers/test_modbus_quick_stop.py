"""`drivers.modbus.quick_stop` on simulated drives that turn without a host; checks of the true shaft."""

import csv
import json
from dataclasses import replace

import pytest

from drivers.clock import SteppedClock
from drivers.drive import Command, Mode, PowerState
from drivers.modbus.link import EmbeddedLink
from drivers.modbus.quick_stop import ModbusTarget
from drivers.quick_stop import Ended, bare_stop
from profiles.library import load_profile, profile_names
from profiles.modbus import ModbusProfile
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from sim_bus.params import RigParams
from tests.drivers.modbus_bank import CONTROL, MODE, MODE_SHOWN, SPEED_SETPOINT, STATUS, Bank
from tests.drivers.modbus_bench import driven
from tests.drivers.power_machine import ENABLED, STOPPING
from tests.rigs import DRIVE_LIMITS

LIMITS = replace(DRIVE_LIMITS, watchdog_s=1.0)
MODBUS = [profile for name in profile_names() if isinstance(profile := load_profile(name), ModbusProfile)]
FAST_RAD_S = 4.0


class Left:
    """Drive in motion without a master."""

    def __init__(self, profile, mode, folder):
        self.trace = folder / "shaft.csv"
        self.clock = SteppedClock()
        self.simulated = EmbeddedModbusDrive(RigParams(), profile, trace=self.trace)
        self.profile = profile
        self.link = EmbeddedLink(self.simulated.serve, self.clock)
        drive = driven(self.simulated, profile, self.clock)
        drive.connect()
        assert not drive.preflight(LIMITS).refused
        drive.enable(Mode.SPEED)
        sample = None
        while sample is None or sample.speed_rad_s < FAST_RAD_S - 0.3:
            assert self.clock.now_s() < 60.0
            sample = drive.exchange(Command(Mode.SPEED, FAST_RAD_S, 0.0))
        while mode is Mode.TORQUE and sample.mode is not Mode.TORQUE:
            sample = drive.exchange(Command(Mode.TORQUE, FAST_RAD_S, sample.torque_nm))
        for _ in range(10):
            drive.exchange(Command(mode, FAST_RAD_S, 100.0))

    def rows(self):
        self.simulated.close()
        with self.trace.open() as file:
            return [(float(row[0]), float(row[1]), row[3]) for row in list(csv.reader(file))[1:]]


@pytest.mark.heavy(but_first=3)
@pytest.mark.parametrize(("profile", "mode"), [
    (profile, mode) for profile in MODBUS for mode in Mode if mode is Mode.SPEED or profile.modes.torque
], ids=lambda one: one.name)
def test_it_brakes_to_rest_and_never_lets_go(profile, mode, tmp_path):
    left = Left(profile, mode, tmp_path)
    began_s = left.clock.now_s()
    report = bare_stop(ModbusTarget(left.link, profile, unit=1), left.clock)
    assert report.ended is Ended.AT_REST, report
    after = [row for row in left.rows() if row[0] >= began_s]
    assert abs(after[0][1]) > 2.0
    free = {"switch on disabled", "ready to switch on", "switched on", "fault"}
    assert not [row for row in after if row[2] in free and abs(row[1]) > 0.1], "a turning shaft was disabled"
    assert abs(after[-1][1]) < 0.05 and left.clock.now_s() - began_s < 15.0
    said = any("speed mode at zero" in remark for remark in report.remarks)
    needed = profile.modes.torque and not profile.quick_stop.decelerates_in_torque_mode
    unknown = profile.modes.display is None            # then it is requested in any case
    assert said is (needed and (unknown or mode is Mode.TORQUE))


def test_a_drive_that_stays_in_torque_mode_gets_its_quick_stop_and_a_message(tmp_path):
    brakes = next(one for one in MODBUS if one.name == "siemens/g120")       # it displays its mode
    stop = brakes.quick_stop.model_copy(update={"decelerates_in_torque_mode": False})
    profile = brakes.model_copy(update={"quick_stop": stop})
    left = Left(profile, Mode.TORQUE, tmp_path)
    left.simulated.machine.application.keeps_mode = True
    report = bare_stop(ModbusTarget(left.link, profile, unit=1), left.clock)
    assert any("did not change to speed mode" in remark for remark in report.remarks)
    assert report.first is not None and abs(left.rows()[-1][1]) < 1.0


def test_a_drive_that_shows_a_state_nobody_knows_is_asked_all_the_same():
    bank, clock = Bank(), SteppedClock()
    bank.machine.state = ENABLED
    bank.feedback = lambda: (0 if bank.machine.state == STOPPING else 3000, 0)
    bank.on_show = lambda words: words.update({STATUS: 0xFFF7})
    target = ModbusTarget(EmbeddedLink(bank.serve, clock), load_profile("generic/modbus"), unit=1)
    assert bare_stop(target, clock).ended is Ended.AT_REST
    assert bank.machine.state == STOPPING


@pytest.mark.parametrize(("counts", "near"), [(4000, False), (60, False), (47, True), (-47, True), (0, True)])
def test_a_speed_in_known_units_is_near_zero_below_0_05_rad_s(counts, near):
    """A count of the unchanged profile is 0.01 rpm."""
    bank, clock = Bank(), SteppedClock()
    bank.feedback = lambda: (counts, 0)
    target = ModbusTarget(EmbeddedLink(bank.serve, clock), load_profile("generic/modbus"), unit=1)
    assert target.poll().near_zero is near


def test_a_fault_reaction_has_power_and_is_braked_on():
    """The quick-stop word is repeated while the shaft turns, because the watchdog of the drive might disable it."""
    bank, clock = Bank(), SteppedClock()
    bank.feedback = lambda: (3000, 0)
    bank.on_show = lambda words: words.update({STATUS: 0x021F})
    target = ModbusTarget(EmbeddedLink(bank.serve, clock), load_profile("generic/modbus"), unit=1)
    target.ask(1)
    assert target.poll().state is PowerState.FAULT_REACTION
    assert bank.writes == [(CONTROL, [0x0002])] * 2


@pytest.mark.parametrize("refused", [SPEED_SETPOINT, MODE, MODE_SHOWN])
def test_a_drive_that_refuses_speed_mode_gets_its_quick_stop_in_the_end(refused):
    bank, clock = Bank(), SteppedClock()
    bank.machine.state, bank.words[MODE] = ENABLED, 1
    bank.feedback = lambda: (0 if bank.machine.state == STOPPING else 3000, 0)
    bank.refuse_at[refused] = 2
    generic = load_profile("generic/modbus").model_dump(by_alias=True)
    generic["quick_stop"] |= {"decelerates_in_torque_mode": False}
    profile = ModbusProfile.model_validate_json(json.dumps(generic))
    report = bare_stop(ModbusTarget(EmbeddedLink(bank.serve, clock), profile, unit=1), clock)
    assert report.ended is Ended.AT_REST
    assert any("did not change to speed mode" in remark for remark in report.remarks)
