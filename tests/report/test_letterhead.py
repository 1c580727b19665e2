"""Letterhead of a report: only the picture of a PNG is kept, other files are refused, and every sheet has it."""

import base64
import re
import struct
import zlib
from dataclasses import replace

import pytest

from profiles import DataFileError
from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.report import NO_LETTERHEAD, Letterhead, clean_logo, load_letterhead
from tdhil.report.blocks import reference_of, report_of
from tdhil.report.document import result_document
from tdhil.report.letterhead import LARGEST_LOGO
from tests.report.findings import RUN, bare, full, open_sided, recording

SIGNATURE = b"\x89PNG\r\n\x1a\n"
STATED = {"customer": "Østfold <Boring>", "order_number": "4711-B", "place": "Stavanger"}


def chunk(kind, content, checksum=None):
    checked = zlib.crc32(kind + content) if checksum is None else checksum
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checked)


def png(width=30, height=10, *, depth=8, colour=2, interlaced=0, extra=b"", body=None, after=b""):
    samples = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    row = b"\x00" + b"\x40" * ((width * depth * samples + 7) // 8)
    palette = chunk(b"PLTE", b"\x10\x20\x30" * 65) if colour == 3 else b""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlaced))
    return SIGNATURE + header + extra + palette + chunk(
        b"IDAT", zlib.compress(row * height) if body is None else body) + chunk(b"IEND", b"") + after


@pytest.mark.parametrize(("depth", "colour"), [(8, 2), (16, 6), (1, 0), (8, 3), (8, 4)])
def test_a_png_of_each_colour_type_is_kept_and_can_be_read(depth, colour):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed (pip install '.[report]')")
    import io

    kept = clean_logo(png(depth=depth, colour=colour))
    assert image.open(io.BytesIO(kept)).size == (30, 10)
    assert Letterhead(logo=kept).logo_size == (30, 10)
    assert clean_logo(kept) == kept


def test_only_the_picture_is_kept():
    hidden = chunk(b"tEXt", b"Author\x00A. Person") + chunk(b"eXIf", b"<script>alert(1)</script>")
    kept = clean_logo(png(extra=hidden, after=b"<script src='https://elsewhere.example/x.js'></script>"))
    assert kept == clean_logo(png())
    assert b"Person" not in kept and b"script" not in kept and kept.endswith(chunk(b"IEND", b""))


@pytest.mark.parametrize(("data", "said"), [
    (b"<svg xmlns='http://www.w3.org/2000/svg'><script>alert(1)</script></svg>", "SVG.*scripts.*Export the logo"),
    (b"\xef\xbb\xbf\n <?xml version='1.0'?><svg/>", "this is an SVG"),
    (b"\xff\xd8\xff\xe0 a JPEG", "this is no PNG"),
    (b"", "this is no PNG"),
    (SIGNATURE + b"\x00" * LARGEST_LOGO, "more than 256 KiB"),
    (png(9000, 9000, body=b"x"), "9000 by 9000 pixels; 4 million"),
    (png(interlaced=1), "interlaced"),
    (png(2000, 1500, body=zlib.compress(b"\x00" * 400_000_000, 1)[:200_000]), "damaged"),
    (png(body=zlib.compress(b"\x00" * 20)), "damaged"),
    (png(body=zlib.compress(b"\x09" * 910)), "damaged"),
    (png(extra=chunk(b"tEXt", b"x", checksum=7)), "damaged"),
    (png()[:-20], "damaged"),
    (png(colour=3).replace(b"PLTE", b"PLTX"), "damaged"),
    (SIGNATURE + chunk(b"IDAT", b""), "damaged"),
    (SIGNATURE + b"\xff\xff\xff\xffIHDR", "damaged"),
], ids=range(15))
def test_another_file_is_refused_with_a_reason(data, said):
    with pytest.raises(UsageError, match=f"(?s){said}"):
        clean_logo(data)


def test_a_letterhead_survives_json_and_its_logo_is_checked_again():
    one = Letterhead("Nordwerk", ("Hafen 1", "Aurich"), clean_logo(png()))
    assert Letterhead.of_plain(one.plain()) == one
    assert Letterhead.of_plain({}) == NO_LETTERHEAD and not NO_LETTERHEAD
    with pytest.raises(UsageError, match="SVG"):
        Letterhead.of_plain({"logo": base64.b64encode(b"<svg/>").decode()})


def test_the_file_names_company_address_and_a_logo_beside_it(tmp_path):
    (tmp_path / "logo.png").write_bytes(png())
    file = tmp_path / "letterhead.yaml"
    file.write_text("company: Nordwerk\naddress: [Hafen 1, Aurich]\nlogo: logo.png\n")
    assert load_letterhead(file) == Letterhead("Nordwerk", ("Hafen 1", "Aurich"), clean_logo(png()))
    assert load_letterhead(None) == NO_LETTERHEAD
    file.write_text("company: Nordwerk\nlogo: none.png\n")
    with pytest.raises(UsageError, match=r"none\.png.*can't be read"):
        load_letterhead(file)
    file.write_text("firm: Nordwerk\n")
    with pytest.raises(DataFileError, match="firm"):
        load_letterhead(file)


def report(make=full, run=STATED):
    own = recording()
    document = result_document(make(), own, RUN | run, "run.mcap")
    return replace(report_of(document, own), letterhead=Letterhead("Nordwerk & Co", ("Hafen 1",), clean_logo(png())))


def test_the_page_shows_logo_company_and_order_and_loads_nothing():
    pytest.importorskip("jinja2")
    pytest.importorskip("matplotlib")
    from tdhil.report.html import report_page

    page = report_page(replace(report(), sections=()))         # the pictures take a second
    sources = re.findall(r'src="([^"]*)"', page)
    assert len(sources) == 1 and sources[0].startswith("data:image/png;base64,")
    assert base64.b64decode(sources[0].partition(",")[2]) == clean_logo(png())
    for text in ("Nordwerk &amp; Co", "Hafen 1", "Østfold &lt;Boring&gt;", "4711-B", "Stavanger"):
        assert text in page, text
    assert page.index("Nordwerk") < page.index("<h1>") < page.index("4711-B")


def test_a_report_without_a_letterhead_is_unchanged():
    pytest.importorskip("jinja2")
    pytest.importorskip("matplotlib")
    from tdhil.report.html import report_page

    own = recording()
    document = result_document(full(), own, RUN, "run.mcap")
    page = report_page(replace(report_of(document, own), sections=()))
    assert "<img" not in page and "<address" not in page and 'class="reference"' not in page
    assert reference_of({name: one for name, one in document.items() if name not in STATED}) == ()


@pytest.mark.heavy
@pytest.mark.parametrize("make", [full, bare, open_sided])
def test_every_sheet_names_customer_and_order_and_the_last_one_is_not_mostly_empty(make):
    pytest.importorskip("matplotlib")
    from tdhil.report.pdf import HIGH, sheets_of
    from tests.report.test_pdf import texts_of

    for one in (report(make), report(make, {}), replace(report(make), letterhead=NO_LETTERHEAD, simulated="")):
        figures = sheets_of(one)
        for number, figure in enumerate(figures):
            texts = texts_of(figure)
            words = " ".join(text for text, *_ in texts)
            assert "4711-B" in words or not one.reference
            assert ("Nordwerk" in words) == (number == 0 and bool(one.letterhead))
            assert len(figure.axes) - (number == 0 and bool(one.letterhead)) == sum(
                len(inside.axes) for inside in figure.subfigs)
            lowest = min(y0 for _, _, y0, _, _ in texts if y0 > 40.0)
            assert number == 0 or lowest < 0.75 * HIGH


@pytest.mark.heavy
def test_the_pdf_has_the_logo_as_its_only_picture_of_pixels():
    pytest.importorskip("matplotlib")
    from tdhil.report.pdf import pdf_bytes

    data = pdf_bytes(report())
    assert data.count(b"/Subtype /Image") == 1 and b"/Width 30" in data and data == pdf_bytes(report())


def test_the_command_line_refuses_an_svg_before_anything_is_identified(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    (tmp_path / "logo.svg").write_text("<svg/>")
    (tmp_path / "l.yaml").write_text("logo: logo.svg\n")
    (tmp_path / "run.mcap").write_bytes(b"no log")
    code = main(["replay", str(tmp_path / "run.mcap"), "--report", str(tmp_path / "r.html"),
                 "--letterhead", str(tmp_path / "l.yaml")])
    assert code == 2 and "this is an SVG" in capsys.readouterr().err
    assert not (tmp_path / "r.html").exists()
