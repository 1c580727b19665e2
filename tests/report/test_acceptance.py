"""Acceptance of expected values: pass, fail or undecided by the interval, and deviations in words."""

import re
from dataclasses import replace

import numpy as np
import pytest

from drivers import DataFileError
from profiles import CodedText, MessageCode
from tdhil.config import Expectation, expectations_in, expectations_of
from tdhil.errors import ExitCode, UsageError
from tdhil.estimation import Estimate
from tdhil.report import acceptance_of, card_text, result_document
from tdhil.session.conclusion import _accepted
from tests.report.findings import RUN, bare, full, recording
from tests.rigs import loaded_rig

EXPECTED = {"inertia": (104.0, 5.0), "viscous": (8.0, 2.0), "coulomb": (60.0, 6.0), "speed-lag": (0.4, 0.05)}


def part(value, share):
    half = value * share
    return {"value": value, "low": value - half, "high": value + half, "low_total": value - half,
            "high_total": value + half}


def document(inertia=104.0, viscous=8.0, coulomb=60.0, speed_lag=0.4, share=0.02):
    return {"inertia_kg_m2": part(inertia, share), "viscous_nm_s_rad": part(viscous, 5 * share),
            "coulomb_nm": part(coulomb, 2 * share), "speed_lag_s": part(speed_lag, 2 * share), "torque_limit_nm": 400.0,
            "impedance": None}


def judged(found, expected=EXPECTED):
    return acceptance_of([Expectation(name, *one) for name, one in expected.items()], found)


def test_a_machine_as_expected_passes():
    found = judged(document())
    assert (found["verdict"], found["off"]) == ("pass", [])
    assert {one["verdict"] for one in found["quantities"]} == {"pass"}


@pytest.mark.parametrize("changed", [{}, {"inertia": 135.0}])
def test_intervals_of_less_than_95_percent_decide_nothing(changed):
    """With --confidence 0.5, a run passed that cannot tell at 95 %."""
    narrow, wide = document(**changed), document(**changed)
    narrow["inertia_kg_m2"]["confidence"], wide["inertia_kg_m2"]["confidence"] = 0.5, 0.99
    found = judged(narrow)
    assert found["verdict"] == "cannot tell"
    assert all("a coverage of 50 %" in one["text"] for one in found["quantities"])
    assert judged(wide)["verdict"] == judged(document(**changed))["verdict"] != "cannot tell"


def test_the_gains_of_a_run_without_j_need_95_percent_too():
    """A run that measures the drive's impedance states its coverage with the frequency response only."""
    found = {"inertia_kg_m2": None, "frequency_response": {"confidence": 0.5},
             "impedance": {"gain_nm_s_rad": part(300.0, 0.01)}}
    assert judged(found, {"gain": (300.0, 30.0)})["verdict"] == "cannot tell"
    found["frequency_response"]["confidence"] = 0.95
    assert judged(found, {"gain": (300.0, 30.0)})["verdict"] == "pass"


@pytest.mark.parametrize(("low", "high", "text"), [
    (1222.2, 1246.8, "pass: expected 1234.5 ± 12.349 kg·m², identified 1235.0 (1222.2 to 1246.8) kg·m²"),
    (1222.2, 1247.0, "cannot tell: expected 1234.5 ± 12.349 kg·m², identified 1235 (1222 to 1247) kg·m²"),
    (1246.8491, 1270.0, "fail: expected 1234.5 ± 12.349 kg·m², identified 1235.0000 (1246.8491 to 1270.0000) kg·m²"),
])
def test_the_printed_interval_never_contradicts_the_printed_verdict(low, high, text):
    """With ± 12.3 and (1222 to 1247), a reader finds another verdict for the first one."""
    found = {"inertia_kg_m2": {"value": 1235.0, "low_total": low, "high_total": high}}
    assert judged(found, {"inertia": (1234.5, 12.349)})["quantities"][0]["text"] == text


def test_printed_numbers_give_the_verdict_for_any_size():
    """2 000 intervals, each with an end near a limit."""
    rng = np.random.default_rng(5)
    for expected, share, half, near in zip(10 ** rng.uniform(-4, 5, 2000), rng.uniform(0.005, 0.2, 2000),
                                           10 ** rng.uniform(-2, 1, 2000), rng.normal(0.0, 1e-3, 2000), strict=True):
        tolerance = share * expected
        end = expected + tolerance * (1.0 + near)
        low, high = (end - half * tolerance, end) if rng.random() < 0.5 else (end, end + half * tolerance)
        part = {"value": 0.5 * (low + high), "low_total": low, "high_total": high}
        (row,) = judged({"inertia_kg_m2": part}, {"inertia": (expected, tolerance)})["quantities"]
        limits, ends = re.fullmatch(r"[a-z ]+: expected (.*) kg·m², identified .*\((.*)\) kg·m²", row["text"]).groups()
        (middle, around), (bottom, top) = map(float, limits.split(" ± ")), map(float, ends.split(" to "))
        inside, apart = middle - around <= bottom and top <= middle + around, bottom > middle + around
        assert row["verdict"] == ("pass" if inside else "fail" if apart else "cannot tell"), row["text"]


@pytest.mark.parametrize(("changed", "name", "words"), [
    ({"inertia": 135.0}, "inertia", "moment of inertia J is 1.3 times"),
    ({"speed_lag": 1.2}, "speed-lag", "lag of the reported speed is 3 times the expected value: the speed filter"),
    ({"coulomb": 90.0}, "coulomb", "Coulomb friction T_c is 1.5 times"),
    ({"viscous": 16.0}, "viscous", "viscous friction B is 2 times"),
])
def test_a_single_deviation_is_named_and_no_other(changed, name, words):
    found = judged(document(**changed))
    assert found["verdict"] == "fail"
    assert [one["name"] for one in found["quantities"] if one["verdict"] == "fail"] == [name]
    (told,) = found["off"]
    assert words in told


def test_friction_is_judged_with_the_torque_scale_like_the_inertia():
    """An exact friction below a torque scale of 3 % (1 sd) neither fails nor passes within 5 %."""
    def verdict(coulomb):
        drawn = result_document(replace(full(), coulomb_nm=Estimate(coulomb, coulomb - 0.1, coulomb + 0.1),
                                        viscous_nm_s_rad=Estimate(8.0, 7.99, 8.01)),
                                recording(torque_scale_rel_sd=0.03), RUN, "run.mcap")
        return judged(drawn, {"coulomb": (60.0, 3.0)})["verdict"], drawn

    assert verdict(64.5)[0] == "cannot tell"          # false fail without the scale
    assert verdict(62.0)[0] == "cannot tell"          # false pass without the scale
    assert verdict(75.0)[0] == "fail"
    found = verdict(60.0)[1]
    for name in ("coulomb_nm", "viscous_nm_s_rad"):
        half = found[name]["high_total"] - found[name]["value"]
        assert half == pytest.approx(1.96 * 0.03 * found[name]["value"], rel=0.01)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_settings_are_compared_in_the_scale_of_the_drive(factor):
    """A calibration that was not applied, as in a run that measures the impedance, changes neither limit nor gain."""
    for applied, limit_nm in ((True, factor * 400.0), (False, 400.0)):
        found = {**document(), "torque_limit_nm": limit_nm,
                 "torque_calibration": {"factor": factor} if applied else None,
                 "impedance": {"gain_nm_s_rad": part(300.0, 0.01)}}
        assert judged(found, {"torque-limit": (400.0, 4.0), "gain": (300.0, 10.0)})["verdict"] == "pass"


@pytest.mark.parametrize(("scope", "load", "name", "verdict"), [
    ("motor_and_load", "none", "inertia", "pass"), ("motor_side", "none", "inertia", "cannot tell"),
    ("motor_side", "string", "inertia", "pass"), ("motor_and_string", "string", "inertia", "cannot tell"),
    ("unclear", "string", "inertia", "cannot tell"), ("motor_side", "none", "motor-inertia", "pass"),
    ("motor_and_load", "none", "motor-inertia", "cannot tell"),
])
def test_the_inertia_of_other_bodies_is_not_judged(scope, load, name, verdict):
    found = judged({**document(), "inertia_scope": scope, "rig": {"load": load}}, {name: (104.0, 5.0)})
    assert found["verdict"] == verdict
    assert (", which is " in found["quantities"][0]["text"]) is (verdict == "cannot tell")


def test_the_document_states_to_which_bodies_its_inertia_refers():
    rigid = replace(full(), compliant=None)
    with_string = replace(recording(), has_drill_string=True)
    together = CodedText("it turns together with the motor", MessageCode.STRING_MOVES_WITH_MOTOR)
    for found, log, scope in (
        (full(), recording(), "motor_side"), (rigid, recording(), "motor_and_load"),
        (replace(rigid, warnings=(together,)), with_string, "motor_and_string"), (rigid, with_string, "unclear"),
        (bare(), recording(), None),
    ):
        assert result_document(found, log, RUN, "run.mcap")["inertia_scope"] == scope


def test_one_factor_in_all_that_has_a_torque_is_one_cause():
    found = judged(document(inertia=104 * 1.3, viscous=8 * 1.3, coulomb=60 * 1.3))
    (told,) = found["off"]
    assert "1.3 times" in told and "torque scale" in told


PRESENT = {"gain_nm_s_rad": 250.0, "integral_nm_rad": 125.0, "filter_s": 0.02, "settings": {}}


def test_the_gains_that_the_drive_reports_are_judged_if_none_was_measured():
    """`--impedance` is not available in the browser, so the gains read in preflight are judged there."""
    expected = {"gain": (250.0, 5.0), "integral-gain": (200.0, 10.0)}
    found = judged({**document(), "speed_loop_present": PRESENT}, expected)
    assert [one["verdict"] for one in found["quantities"]] == ["pass", "fail"]
    assert found["quantities"][0]["text"].endswith("reported by the drive 250 N·m·s/rad")
    (told,) = found["off"]
    assert "integral gain I" in told and "another integral time" in told
    measured = {"gain_nm_s_rad": part(300.0, 0.01), "integral_nm_rad": None}
    found = judged({**document(), "impedance": measured, "speed_loop_present": PRESENT}, expected)
    assert [one["verdict"] for one in found["quantities"]] == ["fail", "fail"]
    assert "identified 300" in found["quantities"][0]["text"]


def test_an_identified_value_has_its_unit_and_the_digits_of_the_result():
    """A signed report must not show one J as 108.1 in its head and as 108.01 in the acceptance."""
    found = judged(document(inertia=103.8907, share=0.0395))
    assert found["quantities"][0]["text"] == "pass: expected 104 ± 5 kg·m², identified 103.9 (99.7 to 108.0) kg·m²"


def test_another_drive_is_named_by_its_identity():
    drive = {"drive": {"name": "EPOS4", "serial": 17}, "profile": {"name": "maxon/epos4"}}
    expected = [Expectation.of("drive-serial", "17"), Expectation.of("drive-name", "epos4"),
                Expectation.of("profile", " maxon/epos4 ")]
    assert acceptance_of(expected, {**document(), **drive})["verdict"] == "pass"
    found = acceptance_of(expected, {**document(), **drive, "drive": {"name": "EPOS4", "serial": 18}})
    assert (found["verdict"], found["off"]) == (
        "fail", ["the serial number of the drive is 18, not 17: another drive"])
    assert acceptance_of(expected, document())["verdict"] == "cannot tell"
    stored = [{"name": one.name, "value": one.value, "tolerance": one.tolerance, "text": one.text} for one in expected]
    assert expectations_in({"acceptance": stored}) == tuple(expected)
    with pytest.raises(ValueError, match="is empty"):
        Expectation.of("profile", " ")


def test_the_interval_decides_and_not_the_value():
    assert judged(document(inertia=108.0))["verdict"] == "cannot tell"          # reaches beyond the tolerance
    assert judged(document(inertia=113.0))["verdict"] == "fail"
    wide = judged(document(share=0.2))
    assert (wide["verdict"], wide["off"]) == ("cannot tell", [])
    assert judged({**document(), "speed_lag_s": None})["verdict"] == "cannot tell"
    assert judged(document(), {"gain": (300.0, 30.0)})["quantities"][0]["text"].endswith("not identified")
    limit = {"torque-limit": (500.0, 10.0)}
    (told,) = judged(document(), limit)["off"]
    assert told.startswith("the torque limit of the run is 0.8 times the expected value")
    assert judged(document(), limit)["quantities"][0]["text"].endswith("identified 400 N·m")      # a setting
    assert acceptance_of([], document()) is None


@pytest.mark.parametrize(("verdict", "stands", "code"), [
    ("pass", True, ExitCode.OK), ("fail", True, ExitCode.NOT_PASSED), ("fail", False, ExitCode.NOT_PASSED),
    ("cannot tell", True, ExitCode.NOT_IDENTIFIABLE), ("pass", False, ExitCode.NOT_IDENTIFIABLE),
])
def test_the_exit_code(verdict, stands, code):
    assert _accepted({"verdict": verdict}, stands=stands) is code
    assert _accepted(None, stands=stands) is (ExitCode.OK if stands else ExitCode.NOT_IDENTIFIABLE)


@pytest.mark.parametrize(("name", "text", "value", "tolerance"), [
    ("inertia", "104 ± 5 %", 104.0, 5.2), ("inertia", "104 kg·m² +/- 2", 104.0, 2.0),
    ("speed-lag", "400ms±50ms", 0.4, 0.05),
    ("torque-limit", "2 kNm ± 10 N·m", 2000.0, 10.0), ("coulomb", "60+-3", 60.0, 3.0),
])
def test_a_value_with_its_tolerance(name, text, value, tolerance):
    found = Expectation.of(name, text)
    assert (found.value, found.tolerance) == (pytest.approx(value), pytest.approx(tolerance))


@pytest.mark.parametrize(("given", "words"), [
    ("inertia=104", "tolerance"), ("mass=1±1", "no quantity is called"), ("inertia", "NAME=VALUE"),
    ("inertia=104±0", "above 0"), ("inertia=104 s±1", "kg"),
])
def test_invalid_expectations_are_refused_by_name(given, words):
    with pytest.raises(UsageError, match="--expect") as caught:
        expectations_of({}, (given,))
    assert words in str(caught.value)


def test_rig_yaml_states_them_and_the_command_line_takes_precedence(tmp_path):
    rig = loaded_rig(tmp_path, "acceptance:\n  inertia: 104 ± 5 %\n  speed-lag: 0.4 s ± 50 ms\n")
    found = expectations_of(rig.acceptance, ("inertia=100±1",))
    assert [(one.name, one.value) for one in found] == [("inertia", 100.0), ("speed-lag", 0.4)]
    with pytest.raises(DataFileError, match=r"rig.yaml:3.*tolerance"):
        loaded_rig(tmp_path, "acceptance:\n  inertia: 104 ± 5 %\n  speed-lag: soon\n")


def test_it_is_in_document_and_card_for_any_content_of_the_log():
    run = {**RUN, "acceptance": [{"name": "inertia", "value": 50.0, "tolerance": 1.0}, {"name": "x"}, 7]}
    assert len(expectations_in(run)) == 1 and expectations_in({"acceptance": 7}) == ()
    found = result_document(full(), recording(), run, "run.mcap")
    assert found["acceptance"]["verdict"] == "fail"
    assert "acceptance" in card_text(found) and "another body" in " ".join(card_text(found).split())
    assert result_document(full(), recording(), RUN, "run.mcap")["acceptance"] is None
