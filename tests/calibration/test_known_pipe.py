"""Drill string with known dimensions: sensitivities, exponent, coverage, and refusal of uncertain pipe data."""

from dataclasses import replace

import numpy as np
import pytest

from profiles import MessageCode
from tdhil.calibration import KnownPipe, PipeInput, calibrate_known_pipe
from tdhil.estimation import MeasuredString
from tdhil.estimation.frequency_domain import string_view
from tdhil.estimation.result import Estimate
from tdhil.recording import Stage
from tdhil.report import PlainConsole, factor_report, print_factor, write_blocks
from tdhil.session import find_by_known_pipe, known_pipe_of
from tests.calibration.bodies import recording
from tests.calibration.bodies import run as body_run
from tests.calibration.pipe_lines import MEASURED, string_file, study_case
from tests.estimation.compliant_bench import Noise, Pipe, run


def test_the_sensitivities_are_those_of_the_formulas():
    known = known_pipe_of(string_file(MEASURED), 4.0)
    outer, inner = 0.127**4, 0.1086**4
    polar = np.pi / 32.0 * (outer - inner)
    assert known.impedance_nm_s_rad == pytest.approx(polar * np.sqrt(79.3e9 * 7850.0) / 16.0)
    assert known.delay_s == pytest.approx(2300.0 * np.sqrt(7850.0 / 79.3e9))
    found = {one.source.split(" of ")[0]: (one.of_impedance, one.of_delay) for one in known.inputs}
    expected = {
        "shear modulus": (0.5, -0.5), "density": (0.5, 0.5), "length": (0.0, 1.0),
        "outer diameter": (4.0 * outer / (outer - inner), 0.0), "inner diameter": (-4.0 * inner / (outer - inner), 0.0),
    }
    assert found.keys() == expected.keys()
    for name, pair in expected.items():
        assert found[name] == pytest.approx(pair, abs=1e-5), name


def test_the_measured_travel_time_replaces_an_uncertain_shear_modulus():
    """e = −1 is the inertia ρ I L of the string, which does not contain G. e = 0 is its impedance."""
    assert known_pipe_of(string_file(MEASURED), 1.0).exponent == pytest.approx(-1.0, abs=0.05)
    sharp = string_file({**MEASURED, "shear_modulus": 0.001, "length": 0.1})
    assert known_pipe_of(sharp, 1.0).exponent == pytest.approx(0.0, abs=0.05)


def test_the_exponent_has_the_least_uncertainty():
    known = known_pipe_of(string_file({**MEASURED, "shear_modulus": 0.01}), 1.0)

    def variance(e):
        return sum(((one.of_impedance - e * one.of_delay) * one.rel_sd) ** 2 for one in known.inputs)

    assert variance(known.exponent) <= min(variance(known.exponent + step) for step in (-0.01, 0.01))


@pytest.mark.parametrize("exponent", [-1.0, -0.4, 0.0, 1.0])
def test_the_view_is_that_of_the_string(exponent):
    m = np.array([1500.0, 12.0, 588.0, 0.9, 5.0, 4.0, 0.36, 0.5])
    inertia, stiffness = 0.36 * 588.0, 0.81 * 588.0 * (1.0 - 0.24)
    z = np.sqrt(inertia * stiffness) * np.sqrt(inertia / stiffness) ** -exponent
    view = string_view(exponent)
    assert view.of(m) == pytest.approx(z, rel=1e-12)
    seen = m.copy()
    seen[view.index] = z
    load, slope = view.back(seen)
    assert load == pytest.approx(588.0, rel=1e-12)
    for index in range(len(m)):
        step = np.zeros(len(m))
        step[index] = 1e-6 * seen[index]
        by = (view.back(seen + step)[0] - view.back(seen - step)[0]) / (2.0 * step[index])
        assert slope[index] == pytest.approx(by, rel=1e-5, abs=1e-9)


def measured(value, share=0.005):
    return MeasuredString(Estimate(value, value * (1.0 - share), value * (1.0 + share)), value, 0.7, None)


def known(half):
    return KnownPipe(290.0, 0.72, (PipeInput("density of the pipe", 1.0 - half, 1.0 + half, 0.5, 0.5),))


def test_a_pipe_more_uncertain_than_the_scale_is_refused_with_its_worst_line():
    usual = known_pipe_of(string_file({}), 1.0)
    fit = calibrate_known_pipe(usual, measured(usual.value))
    assert "wider than the torque scale as stated so far (±3.9 %)" in fit.refusal
    assert "wear of the pipe" in fit.refusal
    assert calibrate_known_pipe(usual, measured(usual.value), scale_rel_sd=0.1).refusal == ""


def test_what_no_torque_scale_can_be_is_refused():
    pipe = known(0.01)
    assert calibrate_known_pipe(pipe, measured(pipe.value)).refusal == ""
    assert "no error of a torque scale" in calibrate_known_pipe(pipe, measured(1.4 * pipe.value)).refusal


def test_a_factor_that_contradicts_the_stated_scale_gives_a_warning():
    pipe = known(0.01)
    assert calibrate_known_pipe(pipe, measured(1.02 * pipe.value)).warnings == ()
    (warning,) = calibrate_known_pipe(pipe, measured(1.1 * pipe.value)).warnings
    assert warning.entry is MessageCode.FACTOR_UNLIKE_SCALE and "Check the sizes of the pipe" in warning


@pytest.mark.parametrize("section", [{"length_m": None, "stiffness_nm_rad": 414.0}, None])
def test_a_string_of_several_sections_or_without_a_length_is_no_known_pipe(section):
    file = string_file({})
    first = file.sections[0]
    sections = (first, first) if section is None else (first.model_copy(update=section),)
    with pytest.raises(ValueError, match="one section with length_m"):
        known_pipe_of(file.model_copy(update={"sections": sections}), 1.0)


@pytest.mark.heavy
def test_a_recording_gives_the_factor_and_the_usual_tolerances_do_not(tmp_path):
    """The string is that of `tests.estimation.compliant_bench` in time, with torque reports 4 % too large."""
    recorded = run(Pipe(), [3], noise=Noise(5.0, 0.005, 2.0, 0.001, 1.0))[0]
    reported = replace(recorded, torque_nm=1.04 * recorded.torque_nm, torque_scale_rel_sd=0.02)
    record = body_run(tmp_path, "run.mcap", 0.0, reported).record
    length = Pipe().delay * np.sqrt(79.3e9 / 7850.0)
    polar = Pipe().inertia / 7850.0 / length
    inner = (0.127**4 - 32.0 * polar / np.pi) ** 0.25
    text = (f"sections: [{{length_m: {length:.3f}, outer_diameter_m: 0.127, inner_diameter_m: {inner:.8f}}}]\n"
            "bottom: {inertia_kg_m2: 374}\n")
    (tmp_path / "usual.yaml").write_text(text)
    (tmp_path / "measured.yaml").write_text(
        text + "tolerance: {length: 0.005, outer_diameter: 0.002, inner_diameter: 0.002}\n")
    found = find_by_known_pipe(record, tmp_path / "measured.yaml", 0.95)
    factor = found["calibration_factor"]
    assert factor["low"] <= 1.0 / 1.04 <= factor["high"]
    assert factor["value"] == pytest.approx(1.0 / 1.04, rel=0.01)
    end_s = 0.9 * float(reported.time_s[-1])
    aborted = replace(reported, stages=(Stage("acquire", 0.0, end_s, "aborted", "Interrupted: by Ctrl-C"),))
    parts = [find_by_known_pipe(replace(record, recording=replace(aborted, torque_nm=np.where(
        reported.time_s < end_s - 1.0, reported.torque_nm, share * reported.torque_nm))), tmp_path / "measured.yaml",
        0.95)["calibration_factor"] for share in (1.0, 0.0)]      # data after the abort
    assert parts[0] == parts[1] and parts[0]["low"] <= 1.0 / 1.04 <= parts[0]["high"]
    usual = find_by_known_pipe(record, tmp_path / "usual.yaml", 0.95)
    assert usual["calibration_factor"] is None and usual["measured_factor"] is not None
    assert "wider than" in usual["reason"]
    for document in (found, usual):
        print_factor(document, PlainConsole())
        write_blocks(factor_report(document), tmp_path / f"{document['verdict']}.html")


def test_a_rigid_shaft_has_no_string(tmp_path):
    rigid = recording(0.0, 1)
    (tmp_path / "string.yaml").write_text(
        "sections: [{length_m: 2300, outer_diameter_m: 0.127, inner_diameter_m: 0.1086}]\n"
        "bottom: {inertia_kg_m2: 374}\n")
    found = find_by_known_pipe(body_run(tmp_path, "run.mcap", 0.0, rigid).record, tmp_path / "string.yaml", 0.95)
    assert found["calibration_factor"] is None and found["advice"] and found["verdict"] == "not_identifiable"


@pytest.mark.parametrize("runs", [pytest.param(2, marks=pytest.mark.heavy), pytest.param(40, marks=pytest.mark.long)])
def test_the_interval_covers_strings_whose_true_sizes_are_drawn_from_the_tolerances(runs):
    cases = [study_case(seed) for seed in range(runs)]
    answered = [case for case in cases if not isinstance(case, str)]
    assert len(answered) >= 0.95 * len(cases)
    assert np.mean([covers for _, _, covers in answered]) >= 0.93
