"""Proof 1: Tables 6 and 7 are reproduced. The published numbers are stated here independently of the program."""

import numpy as np
import pytest

from tdhil.studies.paper.design_runs import closed_form_inertia, run_design
from tdhil.studies.paper.figures import draw_effects, draw_scatter
from tdhil.studies.paper.loop import LoopSettings, changed
from tdhil.studies.paper.published import published
from tdhil.studies.paper.tables import Table6Settings, Table7Settings, published_for
from tdhil.studies.registry import simulated_studies

pytestmark = [pytest.mark.one_worker, pytest.mark.heavy]

L9_RUNS = [898.36, 898.30, 898.15, 892.95, 892.88, 891.03, 885.96, 885.24, 885.52]
L16_RUNS = [
    878.63, 884.83, 889.58, 889.33, 890.63, 894.55, 889.36, 892.94, 899.82, 897.38, 891.97, 891.15, 894.99, 889.09,
    898.13, 898.82,
]
# Results of another program with the same settings, from the first reconstruction.
L9_REFERENCE = [898.30, 898.08, 897.59, 893.36, 893.13, 890.83, 886.73, 885.79, 885.40]
L16_REFERENCE = [
    878.07, 886.06, 889.01, 888.68, 889.83, 893.38, 889.30, 893.10, 899.61, 898.30, 892.49, 889.67, 896.36, 891.28,
    898.85, 899.07,
]
TABLE6 = {
    "frequency_hz": ([885.592, 891.87, 895.08, 895.258], 9.666),
    "kp_nm_s_rad": ([891.017, 891.463, 892.26, 893.06], 2.043),
    "ki_nm_rad": ([890.992, 891.185, 892.858, 892.765], 1.866),
    "amplitude_rad_s": ([887.058, 891.182, 894.103, 895.458], 8.4),
    "offset_rad_s": ([891.77, 893.208, 892.568, 890.255], 2.953),
}
TABLE7 = {
    "viscous_nm_s_rad": ([898.27, 892.287, 885.573], 12.697),
    "coulomb_nm": ([892.423, 892.14, 891.567], 0.856),
    "dahl_stiffness_nm_rad": ([891.543, 892.257, 892.33], 0.787),
    "noise_power_nm2_s": ([892.253, 891.763, 892.113], 0.49),
}


def column(table, name):
    return [row[table.columns.index(name)] for row in table.rows]


def inertias(outcome):
    return np.array([run["inertia_kg_m2"] for run in outcome.document["runs"]])


def rms(one, other):
    return float(np.sqrt(np.mean((np.asarray(one) - np.asarray(other)) ** 2)))


def holding(outcome, words):
    [statement] = [one for one in outcome.statements if words in one.text]
    return statement.holds


def test_table7_meets_its_bound_and_the_published_ranks(table7):
    assert rms(inertias(table7), L9_RUNS) <= 0.5
    assert [factor["rank"] for factor in table7.document["factors"]] == [1, 2, 3, 4]


@pytest.mark.long
def test_table6_meets_its_bound_and_the_published_ranks(table6):
    assert rms(inertias(table6), L16_RUNS) <= 1.1
    rank = {factor["name"]: factor["rank"] for factor in table6.document["factors"]}
    assert (rank["frequency_hz"], rank["amplitude_rad_s"], rank["offset_rad_s"]) == (1, 2, 3)
    assert {rank["kp_nm_s_rad"], rank["ki_nm_rad"]} == {4, 5}


@pytest.mark.long
def test_both_agree_with_the_first_reconstruction(table6, table7):
    assert np.allclose(inertias(table7), L9_REFERENCE, atol=0.02)
    assert np.allclose(inertias(table6), L16_REFERENCE, atol=0.06)


@pytest.mark.parametrize(("name", "printed", "runs"), [("table6", TABLE6, L16_RUNS), ("table7", TABLE7, L9_RUNS)])
def test_the_data_file_agrees_with_the_paper(name, printed, runs):
    design = published().design(name)
    assert {one.name: (list(one.mean_inertia_kg_m2), one.range_kg_m2) for one in design.factors} == printed
    assert np.allclose(design.runs_kg_m2, runs, atol=0.011)


@pytest.mark.long
def test_runs_are_in_array_order_with_their_factors(table6, table7):
    first, last = table6.document["runs"][0], table6.document["runs"][-1]
    assert [first[name] for name in TABLE6] == pytest.approx([0.1, 2500, 1500, 0.5, np.pi / 2])
    assert [last[name] for name in TABLE6] == pytest.approx([1.0, 15000, 1500, 1.5, np.pi])
    assert [table7.document["runs"][5][name] for name in TABLE7] == [50, 100, 100, 1e-4]


@pytest.mark.long
def test_without_the_start_up_the_bias_nearly_vanishes(table6, table7):
    assert np.allclose(column(table7.tables[0], "without_start_up_kg_m2"), 900.0, atol=0.04)
    settled = np.array(column(table6.tables[0], "without_start_up_kg_m2"))
    reversing = np.array([9, 14])      # amplitude against offset: the speed reaches zero
    assert np.allclose(np.delete(settled, reversing), 900.0, atol=0.05)
    assert np.all(np.abs(settled[reversing] - 900.0) < 1.7)


@pytest.mark.long
def test_the_closed_form_explains_the_bias(table6, table7):
    for outcome, within in ((table6, 1.7), (table7, 1.9)):
        closed = np.array(column(outcome.tables[0], "closed_form_kg_m2"))
        found = np.array(column(outcome.tables[0], "inertia_kg_m2"))
        rest = np.abs(found - closed)
        assert np.mean(rest) < 0.15 * np.mean(np.abs(found - 900.0))
        assert np.sort(rest)[-2] < within      # all except one: 4.6 at the smallest torque, where the bristle matters
        assert np.corrcoef(found, closed)[0, 1] > 0.97


def test_the_closed_form_by_hand():
    run = LoopSettings(
        inertia_kg_m2=100.0, viscous_nm_s_rad=10.0, kp_nm_s_rad=90.0, ki_nm_rad=0.0, frequency_hz=0.5,
        amplitude_rad_s=1.0, offset_rad_s=2.0, duration_s=10.0, sample_period_s=0.01,
    )
    # G = 90/(100 s + 100): |G| = 0.9/√(π² + 1). Start-up: 4·8100/(2·100·100·10) = 0.162.
    sine = 0.5 * np.pi**2 * 0.81 / (np.pi**2 + 1.0)
    late = 100.0 * 0.01 * (90.0 * 2.0 / 100.0) ** 2 / 40.0
    assert closed_form_inertia(run) == pytest.approx(100.0 - (10.0 * 4.0 / 20.0 + late) / (sine + 0.162))
    assert closed_form_inertia(changed(run, signal="chirp")) is None


@pytest.mark.long
def test_statements_about_the_tables(table6, table7):
    assert holding(table6, "single runs") is True
    assert holding(table6, "A > D > E") is True
    assert holding(table6, "amplitude grows") is True
    assert holding(table6, "offset's effect") is True
    assert holding(table6, "P moves J more") is False
    assert holding(table6, "low frequencies identify best") is None
    assert holding(table6, "run 16") is None
    assert holding(table6, "numerical differentiation") is False
    assert holding(table7, "single runs") is True
    assert holding(table7, "a > b > c > d") is True
    assert holding(table7, "99.8 %") is True
    assert holding(table7, "noise has the smallest") is True
    assert holding(table7, "units") is None


def test_the_noise_of_table_7_changes_nothing(table7):
    silent = np.array(column(table7.tables[0], "without_noise_kg_m2"))
    assert np.all(np.abs(silent - inertias(table7)) < 0.02)


@pytest.mark.long
def test_the_effect_table_contains_both(table6):
    table = table6.tables[1]
    ours = [row for row in table.rows if row[1] == "here"]
    theirs = [row for row in table.rows if row[1] == "published"]
    assert [row[0] for row in ours] == [row[0] for row in theirs] == list(TABLE6)
    assert [row[-1] for row in theirs] == [1, 4, 5, 2, 3]
    assert theirs[0][2:7] == (885.592, 891.87, 895.08, 895.258, 9.666)


@pytest.mark.long
def test_cost_is_reported_beside_simulated_time(table6, table7):
    assert table6.simulated_s == pytest.approx(16 * 25.0)
    assert table7.simulated_s == pytest.approx(2 * 9 * 20.0)      # each run also without noise
    assert table6.simulation_wall_s > 0.0 and table6.simulated_s > 0.0


def test_a_second_run_gives_the_same_to_the_last_bit():
    settings = Table7Settings(duration_s=5.0)
    one, other = (run_design(settings, lambda share: None) for _ in range(2))
    assert one.inertias == other.inertias
    assert run_design(Table7Settings(duration_s=5.0, seed=2), lambda share: None).inertias != one.inertias


def test_a_custom_design_has_no_published_columns():
    settings = Table6Settings(
        array=((1, 1), (1, 2), (2, 1), (2, 2)), duration_s=4.0,
        factors=({"name": "J", "levels": (450.0, 900.0)}, {"name": "viscous_nm_s_rad", "levels": (10.0, 100.0)}),
    )
    assert published_for("table6", settings) is None
    assert published_for("table6", Table6Settings(kp_nm_s_rad=1.0)) is not None
    [study] = [one for one in simulated_studies() if one.name == "table6"]
    outcome = study.run(settings, lambda share, what: None)
    assert not [name for name in outcome.tables[0].columns if "published" in name]
    assert np.allclose(inertias(outcome), [450, 450, 900, 900], rtol=0.05)
    assert outcome.document["factors"][0]["rank"] == 1
    assert "published_runs_kg_m2" not in outcome.document


@pytest.mark.long
def test_pictures(table6):
    figure_class = pytest.importorskip("matplotlib.figure").Figure
    figure = figure_class(figsize=(8, 5))
    table6.draw(figure)
    assert len(figure.axes) == 1
    settings = Table6Settings(duration_s=2.0, frequency_hz=1.0)
    result = run_design(settings, lambda share: None)
    figure = figure_class(figsize=(10, 7.5))
    draw_scatter(figure, result)
    assert len(figure.axes) == 16
    assert figure.axes[0].get_title().startswith("1: T = ")
    figure = figure_class(figsize=(8, 5))
    draw_effects(figure, settings, result, published_for("table6", settings))
    assert [axes.get_xlabel()[0] for axes in figure.axes] == list("ABCDE")


def test_this_tool_finds_the_inertia_that_the_papers_fit_misses(table7):
    """With declared zero lags, J 900 and B 10, 50, 100, the paper's fit is 0.2 to 1.6 % low on these samples."""
    found = np.array(column(table7.tables[0], "tdhil_kg_m2"))
    assert np.max(np.abs(found / 900.0 - 1.0)) < 0.001
    for run in table7.document["runs"]:
        inertia = run["tdhil"]["inertia_kg_m2"]
        assert inertia["low"] <= 900.0 <= inertia["high"]
