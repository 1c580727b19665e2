"""HTML report: one self-contained file, complete and escaped, with errors in one line."""

import importlib.util
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tdhil.errors import UsageError
from tdhil.file_hash import sha256_of
from tdhil.report.blocks import Picture, report_of
from tdhil.report.document import result_document
from tdhil.report.html import check_report_path, pictures_in, report_page, write_report
from tdhil.report.plots import envelope
from tests.report.findings import RUN, bare, full, open_sided, recording

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

VOID = {"meta", "br", "img", "path", "use", "rect", "line", "circle", "polyline", "polygon"}


class Balanced(HTMLParser):
    """Parser that checks that every opened tag is closed, in order."""

    def __init__(self):
        super().__init__()
        self.open, self.text, self.loaded = [], [], []

    def handle_starttag(self, tag, attributes):
        self.loaded += [value for name, value in attributes if name in ("src", "href", "xlink:href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.loaded += [value for name, value in attributes if name in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def page(found, **changes):
    own = recording(**changes)
    return report_page(report_of(result_document(found, own, RUN, "run.mcap"), own))


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("make", [full, bare, open_sided])
@pytest.mark.parametrize("changes", [{}, {"samples": 1}, {"samples": 0, "stages": (), "excitation": None}])
def test_the_page_is_well_formed_and_loads_nothing(make, changes):
    text = page(make(), **changes)
    parser = Balanced()
    parser.feed(text)
    assert parser.open == []
    assert all(target.startswith("#") for target in parser.loaded)
    assert "url(http" not in text
    assert "<script" not in text
    for svg in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        ET.fromstring(svg)


def test_the_page_contains_every_part():
    text = page(full())
    assert text.count("<svg") == 5
    for wanted in (
        "J_r = 104.0 (99.9 to 108.1) kg·m²  ±4.0 %", "J_r + J_L = 130.0 (124.5 to 135.5) kg·m²",
        "repeatability, this drive: 104.00 (103.55 to 104.45) kg·m²  ±0.44 %", "SIMULATED",
        "does not agree", "J_r, the motor&#39;s side: repeatability", "9 of 3200 cycles without feedback",
        "scatter from period to period",
        "111.5 kg·m²", "116.20 ± 0.80",
        "Hall B · 2026-03-04 05:06:07 UTC+01:00", "A. &lt;Person&gt;", "after [31m repair", "987654", "Drive ]0;x",
        "vendor 2Ah, product 192h, revision 1h", "vendor/model (A drive)", "canopen, channel can0, bitrate 500000",
        "speed 0.5 to 10 rad/s; torque 400 N·m", "drill string",
    ):
        assert wanted in text, wanted
    assert "friction &lt;b&gt;bends&lt;/b&gt; &amp; more" in text


def test_a_refusal_has_no_number_and_no_banner_on_a_real_drive():
    text = page(bare(), simulated=False)
    assert "No number" in text
    assert "12 samples are no record" in text.lower()
    assert "SIMULATED" not in text
    assert text.count("<svg") == 1


@pytest.mark.heavy
def test_open_sides_are_open():
    assert page(open_sided()).count('<td class="number">open</td>') == 3
    assert "J_r + J_L left open by the data" in page(open_sided())


@pytest.mark.heavy
def test_the_same_result_is_the_same_file(tmp_path):
    own = recording()
    document = result_document(full(), own, {}, "run.mcap")
    write_report(document, own, tmp_path / "a.html")
    write_report(document, own, tmp_path / "b.html")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


@pytest.mark.heavy
def test_no_file_is_overwritten(tmp_path):
    own, old = recording(), tmp_path / "report.html"
    old.write_text("somebody's own")
    with pytest.raises(UsageError, match="already exists and was not overwritten"):
        check_report_path(old, tmp_path / "run.mcap")
    assert write_report(result_document(full(), own, {}, "run.mcap"), own, old) == tmp_path / "report-2.html"
    assert old.read_text() == "somebody's own"


@pytest.mark.heavy
def test_it_names_the_log_by_its_hash(tmp_path):
    log = tmp_path / "run.mcap"
    log.write_bytes(b"abc")
    own = recording()
    write_report(result_document(full(), own, {}, str(log)), own, tmp_path / "r.html")
    wanted = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"       # FIPS 180-2, appendix B.1
    assert sha256_of(log) == wanted
    assert wanted in (tmp_path / "r.html").read_text(encoding="utf-8")
    assert sha256_of(tmp_path / "nowhere", missing="") == ""
    with pytest.raises(UsageError, match="nowhere: can't be read"):
        sha256_of(tmp_path / "nowhere")


@pytest.mark.parametrize("run", [
    {"bench": 3, "identity": "x", "profile": [], "bus": {"a": 1}, "ended": "text", "started": "yesterday", "note": 7},
    {"bench": {"limits": {"torque_nm": "much"}, "name": ["a"]}, "identity": {"serial": -1, "name": {}}, "ended": {}},
])
def test_a_hostile_log_still_gives_a_page(run):
    own = recording()
    document = result_document(bare(), own, run, "run.mcap")
    assert "No number" in report_page(report_of(document, own))


def test_errors_are_reported_in_one_line(tmp_path, monkeypatch):
    log = tmp_path / "run.mcap"
    for path, said in ((log, "the log itself"), (tmp_path, "a folder"), (tmp_path / "no" / "r.html", "no such folder")):
        with pytest.raises(UsageError) as caught:
            check_report_path(path, log)
        assert said in str(caught.value)
        assert "\n" not in str(caught.value)
    check_report_path(tmp_path / "r.html", log)
    find = importlib.util.find_spec
    monkeypatch.setattr("tdhil.report.page.find_spec", lambda name: None if name == "jinja2" else find(name))
    with pytest.raises(UsageError, match=r"needs jinja2, not installed here.*pip install -e .*\[report\]"):
        check_report_path(tmp_path / "r.html", log)


def test_the_envelope_loses_no_peak():
    rng = np.random.default_rng(1)
    signal = rng.standard_normal(100_000)
    signal[77_777] = 50.0
    time, low, high = envelope(np.arange(100_000) * 0.001, signal)
    assert len(time) <= 1200
    assert high.max() == 50.0
    assert low.min() == signal.min()
    assert np.all(low <= high)


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["r.html", "r.pdf"])
def test_a_missing_descriptor_for_the_report_is_reported(tmp_path, name):
    """Fonts and modules that are read late fail like the file. This is no programming error."""
    pytest.importorskip("resource")
    script = f"""
import resource, sys
sys.path.insert(0, {str(Path(__file__).parents[2])!r})
from pathlib import Path
from tests.report.findings import RUN, full, recording
from tdhil.errors import UsageError
from tdhil.report import html, page, plots as pictures
from tdhil.report.document import result_document
own = recording()
document = result_document(full(), own, RUN, "run.mcap")
resource.setrlimit(resource.RLIMIT_NOFILE, (3, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
try:
    html.write_report(document, own, Path({str(tmp_path / name)!r}))
except UsageError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f"{name}: can't be written (Too many open files)" in done.stdout
    assert f"tdhil replay run.mcap --report {name}" in done.stdout
    assert not (tmp_path / name).exists()


@pytest.mark.heavy
def test_each_of_its_pictures_is_complete_alone():
    own = recording()
    report = report_of(result_document(full(), own, RUN, "run.mcap"), own)
    meant = [(section.heading, block.caption) for section in report.sections for block in section.blocks
             if isinstance(block, Picture)]
    found = pictures_in(report_page(report))
    assert [(one.heading, one.caption) for one in found] == meant
    assert len(found) >= 4
    assert {ET.fromstring(one.svg).tag for one in found} == {"{http://www.w3.org/2000/svg}svg"}
