"""Another master writes to a Modbus drive: which register shows it, and cases that must not be reported."""

import struct

import pytest

from drivers.drive import Command, Mode, PowerState
from drivers.errors import CommandRejected, CommunicationLost
from profiles.library import load_modbus_profile
from tests.drivers.modbus_bank import CONTROL, MODE, SPEED_SETPOINT, TIME_OUT, TORQUE_SETPOINT, Bank
from tests.drivers.test_modbus_preflight import LIMITS, changed, drive_on

GENERIC = load_modbus_profile("generic/modbus")
RATE_HZ = 20.0
REACTION, TORQUE_LIMIT, QUICK_STOP = 41, 38, 39


class Run:
    """Enabled drive on a bank. ``foreign`` is written into the bank after each reply of the cycle."""

    def __init__(self, profile=GENERIC, bank=None, speed=2.0):
        self.bank = bank or Bank()
        self.foreign = {}
        self.drive = drive_on(self.bank, profile, rate_hz=RATE_HZ)
        self.drive.connect()
        assert not self.drive.preflight(LIMITS).refused
        serve = self.bank.serve

        def serving(unit, pdu, now_s):
            reply = serve(unit, pdu, now_s)
            if pdu[0] == 23:
                self.bank.words.update(self.foreign)
                self.bank.machine.obey(self.bank.words[CONTROL])
            return reply

        self.bank.serve = self.drive._link._serve = serving
        self.drive.enable(Mode.SPEED)
        self.speed = speed
        while self.cycle().state is not PowerState.ENABLED:
            pass
        self.cycles(20)

    def cycle(self, torque=0.0):
        return self.drive.exchange(Command(Mode.SPEED, self.speed, torque))

    def cycles(self, number):
        for _ in range(number):
            sample = self.cycle()
        return sample

    def lost(self, within_s):
        """Return the only error and its cycle."""
        with pytest.raises(CommunicationLost) as caught:
            self.cycles(round(within_s * RATE_HZ))
        return caught.value


@pytest.mark.parametrize(("words", "name", "other", "ours", "where"), [
    ({SPEED_SETPOINT: 0, SPEED_SETPOINT + 1: 4775}, "speed setpoint", "5 rad/s", "2 rad/s", "register 1"),
    ({TORQUE_SETPOINT: 500}, "torque setpoint", "400 N·m", "0 N·m", "register 3"),
    ({CONTROL: 0x010F}, "control word", "010Fh", "000Fh", "register 0"),
])
def test_foreign_words_are_reported_beside_ours(words, name, other, ours, where):
    run = Run()
    run.foreign = words
    error = run.lost(1.0)
    assert f"the {name} in the drive is {other}, and this run wrote {ours}" in error.what
    assert where in error.where and "other master" in error.next_step
    run.foreign = {}
    run.cycles(40)                                             # reported once, so that the stop continues


@pytest.mark.parametrize(("address", "value", "was", "now"), [
    (TIME_OUT, 0, "0.5 s", "0 s"), (REACTION, 0, "3", "0"), (TORQUE_LIMIT, 3000, "0.375", "3 of"),
    (QUICK_STOP, 5, "", ""),
])
def test_a_setting_that_changed_is_named(address, value, was, now):
    run = Run()
    run.bank.words[address] = value
    error = run.lost(3.0)
    assert f"register {address}" in error.where
    assert was in error.what and now in error.what and "changed a setting" in error.what


def test_a_run_without_another_master_raises_nothing():
    """The setpoints change every cycle, in both modes, and the adapter shows values of some cycles ago."""
    run = Run()
    late = []

    def lagging(words):
        late.append([words[at] for at in (0, 1, 2, 3)])

    run.bank.on_write = lambda address, words: lagging(run.bank.words)
    answer = run.bank.answer

    def answering(pdu):
        if pdu[:3] == bytes((3, 0, 0)) and len(late) > 4:
            count = struct.unpack(">H", pdu[3:])[0]
            return struct.pack(f">BB{count}H", 3, 2 * count, *late[-4][:count])
        return answer(pdu)

    run.bank.answer = answering
    for number in range(200):
        mode = Mode.TORQUE if number > 100 else Mode.SPEED
        run.drive.exchange(Command(mode, 0.01 * number, 1.5 * number))
    assert run.drive.counters.missed == 0


class WriteOnly(Bank):
    """Drive whose control word always reads as 0, or whose words cannot be read."""

    def __init__(self, how):
        super().__init__()
        self.how = how

    def answer(self, pdu):
        reply = super().answer(pdu)
        if pdu[0] != 3 or struct.unpack(">H", pdu[1:3])[0] > TORQUE_SETPOINT:
            return reply
        if self.how == "refused":
            return bytes((0x83, 2))
        return reply[:2] + bytes(2) + reply[4:] if pdu[1:3] == bytes(2) else reply


@pytest.mark.parametrize("how", ["zero", "refused"])
def test_a_drive_that_does_not_show_its_words_raises_nothing(how):
    assert Run(bank=WriteOnly(how)).cycles(100).fresh


def test_read_backs_are_rare_and_do_not_delay_the_cycle():
    """Read-backs come at most ten times per second, before the request of the cycle. A missing reply has no effect."""
    run = Run()
    run.bank.requests.clear()
    run.cycles(round(10.0 * RATE_HZ))
    looks = [pdu for pdu in run.bank.requests if pdu[0] == 3]
    assert 70 <= len(looks) <= 101
    answer = run.bank.answer
    run.bank.answer = lambda pdu: b"\x99" if pdu[0] == 3 else answer(pdu)
    assert run.cycles(20).fresh and run.drive.counters.missed == 0


def test_a_slow_line_has_fewer_read_backs():
    bank = Bank(takes_s=0.03)
    run = Run(changed(GENERIC, watchdog={}), bank)
    run.bank.requests.clear()
    began_s = run.drive.clock.now_s()
    while run.drive.clock.now_s() < began_s + 10.0:
        run.cycle()
    assert sum(pdu[0] == 3 for pdu in run.bank.requests) <= 21


def test_the_stop_word_is_repeated_against_another_master_that_continues():
    """It is repeated within the period as often as the line permits. A new enable is reported too."""
    run = Run(bank=Bank(takes_s=0.002))
    run.foreign = {CONTROL: 0x000F}
    run.drive.quick_stop()
    with pytest.raises(CommunicationLost, match="another master"):
        run.cycles(20)
    run.bank.requests.clear()
    run.cycle()
    words = [struct.unpack(">H", pdu[10:12])[0] for pdu in run.bank.requests if pdu[0] == 23]
    assert 15 <= len(words) <= 25 and set(words) <= {0x0002, 0x0000}


def test_silence_is_refused_where_the_other_master_feeds_the_watchdog_too():
    run = Run()
    run.foreign = {SPEED_SETPOINT + 1: 4775}
    run.lost(1.0)
    with pytest.raises(CommandRejected, match="also feeds the drive's watchdog"):
        run.drive.stop_feeding()


@pytest.mark.parametrize(("fed_by", "silent_s"), [
    ("control_word", 0.0), ("writes_of_this_connection", 0.0), ("any_request", 0.75),
    ("requests_of_this_connection", 0.75),
])
def test_left_to_its_watchdog_the_drive_is_only_read(fed_by, silent_s):
    """It is not read while reading feeds the watchdog. Then it is read again, and disabled at standstill."""
    profile = changed(GENERIC, watchdog={"fed_by": fed_by, "fed_by_confidence": "verified"})
    run = Run(profile)
    run.drive.quick_stop()
    run.bank.feedback = lambda: (1000, 0)
    run.cycles(3)
    run.drive.stop_feeding()
    began_s, run.bank.requests[:] = run.drive.clock.now_s(), []
    while run.drive.clock.now_s() < began_s + 3.0:
        before = len(run.bank.requests)
        sample = run.cycle()
        quiet = run.drive.clock.now_s() - began_s < silent_s - 0.01
        assert (len(run.bank.requests) == before) is quiet and sample.fresh is not quiet
    assert all(pdu[0] in (3, 4) for pdu in run.bank.requests)
    run.bank.feedback = lambda: (0, 0)
    run.cycles(20)
    run.drive.disable()
    assert run.cycles(20).state is PowerState.OFF


def test_left_to_its_watchdog_the_torque_is_removed_at_any_speed():
    """The watchdog brakes with the drive's speed control, which may be what accelerates the shaft."""
    run = Run(changed(GENERIC, watchdog={"fed_by": "control_word", "fed_by_confidence": "verified"}))
    run.drive.quick_stop()
    run.bank.feedback = lambda: (1000, 0)
    run.cycles(3)
    run.drive.stop_feeding()
    run.drive.remove_torque()
    assert run.cycles(5).state is PowerState.OFF


def test_a_foreign_change_of_the_mode_does_not_hide_the_words():
    run = Run()
    run.foreign = {MODE: 1, TORQUE_SETPOINT: 100}
    assert "torque setpoint" in run.lost(1.0).what
