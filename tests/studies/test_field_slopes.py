"""Figure 22 by the CANopen path: the published slopes, from one inertia."""

import pytest

from tdhil.cli.study import SimulatedFieldBench
from tdhil.studies.field.settings import SlopeSettings
from tdhil.studies.field.slopes import FieldSlopes

pytestmark = [pytest.mark.one_worker, pytest.mark.long]

PUBLISHED = {0.1: 105.379, 0.3: 116.557, 0.5: 135.622, 1.0: 185.757}
INERTIA = 104.0


@pytest.fixture(scope="module")
def outcome():
    return FieldSlopes(SimulatedFieldBench()).run(SlopeSettings(), lambda share, text: None)


def table(outcome, name):
    (found,) = [table for table in outcome.tables if table.name == name]
    return [dict(zip(found.columns, row, strict=True)) for row in found.rows]


@pytest.mark.parametrize("row", range(4))
def test_the_paper_s_method_gives_the_published_slopes_within_3_percent(outcome, row):
    found = table(outcome, "slopes")[row]
    assert found["published_slope_kg_m2"] == PUBLISHED[found["frequency_hz"]]
    assert abs(found["slope_kg_m2"] / found["published_slope_kg_m2"] - 1.0) <= 0.03
    assert found["deviation_percent"] == pytest.approx(
        100.0 * (found["slope_kg_m2"] / found["published_slope_kg_m2"] - 1.0))


def test_the_joint_fit_covers_the_rig_s_one_inertia(outcome):
    found = outcome.document["joint_fit"]
    assert found["verdict"] == "valid"
    inertia = found["inertia_kg_m2"]
    assert inertia["low"] <= INERTIA <= inertia["high"]
    assert inertia["high"] - inertia["low"] <= 0.02 * INERTIA
    assert found["speed_lag_s"] == pytest.approx(0.40, abs=0.02)
    assert found["torque_lag_s"] == pytest.approx(0.15, abs=0.02)


def test_its_curve_passes_through_all_four(outcome):
    for found in table(outcome, "slopes"):
        assert found["joint_fit_slope_kg_m2"] == pytest.approx(found["slope_without_noise_kg_m2"], rel=0.005)
        assert found["joint_fit_slope_kg_m2"] == pytest.approx(found["slope_kg_m2"], rel=0.02)
        assert found["joint_fit_slope_kg_m2"] == pytest.approx(found["published_slope_kg_m2"], rel=0.03)


def test_possible_statements_hold_and_the_contradictions_are_named(outcome):
    decided = [statement for statement in outcome.statements if statement.holds is not None]
    assert len(decided) == 9
    assert all(statement.holds for statement in decided)
    said = " ".join(statement.text + statement.ours for statement in outcome.statements if statement.holds is None)
    for word in ("lower tone", "intercept", "Coulomb friction + B", "tones of the field test"):
        assert word in said


def test_the_picture_shows_both(outcome):
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    figure = Figure(figsize=outcome.figure_size_in)
    outcome.draw(figure)
    left, right = figure.axes
    straight = [line for line in left.lines if len(line.get_xdata()) == 2]
    assert len(straight) == 4
    labels = " ".join(text.get_text() for axes in (left, right) for text in axes.get_legend().get_texts())
    for word in ("0.1 Hz", "1 Hz: T = ", "joint fit of all records: one J", "published slope", "104 kg·m²"):
        assert word in labels
