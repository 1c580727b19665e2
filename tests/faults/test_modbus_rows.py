"""Rows 38 to 45 of the fault table on the whole path: line faults, and a drive that differs from its description."""

from functools import partial

import pytest

from sim_bus.modbus import embedded
from sim_bus.modbus.wrong_maps import parse
from tests.faults.rehearsal import at, run

MODBUS = ("--drive", "modbus")
WATCHDOG_S = 0.5
NOTICED_S = WATCHDOG_S + 0.1
"""Longest detection time: half of the watchdog time by the host, or all of it by the drive, plus five cycles."""


READS = (0x03, 0x04)
"""Function codes that only read."""


class Line:
    """Line between driver and simulated drive; ``becomes(serve, unit, pdu, now_s)`` → (reply or None, end time)."""

    def __init__(self, monkeypatch):
        self.becomes, self.left, self.writes_only = None, 0, False
        serve = embedded.EmbeddedModbusDrive.serve
        line = self

        def passing(self, unit, pdu, now_s):
            if line.becomes is None or line.left <= 0 or (line.writes_only and pdu[0] in READS):
                return serve(self, unit, pdu, now_s)
            line.left -= 1
            return line.becomes(partial(serve, self), unit, pdu, now_s)

        monkeypatch.setattr(embedded.EmbeddedModbusDrive, "serve", passing)

    def begin(self, becomes, requests):
        """Change this many requests. A single one is a write of the cycle, since a check of settings is repeated."""
        self.becomes, self.left, self.writes_only = becomes, requests, requests == 1


def refusing(code):
    """Reply with an exception; the drive does nothing (Modbus application protocol V1.1b3, section 7)."""
    return lambda serve, unit, pdu, now_s: (bytes((pdu[0] | 0x80, code)), now_s + 0.001)


def silent(serve, unit, pdu, now_s):
    """Lose request and reply."""
    return None, now_s


def late(serve, unit, pdu, now_s):
    """Deliver the reply after the time-out of the host; the drive executes the request."""
    reply, complete_s = serve(unit, pdu, now_s)
    return reply, complete_s + 1.0


def cut(serve, unit, pdu, now_s):
    """Deliver half of the reply; the drive executes the request."""
    reply, complete_s = serve(unit, pdu, now_s)
    return reply[: len(reply) // 2], complete_s


def foreign(serve, unit, pdu, now_s):
    """Deliver the reply to a request of another master."""
    reply, complete_s = serve(unit, pdu, now_s)
    return bytes((reply[0] ^ 7,)) + reply[1:], complete_s


@pytest.fixture
def line(no_bus_of_the_user, monkeypatch):
    return Line(monkeypatch)


ENDS = [
    (38, "exception 1", refusing(1), 1, 6, ("exception 1", "function")),
    (38, "exception 2", refusing(2), 1, 6, ("exception 2", "address")),
    (38, "exception 3", refusing(3), 1, 6, ("exception 3", "value")),
    (38, "exception 4", refusing(4), 1, 6, ("exception 4", "panel")),
    # It replies and cannot be stopped: the message asks for the hard-wired emergency stop.
    (38, "exception 2 for good", refusing(2), 10**9, 8, ("exception 2", "address")),
    (38, "busy for good", refusing(6), 10**9, 8, ("no ", "watchdog")),
    (39, "silence", silent, 10**9, 8, ("no ", "watchdog")),
    (40, "every reply late", late, 10**9, 8, ("no ", "watchdog")),
    (42, "every reply cut short", cut, 10**9, 8, ("no ", "watchdog")),
]


IN_STAGES = [(*case, "speed") for case in ENDS] + [(*case, "acquire") for case in ENDS if case[1] in (
    "exception 1", "silence", "every reply cut short")]


AT_ONCE = ("exception 1", "exception 2 for good", "silence", "every reply cut short")
"""Cases of the README's command; CI runs the others. tests/drivers/test_modbus_wrongs.py has all, without a run."""


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(
    ("row", "name", "becomes", "requests", "code", "words", "stage"), [
        pytest.param(*case, id=f"{case[1]} in {case[-1]}",
                     marks=() if case[1] in AT_ONCE and case[-1] == "speed" else pytest.mark.heavy)
        for case in IN_STAGES
    ],
)
def test_it_ends_with_the_shaft_at_rest(
    row, name, becomes, requests, code, words, stage, line, monkeypatch, tmp_path, seen
):
    acted = at(monkeypatch, stage, 8.0 if stage == "speed" else 3.0, lambda _: line.begin(becomes, requests))
    ended = run(tmp_path, *MODBUS)
    ended.assert_ended(code, *words)
    standstill_s = ended.assert_stopped(acted[0], NOTICED_S)
    assert ended.shaft.speed_at(acted[0]) > 0.3, "the fault did not occur in motion"
    # The report states that standstill is not confirmed, since the drive does not reply.
    assert ("NOT confirmed" in ended.done.document["stop"]) is (requests > 1)
    seen(row, f"{name}: {ended.message}", standstill_s, ended.assert_log_whole(), ended.done.code)


SURVIVES = [
    (38, "busy, twice", refusing(6), 2),
    (39, "one lost reply", silent, 1),
    (40, "one late reply", late, 1),
    (42, "one reply cut short", cut, 1),
    (42, "one reply of another function", foreign, 1),
]


# tests/drivers/test_modbus_drive.py has all five of them, cycle by cycle.
@pytest.mark.parametrize(("row", "name", "becomes", "requests"), [
    pytest.param(*case, id=case[1],
                 marks=pytest.mark.heavy if case[1] == "one late reply" else pytest.mark.long)
    for case in SURVIVES
])
def test_it_is_survived(row, name, becomes, requests, line, monkeypatch, tmp_path, seen):
    acted = at(monkeypatch, "acquire", 5.0, lambda _: line.begin(becomes, requests))
    ended = run(tmp_path, *MODBUS)
    assert acted and line.left == 0
    assert ended.done.code in (0, 9), ended.done.err       # three periods: the uncertainty of J does not matter here
    assert [outcome for _, outcome in ended.done.outcomes] == ["ok"] * 5
    ended.shaft.assert_at_rest()
    seen(row, name, None, ended.assert_log_whole(), ended.done.code)


REFUSED = [
    (44, "word_order"), (44, "scale_10"), (44, "address_off_by_one"), (44, "sign"), (44, "unsigned"),
    (45, "write_not_applied"), (45, "reads_back_something_else:torque_limit"),
]


@pytest.mark.parametrize(("row", "wrong"), REFUSED, ids=[case[1] for case in REFUSED])
def test_it_is_refused_before_motion(row, wrong, no_bus_of_the_user, monkeypatch, tmp_path, seen):
    wired = partial(embedded.EmbeddedModbusDrive, wrongs=(parse(wrong),))
    monkeypatch.setattr(embedded, "EmbeddedModbusDrive", wired)
    ended = run(tmp_path, *MODBUS)
    ended.assert_ended(4)
    ended.assert_nothing_moved()
    seen(row, f"{wrong}: {ended.message}", None, ended.assert_log_whole(), ended.done.code)
