"""Result card: eighty columns, every available part, and no invented values."""

import io
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from profiles.quantities import printed_interval, printed_share
from tdhil.estimation.result import AngleHarmonic, Estimate, LeastHarmonic, PlayMotion
from tdhil.report.blocks import report_of
from tdhil.report.card import (
    backlash_rows,
    budget_figures,
    card_text,
    estimate_text,
    harmonic_rows,
    inertia_text,
    opinion_rows,
    print_card,
)
from tdhil.report.document import result_document
from tdhil.report.intervals import percent, plus_minus, plus_minus_part, table_cell, with_interval
from tests.report.findings import RUN, bare, full, open_sided, recording


def shown(found, width=80, **changes):
    text = io.StringIO()
    document = result_document(found, recording(**changes), {}, "run.mcap")
    print_card(document, Console(file=text, width=width, highlight=False))
    return text.getvalue()


@pytest.mark.parametrize("make", [full, bare, open_sided])
@pytest.mark.parametrize("width", [60, 80, 120])
def test_no_line_is_wider_than_the_terminal(make, width):
    assert max(map(len, shown(make(), width).splitlines())) <= width


def test_on_forty_columns_no_number_and_no_warning_is_cut_off():
    card = shown(full(), width=40)
    assert max(map(len, card.splitlines())) <= 40
    assert "J at the motor shaft · SIMULATED" in card
    assert "…" not in card
    assert "uncertainty budget" in card
    assert "83.1 ± 1.5" in card


def test_every_part_is_shown():
    card = shown(full())
    for wanted in (
        "J, 95 % interval       104.0 (99.9 to 108.1) kg·m²  ±4.0 %",
        "repeatability          104.00 (103.55 to 104.45) kg·m²  ±0.44 %, this drive",
        "SIMULATED", "motor's side, J_r", "J_L behind the spring",
        "130.0 (124.5 to 135.5) kg·m²", "500 (471 to 529) N·m/rad", "left open by the data",
        "2.90 rad/s: 83.1 ± 1.5", "7.00 rad/s: 116.20 ± 0.80",
        "130.6 (128.3 to 132.9) kg·m²  agrees, speed change", "DOES NOT AGREE, coast-down",
        "of torque or speed: 29 % or more would show",
        "uncertainty budget", "momentum cross-check", "acceleration", "regression (Xu 2026)", "lag, reported speed",
        "time offset", "! friction <b>bends</b> & more",
    ):
        assert wanted in card, wanted
    # the interval to quote comes first
    assert card.index("99.9 to 108.1") < card.index("103.55 to 104.45")
    # the largest source first
    assert card.index("torque scale         ") < card.index("noise  ") < card.index("lags  ")


def test_with_an_exact_torque_scale_there_is_one_interval():
    exact = replace(full(), inertia=replace(full().inertia, low_total=103.55, high_total=104.45))
    card = shown(exact)
    assert "104.00 (103.55 to 104.45) kg·m²  ±0.44 %" in card
    assert "repeatability" not in card


def test_the_main_shaft_s_is_the_one_to_quote_too():
    assert re.search(r"J at main shaft +416 \(399 to 433\) kg·m²  ±4.0 %", shown(full(), gear_ratio=2.0))


def test_open_sides_are_stated():
    card = shown(open_sided())
    assert "0.4 s, open on one side" in card
    assert "0 s, open on both sides" in card
    assert re.search(r"J_r \+ J_L +left open by the data", card)


def test_a_refusal_shows_no_missing_values():
    card = shown(bare(), simulated=False)
    assert "not_identifiable" in card
    assert "Record for longer." in card
    for unwanted in ("uncertainty budget", "friction", "cross-check", "regression", "kg·m²", "SIMULATED", "None"):
        assert unwanted not in card


def test_digits_follow_the_half_width():
    assert plus_minus(83.1234, 1.5) == "83.1 ± 1.6"      # 81.6 to 84.6 would miss 84.6234
    assert plus_minus(1234.5, 120.0) == "1230 ± 130"
    assert plus_minus(5.0, float("inf")) == "5"
    assert with_interval(-0.0003, -0.014, 0.016, "s") == "0.000 (-0.014 to 0.016) s"
    assert [percent(half, 100.0) for half in (3.95, 0.5, 12.3, 0.034)] == ["±4.0 %", "±0.50 %", "±13 %", "±0.034 %"]


def test_both_figures_of_a_budget_have_two_digits_rounded_up_and_no_exponent():
    """Beside 3.95 %, which was rounded up to 4.0, 4.11 kg·m² was rounded to the nearest."""
    assert [budget_figures(one, None)[0] for one in (1234.0, 49.4, 6.43, 0.304, 7.9e-5, 0.0)] == [
        "1300", "50", "6.5", "0.31", "0.000079", "0"]
    assert budget_figures(4.11, 104.0) == ("4.2", "4.0")
    assert budget_figures(None, 104.0) == ("open", "") and budget_figures(4.0, None) == ("4.0", "")


def test_a_cell_of_a_table_rounds_its_interval_outwards_and_writes_no_powers_of_ten():
    assert table_cell({"value": 2.401, "low": 2.2949, "high": 2.5012}) == "2.40 (2.29 to 2.51)"
    assert table_cell({"value": 1603.4, "low": 1204.0, "high": 2003.0}) == "1600 (1200 to 2010)"
    assert table_cell({"value": 0.293, "low": 0.253, "high": 0.341}, 100.0) == "29.3 (25.3 to 34.1)"
    assert table_cell({"value": 1603.4, "low": 1603.4, "high": 1603.4}) == "1603"
    assert table_cell({"value": 2.4, "low": 2.29, "high": None}) == "2.4 (from 2.29, no upper limit)"
    assert table_cell({"value": 2.4, "low": None, "high": 2.5}) == "2.4 (no lower limit, to 2.5)"
    assert table_cell({"value": 2.4, "low": None, "high": None}) == "2.4"
    assert table_cell({"value": None, "low": None, "high": None}) == "–"


def test_a_half_width_in_percent_is_never_less_than_the_true_one():
    shown = [printed_share(one) for one in (0.01001, 0.0100, 0.0000123, 0.1234, 1.5, 0.0, float("inf"))]
    assert shown == ["±1.1 %", "±1.0 %", "±0.0013 %", "±13 %", "±150 %", "±0 %", "±?"]


def test_a_printed_interval_contains_the_true_one():
    """Ends are never rounded inwards, in 20 000 intervals of any size, as ends and as ±."""
    rng = np.random.default_rng(8)
    for value, below, above in zip(rng.normal(0, 300, 20_000), 10 ** rng.uniform(-4, 3, 20_000),
                                   10 ** rng.uniform(-4, 3, 20_000), strict=True):
        low, high = value - below, value + above
        allowed = 1e-9 * (abs(value) + above + below)
        for text in (with_interval(value, low, high, "").split("(")[1].split(")")[0], printed_interval(low, high)):
            ends = [float(end) for end in text.split(" to ")]
            assert ends[0] <= low + allowed and high - allowed <= ends[1], (text, low, high)
        middle, _, half = plus_minus(value, above).partition(" ± ")
        assert float(middle) - float(half) <= value - above + allowed
        assert float(middle) + float(half) >= value + above - allowed


def test_an_exact_end_is_printed_as_it_is():
    assert with_interval(104.0, 103.55, 104.45, "") == "104.00 (103.55 to 104.45) "
    assert with_interval(104.2, 100.14, 108.26, "") == "104.2 (100.1 to 108.3) "
    assert with_interval(104.2, 100.06, 108.34, "") == "104.2 (100.0 to 108.4) "
    assert with_interval(1234.0, 1111.0, 1357.0, "") == "1230 (1110 to 1360) "
    assert printed_interval(-0.01234, 0.01235, 3, sign=True) == "-0.0124 to +0.0124"


def test_a_clearly_asymmetric_interval_is_printed_by_its_ends():
    assert plus_minus_part({"value": 83.0, "low": 82.0, "high": 84.1}) == "83.0 ± 1.1"
    assert plus_minus_part({"value": 83.0, "low": 82.0, "high": 86.0}) == "83.0 (82.0 to 86.0)"
    assert inertia_text({"value": 100.0, "low": 96.0, "high": 104.1}) == "100.0 (96.0 to 104.1) kg·m²  ±4.1 %"
    assert inertia_text({"value": 100.0, "low": 98.0, "high": 107.0}) == "100.0 (98.0 to 107.0) kg·m²"


def test_the_friction_on_the_card_includes_the_torque_scale_like_the_inertia():
    """Coulomb friction 59.7 ± 1.0 N·m and a scale of 2 % (1 sd): hypot(1.0, 1.96 · 0.02 · 59.7) = 2.54 N·m."""
    assert re.search(r"Coulomb friction T_c +59\.7 \(57\.1 to 62\.3\) N·m", shown(full()))


def test_a_lag_at_its_bound_of_zero_has_an_upper_limit():
    assert estimate_text({"value": 4.6e-17, "low": 0.0, "high": 0.00197}, "s") == "at most 0.00197 s"
    assert estimate_text({"value": 0.0012, "low": 0.0, "high": 0.002}, "s").startswith("0.0012 (")
    assert estimate_text({"value": 0.0, "low": 0.0, "high": 0.0}, "s").startswith("0 ")


def test_a_rehearsal_is_marked_on_card_and_report():
    run = RUN | {"faults": ["torque-scale=1.1"]}
    document = result_document(full(), recording(simulated=True), run, "run.mcap")
    assert document["rehearsed_faults"] == ["torque-scale=1.1"]
    card = card_text(document, 80)
    assert "SIMULATED · FAULT REHEARSAL" in card
    assert "torque-scale=1.1" in card
    assert "FAULT REHEARSAL" in report_of(document, recording()).simulated


def test_a_cross_check_without_a_j_beside_it_says_so():
    (row,) = opinion_rows({"second_opinions": [
        {"route": "speed change", "agrees": None, "inertia_kg_m2": {"value": 104.0, "low": 100.0, "high": 108.0}}]})
    assert "  not compared: the run gives no J, speed change" in row[1].plain


def test_the_limits_of_harmonics_and_a_motion_that_hides_a_play_are_rows():
    limits = (LeastHarmonic(1, 1.18), LeastHarmonic(2, 0.6), LeastHarmonic(6, 1.31), LeastHarmonic(36, 42.1))
    one = AngleHarmonic(2, Estimate(5.0, 4.5, 5.5), Estimate(0.1, 0.0, 0.2))
    found = replace(full(), harmonics=(one,), least_harmonics=limits, backlash=(),
                    backlash_motion=PlayMotion(False, 8.42))
    document = result_document(found, recording(), {}, "run.mcap")
    assert list(harmonic_rows(document))[1] == (
        "", "would show order 1 from 1.2 N·m, order 6 from 1.4 N·m, order 36 from 43 N·m")
    assert list(backlash_rows(document)) == [("backlash", "may be hidden: the torque stays above 8.4 N·m")]
    assert document["least_harmonics"][0] == {"order": 1, "amplitude_nm": 1.18}
    assert document["backlash_motion"] == {"torque_reverses": False, "least_torque_nm": 8.42}
    texts = str(report_of(document, recording()))
    assert "This motion shows order 1 from 1.2 N·m" in texts
    reversing = document | {"harmonics": [], "backlash_motion": {"torque_reverses": True, "least_torque_nm": -8.0}}
    assert not list(backlash_rows(reversing)) and not list(harmonic_rows(reversing))
    assert "No order stands out. This motion shows order 1" in str(report_of(reversing, recording()))
