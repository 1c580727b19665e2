"""`tdhil tune speed` from a result's file: gains in the drive's units, warnings with codes, refusals, pictures."""

from __future__ import annotations

import html
import json
import math
import re

import pytest

from tdhil.cli.main import main
from tdhil.errors import ExitCode, MessageCode
from tdhil.report import GRAPHS
from tests.cli.test_tune import estimate, impedance, interval
from tests.cli.test_tune import result as any_result


def response():
    """J = 15 kg·m² and B = 0.08 N·m·s/rad, as reported with a lag of the speed."""
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
    """Run it: (exit code, document or text, stderr)."""
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


def test_the_terminal_fits_80_columns_and_says_what_to_type(tuned):
    code, text, _ = tuned("--inner-lags", "20ms", "10ms", "--dead-time", "3ms", "--profile", "abb/acs880-enhanced",
                          "--bandwidth", "0.8", as_json=False)
    assert code == 0
    words = " ".join(text.split())
    assert words.startswith("Type in P = ") and "The requested bandwidth is 0.8 Hz" in words
    assert "SIMULATED" in words and "as stated" in words and "TDH-056" not in words
    assert "25.02 Speed proportional gain" in words and "--rated-torque" in words
    assert max(map(len, text.splitlines())) <= 80


def test_measured_lags_and_present_gains_come_from_the_impedance(tuned, tmp_path):
    path = tmp_path / "z.json"
    path.write_text(json.dumps(result(impedance=impedance())), encoding="utf-8")
    code, document, _ = tuned("--impedance", path)
    assert code == 0
    assert document["plant"]["lags_from"] == "as measured (--impedance)"
    lags = document["plant"]["lags_s"]
    assert [lag["value"] for lag in lags] == [0.021, 0.012]
    assert sum(lag["high"] for lag in lags) == pytest.approx(0.034)    # the sum is known to ±1 ms
    assert document["controllers"][0]["gain_nm_s_rad"] == pytest.approx(203.0)
    assert tuned("--impedance", path, "--present", 1, 1)[0] == ExitCode.USAGE


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


def test_thin_present_gains_are_named_with_a_code(tuned):
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
    parts = re.findall(r"<text[^>]*>([^<]*)</text>|<!-- (.*?) -->", drawn, re.DOTALL)      # text, or shapes of letters
    said = html.unescape(" ".join(text or beside for text, beside in parts))
    for graph in ("open_loop", "step"):             # a line of help below each
        assert " ".join(said.split()).count(GRAPHS[graph].good[:40]) == 1
    text = page.read_text(encoding="utf-8")
    assert text.count("<svg") == 2 and "SIMULATED" in text and "TDH-056" in text
    assert tuned("--plot", picture)[0] == ExitCode.USAGE
    assert tuned("--report", page)[0] == ExitCode.USAGE
