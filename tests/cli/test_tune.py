"""`tdhil tune` from the file of a result: gains at both shafts and in the drive's units, refusals, errors in files."""

from __future__ import annotations

import argparse
import io
import json
import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from tdhil.cli import tune_soft_torque
from tdhil.cli.main import main
from tdhil.cli.tune_soft_torque import add_arguments, case_of, string_for
from tdhil.errors import ExitCode, MessageCode
from tdhil.report import PlainConsole, showcase_of, tuning_document, write_blocks
from tdhil.report.operator_map import print_map
from tdhil.report.tuning import TunedFor, print_tuning, tuning_report
from tdhil.soft_torque import DrawnValues, Interval, Search, TuneCase, lowest_turning, tune
from tdhil.soft_torque.simulation import LONGEST_TICK_S
from tdhil.soft_torque.stability import LoopMargins
from tdhil.soft_torque.tuning import advice_of
from tests.soft_torque.cases import DRIVE, STRING

STRING_YAML = Path(__file__).parents[2] / "examples" / "string.yaml"


def interval(value, low, high):
    return {"value": value, "low": low, "high": high}


def estimate(value, low, high):
    return {"value": value, "low": low, "high": high, "low_total": low, "high_total": high}


def result(**said):
    return {
        "verdict": "valid", "gear_ratio": 10.0, "inertia_kg_m2": estimate(15.0, 14.4, 15.6), "simulated": True,
        "viscous_nm_s_rad": estimate(0.08, 0.07, 0.09), "coulomb_nm": estimate(6.0, 5.9, 6.1),
        "speed_lag_s": estimate(0.4, 0.39, 0.41), "cycle": {"period_s": 0.02}, "profile": None, **said,
    }


@pytest.fixture
def tuned(tmp_path, capsys):
    """Run it without the simulation; return (exit code, document or text, stderr)."""
    def run(*words, string=STRING_YAML, as_json=True, **said):
        path = tmp_path / "result.json"
        path.write_text(json.dumps(result(**said)), encoding="utf-8")
        options = ["--json"] if as_json else []
        named = [] if string is None else ["--string", str(string)]
        code = main(["tune", str(path), *named, "--no-simulation", *options, *words])
        out, err = capsys.readouterr()
        return code, json.loads(out) if as_json else out, err

    return run


@pytest.mark.heavy
def test_gains_stand_at_main_shaft_and_motor_and_in_the_drives_parameters(tuned):
    code, document, _ = tuned(profile={"name": "siemens/s120-canopen"})
    assert code == 0
    assert document["main_shaft"]["inertia_kg_m2"] == {"value": 1500.0, "low": 1440.0, "high": 1560.0}
    assert document["main_shaft"]["coulomb_nm"] == pytest.approx(60.0)
    kinds = [one["kind"] for one in document["controllers"]]
    assert kinds == ["stiff", "soft", "compensated", "broadband"]
    soft = document["controllers"][1]
    assert soft["at_main_shaft"]["gain_nm_s_rad"] == pytest.approx(100.0 * soft["at_motor"]["gain_nm_s_rad"])
    assert soft["integral_nm_rad_by_inertia"]["high"] == pytest.approx(soft["at_main_shaft"]["integral_nm_rad"] * 1.04)
    first, second = soft["drive_parameters"]
    assert first["title"].startswith("p1460")
    assert first["value"] == pytest.approx(soft["at_motor"]["gain_nm_s_rad"])
    assert second["unit"] == "ms"
    assert any("--inner-lags" in warning for warning in document["warnings"])
    assert any("compensated reflects up" in warning for warning in document["warnings"])


@pytest.mark.heavy
def test_the_terminal_shows_the_basis_and_the_parameters(tuned):
    code, text, _ = tuned("--inner-lags", "20ms", "10ms", "3ms", "--profile", "abb/acs880-enhanced", as_json=False,
                          rehearsed_faults=["torque-scale=1.1"])
    assert code == 0
    words = " ".join(text.split())
    assert "SIMULATED · FAULT REHEARSAL" in words
    assert "20 + 10 + 3 ms, as stated" in words
    assert "static 5000 N·m" in words
    assert "broadband refused" in words
    assert "25.02 Speed proportional gain" in words
    assert "--rated-torque" in words
    assert "Feed-forward of the setpoint's acceleration does not replace it." in words


@pytest.mark.heavy
def test_the_card_names_unstable_present_gains_and_no_warning_of_numpy_is_shown(tmp_path, capsys):
    """The signals of the present loop overflow. stderr has lines of progress only."""
    path = tmp_path / "result.json"
    path.write_text(json.dumps(result(inertia_kg_m2=estimate(1.0, 0.96, 1.04))), encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        code = main(["tune", "soft-torque", str(path), "--string", str(STRING_YAML), "--present", "400000", "30000",
                     "--inner-lags", "20ms", "10ms", "3ms"])
    out, err = capsys.readouterr()
    assert code == 0 and "present: thin margins, unstable" in out
    assert "above 240 →" in " ".join(out.split())
    assert all(line.startswith("tune: ") for line in err.splitlines()), err


@pytest.mark.parametrize(("words", "said", "code", "message"), [
    (("--compensate", "80%"), {}, 11, "is unstable"),
    (("--loop", "bus", "--a", "1.5"), {}, 11, "is beyond ζ/(ω² J Στ)"),
    ((), {"inertia_kg_m2": None, "verdict": "not_identifiable"}, 11, "no J to tune for (not_identifiable)"),
    ((), {"inertia_kg_m2": None, "verdict": "not_identifiable", "impedance": {"verdict": "valid"}}, 11,
     "with --impedance"),
    ((), {"verdict": "model_rejected"}, 11, "no J to tune for (model_rejected)"),
    (("--loop", "bus"), {"speed_lag_s": None}, 2, "no lag of the reported speed"),
    (("--a", "20"), {}, 2, "--a: 20: must be from 0.01 to 10"),
    (("--inner-lags", "0"), {}, 2, "there is no lag in the drive's loop"),
    (("--profile", "nobody/none"), {}, 2, "nobody/none"),
])
def test_what_is_refused(tuned, words, said, code, message):
    seen, document, err = tuned(*words, **said)
    assert seen == code
    assert message in document["error"]["message"]
    assert message.split()[-1] in err
    assert "Traceback" not in err


@pytest.mark.parametrize(("stated", "share"), [(None, 0.5), ([0.02, 0.01, 0.003], 0.1)])
def test_over_the_bus_each_lag_keeps_its_tolerance(stated, share):
    """As soon as the reported lag had an interval, the other lags counted as exact."""
    asked = argparse.Namespace(inner_lags=stated, loop="bus")
    found = {"speed_lag_s": interval(0.4, 0.39, 0.41), "cycle": {"period_s": 0.02}}
    lags, ends, _ = tune_soft_torque._lags(found, asked, None)
    moved = [[one.inner_lags_s for one in pair] for pair in ends]
    for at, lag in ((2, 0.01), (3, 0.003)):
        assert lags[at] == lag
        assert max(abs(one[at] - lag) for pair in moved for one in pair) == pytest.approx(share * lag)


def test_a_reported_filter_is_the_first_lag_of_the_loop():
    found = {"speed_loop_present": {"filter_s": 0.15, "settings": {"filter": {"confidence": "verified"}}}}
    lags, _, said = tune_soft_torque._lags(found, argparse.Namespace(inner_lags=None, loop="drive"), None)
    assert lags == (0.15, 0.01, 0.003) and "as the drive reports it" in said
    stated, *_ = tune_soft_torque._lags(found, argparse.Namespace(inner_lags=[0.02], loop="drive"), None)
    assert stated == (0.02,)


@pytest.mark.heavy
def test_over_the_bus_the_reported_speeds_lag_is_in_the_loop(tuned):
    _, document, _ = tuned("--loop", "bus")
    assert document["main_shaft"]["inner_lags_s"] == pytest.approx([0.4, 0.03, 0.01, 0.003])
    soft = document["controllers"][1]
    assert soft["softest_a"] < 0.8
    assert soft["drive_parameters"] == []


def compliant(**said):
    """Return the string of the reference case as a two-mass model, at a motor with a gear of 10."""
    return {"stiffness_nm_rad": interval(3.14, 3.0, 3.3), "antiresonance_hz": interval(0.1299, 0.128, 0.132),
            "damping_nm_s_rad": None, **said}


@pytest.mark.heavy
def test_without_a_string_k_and_j_l_are_those_of_the_result(tuned):
    code, document, _ = tuned(string=None, model="two-mass", compliant=compliant())
    assert code == 0
    assert document["string"]["stiffness_nm_rad"] == pytest.approx(314.0)
    assert document["string"]["modes_hz"][0] == pytest.approx(0.1299, rel=1e-4)
    assert document["string"]["name"] == "k and J_L as identified (two-mass)"
    soft = document["controllers"][1]
    # I = (φω)² J contains the uncertainty of ω
    assert soft["least_damping"]["value"] > 0.1
    own = soft["integral_nm_rad_by_inertia"]
    assert own["low"] / own["value"] == pytest.approx(1.0 - math.hypot(0.04, 0.029), abs=0.002)
    assert any("Describe the pipe in a string.yaml" in warning for warning in document["warnings"])
    # no value that depends on unmeasured waves
    assert [one["kind"] for one in document["controllers"] if one["refused"]] == ["compensated", "broadband"]
    code, document, _ = tuned("--compensate", "0.2", string=None, compliant=compliant())
    assert code == 11 and "State the pipe in string.yaml" in document["error"]["message"]


@pytest.mark.parametrize(("said", "words"), [
    ({}, "--string is missing, and the result is of a rigid shaft"),
    ({"compliant": compliant(stiffness_nm_rad=None)}, "does not determine the spring's stiffness or load"),
])
def test_without_either_the_string_is_asked_for(tuned, said, words):
    code, document, _ = tuned(string=None, **said)
    assert code == ExitCode.USAGE
    assert words in document["error"]["message"]


def test_invalid_files_are_named(tmp_path, capsys):
    wrong = tmp_path / "wrong.json"
    for text, message in (("{}", "not a result of tdhil identify"), ("not json", "neither a log nor JSON")):
        wrong.write_text(text, encoding="utf-8")
        assert main(["tune", str(wrong), "--string", str(STRING_YAML)]) == ExitCode.USAGE
        assert message in capsys.readouterr().err
    assert main(["tune", str(tmp_path / "none"), "--string", str(STRING_YAML)]) == ExitCode.USAGE
    good = tmp_path / "result.json"
    good.write_text(json.dumps(result()), encoding="utf-8")
    bad = tmp_path / "string.yaml"
    bad.write_text("sections:\n  - {length_m: -1, outer_diameter_m: 0.1, inner_diameter_m: 0}\n", encoding="utf-8")
    assert main(["tune", str(good), "--string", str(bad)]) == ExitCode.USAGE
    assert "string.yaml:2" in capsys.readouterr().err


@pytest.mark.heavy
def test_the_interval_of_the_stiff_cure_speed_contains_a_fine_simulation():
    """J is exact, so the interval is the simulation error. The fine one has a third of the step, twice the length."""
    tuning = tune(TuneCase(STRING, DRIVE, Interval(1500.0, 1500.0, 1500.0)), None)
    stiff = tuning.by_kind("stiff")
    found = lowest_turning(STRING, [(DRIVE, stiff.controller)], "stuck", Search())
    tuning = replace(tuning, searched=Search(), tuned=(replace(stiff, quiet_cures=tuple(found * 5)),))
    document = tuning_document(tuning, TunedFor("result.json", True, None, 1.0, "drive", "as stated"))
    cure = document["controllers"][0]["critical_rpm"]["cure"]
    fine = Search(lowest_rpm=170.0, highest_rpm=195.0, coarse_rpm=5.0, resolution_rpm=0.25, duration_s=200.0,
                  calm_s=40.0, longest_tick_s=LONGEST_TICK_S / 3.0)
    (truth,) = lowest_turning(STRING, [(DRIVE, stiff.controller)], "stuck", fine)
    assert cure["value"] == found[0]
    assert cure["low"] <= truth <= cure["high"]
    assert 2.0 <= 0.5 * (cure["high"] - cure["low"]) <= 5.0      # not ±0, and small enough


@pytest.mark.heavy
def test_the_page_has_the_pictures_and_the_speeds(tmp_path):
    """Stick-slip is shown at a set speed between the two cure speeds, which are given here, not searched."""
    pytest.importorskip("matplotlib")
    tuning = tune(TuneCase(STRING, DRIVE, Interval(1500.0, 1440.0, 1560.0)), None)
    cures = {"stiff": None, "soft": 61.0}
    noisy = {"stiff": DrawnValues((180.0, 170.0)), "soft": DrawnValues((60.0, 66.0))}
    tuning = replace(tuning, searched=Search(highest_rpm=160.0), tuned=tuple(
        replace(one, quiet_cures=(cures[one.kind],) * 5, cure=noisy[one.kind],
                start=noisy[one.kind], linear_limit=noisy[one.kind])
        for one in tuning.tuned if one.kind in cures))
    document = tuning_document(tuning, TunedFor("result.json", True, None, 1.0, "drive", "as stated"))
    json.dumps(document, allow_nan=False)
    stiff, soft = document["controllers"][:2]
    assert stiff["critical_rpm"]["cure"]["value"] is None      # above all tested speeds
    cure = soft["critical_rpm"]["cure"]
    assert cure["value"] == 61.0
    assert 58.5 < cure["low"] < 60.0 and 62.0 < cure["high"] < 63.5      # the simulation's own error
    showcase = showcase_of(tuning, seconds=20.0)
    assert showcase is not None
    assert 61.0 < showcase.set_rpm < 160.0
    stuck = [showcase.trace.last_stuck_s[row, 0] for row in (0, 1)]
    assert stuck[0] > 10.0 > stuck[1]
    page = tuning_report(document, showcase)
    assert [section.heading for section in page.sections][3] == "Stick-slip, with and without"
    written = write_blocks(tuning_report(document, showcase), tmp_path / "tune.html")
    text = written.read_text(encoding="utf-8")
    assert text.count("<svg") == 3
    assert "SIMULATED" in text and "frees a stuck bit and keeps it turning" in text
    advised = tuning_report(document | {"advice": document["advice"] | {"kind": "soft"}}, None).answer
    assert "phase margin of 30°, a gain margin of 6 dB and a dead-time reserve of 20 ms" in advised.verdict
    assert write_blocks(tuning_report(document, None), tmp_path / "tune.pdf").read_bytes().startswith(b"%PDF")


def impedance(**said):
    """Return the result of identify --impedance, at the motor."""
    loop = {"gain_nm_s_rad": estimate(203.0, 200.0, 206.0), "integral_nm_rad": estimate(264.5, 260.0, 269.0),
            "torque_lag_s": estimate(0.012, 0.01, 0.014), "speed_filter_s": estimate(0.021, 0.018, 0.024),
            "inner_lag_s": estimate(0.033, 0.032, 0.034)}
    return {"verdict": "valid", "by": "offset", "reason": "explained", "advice": "", **loop, **said}


@pytest.fixture
def measured(tmp_path):
    def write(**said):
        path = tmp_path / "z.json"
        path.write_text(json.dumps(result(**{"impedance": impedance(), **said})), encoding="utf-8")
        return "--impedance", path.as_posix()

    return write


@pytest.mark.heavy
def test_the_present_gains_of_the_drive_are_beside_the_others_with_its_own_lags(tuned, measured):
    code, document, _ = tuned(*measured())
    assert code == 0
    present, stiff = document["controllers"][:2]
    assert (present["kind"], stiff["kind"]) == ("present", "stiff")
    assert present["at_main_shaft"]["gain_nm_s_rad"] == pytest.approx(20300.0)
    assert present["at_motor"]["integral_nm_rad"] == pytest.approx(264.5)
    # the stiff gains of the reference case: their effect on its string is known
    assert present["reflection_at_lowest_mode"]["value"] == pytest.approx(0.992, abs=0.002)
    assert present["least_damping"]["value"] == pytest.approx(0.036, abs=0.003)
    assert present["inertia_wrong_by"] == []
    assert document["main_shaft"]["inner_lags_s"] == [0.021, 0.012]
    assert document["main_shaft"]["inner_lags_from"] == "as measured (--impedance)"
    # each is known to 2 or 3 ms, and their sum to 1 ms: they are used with their covariance
    assert document["main_shaft"]["inner_lag_s"] == pytest.approx(interval(0.033, 0.032, 0.034))
    open_of = [one["reflection_at_lowest_mode"]["high"] - one["reflection_at_lowest_mode"]["low"]
               for one in (present, stiff)]
    assert open_of[0] > 2.0 * open_of[1]       # its gains are measured, too
    assert not any("--inner-lags" in warning for warning in document["warnings"])
    assert len(document["reflection"]["present"]) == len(document["reflection"]["hertz"])


@pytest.mark.heavy
def test_the_table_has_a_column_for_them(tuned, measured):
    code, text, _ = tuned(*measured(), as_json=False)
    assert code == 0
    assert "present" in text and "+12.6" in text


@pytest.mark.heavy
def test_stated_lags_take_precedence_over_measured_ones(tuned, measured):
    _, document, _ = tuned(*measured(), "--inner-lags", "20ms", "10ms")
    assert document["main_shaft"]["inner_lags_s"] == [0.02, 0.01]


@pytest.mark.parametrize(("said", "code", "words"), [
    ({"impedance": None}, ExitCode.USAGE, "did not measure"),
    ({"impedance": impedance(verdict="model_rejected", reason="a reference filter")}, 11, "a reference filter"),
    ({"impedance": impedance(gain_nm_s_rad=None)}, ExitCode.USAGE, "not a number"),
    ({"gear_ratio": 4.0}, ExitCode.USAGE, "gear ratio"),
    ({"simulated": False}, ExitCode.USAGE, "is of a real drive, and the result is of a simulated one"),
])
def test_an_impedance_of_another_shaft_is_refused(tuned, measured, said, code, words):
    found, _, err = tuned(*measured(**said), as_json=False)
    assert found == code
    assert words in err


@pytest.mark.heavy
def test_the_first_sentence_states_missing_comparisons_and_changes(tuned):
    """Typed gains are a row like the others, and the sentence compares with them. No simulation: no advice."""
    code, document, _ = tuned("--present", "40", "30")
    assert code == 0
    assert [one["kind"] for one in document["controllers"]][:2] == ["present", "stiff"]
    assert document["controllers"][0]["at_main_shaft"]["gain_nm_s_rad"] == pytest.approx(4000.0)
    sentence = document["advice"]["sentence"]
    assert sentence.startswith("No gains are recommended: the critical speeds were not compared, because "
                               "--no-simulation omits them. Leave --no-simulation out to compare them. "
                               "Soft gains, compared with the present gains (for assumed lags): least damping")
    assert document["advice"]["kind"] is None and not document["advice"]["keep"]
    assert "phase margin" in sentence and "°" in sentence
    assert "onset" not in json.dumps(document)
    _, text, _ = tuned("--present", "40", "30", as_json=False)
    assert " ".join(text.split()).startswith(sentence)


def rows_of(*margins, lags_assumed=False):
    """Document of rows with these least margins (kind, phase, gain, dead time), simulated speeds given here."""
    tuning = tune(TuneCase(STRING, DRIVE, Interval(1500.0, 1440.0, 1560.0), softness=0.35), None)
    soft = tuning.by_kind("soft")
    rows = []
    for kind, cure_rpm, *values in margins:
        worst = LoopMargins(True, *values, 0.1, 0.5)
        speeds = DrawnValues((cure_rpm, cure_rpm * 1.02))
        rows.append(replace(soft, kind=kind, worst=worst, failed=tuning.case.required.failed(worst), cure=speeds,
                            start=speeds, linear_limit=speeds, quiet_cures=(cure_rpm,) * 5))
    tuning = replace(tuning, tuned=tuple(rows), searched=Search(), advice=advice_of(rows))
    return tuning_document(tuning, TunedFor("result.json", False, None, 1.0, "drive", "assumed", None,
                                            lags_assumed=lags_assumed))


def printed(document):
    terminal = io.StringIO()
    print_tuning(document, Console(file=terminal, width=300))
    return terminal.getvalue()


@pytest.mark.heavy
def test_the_first_sentence_names_the_less_bad_row_and_what_it_misses():
    document = rows_of(("present", 92.0, 6.0, 3.7, 0.006), ("stiff", 49.0, 21.0, 10.2, 0.023))
    assert document["advice"]["less_bad"] == "stiff" and document["advice"]["kind"] is None
    assert document["advice"]["sentence"].startswith(
        "The stiff gains are less bad than the present gains, but they do not keep the margins either: phase margin "
        "21° (limit 30°). Compared with the present gains: critical speed 93 → 49 rpm")
    assert tuning_report(document, None).answer.value == "No gains keep the margins"
    assert "Keep what you have" not in printed(document)


@pytest.mark.heavy
def test_the_card_has_the_time_constant_of_the_speed_and_honest_margins():
    """A failed margin has digits until it is below its limit. A gain margin above 20 dB was not searched."""
    document = rows_of(("present", 92.0, 29.7, 5.98, 0.0199), ("soft", 49.0, 60.0, math.inf, math.inf),
                       lags_assumed=True)
    card = printed(document).split("meaning of the figures")[0]
    lines = {line[:16].strip(): line[16:].split() for line in card.splitlines()}
    assert lines["phase margin"] == ["29.7°", "60°"]
    assert lines["gain margin, dB"] == ["5.98", ">", "20"]
    assert lines["dead time, ms"] == ["19.9", "no", "limit"]
    soft = document["controllers"][1]
    assert lines["P/I, s"][1] == f"{soft['integral_time_s']:.3g}"
    assert soft["integral_time_s"] == pytest.approx(
        soft["at_motor"]["gain_nm_s_rad"] / soft["at_motor"]["integral_nm_rad"])
    assert document["advice"]["sentence"].startswith("Type in the soft gains (for assumed lags). Compared with")
    assert "phase margin 29.7° → 60°" in document["advice"]["sentence"]


@pytest.mark.heavy
def test_a_gain_without_a_unit_and_gains_that_were_not_compared_are_warnings(tuned):
    """The values of the table are in true N·m. The drive does not know the calibration."""
    settings = {part: {"value": 1.0, "unit": "unknown", "where": "p", "confidence": "verified"}
                for part in ("gain", "integral")}
    code, document, _ = tuned(profile={"name": "siemens/g120"}, torque_calibration={"factor": 0.93, "rel_sd": 0.005},
                              speed_loop_present={"settings": settings})
    assert code == 0
    text = " ".join(document["warnings"])
    assert "tdhil has no value to type in. Divide P and I of the table by 0.93, then convert them" in text
    assert "The drive's own gains were not compared: reported by the drive" in text
    assert "type it in before P and I" in " ".join(printed(document).split())


@pytest.mark.heavy
def test_without_a_bit_nothing_is_green(tuned, tmp_path):
    """The identified string has no bit. There is no comparison, and the message names the required entry."""
    words = "--report", str(tmp_path / "tune.html")
    code, document, _ = tuned("--present", "40", "30", *words, string=None, model="two-mass", compliant=compliant())
    assert code == 0
    assert "because no bit is stated. State bottom.coulomb_nm in string.yaml (--string)" in (
        document["advice"]["sentence"])
    assert document["advice"]["kind"] is None
    terminal = io.StringIO()
    print_tuning(document, Console(file=terminal, force_terminal=True, color_system="standard", width=200))
    first = terminal.getvalue().splitlines()[0]
    assert "No gains are recommended" in first and "\x1b[1;33m" in first
    page = (tmp_path / "tune.html").read_text(encoding="utf-8")
    assert "critical speeds not compared" in page and "keep what you have" not in page


def test_a_j_of_motor_and_string_together_is_refused(tuned):
    code, document, err = tuned(warning_codes=[MessageCode.STRING_MOVES_WITH_MOTOR.code])
    assert code == 11
    assert "J of 15 kg·m² is that of motor and string together" in document["error"]["message"]
    assert "Disconnect the string" in err


def test_a_measured_lag_of_zero_is_drawn_within_its_interval(tmp_path):
    path = tmp_path / "z.json"
    loop = impedance(speed_filter_s=interval(0.0, 0.0, 0.01), torque_lag_s=interval(0.03, 0.02, 0.032),
                     inner_lag_s=interval(0.03, 0.028, 0.032))
    path.write_text(json.dumps(result(impedance=loop)), encoding="utf-8")
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    words = ["result.json", "--string", str(STRING_YAML), "--impedance", str(path)]
    case, _ = case_of(result(), parser.parse_args(words))
    assert case.drive.inner_lags_s == (0.0, 0.03)
    drawn = [truth.drive.inner_lags_s for truth in case.truths()]
    assert max(one[0] for one in drawn) > 0.004
    assert np.std([sum(one) for one in drawn]) < 0.004


def test_a_very_soft_request_is_refused_with_its_margin(tuned):
    """a = 5 damps by 0.02, less than the stiff loop. The command ends with 11 and names the missing margin."""
    code, document, _ = tuned("--a", "5")
    assert code == 11
    assert "a = 5 leaves too little margin: phase margin" in document["error"]["message"]
    assert "(limit 30°)" in document["error"]["message"]


@pytest.mark.heavy
def test_present_gains_with_small_margins_are_reported_in_words(tuned):
    """Gains that lose all phase in a sampled case are reported with the value and the limit."""
    code, text, _ = tuned("--present", "2.965", "9.993", as_json=False)
    assert code == 0
    assert "present: thin margins, phase margin" in " ".join(text.split())


@pytest.mark.heavy
def test_other_margins_can_be_requested(tuned):
    _, document, _ = tuned("--margins", "45", "9", "50ms")
    assert document["required_margins"] == {"phase_deg": 45.0, "gain_db": 9.0, "dead_time_s": 0.05}
    for one in document["controllers"]:
        if not one["refused"] and one["kind"] != "stiff":
            assert one["margins"]["worst"]["phase_deg"] >= 45.0
    code, document, _ = tuned("--margins", "45", "much", "50ms")
    assert code == ExitCode.USAGE and "--margins 30 6 20ms" in document["error"]["message"]


@pytest.mark.heavy
def test_an_identified_pipe_keeps_its_impedance(tuned):
    """k, f and J_L known to 0.3 % fit one uniform pipe only: ζ 296 of the reference case. Compensation is possible."""
    def near(value):
        return interval(value, value * 0.997, value * 1.003)

    shaft = {"stiffness_nm_rad": near(3.1412), "antiresonance_hz": near(0.129948),
             "damping_nm_s_rad": None, "load_inertia_kg_m2": near(3.74)}
    code, document, _ = tuned(string=None, model="string", compliant=shaft)
    assert code == 0
    assert document["string"]["impedance_nm_s_rad"] == pytest.approx(296.5, rel=0.01)
    assert document["string"]["echo_s"] == pytest.approx(1.888, rel=0.01)
    compensated = next(one for one in document["controllers"] if one["kind"] == "compensated")
    assert not compensated["refused"] or "margin" in compensated["refused"]
    assert any("The string is the uniform pipe" in warning for warning in document["warnings"])


def present_of(*words, **said):
    """Return P and I of the present gains at the motor shaft, and their source."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    asked = parser.parse_args(["result.json", "--string", str(STRING_YAML), *words])
    case, sources = case_of(result(**said), asked)
    if case.present is None:
        return None, sources.present
    gear_square = 100.0
    return (case.present.gain_nm_s_rad / gear_square, case.present.integral_nm_rad / gear_square), sources.present


def test_the_gains_that_the_drive_reported_are_compared():
    setting = {"where": "5FFDh:1", "unit": "nm_s_rad", "confidence": "verified", "value": 9.0}
    reported = {"gain_nm_s_rad": 9.0, "integral_nm_rad": 6.0, "settings": {"gain": setting, "integral": setting}}
    gains, source = present_of(speed_loop_present=reported)
    assert gains == pytest.approx((9.0, 6.0)) and source.startswith("reported by the drive (5FFDh:1")
    typed, source = present_of("--present", "7", "5", speed_loop_present=reported)
    assert typed == pytest.approx((7.0, 5.0)) and source == "as stated (--present)"
    assert present_of("--loop", "bus", speed_loop_present=reported) == (None, None)
    assert present_of() == (None, None)


@pytest.mark.parametrize(("loop", "dead_time_s"), [("drive", 0.02), ("bus", 0.2)])
def test_the_default_dead_time_is_ten_control_periods(loop, dead_time_s):
    """The control period is 2 ms in the drive, and over the bus the cycle of the run, 20 ms."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    case, _ = case_of(result(), parser.parse_args(["result.json", "--string", str(STRING_YAML), "--loop", loop]))
    assert (case.required.phase_deg, case.required.gain_db) == (30.0, 6.0)
    assert case.required.dead_time_s == pytest.approx(dead_time_s)


def drawn_of(**said):
    """Return J of each draw, and the (k, J_L) of its string, both at the main shaft."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    case, _ = case_of(result(model="two-mass", **said), parser.parse_args(["result.json"]))
    truths = case.truths()
    found = [(one.drive.inertia_kg_m2, one.string.stiffness_nm_rad, one.string.bottom_inertia_kg_m2) for one in truths]
    return case, np.log(np.array(found))


def covariance_of(correlation, *, inertia=0.1, stiffness=0.05):
    """J and k with this correlation, and the antiresonance almost exact."""
    both = correlation * inertia * stiffness
    return {"quantities": ["stiffness_nm_rad", "inertia_kg_m2", "antiresonance_hz"],
            "matrix": [[stiffness**2, both, 0.0], [both, inertia**2, 0.0], [0.0, 0.0, 1e-8]]}


@pytest.mark.parametrize("correlation", (0.95, -0.95))
def test_j_and_string_are_drawn_jointly_from_the_covariance_of_the_result(correlation):
    exact = {**estimate(15.0, 14.4, 15.6), "low": 14.4, "high": 15.6}     # the torque scale adds nothing
    case, drawn = drawn_of(inertia_kg_m2=exact, compliant=compliant(covariance=covariance_of(correlation)))
    assert len(case.inertia_draws) == len(case.string_draws)
    assert np.corrcoef(drawn[:, :2].T)[0, 1] == pytest.approx(correlation, abs=0.03)
    assert np.exp(drawn[:, 0]).std() == pytest.approx(60.0 / 1.96, rel=0.1)
    assert abs(np.corrcoef(drawn[:, 0], drawn[:, 2] - drawn[:, 1])[0, 1]) < 0.1     # J and k/J_L: independent


def test_the_torque_scale_multiplies_j_and_k_alike():
    """J is known to 0.1 %, plus a common scale of ±4 % in J and k."""
    scaled = {**estimate(15.0, 14.4, 15.6), "low": 14.985, "high": 15.015}
    near = interval(3.14, 3.137, 3.143)
    shaft = compliant(stiffness_nm_rad=near, covariance=covariance_of(-0.9))
    _, drawn = drawn_of(inertia_kg_m2=scaled, compliant=shaft)
    assert np.corrcoef(drawn[:, :2].T)[0, 1] > 0.99
    assert (drawn[:, 1] - drawn[:, 0]).std() < 0.002


@pytest.mark.heavy
@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.9])
def test_the_ends_of_the_intervals_have_the_covariance_of_j_and_string(correlation):
    """I = (φω)² J has the relative variance s_J² + 4 s_ω² + 4 ρ s_J s_ω. Separate intervals omit the last term."""
    exact = {**estimate(15.0, 14.4, 15.6), "low": 14.4, "high": 15.6}
    shaft = compliant(antiresonance_hz=interval(0.13, 0.1274, 0.1326), covariance={
        "quantities": ["inertia_kg_m2", "antiresonance_hz"], "matrix": [[1.0, correlation], [correlation, 1.0]]})
    case, _ = drawn_of(inertia_kg_m2=exact, compliant=shaft)
    found = tune(replace(case, draws=2), None).by_kind("soft").integral_nm_rad
    half = math.sqrt(0.04**2 + 0.04**2 + 2.0 * correlation * 0.04**2)
    assert found.high / found.value - 1.0 == pytest.approx(half, rel=0.06)


def test_without_a_covariance_j_and_string_are_drawn_independently():
    for stated in (None, {"quantities": ["stiffness_nm_rad"], "matrix": [[1.0, 2.0]]}, {"matrix": "none"}):
        case, drawn = drawn_of(compliant=compliant(covariance=stated))
        assert case.inertia_draws == ()
        assert abs(np.corrcoef(drawn[:, :2].T)[0, 1]) < 0.5


def test_severity_takes_the_identified_string_too():
    """The command needs the string only. A result without J has no joint draws."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    said = result(model="two-mass", compliant=compliant(covariance=covariance_of(0.5)))
    for inertia in (said["inertia_kg_m2"], None):
        found = string_for({**said, "inertia_kg_m2": inertia}, parser.parse_args(["a.json"]), 10.0)
        assert found.string.stiffness_nm_rad == pytest.approx(314.0)
        assert len(found.inertia_draws) == (len(found.draws) if inertia else 0)


@pytest.mark.heavy
def test_independent_draws_are_stated_in_the_warnings(tuned):
    _, document, _ = tuned(string=None, model="two-mass", compliant=compliant())
    assert any("does not state the covariance of J, k, f and J_L" in warning for warning in document["warnings"])
    _, document, _ = tuned(string=None, model="two-mass", compliant=compliant(covariance=covariance_of(0.5)))
    assert not any("covariance" in warning for warning in document["warnings"])


@pytest.mark.heavy
def test_the_operators_map_is_in_the_document_without_a_report(tmp_path, capsys):
    path = tmp_path / "result.json"
    path.write_text(json.dumps(result()), encoding="utf-8")
    words = ["tune", "soft-torque", str(path), "--string", str(STRING_YAML), "--a", "0.35", "--compensate", "0.3"]
    assert main([*words, "--map", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    found = document["map"]
    assert {"stiff", "soft"} & found["states"].keys()
    for rows in found["states"].values():
        assert [len(row) for row in rows] == [len(found["speeds_rpm"])] * len(found["bit_torques_nm"])
        assert {state for row in rows for state in row} <= {"stable", "at risk", "stick-slip"}
    print_map(found, PlainConsole())
    assert f"{found['bit_torques_nm'][0] / 1e3:.2g} kN·m" in capsys.readouterr().out


def test_a_map_without_its_bit_is_refused(tuned, tmp_path):
    code, document, _ = tuned("--map")
    assert code == ExitCode.USAGE and "--no-simulation omits simulations. Leave" in document["error"]["message"]
    code, document, _ = tuned("--map", string=None, model="two-mass", compliant=compliant())
    assert code == ExitCode.USAGE and "--string string.yaml" in document["error"]["message"]


@pytest.mark.heavy
def test_depths_give_a_schedule_with_the_drives_parameters(tuned):
    """Each row has gains at both shafts and the parameters. A sentence describes the range between the rows."""
    code, document, _ = tuned("--depths", "1000:3000:1000", profile={"name": "siemens/s120-canopen"})
    assert code == 0
    schedule = document["schedule"]
    assert [row["depth_m"] for row in schedule["rows"]] == [1000.0, 2000.0, 3000.0]
    assert [row["depth_m"] for row in schedule["between"]] == [1500.0, 2500.0]
    for row in schedule["rows"]:
        assert row["at_main_shaft"]["gain_nm_s_rad"] == pytest.approx(100.0 * row["at_motor"]["gain_nm_s_rad"])
        assert [one["title"] for one in row["drive_parameters"]]
    assert schedule["sentence"].startswith("Interpolated halfway between rows: least phase margin")
    _, text, _ = tuned("--depths", "1000:3000:1000", as_json=False)
    words = " ".join(text.split())
    assert "gains over depth, soft" in words and schedule["sentence"] in words


@pytest.mark.parametrize("text", ["500", "500:400:10", "500:6000:9000", "1:6000:1", "a:b:c"])
def test_invalid_depths_are_refused(tuned, text):
    code, _, _err = tuned("--depths", text)
    assert code == ExitCode.USAGE


def test_a_schedule_needs_the_string(tuned):
    code, document, _ = tuned("--depths", "500:1000:250", string=None)
    assert code == ExitCode.USAGE and "--string string.yaml" in json.dumps(document)


@pytest.mark.heavy
def test_the_picture_of_a_schedule_is_drawn(tmp_path):
    """The cases are with and without critical speeds, and with a refused depth."""
    figure = pytest.importorskip("matplotlib.figure")
    from tdhil.report.schedule import draw_schedule

    speeds = {"value": 50.0, "low": 40.0, "high": None}
    row = {"depth_m": 1000.0, "refused": None, "at_motor": {"gain_nm_s_rad": 10.0, "integral_nm_rad": 5.0},
           "critical_under_noise_rpm": speeds, "compared_critical_rpm": speeds}
    for noisy in (speeds, None):
        own = {**row, "critical_under_noise_rpm": noisy, "compared_critical_rpm": noisy}
        document = {"kind": "soft", "compared_with": "stiff", "between": [{**own, "depth_m": 1500.0}],
                    "rows": [own, {**own, "depth_m": 2000.0}, {"depth_m": 3000.0, "refused": "no"}]}
        drawn = figure.Figure()
        draw_schedule(drawn, document)
        assert len(drawn.axes) == (2 if noisy else 1)
        drawn.savefig(tmp_path / "schedule.svg")


def test_a_missing_string_is_reported_before_the_log_is_identified(tmp_path, monkeypatch, capsys):
    """A new identification of a log takes seconds, so the files are checked first."""
    log = tmp_path / "run.mcap"
    log.write_bytes(b"\x89MCAP0\r\n")
    monkeypatch.setattr("tdhil.cli.tune_soft_torque.read_result", lambda path: pytest.fail("the result was read first"))
    assert main(["tune", str(log), "--string", str(tmp_path / "nosuch.yaml")]) == ExitCode.USAGE
    assert "nosuch.yaml" in capsys.readouterr().err


@pytest.mark.heavy
def test_a_tuning_that_evaluate_refuses_is_reported(tmp_path, capsys):
    path = tmp_path / "result.json"
    path.write_text(json.dumps(result()))
    assert main(["tune", str(path), "--string", str(STRING_YAML), "--no-simulation", "--json"]) == 0
    assert "tdhil evaluate does not accept this file" in capsys.readouterr().err


def test_at_a_terminal_each_step_moves_until_the_next():
    """Tuning takes a minute. Each step is a line; at a terminal the present one also has a moving sign."""
    from rich.console import Console

    from tdhil.cli.tune_soft_torque import _progress

    for terminal in (True, False):
        out = io.StringIO()
        with _progress(Console(file=out, force_terminal=terminal, width=80), "tuning") as tell:
            tell("string's modes [1/2]")
        assert "tune: string's modes [1/2] …" in out.getvalue()
        assert ("\x1b[?25l" in out.getvalue()) is terminal          # the cursor is hidden while it moves


def test_the_old_call_means_soft_torque(tmp_path, capsys):
    path = tmp_path / "result.json"
    path.write_text(json.dumps(result(verdict="model_rejected")), encoding="utf-8")
    said = []
    for words in (["tune"], ["tune", "soft-torque"]):
        assert main([*words, str(path), "--string", str(STRING_YAML)]) == 11
        said.append(capsys.readouterr().err)
    assert said[0] == said[1] and "no J to tune for" in said[0]
    assert main(["tune", "--string", str(STRING_YAML), str(path)]) == 11      # options first, as in the old form
    with pytest.raises(SystemExit):
        main(["tune", "--help"])
    assert "speed|verify|soft-torque" in capsys.readouterr().out


@pytest.mark.parametrize("words", [[], ["--json"]])
def test_tune_without_a_word_lists_its_actions(words, capsys):
    """It named the arguments of soft-torque, which the user did not write."""
    assert main(["tune", *words]) == 2
    assert "tune: an action is missing: speed, verify, soft-torque." in capsys.readouterr().err


def noisy(tmp_path, noise, why=None):
    path = tmp_path / "severity.json"
    path.write_text(json.dumps({"kind": "severity", "records": [{"bit_noise": noise, "bit_noise_refused": why}]}))
    return path


NOISE = {"rms_nm": interval(310.0, 250.0, 400.0), "correlation_s": interval(0.3, 0.2, 0.45)}


@pytest.mark.heavy
def test_the_bit_noise_of_a_record_replaces_the_assumed_one(tuned, tmp_path):
    code, document, _ = tuned("--bit-noise", str(noisy(tmp_path, NOISE)))
    assert code == 0
    assert document["string"]["bit"]["noise_nm"] == 310.0
    assert document["string"]["bit"]["noise_correlation_s"] == 0.3
    assert any("bit noise of 310 N·m rms" in text for text in document["warnings"])


@pytest.mark.parametrize(("noise", "string", "code", "message"), [
    (None, STRING_YAML, 11, "does not determine the bit noise: the record has 3 segments"),
    ({"rms_nm": {}}, STRING_YAML, 2, "is not a result of tdhil severity"),
    (NOISE, None, 2, "--bit-noise needs the string"),
])
def test_an_invalid_bit_noise_is_refused(tmp_path, capsys, noise, string, code, message):
    (tmp_path / "result.json").write_text(json.dumps(result()), encoding="utf-8")
    named = [] if string is None else ["--string", str(string)]
    seen = main(["tune", str(tmp_path / "result.json"), *named, "--no-simulation", "--bit-noise",
                 str(noisy(tmp_path, noise, "the record has 3 segments"))])
    assert seen == code
    assert message in " ".join(capsys.readouterr().err.split())
