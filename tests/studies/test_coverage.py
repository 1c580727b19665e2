"""Coverage benchmark: its statistics compared with known ones, and a small version with fixed seeds."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from tdhil.studies.coverage.bound import (
    Bounds,
    WatchedSpeed,
    bound_of,
    cramer_rao,
    density,
    information,
    slopes_of_unknown,
)
from tdhil.studies.coverage.plants import FLEET, PlantNoise, ReportFilter
from tdhil.studies.coverage.simulate import SimulatedRun
from tdhil.studies.coverage.study import (
    COVERAGE,
    CoverageSettings,
    clopper_pearson,
    covers,
    figures_of,
    not_too_wide,
    unbiased,
)

PLANT = {plant.name: plant for plant in FLEET}
_NO_BOUND = Bounds(None, None)


@pytest.mark.parametrize(("hits", "tries"), [(0, 12), (3, 100), (25, 500), (12, 12)])
def test_the_bounds_of_a_share_are_scipys(hits: int, tries: int) -> None:
    from scipy.stats import binomtest

    expected = binomtest(hits, tries).proportion_ci(confidence_level=0.98, method="exact")
    assert clopper_pearson(hits, tries) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_the_fleet_spans_the_required_range() -> None:
    assert len(FLEET) >= 12
    assert len({plant.name for plant in FLEET}) == len(FLEET)
    inertias = [plant.inertia_kg_m2 for plant in FLEET]
    assert (min(inertias), max(inertias)) == (0.01, 3000.0)
    assert {10.0, 100.0, 250.0, 1000.0} <= {plant.reading.rate_hz for plant in FLEET}
    for plant in FLEET:
        first_order = all(
            len(report.lags_s) <= 1 and report.average_s == 0.0 for report in (plant.speed_report, plant.torque_report)
        )
        assert first_order or not plant.model_true, plant.name


def test_the_bound_of_two_parameters_is_the_hand_computed_one() -> None:
    """With one line and only J and B free, F = 2|W|²/v · diag(ω², 1), so sd(J) = √(v/2)/(ω|W|)."""
    plant = replace(PLANT["field"], speed_report=ReportFilter(), torque_report=ReportFilter(),
                    noise=PlantNoise(reported_torque_nm=2.0))
    hertz, wave, seconds = np.array([0.2]), 0.5, 100.0
    v = 4.0 * 2.0**2 / (plant.reading.rate_hz * seconds)      # of a complex line: 4 σ²/N
    assert density(plant, hertz)[0] == pytest.approx(2.0**2 / plant.reading.rate_hz)
    one = WatchedSpeed(3.0, np.array([wave + 0j]), seconds)
    fisher = information(plant, hertz, [one])
    levels = np.outer([3.0, 1.0], [3.0, 1.0]) * seconds * plant.reading.rate_hz / 2.0**2
    lines = fisher[:2, :2] - np.diag([0.0, levels[0, 0]])
    assert fisher[1:3, 2] == pytest.approx(levels[:, 1], rel=1e-6)
    assert bound_of(lines) == pytest.approx(np.sqrt(v / 2.0) / (2.0 * np.pi * 0.2 * wave), rel=1e-6)


def test_indistinguishable_parameters_have_no_bound() -> None:
    assert bound_of(np.array([[1.0, 1.0], [1.0, 1.0]])) is None


@pytest.mark.heavy
def test_the_notes_design_has_about_the_notes_bound() -> None:
    """The bound is 0.5 % with 240 s and the lines of the notes. The default plan of 200 s is slightly better."""
    bound = cramer_rao(PLANT["field"], 10)
    assert bound.known is not None
    assert bound.unknown is not None
    assert 0.10 < bound.known < 0.50
    assert 1.2 * bound.known < bound.unknown < 2.0 * bound.known     # cost of unknown filters


def test_equal_poles_do_not_change_the_bound() -> None:
    """Equal and nearly equal poles have the same bound. There is no bound with the poles as the parameters."""
    hertz = 0.1 * np.array([1.0, 2.0, 3.0, 5.0, 7.0, 10.0])
    watched = [WatchedSpeed(speed, np.full(6, 0.3 + 0j), 100.0) for speed in (3.0, 5.0)]
    bounds = []
    for lags in ((0.20, 0.20, 0.20), (0.19, 0.20, 0.21)):
        plant = replace(PLANT["three_poles"], speed_report=ReportFilter(lags))
        slopes, plausible = slopes_of_unknown(plant, hertz)
        bounds.append(bound_of(information(plant, hertz, watched, slopes) + plausible))
    assert bound_of(information(PLANT["three_poles"], hertz, watched)) is None
    assert bounds[0] == pytest.approx(bounds[1], rel=0.01)


def _runs(values: list[tuple[float, float] | None]) -> list[SimulatedRun]:
    return [
        SimulatedRun("field", n, 100.0, "valid", "") if one is None
        else SimulatedRun("field", n, 100.0, "valid", "", one[0], one[0] - one[1], one[0] + one[1])
        for n, one in enumerate(values)
    ]


def test_figures_count_misses_among_runs_with_a_number() -> None:
    found = figures_of(PLANT["field"], _runs([(104.0, 1.0), (106.0, 1.0), None, (103.0, 1.5)]), Bounds(0.5, 0.8))
    assert (found.runs, found.refused, found.misses, found.answered) == (4, 1, 1, 3)
    assert found.miss_rate == pytest.approx(1.0 / 3.0)
    assert found.bias == pytest.approx(1.0 / 3.0 / 104.0)
    assert found.rmse == pytest.approx(np.sqrt(5.0 / 3.0) / 104.0)
    assert found.over_bound == pytest.approx(np.sqrt(5.0 / 3.0) / 0.5)
    assert found.over_unknown == pytest.approx(np.sqrt(5.0 / 3.0) / 0.8)
    assert found.width_over_unknown(2.0) == pytest.approx(3.5 / 3.0 / 1.6)


def test_the_bounds_of_the_proof_refuse_bad_figures() -> None:
    field = PLANT["field"]
    misses = figures_of(field, _runs([(106.0, 1.0)] * 20 + [(104.0, 1.0)] * 80), _NO_BOUND)
    assert covers(misses, 0.05) is False
    never = figures_of(field, _runs([(104.0, 1.0)] * 500), _NO_BOUND)
    assert covers(never, 0.05) is True
    assert not_too_wide(never, 0.05) is False
    assert not_too_wide(replace(never, plant=PLANT["average"]), 0.05) is None
    biased = figures_of(field, _runs([(104.4, 1.0), (104.401, 1.0)] * 50), _NO_BOUND)
    assert unbiased(biased) is False
    silent = figures_of(field, _runs([None] * 5), _NO_BOUND)
    assert (covers(silent, 0.05), unbiased(silent)) == (None, None)


@pytest.mark.parametrize(("seeds", "periods"), [
    pytest.param(3, 4, marks=pytest.mark.heavy), pytest.param(12, 10, marks=pytest.mark.long),
])
def test_a_small_version_holds_and_does_not_depend_on_the_processes(seeds: int, periods: int) -> None:
    """It has four plants of four kinds with a few runs each, so only gross errors exceed a bound."""
    heard: list[float] = []
    plants = ["coarse", "field", "average", "modbus"]
    settings = CoverageSettings(seeds=seeds, periods=periods, plants=plants, processes=2)
    outcome = COVERAGE.run(settings, lambda share, text: heard.append(share))
    assert heard == sorted(heard)
    assert heard[-1] == 1.0
    table = outcome.tables[0]
    assert [row[0] for row in table.rows] == plants
    for plant, row in zip(outcome.document["plants"], table.rows, strict=True):
        assert plant["refused"] <= 1, row
        assert plant["misses"] <= seeds // 3, row
        assert abs(plant["bias"]) < max(0.003, 4.0 * plant["bias_error"]), row
    settings = CoverageSettings(seeds=seeds, periods=periods, plants=["coarse"], processes=1)
    alone = COVERAGE.run(settings, lambda share, text: None)
    assert alone.tables[0].rows[0] == table.rows[0]


@pytest.mark.heavy
def test_the_picture_is_drawn() -> None:
    figure_module = pytest.importorskip("matplotlib.figure")
    outcome = COVERAGE.run(CoverageSettings(seeds=1, plants=["coarse"], periods=4, processes=1), lambda s, t: None)
    assert outcome.draw is not None
    figure = figure_module.Figure(figsize=outcome.figure_size_in)
    outcome.draw(figure)
    assert len(figure.axes) == 2


def test_an_unknown_plant_is_refused_by_name() -> None:
    with pytest.raises(ValidationError, match="no plant 'windmill'"):
        CoverageSettings(plants=["windmill"])
