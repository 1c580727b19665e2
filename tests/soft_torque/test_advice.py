"""Advice of `tune`: the comparison, the advice to keep the present gains, and the intervals."""

from __future__ import annotations

import warnings
from dataclasses import replace
from math import inf

import numpy as np
import pytest

from tdhil.soft_torque import (
    EXACT_STRING,
    Advice,
    BottomEnd,
    DrawnValues,
    Interval,
    PipeSection,
    RequiredMargins,
    Search,
    SpeedController,
    StringFile,
    TopDrive,
    TuneCase,
    Tuned,
    Tuning,
    TuningRefused,
    draw_truths,
    loop_margins,
    lowest_turning_with_noise,
    operator_map,
    string_of,
    tune,
    tuned_controller,
)
from tdhil.soft_torque.stability import LoopMargins
from tdhil.soft_torque.tuning import advice_of
from tests.soft_torque.cases import BIT, DRIVE, SOFT_035, SOFT_1, STIFF, STRING, string_with
from tests.soft_torque.chain_in_time import ends_turning, reference_case

pytestmark = pytest.mark.one_worker      # its fixture is expensive

J = Interval(1500.0, 1440.0, 1560.0)


@pytest.fixture(scope="module")
def beside_good_gains():
    """Tuning with good present gains: a = 0.35 at 0.84 f₁. They cure at 46 rpm, the best damped ones at 57 or more."""
    return tune(TuneCase(STRING, DRIVE, J, present=SOFT_035, draws=6))


def row(kind, cure_rpm, failed=(), spread=0.02):
    """A row with this critical speed, rpm, over ten draws that share their draw with the other rows."""
    draws = np.exp(spread * np.linspace(-1.0, 1.0, 10))
    return Tuned(kind, SOFT_035, failed=failed, cure=DrawnValues(tuple(cure_rpm * draws)))


@pytest.mark.parametrize(("rows", "kind"), [
    ((row("present", 51.3), row("stiff", 150.0), row("soft", 40.0), row("compensated", 39.0)), "soft"),
    ((row("present", 51.3), row("stiff", 150.0), row("soft", 50.0), row("compensated", 39.0)), "compensated"),
    # the soft row is within the resolution of the best row; only the best row is clearly better than the present one
    ((row("present", 51.3), row("stiff", 150.0), row("soft", 49.1), row("compensated", 47.2)), "compensated"),
    ((row("present", 51.3), row("stiff", 150.0), row("soft", 50.0), row("compensated", 49.0)), None),
    ((row("present", 51.3), row("stiff", 150.0), row("soft", 60.0), row("compensated", 70.0)), None),
    ((row("present", 51.3), row("stiff", 150.0), row("soft", 40.0, ("phase",)), row("compensated", 50.9)), None),
    ((row("present", 51.3, ("phase",)), row("stiff", 150.0), row("soft", 52.0), row("compensated", 70.0)), "soft"),
    ((row("present", 51.3, ("phase",)), row("stiff", 150.0), row("soft", 60.0), row("compensated", 70.0)), None),
    ((row("stiff", 150.0), row("soft", 40.0), row("compensated", 45.0)), "soft"),
    ((row("present", 200.0), row("stiff", 60.0), row("soft", 150.0, ("gain",))), "stiff"),
])
def test_the_advice_is_the_best_row_that_is_clearly_better(rows, kind):
    advice = advice_of(rows)
    assert advice.kind == kind and advice.keep is (kind is None)
    assert advice.compared_with == rows[0].kind


UNSTABLE = LoopMargins(stable=False, phase_deg=0.0, gain_db=0.0, dead_time_s=0.0, lag_s=0.0, modulus=0.0)


@pytest.mark.parametrize(("others", "kind"), [
    ((row("stiff", 150.0, ("dead-time reserve",)), row("soft", 40.0, ("phase",))), None),
    ((row("stiff", 150.0), row("soft", 70.0)), "soft"),
])
def test_unstable_gains_are_never_kept(others, kind):
    """The sentence was "Keep what you have", also for a row that is 30 % slower and keeps all margins."""
    base = replace(row("present", 51.3, ("unstable",)), worst=UNSTABLE)
    advice = advice_of((base, *others))
    assert (advice.kind, advice.keep) == (kind, False)


def failing(kind, cure_rpm, phase_deg, gain_db, dead_time_s):
    """A row with these least margins, below the required ones."""
    worst = LoopMargins(True, phase_deg, gain_db, dead_time_s, 0.01, 0.2)
    return replace(row(kind, cure_rpm, RequiredMargins().failed(worst)), worst=worst)


PRESENT = failing("present", 92.0, 6.0, 3.7, 0.006)


@pytest.mark.parametrize(("base", "stiff", "less_bad"), [
    (PRESENT, failing("stiff", 49.0, 21.0, 10.2, 0.023), "stiff"),
    (PRESENT, failing("stiff", 100.0, 21.0, 10.2, 0.023), None),        # a higher critical speed
    (PRESENT, failing("stiff", 49.0, 21.0, 3.0, 0.023), None),          # a smaller gain margin
    (replace(row("present", 92.0, ("unstable",)), worst=UNSTABLE), failing("stiff", 49.0, 21.0, 10.2, 0.023), "stiff"),
    (replace(PRESENT, failed=()), failing("stiff", 49.0, 21.0, 10.2, 0.023), None),
])
def test_a_row_that_is_less_bad_in_every_margin_is_named_and_not_recommended(base, stiff, less_bad):
    advice = advice_of((base, stiff))
    assert (advice.kind, advice.less_bad) == (None, less_bad)
    if less_bad:
        assert not advice.keep
    good = replace(row("soft", 40.0), worst=LoopMargins(True, 60.0, 9.0, 0.03, 0.1, 0.5))
    assert advice_of((base, stiff, good)).kind == "soft" and advice_of((base, stiff, good)).less_bad is None


def test_a_row_that_keeps_the_margins_is_not_called_less_bad():
    good = replace(row("soft", 120.0), worst=LoopMargins(True, 60.0, 9.0, 0.03, 0.1, 0.5))
    advice = advice_of((PRESENT, failing("stiff", 49.0, 21.0, 10.2, 0.023), good))
    assert (advice.kind, advice.less_bad) == (None, "stiff")


def test_a_row_that_is_better_in_some_draws_only_is_not_recommended():
    shared = row("present", 51.3)
    mixed = np.array(shared.cure.values) * np.where(np.arange(10) < 4, 1.2, 0.6)
    soft = Tuned("soft", SOFT_035, cure=DrawnValues(tuple(mixed)))
    advice = advice_of((shared, row("stiff", 150.0), soft))
    assert advice.keep and advice.better_share == pytest.approx(0.6)


def test_without_simulated_critical_speeds_nothing_is_compared():
    rows = [replace(one, cure=None) for one in (row("present", 1.0), row("stiff", 1.0), row("soft", 1.0))]
    assert advice_of(rows) == Advice(None, "present", keep=False)


@pytest.mark.heavy
def test_nothing_worse_than_the_present_gains_is_recommended(beside_good_gains):
    """A recommended row has a lower critical speed under noise than the present gains, on nearly every truth."""
    advice = beside_good_gains.advice
    present = beside_good_gains.by_kind("present")
    assert advice.compared_with == "present"
    if advice.kind is None:
        assert advice.keep
    else:
        best = beside_good_gains.by_kind(advice.kind)
        assert best.cure.median < present.cure.median
        assert advice.better_share >= 0.8
        assert not best.failed


@pytest.mark.heavy
def test_the_soft_row_is_far_below_the_stiff_one(beside_good_gains):
    """The soft row has less than 40 % of the stiff critical speed under noise. Its linear limit is lower still."""
    stiff, soft = (beside_good_gains.by_kind(kind) for kind in ("stiff", "soft"))
    assert soft.cure.median < 0.4 * stiff.cure.median
    assert soft.linear_limit.median < soft.cure.median
    low, high = soft.cure.interval()
    assert low < soft.cure.median < high


@pytest.mark.heavy
def test_margins_hold_on_truths_that_were_not_drawn(beside_good_gains):
    """The soft row keeps phase, gain and dead-time margin on 95 % of 100 further truths."""
    law = beside_good_gains.by_kind("soft").controller
    truths = draw_truths(STRING, DRIVE, J, count=100, seed=77, lag_tolerance=0.1)
    kept = [not RequiredMargins().failed(loop_margins(one.drive, law, one.string)) for one in truths]
    assert np.mean(kept) >= 0.95


@pytest.mark.heavy
def test_gains_with_thin_margins_are_not_green():
    """Gains with a = 1 match ζ and have a phase margin of 14°: the row fails. A request for a = 1.6 is refused."""
    tuning = tune(TuneCase(STRING, DRIVE, J, present=SOFT_1), search=None)
    present = tuning.by_kind("present")
    assert any(words.startswith("phase margin") for words in present.failed)
    with pytest.raises(TuningRefused, match=r"too little margin: phase margin \d+° \(limit 30°\)"):
        tune(TuneCase(STRING, DRIVE, J, softness=1.6), search=None)


WILD = SpeedController(400_000.0, 30_000.0)
"""Gains with which the loop is so unstable that its signals grow beyond the largest number."""


@pytest.mark.parametrize("how", ["stuck", "rest"])
def test_a_loop_that_grows_without_limit_never_turns_the_bit(how):
    """A bit without a finite speed does not turn, at any set speed, and numpy does not warn of it."""
    light = replace(DRIVE, inertia_kg_m2=100.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert lowest_turning_with_noise([STRING], [(light, WILD)], [1], how, 2.0).tolist() == [inf]


@pytest.mark.heavy
def test_unstable_present_gains_are_not_kept():
    """Any row that keeps the margins is better than unstable gains. No warning of numpy is shown."""
    light, inertia = replace(DRIVE, inertia_kg_m2=100.0), Interval(100.0, 96.0, 104.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tuning = tune(TuneCase(STRING, light, inertia, present=WILD, draws=3))
    present = tuning.by_kind("present")
    assert present.failed == ("unstable",) and not present.with_string.stable
    assert present.cure.median is None and present.quiet_cure_rpm is None
    assert tuning.advice.kind == "soft" and not tuning.advice.keep


@pytest.mark.heavy
def test_a_string_without_drag_is_refused_for_its_drag():
    """The refusal names the missing drag, not the lags. With the mud's drag, a compensated share is accepted."""
    bare = string_with(drag=0.0)
    with pytest.raises(TuningRefused, match="states no drag"):
        tune(TuneCase(bare, DRIVE, J, compensated_share=0.6), search=None)
    tune(TuneCase(STRING, DRIVE, J, compensated_share=0.1), search=None)


@pytest.mark.heavy
def test_a_shear_modulus_of_the_field_lies_in_the_interval():
    """The string's tolerance, with G down to 61 GPa, more than doubles the spread of the cure speed of fixed gains."""
    law = tuned_controller(STRING, 1500.0, 0.19, 0.12995)

    def cures(string):
        truths = draw_truths(string, DRIVE, J, count=8)
        return lowest_turning_with_noise([one.string for one in truths], [(one.drive, law) for one in truths],
                                         [one.seed for one in truths], "stuck", 7.7)

    wide, exact = cures(STRING), cures(replace(STRING, tolerance=EXACT_STRING))
    assert np.ptp(np.log(wide)) > 2.0 * np.ptp(np.log(exact))


@pytest.mark.heavy
def test_the_turning_point_of_a_kink_is_found():
    """The least of two damping ratios is largest where they cross, between two of the computed values of J."""
    light = TopDrive(104.126, 8.1, 60.0, DRIVE.inner_lags_s)
    case = TuneCase(STRING, light, Interval(104.126, 80.0, 130.0))
    from tdhil.soft_torque import figures_at, string_modes_hz

    one = next(found for found in tune(case, search=None).tuned if found.kind == "soft")
    assert one.controller is not None
    held = string_modes_hz(STRING)
    along = [figures_at(case, light.with_inertia(float(j)), one.controller, held)[2] for j in np.linspace(80, 130, 60)]
    assert one.damping.high >= max(along) - 1e-3
    assert one.damping.low <= min(along) + 1e-3


def test_an_interval_of_draws_marks_an_unknown_end():
    low, high = DrawnValues((50.0, 60.0, inf)).interval()
    assert low <= 50.0 and high is None
    assert DrawnValues((inf, inf)).median is None
    low, high = DrawnValues((8.0, 8.0, 8.1), 10.0).interval()      # no lower set speed was tested
    assert (low, high) == (0.0, 10.0)


@pytest.mark.heavy
def test_the_map_contains_the_friction_of_a_deviated_well():
    """Side force along the string makes no cell safer. With stiff gains, a stuck bit in some cells is not freed."""
    order = ("stick-slip", "at risk", "stable")

    def states(side_force_n_m):
        section = PipeSection(length_m=3000.0, outer_diameter_m=0.127, inner_diameter_m=0.1086,
                              side_force_n_m=side_force_n_m)
        string = string_of(StringFile(sections=(section,), bottom=BottomEnd(**{"inertia_kg_m2": 374.0, **BIT})))
        case = TuneCase(string, DRIVE, Interval(1500.0, 1440.0, 1560.0))
        tuned = (Tuned("stiff", STIFF),)
        found = operator_map(Tuning(case, (0.1299,), tuned, Search(), Advice("soft", "stiff", keep=False), ()))
        return np.array([[order.index(state) for state in row] for row in found.states["stiff"]])

    free, deviated = states(0.0), states(150.0)
    assert np.all(deviated <= free)
    assert np.sum(deviated < free) >= 2


@pytest.mark.heavy
def test_the_operators_map_agrees_with_a_chain_in_time():
    """Softer gains have more stable cells. Clearly stable and clearly sticking cells agree with another simulator."""
    laws = {"stiff": STIFF, "soft": SOFT_035}
    tuned = tuple(Tuned(kind, law) for kind, law in laws.items())
    string = string_with(torque_per_weight_nm_kn=25.0)
    assert string.bit == replace(STRING.bit, torque_per_weight_nm_kn=25.0)
    case = TuneCase(string, DRIVE, Interval(1500.0, 1440.0, 1560.0))
    found = operator_map(Tuning(case, (0.1299,), tuned, Search(), Advice("soft", "stiff", keep=False), ()))
    row = found.bit_torques_nm.index(2500.0)
    assert found.weights_on_bit_kn[row] == pytest.approx(100.0)
    stable = {kind: [state == "stable" for state in rows[row]] for kind, rows in found.states.items()}
    assert sum(stable["soft"]) > sum(stable["stiff"]) + 4
    assert found.states["stiff"][row][0] == "stick-slip" and "at risk" in found.states["stiff"][row]
    turns = ends_turning(**reference_case(
        laws=[(law.gain_nm_s_rad, law.integral_nm_rad, 0.0, 0.05) for law in laws.values()],
        rpm=np.array([[60.0, 120.0, 200.0]] * 2), periods=12.0, lumps=14))
    for kind, row_turns in zip(laws, turns, strict=True):
        for speed, one in zip((60.0, 120.0, 200.0), row_turns, strict=True):
            assert stable[kind][found.speeds_rpm.index(speed)] == one
    lower = [sum(state == "stable" for state in rows) for rows in found.states["stiff"]]
    assert lower == sorted(lower, reverse=True)
