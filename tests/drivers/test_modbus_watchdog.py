"""Feeding of a Modbus watchdog: a watchdog that any client feeds is refused without an override."""

import struct
from dataclasses import replace
from itertools import count, pairwise

import pytest

from drivers.clock import SteppedClock
from drivers.drive import Outcome
from drivers.errors import CommunicationLost
from drivers.modbus.cycle import Round
from drivers.modbus.watchdog import COUNT_S, measure_pace
from drivers.preflight import PreflightTable
from profiles.library import load_modbus_profile, load_profile, profile_names
from profiles.modbus import ModbusProfile
from tests.drivers.modbus_bank import TIME_OUT, Bank
from tests.drivers.test_modbus_preflight import LIMITS, changed, drive_on

GENERIC = load_modbus_profile("generic/modbus")
FLAG = "--accept-shared-watchdog"
BY_NAME = replace(LIMITS, accept_shared_watchdog=True)
SHARED = [("any_request", "verified"), ("unknown", "unverified"), ("control_word", "unverified")]
OURS = [("control_word", "verified"), ("writes", "likely"), ("requests_of_this_connection", "verified")]


class QuickClock(SteppedClock):
    """Clock for a drive that tdhil treats as a real one, without waits."""

    stepped = False


def fed_by(what, sure="verified", **update):
    return changed(GENERIC, watchdog={"fed_by": what, "fed_by_confidence": sure} | update)


def preflight(profile, limits=LIMITS, bank=None):
    bank = bank or Bank(marker=False)
    clock = QuickClock()
    drive = drive_on(bank, profile, clock=clock)
    drive.connect()
    return drive.preflight(limits)


def row(found):
    (check,) = [check for check in found.checks if check.name == "watchdog fed by"]
    return check


@pytest.mark.parametrize(("what", "sure"), SHARED)
def test_any_client_feeds_it_and_that_is_refused(what, sure):
    found = preflight(fed_by(what, sure))
    (check,) = found.refused
    assert check == row(found) and found.fed_by_any_client
    assert what.replace("_", " ") in check.found and "will not stop by itself" in check.found
    assert "cannot detect such a client" in check.found
    assert FLAG in check.next_step


@pytest.mark.parametrize(("what", "sure"), SHARED)
def test_accepted_by_override(what, sure):
    found = preflight(fed_by(what, sure), BY_NAME)
    assert not found.refused and found.fed_by_any_client and found.watched
    assert row(found).outcome is Outcome.NOTE and FLAG in row(found).found


@pytest.mark.parametrize(("what", "sure"), OURS)
def test_a_watchdog_that_readers_do_not_feed_is_accepted(what, sure):
    found = preflight(fed_by(what, sure))
    assert not found.refused and not found.fed_by_any_client


def test_another_override_does_not_accept_it():
    assert preflight(fed_by("any_request"), replace(LIMITS, accept_no_watchdog=True)).refused


def test_a_simulated_drive_reports_it_and_needs_no_override():
    found = preflight(fed_by("any_request"), bank=Bank())
    assert not found.refused and found.fed_by_any_client
    assert "any request" in row(found).found and row(found).outcome is Outcome.NOTE


class Counting(Bank):
    """Bank that counts requests for function 8 and register 55. Each request comes with ``others`` foreign ones."""

    def __init__(self, others, diagnostics=True):
        super().__init__(marker=False)
        self.others, self.diagnostics, self.count = others, diagnostics, 65530
        self.words[55] = 0

    def answer(self, pdu):
        self.count += 1 + self.others
        self.words[55] = self.count & 0xFFFF
        if pdu[0] == 8 and self.diagnostics:
            assert pdu == bytes.fromhex("08 000e 0000")
            return struct.pack(">BHH", 8, 14, self.count & 0xFFFF)
        return super().answer(pdu)


@pytest.mark.parametrize("by", ["function 8", "register"])
@pytest.mark.parametrize("others", [0, 2])
def test_a_drive_that_counts_shows_another_client(by, others):
    register = {"address": 55, "type": "u16"} if by == "register" else None
    profile = fed_by("any_request", request_counter=register)
    found = row(preflight(profile, bank=Counting(others, diagnostics=by == "function 8"))).found
    if others:
        assert f"Another client is active: it sent 96 requests in {COUNT_S:g} s" in found
    else:
        assert "No other client sent a request within 3 s" in found


def test_counting_keeps_the_armed_watchdog_fed():
    """It is armed during the count, so no pause between requests is as long as its time."""
    bank, times = Counting(0), []
    clock = QuickClock()
    serve = bank.serve

    def timed(unit, pdu, now_s):
        times.append(now_s)
        return serve(unit, pdu, now_s)

    bank.serve = timed
    drive = drive_on(bank, fed_by("any_request"), clock=clock)
    drive.connect()
    drive.preflight(LIMITS)
    assert bank.words[TIME_OUT] == 500
    assert max(b - a for a, b in pairwise(times)) < LIMITS.watchdog_s


@pytest.mark.parametrize(("every", "refused"), [(1, True), (4, True), (5, False)])
def test_a_line_that_loses_a_quarter_of_its_cycles_is_refused(every, refused):
    asked, now_s = count(1), count(0.0, 0.01)

    def go():
        if next(asked) % every == 0:
            raise CommunicationLost("no reply", where="line", next_step="Check it")
        return Round({}, 0.0, 0.002, 0.002)

    table = PreflightTable()
    pace = measure_pace(table, "line", 10.0, 0.5, "5 requests", go, lambda: next(now_s))
    assert (table.checks[-1].outcome is Outcome.REFUSED) is refused
    assert pace.period_s == pytest.approx(0.1)
    assert not refused or "cycles failed" in table.checks[-1].found


def test_every_profile_that_ships_says_what_feeds_it():
    for name in profile_names():
        profile = load_profile(name)
        if isinstance(profile, ModbusProfile):
            assert profile.watchdog.fed_by != "unknown", name
