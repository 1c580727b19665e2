"""Row 72: a serial line on which one in five replies is damaged, from a time in motion on; checks of the true shaft."""

import random

import pytest

from drivers.modbus.link import EmbeddedLink
from drivers.modbus.pdu import NoisyReply
from tests.faults.rehearsal import at, run


class Noise:
    """Line that damages a seeded share of the replies. The drive executes the requests."""

    def __init__(self, monkeypatch):
        self.share, self.damaged, self._random = 0.0, 0, random.Random(7)
        transact, noise = EmbeddedLink.transact, self

        def noisy(self, unit, pdu, timeout_s):
            reply = transact(self, unit, pdu, timeout_s)
            if noise._random.random() < noise.share:
                noise.damaged += 1
                raise NoisyReply("a reply with a wrong CRC", where=self.description)
            return reply

        monkeypatch.setattr(EmbeddedLink, "transact", noisy)


@pytest.mark.heavy
@pytest.mark.parametrize("profile", ["generic/modbus", "siemens/g120"])
def test_row_72_it_comes_to_rest_and_that_is_confirmed(profile, no_bus_of_the_user, monkeypatch, tmp_path, seen):
    """The cases are one request per cycle, and three at 19,200 baud."""
    noise = Noise(monkeypatch)

    def begin(_):
        noise.share = 0.2

    acted = at(monkeypatch, "speed", 8.0, begin)
    ended = run(tmp_path, "--drive", "modbus", "--profile", profile, "--rate", 15, "--mode", "speed")
    assert noise.damaged > 20
    assert ended.done.code in (0, 5, 9), ended.done.err
    assert "NOT confirmed" not in ended.done.err
    ended.shaft.assert_at_rest()
    ended.shaft.assert_never_let_go()
    seen(72, f"{profile}: the run {'goes on' if ended.done.code != 5 else 'is ended, standstill is seen'}",
         None if ended.done.code != 5 else ended.standstill_s(acted[0]), ended.assert_log_whole(), ended.done.code)
