"""Marks of rehearsals in each report and on the terminal. Only the result of an identification used to have it."""

from __future__ import annotations

import io

import pytest

from tdhil.report import PlainConsole, card_text, evaluation_report, result_document, write_evaluation_report
from tdhil.report.blocks import report_of
from tdhil.report.document import banner
from tdhil.report.evaluation import print_evaluation
from tdhil.report.verification import print_verification
from tests.report.findings import RUN, full, recording
from tests.report.test_evaluation import document as evaluated
from tests.soft_torque.test_evaluation import rows

FAULTED = {"simulated": True, "rehearsed_faults": ["spike=3"]}
MARKS = "SIMULATED · FAULT REHEARSAL"
VERIFIED = {
    "verdict": "agrees", "reason": "as predicted", "next_step": "", "rows": [], "log": "run.mcap",
    "tuned_for": {"kind": "stiff", "source": "loop.json"}, "misfit": {"rms_share": None, "p": None},
    "steps": {"counted_pairs": 3, "step_rad_s": 0.1, "low_rad_s": 1.0, "half_s": 2.0},
}


def printed(show, document) -> str:
    out = io.StringIO()
    show(document, PlainConsole(out))
    return out.getvalue()


def test_the_terminal_marks_an_evaluation_and_a_verification():
    log = rows(57.0, (57.5,))
    assert f"· {MARKS}" in printed(print_evaluation, evaluated(log) | FAULTED)
    verified = printed(print_verification, VERIFIED | FAULTED)
    assert f"verified by steps · {MARKS}" in verified
    assert "3 pairs: 0.1 rad/s up from 1 rad/s and down again, 2 s each" in verified
    plain = VERIFIED | {"simulated": True, "rehearsed_faults": []}
    assert "· SIMULATED" in printed(print_verification, plain) and "REHEARSAL" not in printed(print_verification, plain)


def test_the_report_of_an_evaluation_is_marked_like_that_of_a_result(tmp_path):
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    log = rows(57.0, (57.5,))
    found = evaluated(log) | FAULTED
    result = result_document(full(), recording(simulated=True), RUN | {"faults": ["spike=3"]}, "run.mcap")
    assert MARKS in card_text(result, 80)
    assert evaluation_report(found, log).simulated == report_of(result, recording()).simulated == banner(found)
    assert banner(found).startswith(f"{MARKS}: ") and "rehearsed: spike=3" in banner(found)
    text = write_evaluation_report(found, log, tmp_path / "x.html").read_text(encoding="utf-8")
    assert f"({MARKS})</title>" in text.replace("\n", "")
