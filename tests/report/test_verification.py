"""Rows of a verification by steps: their statements, and no statement for a response without gains."""

from __future__ import annotations

import io

import numpy as np

from tdhil.report import PlainConsole
from tdhil.report.verification import print_verification, verification_document
from tests.report.findings import RUN, recording
from tests.speed_loop.test_verification import CASE, PERIOD_S, PROGRAM, found, responses


def shown(pairs):
    """Return the document of these pairs of steps, and the text on the terminal."""
    document = verification_document(found(pairs), CASE, PROGRAM, recording(), RUN, "run.mcap")
    out = io.StringIO()
    print_verification(document, PlainConsole(out))
    return document, out.getvalue()


def test_each_quantity_of_a_response_as_predicted_agrees():
    document, text = shown(responses(CASE.gains, noise=0.002))
    assert document["verdict"] == "agrees" and text.count("agrees") == 1 + len(document["rows"])


def test_no_gain_agrees_beside_a_response_that_no_gains_explain():
    pairs = responses(CASE.gains, noise=0.002)
    document, text = shown(pairs + 0.08 * np.sin(2.0 * np.pi * 3.0 * PERIOD_S * np.arange(pairs.shape[1])))
    assert document["verdict"] == "differs" and {row["within"] for row in document["rows"]} == {None}
    assert "agrees" not in text and "any P and I" in " ".join(text.split())
