"""Figures 20, 21 and 23 by the CANopen path: published trends, and sentences on trends that cannot be met."""

import numpy as np
import pytest

from tdhil.cli.study import SimulatedFieldBench
from tdhil.studies.field.gains import KiSweep, KpSweep
from tdhil.studies.field.loops import ToneSweep, best_kp, gain
from tdhil.studies.field.settings import SimulatedRig

pytestmark = [pytest.mark.heavy, pytest.mark.one_worker]

STUDIES = {"figure20": KpSweep, "figure21": KiSweep, "figure23": ToneSweep}


@pytest.fixture(scope="module", params=[
    pytest.param("figure20", marks=pytest.mark.long), pytest.param("figure21", marks=pytest.mark.long), "figure23",
])
def swept(request):
    return ran(request.param)


_done: dict[str, object] = {}


def ran(name):
    if name not in _done:
        study = STUDIES[name](SimulatedFieldBench())
        _done[name] = study.run(study.settings_model(), lambda share, text: None)
    return _done[name]


def column(outcome, name):
    return np.array([run[name] for run in outcome.document["runs"]])


def holds(outcome, part):
    (found,) = [statement for statement in outcome.statements if part in statement.text]
    return found


def test_the_bus_agrees_with_the_linear_loop(swept):
    """Both derivations agree: frames, drive, plant and Fourier coefficients; and a transfer function."""
    assert column(swept, "output_rad_s") == pytest.approx(column(swept, "linear_loop_output_rad_s"), rel=0.012)
    assert np.all(column(swept, "share_at_limit") == 0.0)


@pytest.mark.long
def test_figure20_falls_then_rises():
    outcome = ran("figure20")
    assert column(outcome, "kp_nm_s_rad")[[0, -1]].tolist() == [150.0, 1500.0]
    away = column(outcome, "difference_rad_s")
    best = int(np.argmin(away))
    assert 0 < best < len(away) - 1
    assert np.all(np.diff(away[: best + 1]) < 0.0)
    assert np.all(np.diff(away[best:]) > 0.0)
    assert holds(outcome, "first falls, then rises").holds is True
    assert holds(outcome, "least at P = 300").holds is None
    assert holds(outcome, "best balance").holds is False


@pytest.mark.long
def test_figure21_is_least_at_the_lowest_i_and_explains_why_it_does_not_rise_throughout():
    outcome = ran("figure21")
    assert column(outcome, "ki_nm_rad")[[0, -1]].tolist() == [200.0, 2500.0]
    assert int(np.argmin(column(outcome, "difference_rad_s"))) == 0
    assert holds(outcome, "least at the lowest I").holds is True
    assert holds(outcome, "first grows").holds is True
    further = holds(outcome, "goes on growing")
    assert further.holds is None
    assert "of 96 tones" in further.ours
    assert holds(outcome, "0.0594").holds is None


def test_figure23_is_a_low_pass():
    outcome = ran("figure23")
    assert column(outcome, "frequency_hz")[[0, -1]].tolist() == [0.1, 1.0]
    assert np.all(np.diff(column(outcome, "output_rad_s")) < 0.0)
    assert np.all(np.diff(column(outcome, "difference_rad_s")) > 0.0)
    for part in ("falls steadily", "grows with the tone", "low-pass"):
        assert holds(outcome, part).holds is True
    assert holds(outcome, "1.3492").holds is None


def test_every_statement_is_in_words(swept):
    for statement in swept.statements:
        assert statement.text
        assert statement.published
        assert statement.ours


def test_pictures_can_be_drawn(swept):
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    figure = Figure(figsize=swept.figure_size_in)
    swept.draw(figure)
    assert len(figure.axes) == 2
    assert all(axes.get_xlabel() and axes.get_ylabel() and axes.get_legend() for axes in figure.axes)


# -- the linear loop ---------------------------------------------------------------------------------------------


def test_without_filters_the_loop_is_the_textbook_s():
    """The reference is (K_p s + K_i)/(J s² + (K_p + B) s + K_i)."""
    rig = SimulatedRig(loop_filter_s=0.0, loop_torque_lag_s=0.0)
    hertz = np.array([0.05, 0.2, 0.7, 2.0])
    s = 2j * np.pi * hertz
    textbook = np.abs((300.0 * s + 200.0) / (104.0 * s**2 + 308.0 * s + 200.0))
    assert gain(rig, hertz, 300.0, 200.0, reported=False) == pytest.approx(textbook, rel=1e-12)
    lag = 1.0 / np.sqrt(1.0 + (2.0 * np.pi * hertz * rig.speed_lag_s) ** 2)
    assert gain(rig, hertz, 300.0, 200.0, reported=True) == pytest.approx(textbook * lag, rel=1e-12)


def test_where_the_minimum_lies_depends_on_the_tone():
    rig = SimulatedRig()
    assert best_kp(rig, 0.2, 200.0, 150.0, 1500.0) == pytest.approx(300.0, rel=0.05)
    assert best_kp(rig, 0.1, 200.0, 150.0, 1500.0) > 500.0
    assert best_kp(rig, 0.3, 200.0, 150.0, 1500.0) == pytest.approx(150.0)
