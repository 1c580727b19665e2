"""Cycle on a test bank, in stepped time: faults during a run, and the time of a sample."""

import json

import pytest

from drivers.clock import SteppedClock
from drivers.drive import Command, DriveLimits, Mode, PowerState
from drivers.errors import CommandRejected, CommunicationLost, DriveFault
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from drivers.modbus.pdu import CycleRefused, LinkLost, NoisyReply, NoReply
from profiles.library import load_modbus_profile
from profiles.modbus import ModbusProfile
from tests.drivers.modbus_bank import CONTROL, MODE, SPEED, STATUS, Bank, high_and_low
from tests.drivers.power_machine import OFF, STOPPING

LIMITS = DriveLimits(speed_rad_s=15.0, torque_nm=300.0, quick_stop_rad_s2=1.0, watchdog_s=0.5)
GENERIC = load_modbus_profile("generic/modbus")
PERIOD_S = 0.01


class Run:
    """Drive on a bank, after preflight."""

    def __init__(self, profile=GENERIC, bank=None, **options):
        self.bank, self.clock = bank or Bank(**options), SteppedClock()
        self.link = EmbeddedLink(self.bank.serve, self.clock)
        self.drive = ModbusDrive(self.link, profile, unit=1)
        self.drive.connect()
        assert self.drive.preflight(LIMITS).refused == ()
        self.bank.writes.clear()
        self.bank.requests.clear()

    def cycle(self, speed=1.0, torque=0.0, mode=Mode.SPEED):
        return self.drive.exchange(Command(mode, speed, torque))

    def enabled(self, mode=Mode.SPEED):
        self.drive.enable(mode)
        for _ in range(4):
            sample = self.cycle(mode=mode)
        assert (sample.state, sample.mode) == (PowerState.ENABLED, mode)
        return self

    def controlwords(self):
        return [words[CONTROL - address] for address, words in self.bank.writes if address == CONTROL]


def profile_with(**sections):
    data = GENERIC.model_dump(by_alias=True)
    for section, change in sections.items():
        data[section] |= change
    return ModbusProfile.model_validate_json(json.dumps(data))


def errors(run, cycles):
    """Return (cycle, error) of every error."""
    found = []
    for k in range(cycles):
        try:
            run.cycle()
        except (CommunicationLost, DriveFault) as error:
            found.append((k, error))
    return found


def test_the_words_on_the_way_to_enabled_and_off():
    run = Run().enabled()
    run.drive.quick_stop()
    run.cycle()
    run.cycle()
    assert run.bank.machine.state == STOPPING
    run.drive.disable()
    run.cycle(0.0)
    run.cycle(0.0)
    assert run.controlwords() == [0x00, 0x06, 0x07, 0x0F, 0x02, 0x02, 0x00, 0x00]
    assert all(request[0] == 23 for request in run.bank.requests)       # one transaction per cycle


def test_time_is_the_middle_of_the_transaction():
    run = Run(takes_s=0.006)
    before_s = run.clock.now_s()
    first, second = run.cycle(), run.cycle()
    assert run.drive.period_s == PERIOD_S
    assert (first.half_width_s, first.age_s, first.fresh) == (pytest.approx(0.003), pytest.approx(0.003), True)
    assert before_s < first.time_s
    assert second.time_s - first.time_s == pytest.approx(PERIOD_S)
    assert run.drive.counters.overruns == 0


def test_speed_and_torque_of_two_transactions_are_of_both():
    """Reads of 17+2 and 19 are separate. The half-width covers both and the time between."""
    split = profile_with(cycle={"functions": [3, 6, 16], "largest_read": 3})
    run = Run(split, takes_s=0.002)
    sample = run.cycle()
    assert [request[0] for request in run.bank.requests] == [16, 3, 3]
    assert sample.half_width_s == pytest.approx(0.002)


def test_feedback_in_si():
    run = Run()
    run.bank.feedback = lambda: (-70_000, -250)
    sample = run.cycle()
    assert sample.speed_rad_s == pytest.approx(-73.3038286)         # 700 rpm
    assert sample.torque_nm == pytest.approx(-200.0)
    assert sample.torque_demand_nm is None


def test_one_lost_reply_is_one_missed_sample():
    run = Run().enabled()
    run.bank.feedback = lambda: (1000, 100)
    good = run.cycle()
    run.bank.script = [lambda reply: None]
    missed = run.cycle()
    assert not missed.fresh
    assert missed.speed_rad_s == good.speed_rad_s
    after = run.cycle()
    assert after.fresh
    assert after.state is PowerState.ENABLED
    assert run.drive.counters.missed == 1
    assert run.drive.counters.cycles == 7


def test_a_reply_that_comes_too_late_is_dropped_and_counted():
    run = Run().enabled()
    run.bank.takes_s = 0.2
    assert not run.cycle().fresh
    run.bank.takes_s = 0.0
    assert run.cycle().fresh
    assert (run.drive.counters.late, run.drive.counters.missed) == (1, 1)


@pytest.mark.parametrize("rubbish", [
    lambda reply: reply[:-1], lambda reply: bytes((3, *reply[1:])), lambda reply: b"", lambda reply: reply + b"\0",
])
def test_rubbish_is_a_missed_sample(rubbish):
    run = Run().enabled()
    run.bank.script = [rubbish]
    assert not run.cycle().fresh
    assert run.cycle().fresh


def test_silence_ends_within_half_the_watchdogs_time_and_is_said_once():
    run = Run().enabled()
    begun_s = run.clock.now_s()
    run.bank.silent = True
    (found,) = errors(run, 40)
    assert isinstance(found[1], CommunicationLost)
    assert "no good reply" in found[1].what
    run.bank.silent, run.bank.requests = False, []
    run.bank.writes.clear()
    for _ in range(5):
        run.cycle()
    # After the return of the line there is no enable and no motion without a request.
    assert 0x0F not in run.controlwords()
    assert run.bank.machine.state == STOPPING
    assert begun_s < run.clock.now_s()


def test_the_budget_for_retries():
    run = Run().enabled()
    run.bank.silent = True
    last_good_s = run.clock.now_s()
    for _ in range(100):
        try:
            run.cycle()
        except CommunicationLost:
            break
    # Raised before the drive's own watchdog (0.5 s) would act.
    assert 0.25 <= run.clock.now_s() - last_good_s <= 0.4


@pytest.mark.parametrize("code", [1, 2, 3, 4])
def test_an_exception_in_the_cycle_is_raised_once(code):
    run = Run().enabled()
    run.bank.refuse = {23: code}
    ((k, error),) = errors(run, 20)
    assert k == 0
    assert isinstance(error, CycleRefused)
    assert error.code == code
    assert "23 writes 0+5 reads 16+5" in error.where


def test_busy_is_asked_again_within_the_cycle():
    run = Run().enabled()
    run.bank.script = [lambda reply: bytes((0x97, 6))] * 2
    assert run.cycle().fresh
    assert run.drive.counters.missed == 0


def test_busy_for_good_counts_as_lost():
    run = Run().enabled()
    run.bank.refuse = {23: 6}
    ((k, error),) = errors(run, 60)
    assert k > 3
    assert isinstance(error, CommunicationLost)
    assert "busy" in error.what


def test_a_fault_is_raised_once_and_never_reset():
    run = Run().enabled()
    run.bank.machine.fail()
    ((_, error),) = errors(run, 20)
    assert isinstance(error, DriveFault)
    assert "--reset-fault" in error.next_step
    sample = run.cycle()
    assert sample.state is PowerState.FAULT
    assert not any(word & 0x80 for word in run.controlwords())


def test_a_fault_reaction_is_no_fault_yet():
    """The drive brakes with its power stage on. The error is raised once, and the drive is not disabled."""
    run = Run().enabled()
    run.bank.feedback = lambda: (3000, 0)
    run.cycle()
    run.bank.on_show = lambda words: words.update({STATUS: 0x021F})
    run.bank.writes.clear()
    ((_, error),) = errors(run, 20)
    assert isinstance(error, DriveFault) and "fault reaction, status 021Fh" in error.what
    assert run.cycle().state is PowerState.FAULT_REACTION
    run.drive.quick_stop()
    for _ in range(20):
        run.cycle()
    run.drive.disable()
    run.cycle()
    words = run.controlwords()
    assert set(words[1:]) == {0x0002}                 # quick stop; the first word was sent before the state was known
    run.bank.on_show = lambda words: words.update({STATUS: 0x0218})
    assert run.cycle().state is PowerState.FAULT
    assert not any(word & 0x80 for word in run.controlwords())


def test_a_drive_that_left_operation_is_not_enabled_again():
    run = Run().enabled()
    run.bank.machine.state = OFF
    for _ in range(10):
        sample = run.cycle()
    assert sample.state is PowerState.OFF
    assert run.controlwords()[-8:] == [0] * 8


@pytest.mark.parametrize(("status", "speed"), [(0x0000, 0), (0x0000, 3000), (0xFFF7, 3000), (0x0223, 3000)])
def test_one_status_word_that_makes_no_sense_lets_no_shaft_go(status, speed):
    """A gateway shows zeros or another state for one cycle, while the drive is in operation."""
    run = Run().enabled()
    run.bank.feedback = lambda: (3000, 0)
    run.cycle()
    run.bank.on_show = lambda words: words.update({STATUS: status, SPEED: 0, SPEED + 1: speed})
    assert run.cycle().state in (PowerState.UNKNOWN, PowerState.READY)
    run.cycle()
    run.drive.quick_stop()
    run.cycle()
    run.bank.on_show = lambda words: None
    states = set()
    for _ in range(5):
        run.cycle()
        states.add(run.bank.machine.state)
    assert states == {STOPPING}


def test_a_drive_that_was_enabled_and_shows_no_state_is_left_to_its_watchdog():
    run = Run().enabled()
    run.bank.on_show = lambda words: words.update({STATUS: 0, SPEED + 1: 3000})
    run.cycle()
    run.drive.quick_stop()
    run.cycle()
    run.bank.writes.clear()
    assert any("not confirmed that the drive is disabled" in line for line in run.drive.close())
    assert run.bank.writes == []


def test_a_drive_that_is_switched_to_another_control_place_ends_the_run():
    run = Run().enabled()
    run.bank.on_show = lambda words: words.update({STATUS: words[STATUS] & ~0x0200})
    ((_, error),) = errors(run, 20)
    assert "does not show remote control" in error.what


def test_a_turning_shaft_is_braked_before_it_is_disabled():
    run = Run().enabled()
    run.bank.feedback = lambda: (3000, 0)
    run.cycle()
    run.drive.disable()
    for _ in range(5):
        run.cycle()
    assert run.bank.machine.state == STOPPING
    run.bank.feedback = lambda: (0, 0)
    run.cycle()
    run.cycle()
    assert run.bank.machine.state == OFF


def test_standstill_from_the_speed_needs_time():
    run = Run().enabled()
    run.bank.feedback = lambda: (300, 0)
    assert not run.cycle().standstill
    run.bank.feedback = lambda: (0, 0)
    seen = [run.cycle().standstill for _ in range(30)]
    assert seen.index(True) == 19       # 20 cycles of 10 ms
    for lost, unsaid in ((1, False), (2, False), (3, True)):
        run.bank.refuse = {23: 6}                                       # busy: no reply to this cycle
        assert not any(run.cycle().standstill for _ in range(lost))     # without a reply the state is unknown
        run.bank.refuse = {}
        assert run.cycle().standstill is not unsaid
        seen = [run.cycle().standstill for _ in range(30)]


def test_creeping_is_no_standstill():
    run = Run().enabled()
    run.bank.feedback = lambda: (40, 0)         # 0.042 rad/s, within the noise allowed for one sample
    assert not any(run.cycle().standstill for _ in range(50))


def test_standstill_as_the_drive_reports():
    said = profile_with(control={"standstill": {"mask": 0x1000, "value": 0}})
    run = Run(said)
    assert run.cycle().standstill is not bool(run.cycle().status & 0x1000)


def test_the_word_after_a_stall_is_a_quick_stop():
    """On a CiA 402 bus the stop does this. The contract tests cover the rest of a frozen loop."""
    run = Run().enabled()
    run.clock.wait_until(run.clock.now_s() + 0.3)
    with pytest.raises(CommunicationLost, match="stood still"):
        run.cycle()
    run.bank.writes.clear()
    run.cycle()
    assert run.controlwords() == [0x02]


def test_a_lost_line_is_reported_every_time_and_closing_does_not_raise():
    run = Run().enabled()

    def gone(unit, pdu, timeout_s):
        raise LinkLost("connection reset", where="wire")

    run.link.transact = gone
    assert len(errors(run, 5)) == 5
    left = run.drive.close()                   # the settings stay: the host does not know whether it is disabled
    assert len(left) == 6 and all("not restored" in line for line in left)
    assert run.bank.words[40] == 500        # the watchdog stays armed


def test_settings_that_could_not_be_restored_are_reported():
    run = Run()
    run.cycle()
    run.bank.refuse_at = {38: 4}
    left = run.drive.close()
    assert len(left) == 1
    assert "register 38" in left[0]
    assert run.bank.words[40] == 0


@pytest.mark.parametrize("display", [True, False])
def test_a_mode_that_was_lost_with_its_cycle_is_written_again_in_the_next_one(display):
    shown = {"register": {"address": 9}, "speed": 0, "torque": 1} if display else None
    apart = profile_with(modes={"register": {"address": 8, "type": "u16"}, "display": shown})
    bank = Bank()
    bank.on_show = lambda words: words.update({9: words[8]})
    run = Run(apart, bank).enabled()
    good = run.link.transact

    def lost(unit, pdu, timeout_s):
        raise NoReply("no reply in time")

    run.link.transact = lost
    assert run.cycle(1.0, 120.0, Mode.TORQUE).mode is Mode.SPEED
    run.link.transact = good
    bank.writes.clear()
    assert run.cycle(1.0, 120.0, Mode.TORQUE).mode is Mode.TORQUE
    assert [words for address, words in bank.writes if address == 8] == [[1]]


def test_mode_in_a_register_of_its_own_comes_after_the_seed():
    display = {"register": {"address": 9}, "speed": 0, "torque": 1}
    apart = profile_with(modes={"register": {"address": 8, "type": "u16"}, "display": display})
    bank = Bank()
    bank.on_show = lambda words: words.update({9: words[8]})
    run = Run(apart, bank).enabled()
    bank.writes.clear()
    bank.on_show = lambda words: None           # the display does not change
    for _ in range(30):
        sample = run.cycle(1.0, 120.0, Mode.TORQUE)
    assert sample.mode is Mode.SPEED
    seeds = [k for k, (address, _) in enumerate(bank.writes) if address == 0]
    switches = [k for k, (address, _) in enumerate(bank.writes) if address == 8]
    assert bank.writes[seeds[0]][1][3] == 150                   # 120 of 800 N·m
    assert seeds[0] < switches[0]
    assert len(switches) == 2                                   # requested again after 25 cycles
    bank.words[9] = 1
    assert run.cycle(1.0, 120.0, Mode.TORQUE).mode is Mode.TORQUE
    # Once confirmed, it is read occasionally only.
    bank.requests.clear()
    for _ in range(40):
        run.cycle(1.0, 120.0, Mode.TORQUE)
    assert sum(request[:3] == bytes((3, 0, 9)) for request in bank.requests) == 2


def test_mode_by_bits_of_the_control_word():
    bits = profile_with(
        control={"torque_bits": 0x0800},
        modes={"by": "control_bits", "register": None, "speed_value": None, "torque_value": None, "display": None},
    )
    run = Run(bits).enabled()
    assert run.cycle(1.0, 120.0, Mode.TORQUE).mode is Mode.TORQUE
    assert run.controlwords()[-2:] == [0x0F, 0x080F]
    assert all(address <= CONTROL and len(words) == 4 for address, words in run.bank.writes)
    assert MODE not in [address for address, _ in run.bank.writes]


def test_a_direction_bit_for_a_register_without_sign():
    data = GENERIC.model_dump(by_alias=True)
    data["control"]["reverse_bits"] = 0x4000
    data["cycle"]["speed_setpoint"]["register"]["type"] = "u32"
    profile = ModbusProfile.model_validate_json(json.dumps(data))
    run = Run(profile).enabled()
    run.cycle(-2.0)
    _, words = run.bank.writes[-1]
    assert words[0] == 0x400F
    assert words[1:3] == high_and_low(1910)         # 19.1 rpm
    run.cycle(0.0)
    assert run.controlwords()[-1] == 0x400F         # braked from its former direction
    run.cycle(2.0)
    assert run.controlwords()[-1] == 0x000F


def test_a_mode_that_was_not_prepared():
    drive = ModbusDrive(EmbeddedLink(Bank().serve, SteppedClock()), GENERIC, unit=1)
    with pytest.raises(CommandRejected):
        drive.exchange(Command(Mode.SPEED, 0.0, 0.0))


def test_every_pdu_is_tapped():
    bank, clock, frames = Bank(), SteppedClock(), []
    drive = ModbusDrive(EmbeddedLink(bank.serve, clock), GENERIC, unit=1, tap=frames.append)
    drive.connect()
    drive.preflight(LIMITS)
    drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    assert [frame.data for frame in frames if frame.outgoing] == bank.requests
    assert len([frame for frame in frames if not frame.outgoing]) == len(bank.requests)
    assert {frame.identifier for frame in frames} == {1}


@pytest.mark.parametrize(("damaged", "missed"), [(1, 0), (2, 1)])
def test_a_request_with_a_damaged_reply_is_repeated_within_the_cycle(damaged, missed):
    run = Run().enabled()
    transact, left = run.drive._link.transact, [damaged]

    def noisy(unit, pdu, timeout_s):
        reply = transact(unit, pdu, timeout_s)
        if pdu[0] == 23 and left[0]:
            left[0] -= 1
            raise NoisyReply("a reply with a wrong CRC", where="line")
        return reply

    run.drive._link.transact = noisy
    before = run.drive.counters.missed
    assert run.cycle().fresh is (missed == 0)
    assert run.drive.counters.missed - before == missed


def test_removing_the_torque_sends_the_word_for_coasting():
    """`off` is a ramp on some drives. It would not stop a shaft that accelerates against its quick stop."""
    run = Run(profile_with(control={"coast": 0x0005})).enabled()
    run.drive.quick_stop()
    run.cycle()
    run.drive.remove_torque()
    for _ in range(3):
        run.cycle()
    assert run.controlwords()[-3:] == [0x0005] * 3


OFF2, NO_COASTING = 0x0002, 0x0008      # PROFIdrive and the FC profile: the shaft coasts with 0 in this bit


@pytest.mark.parametrize(("name", "bit"), [
    ("siemens/g120", OFF2), ("siemens/g130-s120", OFF2), ("danfoss/fc302", NO_COASTING),
])
def test_a_profile_whose_off_is_a_ramp_has_a_word_to_coast(name, bit):
    control = load_modbus_profile(name).control
    assert control.off & bit and control.coast is not None and control.coast == control.off & ~bit
