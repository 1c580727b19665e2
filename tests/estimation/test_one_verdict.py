"""One builder of verdicts: every route gives a finding, and only `conclude` makes an Identification from it."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tdhil.estimation as package
from tdhil.estimation import Estimate, Options, ResidualTest, Verdict
from tdhil.estimation.case import Case, Finding, ModelWords
from tdhil.estimation.conclude import conclude
from tdhil.estimation.result import BudgetLine, Refusal
from tdhil.recording.recording import Recording, Stage

WORDS = ModelWords("a shaft", "look elsewhere", "excite more")
FOUND = Finding(model="shaft", words=WORDS, residual=ResidualTest(3.0, 3.0, 0.4),
                inertia=Estimate(100.0, 99.0, 101.0), budget=(BudgetLine("noise", 1.0, ""),))
REJECTED = replace(FOUND, inertia=None, residual=ResidualTest(90.0, 3.0, 1e-9), remark=", and no other does better")
STAGE = Stage("acquire", 0.0, 1.0, "aborted", "the bus is gone")


def case(**more):
    nothing = np.zeros(0)
    recording = Recording(nothing, nothing, nothing, np.zeros(0, bool), np.zeros(0, bool))
    return Case(recording, Options(tolerance=0.02), warnings=("first",), **more)


def trees():
    return [ast.parse(file.read_text(encoding="utf-8")) for file in Path(package.__file__).parent.rglob("*.py")]


@pytest.mark.heavy
def test_an_identification_is_made_in_one_place():
    made = [node for tree in trees() for node in ast.walk(tree)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Identification"]
    assert len(made) == 1


@pytest.mark.heavy
def test_a_refusal_is_caught_in_one_place():
    caught = [node for tree in trees() for node in ast.walk(tree)
              if isinstance(node, ast.ExceptHandler) and isinstance(node.type, ast.Name) and node.type.id == "Refused"]
    assert len(caught) == 1


@pytest.mark.parametrize(
    ("finding", "verdict", "reason", "advice"),
    [
        (FOUND, Verdict.VALID, "a shaft explains the data (p = 0.4)", "identical filters"),
        (replace(FOUND, residual=None), Verdict.VALID, "a shaft explains the data, untested", "identical filters"),
        (replace(FOUND, inertia=Estimate(100.0, 97.0, 103.0)), Verdict.VALID_WIDE,
         "a shaft explains the data (p = 0.4), but the interval is ±3.00 %, wider than ±2.00 %", "excite more"),
        (replace(FOUND, reading_kg_m2=2.0, advice="shorten the cycle"), Verdict.VALID_WIDE,
         "a shaft explains the data (p = 0.4), but the interval is ±3.00 %, wider than ±2.00 %", "shorten the cycle"),
        (REJECTED, Verdict.MODEL_REJECTED,
         "the residuals contradict a shaft (p = 1e-09), and no other does better", "look elsewhere"),
        (Finding(refusal=Refusal("nothing moved", "move it")), Verdict.NOT_IDENTIFIABLE, "nothing moved", "move it"),
    ],
)
def test_the_verdict_follows_from_tolerance_interval_and_p_value(finding, verdict, reason, advice):
    said = conclude(case(), finding)
    assert (said.verdict, said.reason) == (verdict, reason)
    assert said.advice.startswith(advice)
    assert (said.inertia is None) == (finding.inertia is None)
    assert said.warnings == ("first",)


@pytest.mark.parametrize(("scale_rel_sd", "advised"), [(0.0, False), (0.02, True)])
def test_a_calibration_is_advised_if_the_torque_scale_dominates_the_interval(scale_rel_sd, advised):
    one = case()
    said = conclude(replace(one, recording=replace(one.recording, torque_scale_rel_sd=scale_rel_sd)), FOUND)
    assert said.calibration_advised is advised is ("tdhil calibrate torque" in said.advice)
    wide = conclude(case(), replace(FOUND, inertia=Estimate(100.0, 97.0, 103.0)))
    assert not wide.calibration_advised


def test_uncertainty_of_the_sampling_widens_both_intervals():
    plain, wider = (conclude(case(), replace(FOUND, reading_kg_m2=half)).inertia for half in (0.0, 2.0))
    assert (plain.low, plain.high) == (99.0, 101.0)
    assert (wider.low, wider.high) == (97.0, 103.0)
    assert wider.low_total == plain.low_total - 2.0


def test_an_abort_takes_precedence_over_the_data():
    stood, fell = (conclude(case(aborted=STAGE), finding) for finding in (FOUND, REJECTED))
    assert stood.warnings[0].startswith("the run was aborted in stage acquire (the bus is gone). ")
    assert stood.reason == FOUND.explained
    assert fell.reason.startswith("the run was aborted in stage acquire (the bus is gone). ")
    assert fell.reason.endswith(REJECTED.contradicted)
