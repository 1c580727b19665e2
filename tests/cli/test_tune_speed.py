"""`tdhil tune speed` from the file of a result: gains in the drive's units, warnings, refusals, pictures."""

from __future__ import annotations

import html
import json
import math
import re

import pytest

from profiles.library import profile_path
from tdhil.cli.main import main
from tdhil.errors import ExitCode, MessageCode
from tdhil.report import GRAPHS
from tests.cli.test_tune import estimate, impedance, interval
from tests.cli.test_tune import result as any_result


def response():
    """Return the response of J = 15 kg·m² and B = 0.08 N·m·s/rad with a lag of the reported speed."""
    lines = []
    for hertz in (0.1, 0.3, 1.0):
        s = 2j * math.pi * hertz
        g = (1.0 + 0.1 * s) / (1.0 + 0.4 * s) / (15.0 * s + 0.08)
        phase = math.atan2(g.imag, g.real)
        lines.append({"hertz": hertz, "magnitude": interval(abs(g), abs(g) / 1.01, abs(g) / 0.99),
                      "phase_rad": interval(phase, phase - 0.01, phase + 0.01)})
    return {"lines": lines}


def result(**said):
    return any_result(**{"model": "rigid+lags", "torque_lag_s": estimate(0.1, 0.09, 0.11), "skew_s": None,
                         "compliant": None, "frequency_response": response(), **said})


COMPLIANT = {"antiresonance_hz": interval(2.0, 1.95, 2.05), "resonance_hz": interval(3.0, 2.95, 3.05),
             "damping_nm_s_rad": interval(8.0, 4.0, 12.0)}


@pytest.fixture
def tuned(tmp_path, capsys):
    """Run it; return (exit code, document or text, stderr)."""
    def run(*words, as_json=True, **said):
        path = tmp_path / "result.json"
        path.write_text(json.dumps(result(**said)), encoding="utf-8")
        code = main(["tune", "speed", str(path), *(["--json"] if as_json else []), *map(str, words)])
        out, err = capsys.readouterr()
        return code, json.loads(out) if as_json else out, err

    return run


def test_gains_stand_at_the_motor_and_in_the_drives_parameters(tuned):
    code, document, _ = tuned("--present", 40, 30, profile={"name": "siemens/s120-canopen"})
    assert code == 0
    present, found = document["controllers"]
    assert [present["kind"], found["kind"]] == ["present", "tuned"]
    assert present["gain_nm_s_rad"] == 40.0
    assert found["worst"]["phase_deg"] == pytest.approx(45.0, abs=0.1)
    first, second = found["drive_parameters"]
    assert first["title"].startswith("p1460") and first["value"] == pytest.approx(found["gain_nm_s_rad"])
    assert second["unit"] == "ms" and second["value"] == pytest.approx(1e3 * found["integral_time_s"])
    assert "TDH-056" in document["warning_codes"]                      # assumed lags
    assert document["warning_codes"].count("TDH-055") == 1             # beyond 1 Hz, the highest line
    assert max(document["measured"]["deviation_rel"]) < 1e-9
    assert document["measured"]["loops"]["tuned"]["phase_deg"][0] < -90.0
    assert document["steps"]["tuned"]["value"][-1] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("coverage", [0.5, 0.99])
def test_intervals_of_another_coverage_are_refused(tuned, coverage):
    """They were taken as those of 95 %: at 50 %, J was drawn with a third of its standard uncertainty."""
    inertia = result()["inertia_kg_m2"]
    code, document, _ = tuned(inertia_kg_m2={**inertia, "confidence": coverage})
    assert code == 2
    assert f"a coverage of {100 * coverage:g} %" in document["error"]["message"]
    assert tuned(inertia_kg_m2={**inertia, "confidence": 0.95})[0] == 0


def test_an_impedance_of_another_coverage_is_refused(tuned):
    """Such a result has no J whose coverage could be read."""
    response_50 = {**response(), "confidence": 0.5}
    code, document, _ = tuned(inertia_kg_m2=None, verdict="not_identifiable", frequency_response=response_50)
    assert code == 2 and "a coverage of 50 %" in document["error"]["message"]


@pytest.mark.parametrize(("confidence", "high"), [("verified", 0.165), ("likely", 0.225)])
def test_the_filter_that_the_drive_reports_is_in_the_loop(tuned, confidence, high):
    """20 ms were assumed beside it: the phase margin was 15° instead of the promised 45°."""
    present = {"gain_nm_s_rad": None, "integral_nm_rad": None, "filter_s": 0.15,
               "settings": {"filter": {"confidence": confidence}}}
    assumed, reported = (tuned(speed_loop_present=one)[1] for one in (None, present))
    assert reported["plant"]["lags_s"][0] == pytest.approx({"value": 0.15, "low": 0.3 - high, "high": high})
    assert reported["controllers"][-1]["gain_nm_s_rad"] < 0.5 * assumed["controllers"][-1]["gain_nm_s_rad"]
    stated = tuned("--inner-lags", "20ms", "10ms", speed_loop_present=present)[1]
    assert stated["plant"]["lags_s"][0]["value"] == 0.02


def test_present_gains_that_are_faster_within_the_margins_are_not_replaced(tuned):
    code, text, _ = tuned("--present", 320, 240, "--inner-lags", "20ms", "10ms", "--dead-time", "3ms", as_json=False,
                          inertia_kg_m2=estimate(15.0, 14.9, 15.1))
    assert code == 0
    assert "present gains keep the margins and are faster" in " ".join(text.split())
    assert "Type in" not in text


def test_the_terminal_fits_80_columns_and_shows_the_parameters(tuned):
    code, text, _ = tuned("--inner-lags", "20ms", "10ms", "--dead-time", "3ms", "--profile", "abb/acs880-enhanced",
                          "--bandwidth", "0.8", as_json=False)
    assert code == 0
    words = " ".join(text.split())
    assert words.startswith("Type in P = ") and "The requested bandwidth is 0.8 Hz" in words
    assert "SIMULATED" in words and "as stated" in words and "TDH-056" not in words
    assert "25.02 Speed proportional gain" in words and "--rated-torque" in words
    assert "required margins 45° and 8 dB" in words and "phase margin, best estimate" in words
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize("hertz", [1.0, 0.6, 0.8556, 1.0049])
def test_the_bandwidth_that_the_warning_advises_ends_it(tuned, hertz):
    """The bandwidth of the result equals the requested one within rounding, such as 0.6000000000000127 Hz."""
    lines = response()["lines"]
    lines[-1]["hertz"] = hertz
    words, said = ("--inner-lags", "20ms", "10ms", "--dead-time", "3ms"), {"frequency_response": {"lines": lines}}
    _, first, _ = tuned(*words, **said)
    (warning,) = (text for text in first["warnings"] if "highest excited frequency" in text)
    (advised,) = re.findall(r"request --bandwidth ([\d.]+)\.$", warning)
    _, second, _ = tuned(*words, "--bandwidth", advised, **said)
    assert "TDH-055" in first["warning_codes"] and "TDH-055" not in second["warning_codes"]


def test_the_interval_of_the_lags_is_rounded_outwards(tuned):
    _, text, _ = tuned("--inner-lags", "20ms", "10.04ms", "--dead-time", "3ms", as_json=False)
    assert "together 29.7 to 36.4 ms" in " ".join(text.split())          # ±10 %: 29.736 to 36.344 ms


def test_a_rehearsal_is_marked(tuned):
    code, text, _ = tuned(simulated=True, rehearsed_faults=["torque-scale=1.1"], as_json=False)
    assert code == 0 and "speed loop of the drive · SIMULATED · FAULT REHEARSAL" in " ".join(text.split())


def test_measured_lags_and_present_gains_come_from_the_impedance(tuned, tmp_path):
    path = tmp_path / "z.json"
    path.write_text(json.dumps(result(impedance=impedance())), encoding="utf-8")
    code, document, _ = tuned("--impedance", path)
    assert code == 0
    assert document["plant"]["lags_from"] == "as measured (--impedance)"
    _, text, _ = tuned("--impedance", path, as_json=False)
    assert ("21 (18 to 24) + 12 (10 to 14) ms, together 32 to 34 ms, up to 4.5 ms of it as dead time"
            in " ".join(text.split()))
    lags = document["plant"]["lags_s"]
    assert [lag["value"] for lag in lags] == [0.021, 0.012]
    assert document["plant"]["lag_sum_s"] == {"value": 0.033, "low": 0.032, "high": 0.034}
    assert document["plant"]["dead_time_s"]["high"] == pytest.approx(0.0045)      # a part of the sum
    assert document["controllers"][0]["gain_nm_s_rad"] == pytest.approx(203.0)
    assert tuned("--impedance", path, "--present", 1, 1)[0] == ExitCode.USAGE


def reported(gain=40.0, integral=30.0, units=("nm_s_rad", "nm_rad"), values=(40.0, 30.0), confidence="verified"):
    rows = zip(("gain", "integral"), ("2101h", "2102h"), units, values, strict=True)
    settings = {part: {"title": part, "where": where, "raw": 1.0, "value": value, "unit": unit,
                       "confidence": confidence}
                for part, where, unit, value in rows
                if value is not None}
    return {"gain_nm_s_rad": gain, "integral_nm_rad": integral, "filter_s": None, "settings": settings}


def present_in(document):
    found = [one for one in document["controllers"] if one["kind"] == "present"]
    gains = (found[0]["gain_nm_s_rad"], found[0]["integral_nm_rad"]) if found else None
    return gains, document["tuned_for"]["present_from"]


def test_the_drives_own_gains_come_after_typed_and_measured_ones(tuned, tmp_path):
    path = tmp_path / "z.json"
    path.write_text(json.dumps(result(impedance=impedance())), encoding="utf-8")
    _, document, _ = tuned(speed_loop_present=reported())
    assert present_in(document) == ((40.0, 30.0), "reported by the drive (2101h, 2102h)")
    _, document, _ = tuned("--present", 20, 10, speed_loop_present=reported())
    assert present_in(document) == ((20.0, 10.0), "as stated (--present)")
    _, document, _ = tuned("--impedance", path, speed_loop_present=reported())
    gains, source = present_in(document)
    assert (gains[0], source) == (pytest.approx(203.0), "as measured (--impedance)")
    _, document, _ = tuned()
    assert present_in(document) == (None, None)


PERCENT = {"gain": None, "integral": None, "units": ("percent_per_percent", "ms"), "values": (10.0, 2000.0)}


@pytest.mark.parametrize(("words", "said", "gains", "source"), [
    ((), PERCENT, None, "they need --rated-torque and --rated-speed of the motor's name plate"),
    # 10 %/% of 600 N·m and 1500 rpm = 157.08 rad/s: 38.197 N·m·s/rad; over 2 s.
    (("--rated-torque", "600", "--rated-speed", "1500"), PERCENT, (38.197, 19.099), "(2101h, 2102h)"),
    ((), {"gain": None, "integral": None, "units": ("unknown", "ms")}, None, "the profile does not know their units"),
    ((), {"gain": None, "integral": None, "units": ("a_s_rad", "ms")}, None, "needs the motor's torque constant"),
    ((), {"integral": 0.0, "values": (40.0, 0.0)}, None, "P or I is 0"),
    ((), {"integral": None, "values": (40.0, None)}, None, "the drive did not report both gains"),
    ((), {"confidence": "unverified"}, (40.0, 30.0), "in units that the profile marks as unverified"),
])
def test_gains_that_cannot_be_compared_give_the_reason(tuned, words, said, gains, source):
    code, document, _ = tuned(*words, speed_loop_present=reported(**said))
    assert code == 0
    found, text = present_in(document)
    assert found == (gains if gains is None else pytest.approx(gains, rel=1e-4))
    assert source in text


@pytest.mark.parametrize("junk", [3, [], {}, {"settings": 4}, {"settings": {"gain": 1, "integral": 2}}])
def test_a_broken_entry_is_no_error(tuned, junk):
    code, document, _ = tuned(speed_loop_present=junk)
    assert code == 0
    assert present_in(document)[0] is None


def test_the_terminal_names_the_source_of_the_present_gains(tuned):
    code, text, _ = tuned(speed_loop_present=reported(), as_json=False)
    assert code == 0
    assert "present gains reported by the drive (2101h, 2102h)" in " ".join(text.split())


def test_objects_of_the_simulated_drive_are_not_named_for_a_real_one(tuned):
    for simulated in (True, False):
        _, document, _ = tuned(profile={"name": "generic/cia402"}, simulated=simulated)
        assert bool(document["controllers"][-1]["drive_parameters"]) is simulated


NAMED = """  notch:
    - {title: p1658 notch frequency, quantity: frequency_hz, source: the manual, confidence: likely}
    - {title: p1659 notch width, quantity: width_hz, source: the manual, confidence: likely}
    - {title: p1660 notch depth, quantity: depth_db, source: the manual, confidence: likely}
    - {title: p1661 damping of the numerator, quantity: numerator_damping, source: the manual, confidence: likely}
"""


@pytest.mark.heavy
def test_a_notch_is_given_in_the_drives_own_parameters(tuned, tmp_path):
    text = profile_path("siemens/s120-canopen").read_text(encoding="utf-8")
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace("speed_controller:\n", "speed_controller:\n" + NAMED), encoding="utf-8")
    _, document, _ = tuned("--profile", path, compliant=COMPLIANT, frequency_response=None)
    found = document["controllers"][-1]
    notch = found["notch"]
    assert [(one["title"], one["value"], one["unit"]) for one in found["drive_parameters"][2:]] == [
        ("p1658 notch frequency", notch["hertz"], "Hz"), ("p1659 notch width", notch["width_hz"], "Hz"),
        ("p1660 notch depth", notch["depth_db"], "dB"),
        ("p1661 damping of the numerator", notch["numerator_damping"], "")]
    assert document["notch_by_hand"] is None


@pytest.mark.heavy
def test_without_parameters_of_its_own_a_notch_is_given_in_plain_units(tuned):
    _, document, _ = tuned("--profile", "abb/acs880-enhanced", compliant=COMPLIANT, frequency_response=None)
    notch = document["controllers"][-1]["notch"]
    said = document["notch_by_hand"]
    assert said.startswith(f"Notch: frequency 3 Hz, width {notch['width_hz']:.3g} Hz at −3 dB, depth "
                           f"{notch['depth_db']:.3g} dB.")
    assert "The profile abb/acs880-enhanced does not describe the drive's notch." in said
    _, text, _ = tuned(compliant=COMPLIANT, frequency_response=None, as_json=False)
    words = " ".join(text.split())
    assert "Notch: frequency 3 Hz, width" in words and "The drive's notch is not known without a profile." in words
    assert "notch: width, Hz; depth, dB" in words
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.heavy
def test_a_resonance_gets_a_notch_and_a_string_a_warning(tuned):
    code, document, _ = tuned(model="string+lags", compliant=COMPLIANT, frequency_response=None)
    assert code == 0
    assert document["controllers"][-1]["notch"]["hertz"] == pytest.approx(3.0)
    assert document["bandwidth_without_notch_hz"] < document["controllers"][-1]["bandwidth_hz"]["value"]
    assert {"TDH-056", "TDH-057"} <= set(document["warning_codes"])
    _, document, _ = tuned("--no-notch", compliant=COMPLIANT)
    assert document["controllers"][-1]["notch"] is None
    assert "TDH-058" in document["warning_codes"]                      # the response is that of a rigid shaft


@pytest.mark.parametrize(("words", "said", "code", "message"), [
    (("--bandwidth", "40"), {}, 11, "The largest bandwidth that fits is"),
    ((), {"inertia_kg_m2": None, "verdict": "not_identifiable"}, 11, "no J to tune for (not_identifiable)"),
    ((), {"warning_codes": [MessageCode.STRING_MOVES_WITH_MOTOR.code]}, 11, "that of motor and string together"),
    ((), {"compliant": {**COMPLIANT, "resonance_hz": None}}, 11, "its antiresonance or resonance is open"),
    (("--inner-lags", "0", "--dead-time", "0"), {}, 2, "there is no lag in the drive's loop"),
    (("--phase-margin", "5"), {}, 2, "--phase-margin: 5: must be from 20 to 80 degrees"),
    (("--plot", "tune.txt"), {}, 2, "ends in none of"),
    (("--profile", "nobody/none"), {}, 2, "nobody/none"),
])
def test_what_is_refused(tuned, words, said, code, message):
    seen, document, err = tuned(*words, **said)
    assert seen == code
    assert message in document["error"]["message"]
    assert "Traceback" not in err


def test_a_j_that_may_include_the_string_is_warned_of(tuned):
    _, document, _ = tuned(warning_codes=[MessageCode.LOAD_MAY_STAY_BEHIND.code])
    assert any("motor alone or of motor and string" in one for one in document["warnings"])
    _, document, _ = tuned()
    assert not any("string" in one for one in document["warnings"])


def test_present_gains_with_small_margins_are_reported_with_a_code(tuned):
    _, document, _ = tuned("--present", 400, 9000)
    assert document["controllers"][0]["failed"]
    assert "TDH-059" in document["warning_codes"]


@pytest.mark.heavy
def test_picture_and_page_are_written_and_nothing_is_overwritten(tuned, tmp_path):
    pytest.importorskip("matplotlib")
    picture, page = tmp_path / "tune.svg", tmp_path / "tune.html"
    assert tuned("--plot", picture, "--report", page, "--present", 40, 30)[0] == 0
    drawn = picture.read_text(encoding="utf-8")
    assert drawn.count("<svg") == 1
    parts = re.findall(r"<text[^>]*>([^<]*)</text>|<!-- (.*?) -->", drawn, re.DOTALL)      # text, or letter outlines
    said = html.unescape(" ".join(text or beside for text, beside in parts))
    for graph in ("open_loop", "step"):             # a line of help below each
        assert " ".join(said.split()).count(GRAPHS[graph].good[:40]) == 1
    text = page.read_text(encoding="utf-8")
    assert text.count("<svg") == 2 and "SIMULATED" in text and "TDH-056" in text
    assert tuned("--plot", picture)[0] == ExitCode.USAGE
    assert tuned("--report", page)[0] == ExitCode.USAGE


def test_the_gains_of_a_calibrated_result_are_in_the_drive_s_own_torque(tuned):
    """The drive does not know the calibration κ. With T = κ T_drive, its controller sees (J/κ) ω' = T_drive."""
    _, plain, _ = tuned()
    factor = 1.1
    scaled = {name: {key: factor * value if isinstance(value, float) and key != "confidence" else value
                     for key, value in result()[name].items()}
              for name in ("inertia_kg_m2", "viscous_nm_s_rad", "coulomb_nm")}
    code, found, _ = tuned(**scaled, torque_calibration={"factor": factor, "rel_sd": 0.005})
    assert code == 0
    ours, theirs = (document["controllers"][-1] for document in (found, plain))
    for name in ("gain_nm_s_rad", "integral_nm_rad"):
        assert ours[name] == pytest.approx(theirs[name], rel=1e-6)
    assert any("torque calibration (factor 1.1)" in warning for warning in found["warnings"])
    assert not any("torque calibration" in warning for warning in plain["warnings"])


# ---------------------------------------------------------------------------------------------------------------------
# Backlash and distortion

LAGS = ("--inner-lags", "20ms", "10ms", "--dead-time", "3ms")
UNSIZED = [{"play_rad": None, "at_motor_rad": None}]


def sized(share, width=1.05):
    """Return a play of 20 mrad, of which the motor shows a share."""
    return [{"play_rad": interval(0.02, 0.02 / width, 0.02 * width),
             "at_motor_rad": interval(0.02 * share, 0.02 * share / width, 0.02 * share * width)}]


def test_a_backlash_without_the_motors_inertia_is_named_and_the_promise_withdrawn(tuned):
    code, document, _ = tuned(*LAGS, backlash=UNSIZED)
    assert code == 0
    assert "TDH-066" in document["warning_codes"] and document["plant"]["gap_kg_m2"] is None
    assert "in the worst case while the backlash is closed." in document["sentence"]
    _, text, _ = tuned(*LAGS, as_json=False, backlash=UNSIZED)
    words = " ".join(text.split())
    assert "backlash, open the inertia of the motor alone is not known" in words
    assert "State the inertia of the motor side with --motor-inertia" in words
    for none in ([], None):
        _, document, _ = tuned(*LAGS, backlash=none)
        assert "TDH-066" not in document["warning_codes"] and "backlash" not in document["sentence"]


@pytest.mark.parametrize(("words", "said", "least_kg_m2", "source"), [
    (("--motor-inertia", "7.5"), {"backlash": UNSIZED}, 6.75, "as stated (--motor-inertia)"),
    (("--motor-inertia", "7.5"), {}, 6.75, "as stated (--motor-inertia)"),
    # the motor shows J_L/J of the play
    ((), {"backlash": sized(0.5)}, 14.25 * (1.0 - 0.5 * 1.05**2), "from the play and the part of it"),
])
def test_the_motor_alone_is_a_corner_where_its_inertia_is_known(tuned, words, said, least_kg_m2, source):
    inertia = {"inertia_kg_m2": estimate(15.0, 14.25, 15.75)}
    _, before, _ = tuned(*LAGS, **inertia)
    code, document, _ = tuned(*LAGS, *words, **inertia, **said)
    assert code == 0
    assert document["plant"]["gap_kg_m2"]["low"] == pytest.approx(least_kg_m2)
    assert source in document["plant"]["gap_from"]
    assert "TDH-066" not in document["warning_codes"] and "while the backlash" not in document["sentence"]
    ours, theirs = (one["controllers"][-1] for one in (document, before))
    assert ours["gain_nm_s_rad"] < 0.8 * theirs["gain_nm_s_rad"]
    assert ours["worst"]["phase_deg"] == pytest.approx(45.0, abs=0.1)
    _, text, _ = tuned(*LAGS, *words, as_json=False, **inertia, **said)
    assert "backlash, open motor alone with" in " ".join(text.split())


def test_a_share_of_the_play_that_may_be_the_whole_gives_no_inertia_of_the_motor(tuned):
    _, document, _ = tuned(*LAGS, backlash=sized(0.8, 1.2))
    assert document["plant"]["gap_kg_m2"] is None and "TDH-066" in document["warning_codes"]


@pytest.mark.parametrize("inertia", ["0", "200"])
def test_an_inertia_of_the_motor_that_cannot_be_is_refused(tuned, inertia):
    code, document, _ = tuned("--motor-inertia", inertia)
    assert code == ExitCode.USAGE and "--motor-inertia" in document["error"]["message"]


def test_the_inertia_of_the_motor_is_converted_to_the_drive_s_own_torque(tuned):
    _, document, _ = tuned("--motor-inertia", "7", torque_calibration={"factor": 1.1, "rel_sd": 0.005})
    assert document["plant"]["gap_kg_m2"]["value"] == pytest.approx(7.0 / 1.1)


def test_distortion_without_a_known_cause_is_a_warning(tuned):
    bent = {"frequency_response": response() | {"distortion": {"detected": True}}}
    _, document, _ = tuned(**bent)
    assert "TDH-067" in document["warning_codes"]
    for code in (MessageCode.BACKLASH_FOUND, MessageCode.FRICTION_NOT_LINEAR):
        _, document, _ = tuned(**bent, warnings=["the cause"], warning_codes=[code.code])
        assert "TDH-067" not in document["warning_codes"]
    _, document, _ = tuned(frequency_response=response() | {"distortion": {"detected": False}})
    assert "TDH-067" not in document["warning_codes"]


# ---------------------------------------------------------------------------------------------------------------------
# What the card states


def test_the_impedance_in_the_result_itself_is_used(tuned, tmp_path):
    """The card advised to measure what the same file contained."""
    code, document, _ = tuned(impedance=impedance(), speed_loop_present=reported())
    assert code == 0
    assert document["plant"]["lags_from"] == "as measured (impedance in the result)"
    assert [lag["value"] for lag in document["plant"]["lags_s"]] == [0.021, 0.012]
    assert present_in(document) == ((203.0, 264.5),
                                    "as measured (impedance in the result)")
    assert "TDH-056" not in document["warning_codes"]
    _, text, _ = tuned(as_json=False, impedance=impedance())
    assert "as measured (impedance in the result)" in " ".join(text.split())
    path, other = tmp_path / "z.json", impedance()
    other["speed_filter_s"] = interval(0.025, 0.02, 0.03)
    path.write_text(json.dumps(result(impedance=other)), encoding="utf-8")
    _, document, _ = tuned("--impedance", path, impedance=impedance())
    assert document["plant"]["lags_s"][0]["value"] == 0.025
    assert document["plant"]["lags_from"] == "as measured (--impedance)"
    _, document, _ = tuned(*LAGS, "--present", 20, 10, impedance=impedance())
    assert document["plant"]["lags_s"][0]["value"] == 0.02 and present_in(document)[0] == (20.0, 10.0)
    assert tuned("--dead-time", "3ms", impedance=impedance())[0] == ExitCode.USAGE
    _, document, _ = tuned(impedance={"verdict": "model_rejected", "reason": "", "advice": ""})
    assert "assumed" in document["plant"]["lags_from"]


def test_a_profile_without_parameters_of_the_speed_loop_is_named_with_the_units(tuned):
    _, text, _ = tuned(*LAGS, "--profile", "nanotec/c5-e", as_json=False)
    words = " ".join(text.split())
    assert "The profile nanotec/c5-e names no parameters of the speed loop for this drive. P is given in N·m" in words
    _, text, _ = tuned(*LAGS, as_json=False)
    assert "are not known without a profile. P is given in N·m·s/rad" in " ".join(text.split())
    assert max(map(len, text.splitlines())) <= 80
    _, document, _ = tuned(*LAGS, "--profile", "siemens/s120-canopen")
    assert document["gains_by_hand"] is None


def test_an_unstable_loop_has_no_bandwidth_and_the_warning_says_so(tuned):
    _, document, _ = tuned("--present", 5000, 90000)
    row = document["controllers"][0]
    assert row["bandwidth_hz"]["value"] is None and row["as_believed"]["bandwidth_hz"] is None
    (warning,) = (one for one in document["warnings"] if "present" in one)
    assert warning == "The present loop is unstable, also with the best estimate."
    _, text, _ = tuned("--present", 5000, 90000, as_json=False)
    assert re.search(r"bandwidth, Hz +– ", text)


def test_the_named_line_is_the_one_that_contradicts_the_shaft_most(tuned):
    """A line of ±30 % that was 20 % off was named, and no line contradicted the shaft."""
    lines = response()["lines"]
    size = lines[0]["magnitude"]
    size.update(value=1.2 * size["value"], low=0.9 * size["value"], high=1.7 * size["value"])      # +20 %, ±33 %
    size = lines[1]["magnitude"]
    size.update({key: 1.02 * size[key] for key in ("value", "low", "high")})                       # +2 %, ±1 %
    _, text, _ = tuned(*LAGS, as_json=False, frequency_response={"lines": lines})
    assert "the line at 0.3 Hz is farthest from this shaft: by 2 %, known to ±1 %" in " ".join(text.split())


def test_the_line_below_the_open_loop_agrees_with_the_proposal(tuned):
    """|L| may rise above 1 again at a resonance: the margins hold there, and the line called it bad."""
    _, document, _ = tuned(*LAGS, "--no-notch", compliant=COMPLIANT, frequency_response=None)
    curve = document["curves"]["tuned"]
    gain, phase = curve["gain"]["value"], curve["phase_deg"]["value"]
    crossings = [k for k in range(len(gain) - 1) if (gain[k] > 1.0) != (gain[k + 1] > 1.0)]
    assert len(crossings) >= 3
    assert all(abs(phase[k] + 180.0) > 45.0 for k in crossings)
    good, bad = GRAPHS["open_loop"].good, GRAPHS["open_loop"].bad
    assert good == "wherever |L| crosses 1, its phase is not between the dashed lines"
    assert "rises" not in bad and "between the dashed lines" in bad


@pytest.mark.parametrize(("content", "said"), [
    (b"<!DOCTYPE html>", "is an HTML page, not a result of tdhil"),
    (b"%PDF-1.7", "is a PDF file, not a result of tdhil"),
    (b'{"tdhil": 1', "is damaged JSON"), (b"speed\n1\n", "is neither a log nor JSON"),
])
def test_a_file_of_another_kind_is_named(tmp_path, capsys, content, said):
    path = tmp_path / "run1.html"
    path.write_bytes(content)
    assert main(["tune", "speed", str(path)]) == ExitCode.USAGE
    err = capsys.readouterr().err
    assert said in err and "Expecting value" not in err
