"""Report as PDF: A4, all content within the margins, no overlapping texts, whole tables, and reproducible."""

import io
import itertools
import re
import shutil
import subprocess
from dataclasses import replace

import pytest

from tdhil.estimation import FrictionPoint
from tdhil.report.blocks import report_of
from tdhil.report.document import result_document
from tests.report.findings import RUN, around, bare, full, open_sided, recording

pytest.importorskip("matplotlib")

from matplotlib.backends.backend_pdf import PdfFile, RendererPdf

from tdhil.report.pdf import HIGH, LEFT, WIDE, pdf_bytes, sheets_of, wrapped

LONG = "a word of usual length and " * 40


def report(found, run=RUN, **changes):
    own = recording(**changes)
    document = result_document(found, own, run, "a/very/long/path/" * 9 + "run.mcap")
    return report_of(document, own, "0123456789abcdef" * 4)


def wordy():
    """Return a long report: a table of more than a sheet, texts that wrap, one without a space."""
    everything = full()
    return replace(
        everything, warnings=(LONG, "x" * 400, "three"), reason=LONG,
        friction_curve=tuple(FrictionPoint(0.1 * k, around(80.0 + k, 1.5)) for k in range(1, 41)),
        lines=tuple(replace(everything.lines[0], hertz=0.01 * k) for k in range(1, 90)),
    )


def texts_of(figure):
    """Return (text, bounds in points, y up) of the texts on a sheet, without those in pictures."""
    figure.dpi = 72
    renderer = RendererPdf(PdfFile(io.BytesIO()), 72, HIGH / 72.0, WIDE / 72.0)       # letters as wide as in the file
    found = []
    for text in figure.texts:
        box = text.get_window_extent(renderer)
        found.append((text.get_text(), box.x0, box.y0, box.x1, box.y1))
    return [one for one in found if one[0]]


@pytest.mark.heavy
@pytest.mark.parametrize("make", [full, bare, open_sided, wordy])
def test_everything_is_within_the_margins_and_nothing_overlaps(make):
    for figure in sheets_of(report(make(), {**RUN, "note": LONG, "operator": "y" * 300})):
        assert figure.get_size_inches() * 72.0 == pytest.approx((WIDE, HIGH))
        texts = texts_of(figure)
        for text, x0, y0, x1, y1 in texts:
            assert x0 >= LEFT - 1.0, text
            assert x1 <= WIDE - LEFT + 1.0, text
            assert 15.0 <= y0 < y1 <= HIGH - 20.0, text
        for one, other in itertools.combinations(texts, 2):
            apart = one[3] <= other[1] or other[3] <= one[1] or one[4] <= other[2] + 1.5 or other[4] <= one[2] + 1.5
            assert apart, (one[0], other[0])
        for inside in figure.subfigs:
            box = inside.bbox.transformed(figure.dpi_scale_trans.inverted())
            assert 72.0 * box.x0 >= LEFT - 1.0
            assert 72.0 * box.y0 >= 30.0


@pytest.mark.heavy
def test_a_long_table_is_split_with_its_head_and_a_short_one_never():
    sheets = [[text for text, *_ in texts_of(figure)] for figure in sheets_of(report(wordy()))]
    heads = [k for k, texts in enumerate(sheets) if "frequency, Hz" in texts]
    assert len(heads) >= 2
    rows = [[text for text in texts if re.fullmatch(r"0\.\d\d?", text)] for texts in sheets]
    assert sum(map(len, rows)) >= 89
    short = [[text for text, *_ in texts_of(figure)] for figure in sheets_of(report(full()))]
    assert sum("frequency, Hz" in texts for texts in short) == 1


def lowest_of(figure):
    """Return the position of the lowest text above the foot of a sheet, points."""
    return min(y0 for _, _, y0, _, _ in texts_of(figure) if y0 > 40.0)


def stopped():
    """Return a result of the stages before the excitation: no frequencies, and fewer values."""
    everything = full()
    return replace(everything, lines=(), friction_curve=(), second_opinions=(), compliant=None)


def test_no_sheet_is_half_empty():
    figures = sheets_of(report(full()))
    assert len(figures) <= 4
    for figure in figures[:-1]:
        assert lowest_of(figure) < 0.4 * HIGH
    assert lowest_of(figures[-1]) < 0.5 * HIGH


@pytest.mark.heavy
@pytest.mark.parametrize("make", [open_sided, wordy, stopped])
def test_the_last_sheet_of_other_reports_is_half_full(make):
    *others, last = sheets_of(report(make()))
    assert all(lowest_of(figure) < 0.4 * HIGH for figure in others)
    assert lowest_of(last) < 0.5 * HIGH


@pytest.mark.heavy
def test_a_report_of_little_more_than_a_sheet_is_shared_between_two():
    """The second sheet cannot be half full without a gap on the first one, but it is fuller than before."""
    first, second = sheets_of(report(bare()))
    assert lowest_of(first) < 0.35 * HIGH
    assert lowest_of(second) < 0.7 * HIGH


@pytest.mark.heavy
@pytest.mark.parametrize("lines", [24, 34, 44])
def test_a_table_leaves_no_sheet_before_it_mostly_empty(lines):
    """The table of the excited frequencies would fit on its own sheet, but it is split, with a repeated head."""
    everything = full()
    found = replace(everything, lines=tuple(replace(everything.lines[0], hertz=0.01 * k) for k in range(1, lines + 1)))
    figures = sheets_of(report(found))
    for figure in figures[:-1]:
        assert lowest_of(figure) < 0.4 * HIGH
    assert lowest_of(figures[-1]) < 0.5 * HIGH
    rows = [sum(bool(re.fullmatch(r"0\.\d\d?", text)) for text, *_ in texts_of(figure)) for figure in figures]
    assert all(count == 0 or count >= 3 for count in rows)


@pytest.mark.heavy
def test_it_is_a_pdf_with_this_number_of_pages_and_reproducible():
    one, other = pdf_bytes(report(full())), pdf_bytes(report(full()))
    assert one == other
    assert one.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type /Page\b", one)) == len(sheets_of(report(full())))
    assert b"/Subtype /Image" not in one            # vectors


@pytest.mark.heavy
@pytest.mark.skipif(shutil.which("pdftotext") is None, reason="no pdftotext (poppler-utils) here")
def test_its_text_can_be_read_by_other_programs(tmp_path):
    (tmp_path / "r.pdf").write_bytes(pdf_bytes(report(full())))
    said = subprocess.run(["pdftotext", "-layout", tmp_path / "r.pdf", "-"], capture_output=True, text=True, check=True)
    for wanted in ("J_r = 104.0 (99.9 to 108.1) kg·m² ±4.0 %", "Hall B · 2026-03-04 05:06:07 UTC+01:00", "987654",
                   "friction <b>bends</b> & more", "0123456789abcdef", "page 1 of"):
        assert wanted in said.stdout, wanted
    assert said.stdout.count("SIMULATED") >= len(sheets_of(report(full())))


def test_lines_are_wrapped_to_a_width():
    assert wrapped("", 8.0, 100.0) == [""]
    assert "".join(wrapped("x" * 100, 8.0, 60.0)) == "x" * 100
    lines = wrapped(LONG, 8.0, 200.0)
    assert " ".join(lines) == LONG.strip()
    assert len(lines) > 10
