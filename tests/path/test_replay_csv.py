"""`tdhil replay trace.csv`: the same J from the log of a run and from its samples in other CSV dialects."""

import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml

from tdhil.cli import replay as replay_command
from tdhil.cli.main import build_parser
from tdhil.recording.csv.excitation import load_excitation
from tdhil.recording.log_reader import read_run
from tests.path.path_runs import tdhil

pytestmark = pytest.mark.one_worker

RPM = 2.0 * math.pi / 60.0
DOC = Path(__file__).parents[2] / "docs" / "how-to" / "use-a-trace.md"


@pytest.fixture(scope="module")
def run(short_run, tmp_path_factory):
    """Return a completed run, its Recording, and its excitation as a file."""
    folder, done = tmp_path_factory.mktemp("run"), short_run
    assert done.code == 0, done.err
    recording = read_run(done.log).recording
    segments = [
        {"start_s": s.start_s, "periods": round((s.end_s - s.start_s) / s.period_s), "period_s": s.period_s,
         "settle_periods": s.settle_periods, "offset_rad_s": s.offset_rad_s, "lines_hz": list(s.lines_hz)}
        for s in recording.excitation.segments
    ]
    path = folder / "excitation.yaml"
    path.write_text(yaml.safe_dump({"kind": "multisine", "mode": recording.excitation.mode, "segments": segments}))
    return done.document, recording, path, done.log


def plain(t, w, m):
    return "time_s,speed_rad_s,torque_nm\n", "%.17g,%.17g,%.17g", (t, w, m), "utf-8", ()


def percent(t, w, m):
    options = ("--columns", "time=t_s", "speed=n_rpm:rpm", "torque=m_pct:%", "--rated-torque", 480)
    return "t_s,n_rpm,m_pct\n", "%.6f,%.7f,%.7f", (t, w / RPM, m / 4.8), "utf-8-sig", options


def german(t, w, m):
    head = "Gerät;7\n\nZeit;Drehzahl;Moment\nms;1/min;kNm\n"
    options = ("--columns", "time=zeit", "speed=drehzahl", "torque=moment")
    return head, "%.4f;%.7f;%.9f", (t * 1e3, w / RPM, m / 1e3), "latin-1", options


def american(t, w, m):
    options = ("--columns", "torque=Tq:lbf.ft", "speed=Spd")
    return "Time [us]\tTq\tSpd (deg/s)\n", "%.1f\t%.8f\t%.8f", (t * 1e6, m / 1.3558179483314004, np.degrees(w)), \
        "utf-16", options


def parse(*words):
    return build_parser("replay").parse_args(["replay", *map(str, words)])


@pytest.mark.heavy
def test_the_options_of_one_motion_replace_its_file(run, tmp_path):
    """For the first mean speed only, the options give the same result, digit by digit, as a file with this segment."""
    _, recording, excitation, _ = run
    fresh = recording.fresh
    columns = (recording.time_s[fresh], recording.speed_rad_s[fresh],
               recording.torque_nm[fresh] - recording.torque_offset_nm)
    trace, one = tmp_path / "trace.csv", tmp_path / "one.yaml"
    trace.write_text("time_s,speed_rad_s,torque_nm\n"
                     + "\n".join(",".join(map(repr, row)) for row in zip(*(c.tolist() for c in columns), strict=True)))
    whole = yaml.safe_load(excitation.read_text())
    first = whole["segments"][0]
    one.write_text(yaml.safe_dump({**whole, "segments": [first]}))
    options = ("--motion-start", first["start_s"], "--motion-period", first["period_s"], "--motion-periods",
               first["periods"], "--motion-settle-periods", first["settle_periods"], "--motion-offset",
               first["offset_rad_s"], "--motion-lines", ",".join(map(str, first["lines_hz"])), "--motion-mode",
               whole["mode"])
    by_file, by_options = (tdhil("replay", trace, "--json", *more) for more in (("--excitation", one), options))
    assert by_options.document == by_file.document
    known = [replay_command.read_recorded(parse(trace, *more), trace).recording.excitation
             for more in (("--excitation", one), options)]
    assert known[0] == known[1] and known[0].segments[0].lines_hz == tuple(first["lines_hz"])
    refused = tdhil("replay", trace, *options[2:])
    assert refused.code == 2 and "--motion-start: is needed for a periodic motion" in refused.err


@pytest.mark.heavy
@pytest.mark.parametrize("dialect", [plain, percent, german, american])
def test_a_run_in_other_columns_and_units_has_the_same_inertia(run, tmp_path, dialect):
    document, recording, excitation, _ = run
    fresh = recording.fresh
    torque = recording.torque_nm[fresh] - recording.torque_offset_nm
    head, row, columns, encoding, options = dialect(recording.time_s[fresh], recording.speed_rad_s[fresh], torque)
    body = "\n".join(row % values for values in zip(*columns, strict=True))
    path = tmp_path / "trace.csv"
    path.write_text(head + (body.replace(".", ",") if dialect is german else body), encoding=encoding)
    done = tdhil("replay", path, "--json", "--excitation", excitation, *options)
    assert done.code == 0, done.err
    found = done.document
    assert found.keys() == document.keys()
    assert found["log"] == str(path)
    for name in ("value", "low", "high"):
        assert found["inertia_kg_m2"][name] == pytest.approx(document["inertia_kg_m2"][name], rel=5e-4)
    assert found["verdict"] == document["verdict"]
    assert found["paper"]["inertia_kg_m2"] == pytest.approx(document["paper"]["inertia_kg_m2"], rel=1e-3)
    assert found["samples_used"] == document["samples_used"]
    assert any("torque scale" in warning for warning in found["warnings"])
    assert any("decimal comma" in warning for warning in found["warnings"]) == (dialect is german)


@pytest.fixture
def trace(run, tmp_path):
    _, recording, _, _ = run
    path = tmp_path / "run.mcap"          # the name does not matter
    rows = zip(recording.time_s[::2], recording.speed_rad_s[::2], recording.torque_nm[::2], strict=True)
    path.write_text("time_s,speed_rad_s,torque_nm\n" + "".join(f"{t:.5f},{w:.6f},{m:.4f}\n" for t, w, m in rows))
    return path


@pytest.mark.heavy
def test_without_an_excitation_it_is_identified_from_the_motion_itself(run, trace):
    document, *_ = run
    done = tdhil("replay", trace, "--json")
    assert done.code == 0, done.document
    found = done.document
    assert found["verdict"] in ("valid", "valid_wide")
    assert found["inertia_kg_m2"]["low"] <= 104.0 <= found["inertia_kg_m2"]["high"]
    assert found["inertia_kg_m2"]["value"] == pytest.approx(document["inertia_kg_m2"]["value"], rel=0.05)
    assert "time domain" in found["model"]
    assert found["paper"]["inertia_kg_m2"] > 0


@pytest.mark.heavy
def test_an_unsuitable_trace_gives_advice_on_the_motion(tmp_path):
    path = tmp_path / "trace.csv"
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((2, 2000))
    rows = zip(np.arange(2000) * 0.01, 5.0 + 0.003 * noise[0], 100.0 + 2.0 * noise[1], strict=True)
    path.write_text("time_s,speed_rad_s,torque_nm\n" + "".join(f"{t:.5f},{w:.6f},{m:.4f}\n" for t, w, m in rows))
    done = tdhil("replay", path, "--json")
    assert done.code == 9
    assert done.document["verdict"] == "not_identifiable"
    assert "constant" in done.document["reason"]
    assert "several speeds" in done.document["advice"]


@pytest.mark.heavy
def test_known_data_of_the_bench_are_used(run, trace):
    _, _, excitation, _ = run
    arguments = ("replay", "--json", trace, "--excitation", excitation)
    alone = tdhil(*arguments).document
    found = tdhil(*arguments, "--gear", 2, "--torque-scale-sd", 0, "--speed-lag", 0.4, "--speed-lag-sd", 0.01,
                  "--torque-lag", 0.15, "--confidence", 0.9, "--tolerance", 0.0001).document
    inertia = found["inertia_kg_m2"]
    assert found["verdict"] == "valid_wide"
    assert inertia["confidence"] == 0.9
    assert (inertia["low_total"], inertia["high_total"]) == (inertia["low"], inertia["high"])
    assert found["inertia_main_shaft_kg_m2"]["value"] == 4 * inertia["value"]
    assert any("the command line" in condition for condition in inertia["conditional_on"])
    assert not any("torque scale" in warning for warning in found["warnings"])
    narrower = inertia["high"] - inertia["low"]
    assert narrower < alone["inertia_kg_m2"]["high"] - alone["inertia_kg_m2"]["low"]
    clipped = tdhil(*arguments, "--torque-limit", 50)
    assert clipped.code == 9
    assert "limit of 50 N·m" in clipped.document["reason"]


@pytest.mark.heavy
def test_a_log_is_known_by_its_content(run, tmp_path):
    document, _, excitation, log = run
    renamed = tmp_path / "trace.csv"
    renamed.write_bytes(log.read_bytes())
    assert tdhil("replay", "--json", renamed).document == document | {"log": str(renamed)}
    sure = tdhil("replay", "--json", renamed, "--confidence", 0.99).document
    assert sure["inertia_kg_m2"]["low"] < document["inertia_kg_m2"]["low"]
    assert sure["inertia_kg_m2"]["confidence"] == 0.99
    wrong = tdhil("replay", renamed, "--excitation", excitation)
    assert wrong.code == 2
    assert "--excitation" in wrong.err


@pytest.mark.parametrize(("arguments", "said"), [
    (("--columns", "speed=n_rmp:rpm"), "no column 'n_rmp'"),
    (("--columns", "speed=n:rmp"), "'rmp' is not a unit of speed"),
    (("--columns", "torque=torque_nm:%"), "--rated-torque"),
    (("--rated-torque", "0"), "--rated-torque"),
    (("--gear", "nan"), "--gear"),
    (("--confidence", "95"), "--confidence"),
    (("--tolerance", "0"), "--tolerance"),
    (("--torque-scale-sd", "2"), "--torque-scale-sd"),
    (("--speed-lag", "-1"), "--speed-lag"),
    (("--speed-lag", "400"), "--speed-lag: 400 s: must be at least 0 and less than 60 s"),        # 400 ms were intended
    (("--torque-lag-sd", "0.1"), "--torque-lag"),
    (("--excitation", "none.yaml"), "none.yaml"),
])
def test_a_wrong_option_ends_with_2_and_names_what_is_wrong(tmp_path, arguments, said):
    trace = tmp_path / "run.csv"          # its columns are right; the check of the motion is not reached
    trace.write_text("time_s,speed_rad_s,torque_nm\n" + "".join(f"{0.01 * k:.2f},2.0,76.0\n" for k in range(100)))
    done = tdhil("replay", trace, *arguments)
    assert done.code == 2, done.err
    assert said in done.err
    assert "Traceback" not in done.err
    assert done.out == ""


@pytest.mark.heavy
def test_the_file_may_come_after_the_columns(trace):
    done = tdhil("replay", "--json", "--columns", "time=TIME_S", "speed=speed_rad_s", trace)
    assert done.code == 0
    assert done.document["log"] == str(trace)
    nothing = tdhil("replay", "--json")
    assert nothing.code == nothing.document["exit_code"] == 2


def test_an_unusable_file_ends_with_10_in_one_line(tmp_path):
    path = tmp_path / "trace.csv"
    path.write_text("time_s,speed_rad_s,torque_nm\n" + "0,1,2\n" * 100)
    done = tdhil("replay", "--json", path)
    assert done.code == done.document["exit_code"] == 10
    assert f"{path}:3: the time repeats itself" in done.err
    assert done.err.count("\n") == 1


# -- docs/how-to/use-a-trace.md ------------------------------------------------------------------------------


def test_the_examples_of_the_page_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = DOC.read_text(encoding="utf-8")
    files = re.findall(r"^<!-- file: (\S+)[^\n]*-->\n```\w+\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    assert {name for name, _ in files} == {"trace.csv", "percent.csv", "german.csv", "excitation.yaml"}
    for name, content in files:
        Path(name).write_text(content, encoding="utf-8")
    excitation, levels = load_excitation(Path("excitation.yaml"), np.array([0.0, 300.0]))
    assert [segment.end_s for segment in excitation.segments] == [152.0, 300.0]
    assert levels == ()
    commands = re.findall(r"^tdhil (replay .*)$", text, re.MULTILINE)
    assert len(commands) == 4
    for command in commands[:3]:
        done = tdhil(*shlex.split(command), "--json")
        assert done.code == 9, done.err
        assert "too few" in done.document["reason"]
    late = tdhil(*shlex.split(commands[3]))
    assert late.code == 2
    assert "excitation.yaml:4: segment 1 lasts from 12 to 152 s, but the trace" in late.err


def test_the_page_names_every_option():
    shown = tdhil("replay", "--help").out
    for option in set(re.findall(r"--[a-z][a-z-]+", DOC.read_text(encoding="utf-8"))):
        assert option in shown, option
