"""`tdhil study soft-torque`: theory in every row as expected; simulations are reduced to a minimum here.

For the cure speeds of four controllers see tests/soft_torque/test_simulation.py. The whole study takes three minutes.
"""

from __future__ import annotations

import pytest

from tdhil.cli.study import all_studies
from tdhil.soft_torque import CriticalSpeeds
from tdhil.studies.soft_torque import study
from tdhil.studies.soft_torque.study import (
    ERROR_ROWS,
    EXPECTED,
    IDEAL,
    SoftTorqueSettings,
    controller_statements,
    controllers,
    error_statements,
)


def test_the_study_is_listed():
    assert all_studies()["soft-torque"].title.startswith("Soft torque")


def test_theory_gives_the_reference_table():
    rows = controllers(SoftTorqueSettings())
    held = {row.name: statement.holds for row, statement in zip(rows, controller_statements(rows), strict=True)}
    assert held == {name: name != IDEAL for name in EXPECTED}


def test_a_deviating_figure_is_reported_with_its_reason():
    rows = controllers(SoftTorqueSettings())[:1]
    found = [type(row)(**{**row.__dict__, "critical": CriticalSpeeds(183.0, 170.0)}) for row in rows]
    statement = controller_statements(found)[1]
    assert statement.holds is False
    assert "start hangs on how it begins" in statement.ours
    errors = {name: tuple(row) for name, row in ERROR_ROWS.items()}
    assert all(one.holds for one in error_statements(errors))
    errors["soft a = 1"] = (94, 72, 73, 75, 84, None)
    assert [one.holds for one in error_statements(errors)].count(False) == 1


@pytest.mark.heavy
def test_it_runs_and_draws(monkeypatch):
    """The searches are replaced by stubs, since each has its own tests."""
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    found = CriticalSpeeds(50.0, 50.0)
    monkeypatch.setattr(study, "critical_speeds", lambda string, loops, search: [found for _ in loops])
    monkeypatch.setattr(study, "lowest_turning", lambda string, loops, how, search: [50.0 for _ in loops])
    told: list[float] = []
    settings = SoftTorqueSettings(duration_s=10.5, beside=False)
    outcome = all_studies()["soft-torque"].run(settings, lambda share, _: told.append(share))
    assert [table.name for table in outcome.tables] == [
        "controllers", "damping", "cure_rpm_by_error_of_J", "largest_stable_share"]
    errors = outcome.tables[2].rows
    assert errors[3][-1] == errors[4][4] == "unstable"
    assert len(outcome.statements) == 2 * len(EXPECTED) + len(ERROR_ROWS) + 2
    assert [one.holds for one in outcome.statements[-2:]] == [True, True]      # possible compensation
    assert told == sorted(told)
    figure = Figure(figsize=outcome.figure_size_in)
    assert outcome.draw is not None
    outcome.draw(figure)
    assert len(figure.axes) == 4
