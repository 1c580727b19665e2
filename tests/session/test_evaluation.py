"""Evaluation from the log alone; in an aborted run only the time before the abort counts."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from tdhil.errors import LogError
from tdhil.recording import Stage
from tdhil.recording.recording import MARGIN_S
from tdhil.session.evaluation import conclude_evaluation
from tdhil.soft_torque import COLUMNS, evaluate
from tests.report.findings import RUN, recording
from tests.soft_torque.test_evaluation import CASE, PROGRAM, rows


@pytest.mark.parametrize(("end_s", "trials"), [(190.0, 2), (110.0, 0)])
def test_data_after_an_abort_do_not_count(end_s, trials):
    log = rows(57.0, (60.0, 56.3, 57.2), damping=0.22)
    stages = (Stage("acquire", 8.0, end_s, "aborted", "Interrupted: interrupted by Ctrl-C"),)
    run = RUN | {"evaluation": {"case": CASE.plain(), "program": asdict(PROGRAM)}}
    whole = conclude_evaluation(log, recording(len(log) * 10), run, "run.mcap").document
    assert len(whole["trials"]) == 3
    assert not any("aborted" in one for one in whole["warnings"])
    found = conclude_evaluation(log, recording(len(log) * 10, stages=stages), run, "run.mcap").document
    before = evaluate(log[log[:, COLUMNS.index("time_s")] < end_s - MARGIN_S - 0.01], CASE, PROGRAM)
    assert found["verdict"] == before.outcome.value and found["reason"] == before.why
    assert [one["set_rpm"] for one in found["trials"]] == [one.set_rpm for one in before.trials]
    assert len(found["trials"]) == trials < len(whole["trials"])
    assert np.isclose(found["loop"]["unknown_rms_nm"], before.unknown_rms_nm)
    assert found["warnings"][0] == ("the run was aborted in stage acquire (interrupted by Ctrl-C). The result uses the "
                                    "data recorded before")


def test_a_run_that_was_aborted_at_once_has_no_evaluation():
    log = rows(57.0, (60.0,), damping=0.22)
    stages = (Stage("acquire", 0.0, 0.5, "aborted", "Interrupted: interrupted by Ctrl-C"),)
    run = RUN | {"evaluation": {"case": CASE.plain(), "program": asdict(PROGRAM)}}
    with pytest.raises(LogError, match="the virtual string was never turned"):
        conclude_evaluation(log, recording(len(log) * 10, stages=stages), run, "run.mcap")
