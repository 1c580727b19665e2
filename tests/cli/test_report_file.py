"""Head of every report: letterhead, customer, order number and place."""

import argparse

import pytest

from tdhil.cli.main import build_full_parser, main
from tdhil.cli.report_file import ReportFile
from tdhil.config import OF_THE_HEAD, OPTION
from tdhil.errors import ExitCode
from tdhil.report import NO_LETTERHEAD, Letterhead, Report
from tests.report.test_letterhead import png

COUNTED = ["calibrate", "speed", "--turns", "100", "--seconds", "312.4", "--speed", "2.0"]
EMPTY = Report(title="T", subtitle="", simulated="", answer=None, warnings=(), sections=(), footer="")


@pytest.fixture
def letterhead(tmp_path):
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    (tmp_path / "logo.png").write_bytes(png())
    file = tmp_path / "letterhead.yaml"
    file.write_text("company: Nordwerk\naddress: [Hafen 1]\nlogo: logo.png\n")
    return file


def _parsers(parser, name="tdhil"):
    yield name, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, one in action.choices.items():
                yield from _parsers(one, f"{name} {word}")


def test_every_command_with_a_report_has_the_options_of_its_head():
    pytest.importorskip("starlette", reason="of the extra service")
    head = {*(one.flag for one in OF_THE_HEAD), OPTION["letterhead"].flag}
    found = {name: head - set(one._option_string_actions) for name, one in _parsers(build_full_parser())
             if "--report" in one._option_string_actions}
    assert {name: missing for name, missing in found.items() if missing} == {}
    assert found.keys() >= {"tdhil calibrate torque", "tdhil calibrate speed", "tdhil severity", "tdhil tune speed",
                            "tdhil tune soft-torque", "tdhil trend", "tdhil compare", "tdhil identify", "tdhil replay"}


@pytest.mark.parametrize("ending", ["html", pytest.param("pdf", marks=pytest.mark.heavy)])
def test_a_certificate_of_a_speed_calibration_has_the_head(letterhead, tmp_path, capsys, ending):
    page = tmp_path / f"speed.{ending}"
    asked = [*COUNTED, "--report", str(page), "--letterhead", str(letterhead), "--customer", "Østfold Boring",
             "--order-number", "4711-B", "--place", "Aurich"]
    assert main(asked) == 0
    assert f"report: {page}" in capsys.readouterr().err
    assert main(asked) == 2 and "already exists and was not overwritten" in capsys.readouterr().err
    data = page.read_bytes()
    if ending == "pdf":
        assert data.startswith(b"%PDF") and data.count(b"/Subtype /Image") == 1
        return
    text = data.decode()
    for part in ("Nordwerk", "Hafen 1", "Østfold Boring", "4711-B", "Aurich", "Calibration of a drive&#39;s speed",
                 "too little speed", "counted turns", "signature"):
        assert part in text, part
    assert text.index("Nordwerk") < text.index("<h1>") < text.index("4711-B") < text.index("κ = ")


def test_a_refused_speed_calibration_has_its_page_too(letterhead, tmp_path):
    page = tmp_path / "speed.html"
    few = ["--turns", "3", "--seconds", "9.4", "--speed", "2.0"]
    assert main(["calibrate", "speed", *few, "--report", str(page)]) == ExitCode.NOT_IDENTIFIABLE
    assert "No number" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("more", [["--customer", "K"], ["--order-number", "1"], ["--place", "A"],
                                  ["--letterhead", "letterhead.yaml"]])
def test_a_head_without_a_report_is_refused(more, capsys):
    assert main([*COUNTED, *more]) == 2
    assert more[0] in (said := capsys.readouterr().err) and "no report is requested" in said


def test_an_svg_and_a_wrong_name_are_refused_before_any_work(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    (tmp_path / "logo.svg").write_text("<svg/>")
    (tmp_path / "l.yaml").write_text("logo: logo.svg\n")
    assert main([*COUNTED, "--report", str(tmp_path / "r.html"), "--letterhead", str(tmp_path / "l.yaml")]) == 2
    assert "this is an SVG" in capsys.readouterr().err
    assert main([*COUNTED, "--report", str(tmp_path / "r.txt")]) == 2
    assert list(tmp_path.glob("r.*")) == []


def _written(tmp_path, stated, runs, letterhead=NO_LETTERHEAD):
    pytest.importorskip("jinja2")
    path = tmp_path / "r.html"
    ReportFile(path, letterhead, stated).write(EMPTY, runs)
    return path.read_text(encoding="utf-8")


def test_the_runs_state_the_head_and_the_command_line_replaces_it(tmp_path, capsys):
    runs = [{"customer": "Østfold", "order_number": "1", "place": "Aurich"},
            {"customer": "Østfold", "order_number": None}]
    text = _written(tmp_path, {"place": "Stavanger"}, runs)
    assert all(one in text for one in ("Østfold", "Order number", "Stavanger")) and "Aurich" not in text
    assert "different" not in capsys.readouterr().err


def test_runs_with_different_heads_give_none_and_a_message(tmp_path, capsys):
    runs = [{"customer": "A&B", "place": 7}, {"customer": "C"}]
    text = _written(tmp_path, {}, runs, Letterhead("Nordwerk"))
    assert "A&amp;B" not in text and "Customer" not in text and "Place" not in text and "Nordwerk" in text
    said = " ".join(capsys.readouterr().err.split())
    assert "different texts for customer (A&B, C). The report states none. Add --customer." in said


def test_a_page_without_a_verdict_has_no_empty_box(tmp_path):
    assert 'class="answer' not in _written(tmp_path, {}, ())
