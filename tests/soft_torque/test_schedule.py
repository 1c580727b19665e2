"""Gain schedule over depth: each row equals the tuning at that depth, and interpolated gains are checked."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tdhil.report import schedule_document
from tdhil.soft_torque import (
    DepthRow,
    DepthSchedule,
    DrawnValues,
    Interval,
    LoopMargins,
    RequiredMargins,
    SpeedController,
    TuneCase,
    at_depth,
    draw_truths,
    loop_margins,
    schedule,
    string_modes_hz,
    tune,
)
from tests.soft_torque.cases import DRIVE, STRING

J = Interval(1500.0, 1440.0, 1560.0)
CASE = TuneCase(STRING, DRIVE, J, draws=8)
DEPTHS_M = (1500.0, 2250.0, 3000.0)


@pytest.fixture(scope="module")
def scheduled():
    return schedule(CASE, DEPTHS_M, "soft", simulated=False)


def test_the_topmost_section_gets_the_change_of_depth():
    assert at_depth(STRING, 1200.0).lines[0].length_m == 1200.0
    collars = replace(STRING, lines=(STRING.lines[0], replace(STRING.lines[0], length_m=200.0)))
    assert [line.length_m for line in at_depth(collars, 1000.0).lines] == [800.0, 200.0]
    with pytest.raises(ValueError, match="200 m long"):
        at_depth(collars, 150.0)


@pytest.mark.heavy
def test_a_row_equals_the_tuning_at_that_depth(scheduled):
    """The row at the stated length has the gains of `tune`. Integral gain and mode decrease with depth."""
    alone = tune(CASE, search=None).by_kind("soft").controller
    assert scheduled.rows[-1].controller == alone
    gains = [row.controller.integral_nm_rad for row in scheduled.rows]
    assert gains == sorted(gains, reverse=True)
    assert [row.mode_hz for row in scheduled.rows] == [string_modes_hz(at_depth(STRING, one))[0] for one in DEPTHS_M]


@pytest.mark.heavy
def test_rows_keep_the_margins_and_interpolated_gains_are_checked(scheduled):
    """Interpolated gains are the mean of both neighbours. Their margins are those of `loop_margins` on each truth."""
    assert not any(row.failed for row in scheduled.rows)
    assert [row.depth_m for row in scheduled.between] == [1875.0, 2625.0]
    for k, row in enumerate(scheduled.between):
        neighbours = [one.controller.gain_nm_s_rad for one in scheduled.rows[k : k + 2]]
        assert row.controller.gain_nm_s_rad == pytest.approx(sum(neighbours) / 2.0)
        truths = draw_truths(at_depth(STRING, row.depth_m), DRIVE, J, count=8, lag_tolerance=CASE.lag_tolerance)
        least = min(loop_margins(one.drive, row.controller, one.string).phase_deg for one in truths)
        assert row.worst.phase_deg == pytest.approx(least, abs=0.5)
        assert bool(row.failed) is bool(RequiredMargins().failed(row.worst))


@pytest.mark.heavy
def test_critical_speeds_are_beside_those_of_the_present_gains():
    """The row at 1,500 m has a lower critical speed than the present gains of the rig."""
    case = replace(CASE, present=SpeedController(4000.0, 3000.0), draws=6)
    (row,) = schedule(case, (1500.0,), "soft").rows
    assert row.cure.median < row.compared.median


def sentence_of(between, speeds):
    """Return the sentence of the report on rows at 1, 2 and 3 km, with (depth, phase, speed, failed) between them."""
    def row(depth_m, speed_rpm, phase_deg=60.0, failed=()):
        return DepthRow(depth_m, 0.13, SpeedController(800.0, 700.0), worst=replace(MARGINS, phase_deg=phase_deg),
                        failed=failed, cure=DrawnValues((speed_rpm,)))

    rows = tuple(row(1000.0 * (k + 1), speed) for k, speed in enumerate(speeds))
    halfway = tuple(row(depth, speed, phase, failed) for depth, phase, speed, failed in between)
    found = DepthSchedule("soft", "stiff", rows, halfway)
    return schedule_document(found, 1.0, lambda law: ())["sentence"]


MARGINS = LoopMargins(True, 60.0, 12.0, 0.1, 0.1, 0.5)


def test_the_sentence_states_the_worst_case_between_the_depths():
    """The worst case is the least phase, and the largest rise above the higher one of both neighbours."""
    calm = sentence_of(((1500.0, 41.0, 52.0, ()), (2500.0, 55.0, 41.0, ())), (50.0, 52.0, 40.0))
    assert calm == ("Interpolated halfway between rows: least phase margin 41° (at 1500 m); critical speed nowhere "
                    "above that of the neighbouring rows.")
    worse = sentence_of(((1500.0, 55.0, 52.0, ()), (2500.0, 28.0, 65.0, ("phase margin 28° (limit 30°)",))),
                        (50.0, 52.0, 40.0))
    assert worse == ("Interpolated halfway between rows: least phase margin 28° (at 2500 m), margins too small at 2500 "
                     "m; critical speed at most 25 % above that of the neighbouring rows (at 2500 m).")
    assert sentence_of((), (50.0,)).startswith("No two neighbouring depths have gains")


@pytest.mark.heavy
def test_a_depth_without_gains_that_keep_the_margins_is_reported():
    strict = replace(CASE, required=RequiredMargins(89.0, 30.0, 1.0))
    found = schedule(strict, (1500.0, 3000.0), "soft", simulated=False)
    assert [row.controller for row in found.rows] == [None, None]
    assert "limit 89°" in found.rows[0].refusal
    assert found.between == ()
