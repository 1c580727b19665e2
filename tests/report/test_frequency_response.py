"""Frequency response in a report: figure, sentences, and advice for detected distortion."""

from __future__ import annotations

import io
from functools import cache

import numpy as np
import pytest

from tdhil.estimation import identify
from tdhil.report.blocks import Picture, report_of
from tdhil.report.console import PlainConsole
from tdhil.report.document import result_document
from tdhil.report.frequency_response import draw_responses, print_responses, response_sentences
from tests.estimation.analytic import closed_form
from tests.estimation.test_frequency_response import with_torque
from tests.report.findings import RUN

ADVICE = "--realisations 2"


@cache
def measured(distorted):
    """Return a recording of a rigid shaft, and its document. ``distorted``: with a torque beside the excited lines."""
    recording = closed_form(noise=3.0)
    if distorted:
        recording = with_torque(recording, lambda t, _: 2.0 * np.cos(2.0 * np.pi * 0.5 * t))
    return recording, result_document(identify(recording), recording, RUN, "run.mcap")


def test_a_report_shows_the_response_and_its_sentences():
    recording, document = measured(False)
    (section,) = (one for one in report_of(document, recording).sections if one.heading == "Frequency response")
    (picture,) = (block for block in section.blocks if isinstance(block, Picture))
    assert picture.graph == "response"
    assert " ".join(response_sentences(document["frequency_response"])) in picture.about


@pytest.mark.parametrize(("distorted", "sets", "advised"), [(True, 1, True), (True, 2, False), (False, 1, False)])
def test_a_second_set_of_phases_is_advised_for_distortion(distorted, sets, advised):
    _, document = measured(distorted)
    response = document["frequency_response"]
    assert (response["distortion"]["detected"], response["realisations"]) == (distorted, 1)
    assert (ADVICE in " ".join(response_sentences(response | {"realisations": sets}))) is advised


def test_a_single_line_has_one_uncertainty_and_no_model():
    _, document = measured(False)
    found = document["frequency_response"]
    one = found | {"lines": found["lines"][:1], "model": "none"}
    assert "at the only line." in response_sentences(one)[0]
    weak = {"magnitude": {"value": 1.0, "low": 0.5, "high": None}}
    assert "at one of 2 lines; 1 is below the noise." in response_sentences(one | {"lines": [*one["lines"], weak]})[0]
    console = PlainConsole(io.StringIO())
    print_responses([{"log": "run.mcap", "simulated": False, "frequency_response": one}], console)
    assert "95 % intervals; no model is fitted" in console.file.getvalue()


def test_each_of_several_logs_has_its_own_colour_in_every_panel():
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    found = measured(False)[1]["frequency_response"]
    figure = Figure()
    draw_responses(figure, [("one", found), ("two", found), ("three", found)])
    for axes in figure.axes[:3]:
        curves = [line for line in axes.lines if line.get_linestyle() == "-" and len(line.get_xdata()) > 20]
        bands = [to_hex(one.get_facecolor()[0]) for one in axes.collections if isinstance(one, PolyCollection)]
        assert len({to_hex(line.get_color()) for line in curves}) == len(curves) == 3, axes.get_ylabel()
        assert len(set(bands)) == len(bands) == 3, axes.get_ylabel()
