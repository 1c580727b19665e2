"""Pairs of a reference sensor: York's line compared with scipy.odr, its coverage, hysteresis, and refusals."""

import json
import re

import numpy as np
import pytest

from tdhil.calibration import MeasuredValue, TorquePairs, calibrate_pairs, line_with_errors_in_both
from tdhil.cli import calibrate_reference
from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.report import factor_report
from tdhil.report.calibration_page import band_of, quantity
from tdhil.session import RunRecord, load_calibration, read_pairs
from tests.estimation.reporting import recorded


def pairs(rng, factor=0.95, offset=1.5, many=8, hysteresis=0.0, x_sd=1.0, y_sd=0.8):
    torque = np.concatenate([np.linspace(-200.0, 200.0, many), np.linspace(200.0, -200.0, many)])
    direction = ("up",) * many + ("down",) * many
    sign = np.array([1.0] * many + [-1.0] * many)
    reference = factor * torque + offset + 0.5 * hysteresis * sign
    return TorquePairs(
        torque + x_sd * rng.standard_normal(len(torque)), np.full(len(torque), x_sd),
        reference + y_sd * rng.standard_normal(len(torque)), np.full(len(torque), y_sd), direction)


@pytest.mark.parametrize("seed", range(5))
def test_york_agrees_with_orthogonal_distance_regression(seed):
    odr = pytest.importorskip("scipy.odr")
    rng = np.random.default_rng(seed)
    x = np.sort(rng.uniform(-200.0, 200.0, 12))
    x_sd, y_sd = rng.uniform(0.5, 3.0, 12), rng.uniform(0.5, 3.0, 12)
    y = 0.93 * x + 4.0 + y_sd * rng.standard_normal(12)
    x = x + x_sd * rng.standard_normal(12)
    slope, intercept, _, chi2 = line_with_errors_in_both(x, x_sd, y, y_sd)
    fit = odr.ODR(odr.RealData(x, y, sx=x_sd, sy=y_sd), odr.Model(lambda beta, x: beta[0] * x + beta[1]),
                  beta0=[1.0, 0.0], sstol=1e-15, partol=1e-15, maxit=500).run()
    assert slope == pytest.approx(fit.beta[0], rel=1e-6)
    assert intercept == pytest.approx(fit.beta[1], rel=1e-6, abs=1e-6)
    assert chi2 == pytest.approx(fit.sum_square, rel=1e-6)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("hysteresis", [0.0, 4.0])
def test_the_interval_covers_with_errors_in_both_and_hysteresis(hysteresis):
    rng, many = np.random.default_rng(11), 1000
    covered = 0
    for _ in range(many):
        found = calibrate_pairs(pairs(rng, hysteresis=hysteresis))
        covered += found.factor.low <= 0.95 <= found.factor.high
    assert 0.93 * many <= covered


def test_hysteresis_is_shown_and_widens_the_interval():
    plain, wide = (calibrate_pairs(pairs(np.random.default_rng(2), hysteresis=one)) for one in (0.0, 10.0))
    assert wide.hysteresis_nm == pytest.approx(10.0, abs=2.0) and abs(plain.hysteresis_nm) < 2.0
    assert wide.factor.standard_uncertainty > 2.0 * plain.factor.standard_uncertainty


def test_what_no_torque_scale_can_be_is_refused():
    assert "no error of a torque scale" in calibrate_pairs(pairs(np.random.default_rng(3), factor=10.0)).refusal
    assert "no error of a torque scale" in calibrate_pairs(pairs(np.random.default_rng(3), factor=-0.95)).refusal
    assert calibrate_pairs(pairs(np.random.default_rng(3))).refusal == ""


def test_a_reference_that_is_curved_is_refused():
    rng = np.random.default_rng(4)
    made = pairs(rng)
    bent = TorquePairs(made.reported_nm, made.reported_sd_nm, made.reference_nm + 5e-4 * made.reported_nm**2,
                       made.reference_sd_nm, made.direction)
    assert "curved" in calibrate_pairs(bent).refusal


def test_a_reference_without_a_signal_is_an_error_of_use(tmp_path, capsys):
    """The cable of the sensor is not plugged in: a slope of 0 ended with a traceback."""
    path = tmp_path / "pairs.csv"
    path.write_text(HEADER + "".join(f"{x},1,0,0.5,up\n" for x in (0, 50, 100, 200)))
    assert main(["calibrate", "torque", "--pairs", str(path)]) == 2
    assert "the same in all pairs" in capsys.readouterr().err


def test_torques_at_the_main_shaft_are_divided_by_the_gear_ratio(tmp_path, capsys, monkeypatch):
    """The option was ignored with --pairs. The ratio is in the log."""
    path = tmp_path / "pairs.csv"
    path.write_text(HEADER + "".join(f"{x},0.1,{1.1 * 0.95 * x},0.1,up\n" for x in (0, 50, 100, 200)))
    words = ["calibrate", "torque", "--pairs", str(path), "--at", "main", "--json"]
    assert main(words) == 2
    assert "gear ratio" in capsys.readouterr().err
    log_path = tmp_path / "run.mcap"
    log_path.write_bytes(b"of which only the hash is read")
    recording = recorded(np.arange(10.0), np.ones(10), np.ones(10), gear_ratio=1.1, torque_scale_rel_sd=0.02)
    log = RunRecord(recording, {}, str(log_path))
    monkeypatch.setattr(calibrate_reference, "_one_log", lambda *_: log)
    assert main([*words[:2], str(log_path), *words[2:]]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["calibration_factor"]["value"] == pytest.approx(0.95)
    assert "TDH-065" in document["warning_codes"]            # the gear loses torque, and this is in the factor
    with path.open("a") as file:
        file.write("".join(f"{x},0.1,{1.1 * 0.95 * x},0.1,down\n" for x in (0, 50, 100, 200)))
    for at, warned in (("main", False), ("motor", False)):
        assert main([*words[:2], str(log_path), "--pairs", str(path), "--at", at, "--json"]) == 0
        assert ("TDH-065" in json.loads(capsys.readouterr().out)["warning_codes"]) is warned


def test_the_date_of_the_calibration_is_that_of_the_log(tmp_path, capsys, monkeypatch):
    """The date was that of the command, so a calibration from old pairs never exceeded calibration_valid_days."""
    path, log_path, saved = (tmp_path / name for name in ("pairs.csv", "run.mcap", "calibration.json"))
    path.write_text(HEADER + "".join(f"{x},0.1,{0.99 * x},0.1,up\n" for x in (0, 50, 100, 200)))
    log_path.write_bytes(b"of which only the hash is read")
    recording = recorded(np.arange(10.0), np.ones(10), np.ones(10), torque_scale_rel_sd=0.02)
    log = RunRecord(recording, {"started": "2020-03-01T08:00:00+00:00"}, str(log_path))
    monkeypatch.setattr(calibrate_reference, "_one_log", lambda *_: log)
    assert main(["calibrate", "torque", str(log_path), "--pairs", str(path), "--save", str(saved)]) == 0
    assert load_calibration(saved)["date"] == "2020-03-01T08:00:00+00:00"
    capsys.readouterr()
    assert main(["calibrate", "torque", "--pairs", str(path), "--json"]) == 0
    undated = capsys.readouterr().out
    assert json.loads(undated)["date"] is None
    (tmp_path / "undated.json").write_text(undated)
    with pytest.raises(UsageError, match="holds no date"):
        load_calibration(tmp_path / "undated.json")


def test_the_band_of_few_pairs_has_their_coverage_factor():
    """The scatter of three pairs has one degree of freedom: k is 12.7, and the band was drawn with 1.96."""
    factor = quantity(MeasuredValue(0.95, 0.004, 1.0, 12.7, 0.9, 1.0), 0.95)
    assert band_of(factor) == (12.7, "95 % band")
    assert band_of({**factor, "confidence": 0.9, "coverage_factor": 6.3}) == (6.3, "90 % band")
    assert band_of(None) == (1.96, "95 % band")


def test_two_pairs_give_no_line():
    two = np.array([1.0, 2.0])
    with pytest.raises(ValueError, match="3 pairs"):
        line_with_errors_in_both(two, two, two, two)


HEADER = "reported_nm,reported_sd_nm,reference_nm,reference_sd_nm,direction\n"


@pytest.mark.parametrize(("text", "words"), [
    ("a\n1\n", "no column reported_nm"), (HEADER, "fewer than three"), (HEADER + "1,1,nan,1,up\n", "is no number"),
    (HEADER + "1,1,x,1,up\n", "reference_nm is no number"), (HEADER + "1,0,1,1,up\n", "must be above 0"),
    (HEADER + "1,1,1,1,left\n", "neither up nor down"),
])
def test_invalid_pairs(tmp_path, text, words):
    path = tmp_path / "pairs.csv"
    path.write_text(text)
    with pytest.raises(UsageError, match=words):
        read_pairs(path)


def test_the_command_prints_a_card_and_a_document(tmp_path, capsys):
    path = tmp_path / "pairs.csv"
    rows = [f"{x},1,{0.95 * x},0.5,{way}\n" for x in (0, 50, 100, 200) for way in ("up", "down")]
    path.write_text(HEADER + "".join(rows))
    assert main(["calibrate", "torque", "--pairs", str(path)]) == 0
    card = capsys.readouterr().out
    (share,) = re.findall(r"calibration factor .* (±[\d.]+ %)", card)
    assert f"8 pairs give κ to {share}." in card          # one half-width, rounded up in both places
    assert "pair, N·m" in card and "200.00 reported,    190.00 true, residual" in card
    assert main(["calibrate", "torque", "--pairs", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["calibration_factor"]["value"] == pytest.approx(0.95)
    assert main(["calibrate", "torque", "--pairs", str(path), "--added", "5"]) == 2
    assert main(["calibrate", "torque", "--pairs", str(path), "--save", str(tmp_path / "c.json")]) == 2


def test_pairs_that_contradict_the_stated_scale_give_a_warning_with_its_code(tmp_path, capsys):
    path = tmp_path / "pairs.csv"
    path.write_text(HEADER + "".join(f"{x},0.1,{0.9 * x},0.1,up\n" for x in (0, 50, 100, 200)))
    assert main(["calibrate", "torque", "--pairs", str(path)]) == 0
    card = " ".join(capsys.readouterr().out.replace("│", "").split())
    assert "the factor differs from 1 by 10 %, and the stated torque scale allows ±4.0 %. Check the reference" in card
    assert "[TDH-064]" in card
    assert main(["calibrate", "torque", "--pairs", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["warning_codes"][0] == "TDH-064"
    assert any("[TDH-064]" in one for one in factor_report(document).warnings)
    path.write_text(HEADER + "".join(f"{x},0.1,{0.97 * x},0.1,up\n" for x in (0, 50, 100, 200)))
    assert main(["calibrate", "torque", "--pairs", str(path), "--json"]) == 0
    assert "TDH-064" not in json.loads(capsys.readouterr().out)["warning_codes"]


@pytest.mark.parametrize("many", [8, 80])
def test_more_pairs_do_not_reduce_the_uncertainty_of_the_sensor_scale(many):
    """All pairs share the sensor and therefore its error of scale (GUM F.1.2.3)."""
    found = calibrate_pairs(pairs(np.random.default_rng(5), many=many), reference_rel_sd=0.003)
    assert found.factor.standard_uncertainty > 0.003 * found.factor.value
    (scale,) = (line for line in found.budget if line.source == "scale of the reference")
    assert scale.of_factor == 0.003
    squares = np.sqrt(sum(line.of_factor**2 for line in found.budget))
    assert squares * found.factor.value == pytest.approx(found.factor.standard_uncertainty, rel=1e-9)


def test_pairs_more_uncertain_than_the_stated_scale_give_no_factor():
    few = TorquePairs(np.array([0.0, 5.0, 10.0]), np.full(3, 1.0), np.array([0.0, 5.6, 11.0]), np.full(3, 0.5),
                      ("up",) * 3)
    found = calibrate_pairs(few)
    assert found.too_wide and "the stated torque scale leaves ±3.9 %" in found.refusal
    assert not calibrate_pairs(few, scale_rel_sd=0.3).too_wide


def test_an_implausible_scale_is_not_reported_as_too_uncertain():
    found = calibrate_pairs(pairs(np.random.default_rng(3), factor=10.0), scale_rel_sd=0.001)
    assert found.factor.half_width_share > 0.002
    assert "no error of a torque scale" in found.refusal and not found.too_wide


def test_a_sensor_error_within_its_class_is_covered():
    """The limit of accuracy class 0.5 is 0.5 %. Without the budget line of its scale, κ would exclude 1."""
    rng, torque = np.random.default_rng(6), np.linspace(0.0, 200.0, 40)
    sd = 0.2 + 0.001 * torque
    found = calibrate_pairs(TorquePairs(torque + 0.2 * rng.standard_normal(40), np.full(40, 0.2),
                                        1.005 * torque + sd * rng.standard_normal(40), sd, ("up",) * 40))
    assert found.factor.low <= 1.0 <= found.factor.high
