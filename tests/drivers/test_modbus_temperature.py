"""Temperatures that a Modbus drive reports: monitoring, refusals, and the note without monitoring."""

from dataclasses import replace

import pytest

from drivers.drive import Command, Mode, Outcome, PowerState
from drivers.errors import LimitHit
from profiles.library import load_modbus_profile
from tests.drivers.modbus_bank import STATUS, Bank
from tests.drivers.test_modbus_preflight import LIMITS, drive_on, of

GENERIC = load_modbus_profile("generic/modbus")
CELSIUS = {"title": "motor", "register": {"address": 54}, "per_lsb": 0.1, "source": "own", "confidence": "verified"}
SHARE = CELSIUS | {"unit": "share", "per_lsb": 0.01, "at_most": 1.0}
BITS = {"title": "status, hot", "register": {"address": STATUS, "type": "u16"},
        "too_hot": {"mask": 0x4000, "value": 0x4000}, "source": "own", "confidence": "verified"}


def ready(temperatures, limit_c=None, counts=400):
    bank = Bank()
    bank.words[54] = counts
    drive = drive_on(bank, of(GENERIC.model_dump(by_alias=True) | {"temperatures": temperatures}), rate_hz=20.0)
    drive.connect()
    return bank, drive, drive.preflight(replace(LIMITS, temperature_c=limit_c))


def cycles(drive, number=100):
    for _ in range(number):
        sample = drive.exchange(Command(Mode.SPEED, 1.0, 0.0))
    return sample


def enabled(drive):
    drive.enable(Mode.SPEED)
    assert cycles(drive, 20).state is PowerState.ENABLED


@pytest.mark.parametrize(("entry", "limit_c", "hot", "words"), [
    (CELSIUS, 110.0, 1101, ("110.1 °C", "limit of 110 °C", "register 54")),
    (CELSIUS | {"at_most": 90.0}, 110.0, 901, ("90.1 °C", "limit of 90 °C")),
    (SHARE, None, 101, ("101 %", "limit of 100 %")),
])
def test_a_number_beyond_its_limit_stops_the_run_once(entry, limit_c, hot, words):
    bank, drive, found = ready([entry], limit_c, counts=50)
    assert not found.refused
    enabled(drive)
    cycles(drive)
    bank.words[54] = hot
    with pytest.raises(LimitHit) as caught:
        cycles(drive, 50)                  # within a little more than 2 s
    assert all(word in str(caught.value) for word in words)
    drive.quick_stop()
    cycles(drive)


def test_bits_of_the_status_word_are_seen_at_once():
    bank, drive, _ = ready([BITS])
    enabled(drive)
    bank.on_show = lambda words: words.update({STATUS: words[STATUS] | 0x4000})
    with pytest.raises(LimitHit, match="status, hot: too hot"):
        cycles(drive, 1)


def test_too_hot_already_is_refused():
    _, _, found = ready([CELSIUS], 110.0, counts=1200)
    (check,) = found.refused
    assert check.found == "120 °C" and check.wanted == "at most 110 °C"


def test_a_limit_without_monitoring_is_refused():
    _, _, found = ready([BITS], 110.0)
    assert [check.where for check in found.refused] == ["limits.temperature_c"]


@pytest.mark.parametrize("temperatures", [[], [CELSIUS]])
def test_without_monitoring_there_is_a_note(temperatures):
    _, _, found = ready(temperatures)
    assert not found.refused
    assert [check for check in found.checks if check.outcome is Outcome.NOTE and "not monitored" in check.found]
