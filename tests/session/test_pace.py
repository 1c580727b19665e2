"""Test of whether this computer sustains a rate in real time: measured with a disabled drive, and reported."""

from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from tdhil.config import resolve
from tdhil.session import PaceMeasured, connection_of, measure_pace


@pytest.mark.parametrize(("late", "holds", "words"), [
    (0, True, "sustains 100 cycles per second: 0 of 150"),
    (3, False, "does not sustain 100 cycles per second now: 3 of"),
])
def test_it_is_reported_with_its_limit(late, holds, words):
    found = PaceMeasured(100.0, 150, late, 0.012)
    assert found.holds is holds
    assert words in found.text and "half a period (5 ms)" in found.text and "12 ms" in found.text
    assert found.plain()["holds"] is holds


@pytest.mark.parametrize(("cycle_s", "late"), [(0.010, 0), (0.014, 0), (0.016, 150)])
def test_a_drive_without_delays_is_timed_from_cycle_to_cycle(monkeypatch, cycle_s, late):
    clock = SimpleNamespace(now_s=5.0)

    def exchange(_command: object) -> None:
        clock.now_s += cycle_s

    drive = SimpleNamespace(connect=lambda: None, preflight=lambda _: None, period_s=0.01, exchange=exchange)
    monkeypatch.setattr("tdhil.session.pace.time", SimpleNamespace(monotonic=lambda: clock.now_s))
    monkeypatch.setattr("tdhil.session.pace.opened_drive", lambda *_: nullcontext(drive))
    given = {"simulate": True, "real_time": True, "seed": 1}
    found = measure_pace(*connection_of(given, None, resolve(given, None)), None)
    assert (found.cycles, found.late) == (150, late)
    assert found.worst_s == pytest.approx(cycle_s - 0.01, abs=1e-9)


@pytest.mark.real_time
@pytest.mark.heavy
@pytest.mark.parametrize("drive", ["canopen", "modbus"])
def test_the_cycles_are_those_of_the_embedded_drive(drive):
    given = {"drive": drive, "simulate": True, "real_time": True, "seed": 1}
    options, connection = connection_of(given, None, resolve(given, None))
    found = measure_pace(options, connection, None)
    assert found.cycles == round(1.5 * found.rate_hz)
    assert 0 <= found.late <= found.cycles and found.worst_s >= 0.0
