"""Warnings of the run itself: they are in each kind of result, not only in an identification."""

from __future__ import annotations

import io
from dataclasses import asdict

import pytest

from tdhil.report import PlainConsole
from tdhil.report.evaluation import evaluation_report, print_evaluation
from tdhil.report.verification import print_verification, verification_report
from tdhil.session.conclusion import conclude_run
from tests.report.findings import RUN, recording
from tests.soft_torque.test_evaluation import CASE as STRING_CASE
from tests.soft_torque.test_evaluation import PROGRAM as STRING_PROGRAM
from tests.soft_torque.test_evaluation import rows
from tests.speed_loop.test_verification import CASE, PERIOD_S, PROGRAM

STOP, MASTER = "the stop of this run was NOT confirmed", "another master wrote 6060h"
WARNED = {**RUN, "stop": {"confirmed": False}, "others": [MASTER]}
VERIFIED = {"verification": {"case": CASE.plain(), "program": asdict(PROGRAM), "starts_s": [],
                             "reference_filter_s": 0.0}, "cycle": {"period_s": PERIOD_S}}
EVALUATED = {"evaluation": {"case": STRING_CASE.plain(), "program": asdict(STRING_PROGRAM)}}


@pytest.mark.parametrize("kind", [VERIFIED, EVALUATED], ids=["verification", "evaluation"])
def test_an_unconfirmed_stop_and_another_master_are_beside_the_verdict(kind):
    string = rows(57.0, (57.5,))
    document = conclude_run(recording(), WARNED | kind, "run.mcap", string).document
    assert [STOP in document["warnings"][0], MASTER in document["warnings"][1]] == [True, True]
    assert all(code.startswith("TDH-") for code in document["warning_codes"])
    out = io.StringIO()
    show, page = (print_verification, verification_report(document)) if kind is VERIFIED else (
        print_evaluation, evaluation_report(document, string))
    show(document, PlainConsole(out))
    assert STOP in " ".join(out.getvalue().split()) and MASTER in out.getvalue()
    assert STOP in page.warnings[0] and MASTER in page.warnings[1]


def test_a_run_without_them_has_none():
    assert conclude_run(recording(), {**RUN, **VERIFIED}, "run.mcap").document["warnings"] == []
