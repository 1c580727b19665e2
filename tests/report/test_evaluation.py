"""Page of an evaluation: measured and predicted values, bit and top drive over time; complete or aborted."""

from __future__ import annotations

import io

import pytest

from tdhil.report import PlainConsole, evaluation_document, evaluation_report, print_evaluation, write_evaluation_report
from tdhil.soft_torque import COLUMNS, Phase, evaluate
from tests.report.findings import RUN, recording
from tests.soft_torque.test_evaluation import CASE, PROGRAM, rows

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")


def document(log, **changes):
    return evaluation_document(evaluate(log, CASE, PROGRAM), CASE, recording(**changes), RUN, "run.mcap")


@pytest.mark.heavy
def test_the_page_has_both_columns_and_the_pictures(tmp_path):
    log = rows(57.0, (60.0, 56.3, 57.2), damping=0.22)
    page = evaluation_report(document(log), log)
    assert page.answer.colour == "green" and "57.2 rpm" in page.answer.value
    headings = [section.heading for section in page.sections]
    assert headings == ["Measured and predicted by tune", "Bit and top drive", "Trials", "Basis of the result", "Run",
                        "Meaning of the figures"]
    critical, damping, sticking, *_ = page.sections[0].blocks[0].rows
    assert critical[1:] == ("57.2, sticks at 56.3", "57 (56 to 59)")
    assert damping[1].startswith("0.220") and damping[2] == "0.226 (0.213 to 0.240)"
    assert "sticking" in sticking[0]
    assert page.sections[2].blocks[0].rows == (("56.3", "sticks"), ("57.2", "turns"), ("60.0", "turns"))
    text = write_evaluation_report(document(log), log, tmp_path / "x.html").read_text(encoding="utf-8")
    assert text.count("<svg") == 3
    assert "SIMULATED" in text and "A. &lt;Person&gt;" in text and "\x1b" not in text
    assert write_evaluation_report(document(log), log, tmp_path / "x.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("log", "colour", "words"), [
    (rows(66.0, (68.0, 65.2, 66.1), damping=0.22), "yellow", "critical speed 66.1 rpm, predicted 56 to 59"),
    (rows(57.0, (57.5, 56.6), damping=0.22, clamped=1.0), "red", "torque limit"),
    (rows(57.0, ())[:100], "red", "ended at 45 rpm, before"),
    (rows(57.0, ())[:1], "red", "ended at 45 rpm, before"),
], ids=["differs", "invalid", "cut short", "one cycle"])
def test_a_disagreement_is_stated_in_the_box(log, colour, words, tmp_path):
    found = document(log, complete=len(log) > 100)
    page = evaluation_report(found, log)
    assert page.answer.colour == colour and words in page.answer.reason
    assert bool(page.warnings) is (len(log) <= 100)
    write_evaluation_report(found, log, tmp_path / "x.html")


def test_a_damping_that_is_not_compared_is_not_green():
    log = rows(57.0, (60.0, 56.3, 57.2), damping=0.22)
    log = log[log[:, COLUMNS.index("phase")] != Phase.RELEASED]            # no decay
    found = document(log)
    assert (found["verdict"], found["damping_compared"]) == ("as_predicted", False)
    answer = evaluation_report(found, log).answer
    assert answer.colour == "yellow" and "damping is not compared" in answer.verdict
    assert "no damping was found" in answer.reason
    printed = io.StringIO()
    print_evaluation(found, PlainConsole(printed))
    assert "damping is not compared" in " ".join(printed.getvalue().split())
    assert document(rows(57.0, (60.0, 56.3, 57.2), damping=0.22))["damping_compared"] is True


def test_a_phase_that_did_not_occur_has_no_picture():
    log = rows(57.0, (57.5,))
    log = log[log[:, COLUMNS.index("phase")] != Phase.RELEASED]
    assert len(evaluation_report(document(log), log).sections[1].blocks) == 2
