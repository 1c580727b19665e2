"""Figures of the pages: they agree with the output of their code."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest

from tdhil.report import GRAPHS

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "figures"
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
PIXELS = 1.0                      # tolerance in the figure: the linear algebra of another processor rounds differently


@pytest.fixture(scope="module")
def figures():
    sys.path.insert(0, str(FOLDER))
    try:
        spec = importlib.util.spec_from_file_location("figures_of_the_pages", FOLDER / "draw.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FOLDER))
    return module


def script(name: str):
    """Return the module of a script in docs/figures."""
    sys.path.insert(0, str(FOLDER))
    try:
        spec = importlib.util.spec_from_file_location(f"{name}_of_the_pages", FOLDER / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FOLDER))
    return module


def same(drawn: str, kept: str) -> bool:
    """Return whether elements and words are the same, and coordinates agree within a pixel."""
    if NUMBER.sub("#", drawn) != NUMBER.sub("#", kept):
        return False
    pairs = zip(NUMBER.findall(drawn), NUMBER.findall(kept), strict=True)
    return all(abs(float(a) - float(b)) <= PIXELS for a, b in pairs)


def kept(figures, name: str) -> str:
    return (figures.IMAGES / f"{name}.svg").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["slope_bends", "model_choice", "what_stops"])
def test_figure_from_formulas(figures, name):
    assert same(figures.FORMULA[name]().svg(), kept(figures, name)), f"stale: python docs/figures/draw.py {name}"


@pytest.mark.heavy
@pytest.mark.one_worker("figures")
@pytest.mark.parametrize("name", ["five_stages", "uncertainty_budget"])
def test_figure_from_a_run(figures, name):
    assert same(figures.RUN[name]().svg(), kept(figures, name)), f"stale: python docs/figures/draw.py {name}"


OF_ANOTHER_RUN = "graph_lines_bad"
"""Graphs from a run of a shaft with two masses, whose fits take half a minute."""


@pytest.mark.one_worker("figures")
@pytest.mark.parametrize("whose", [
    pytest.param("the run", marks=pytest.mark.heavy), pytest.param("another run", marks=pytest.mark.long),
])
def test_graphs_of_the_report_have_the_words_of_the_pictures(figures, whose):
    """Another version of matplotlib draws curves differently. Words and ticks are the same."""
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (pip install '.[report]')")
    for name in figures.GRAPHS:
        if (name == OF_ANOTHER_RUN) is (whose == "the run"):
            continue
        words = re.findall(r"<text[^>]*>([^<]*)</text>", figures.graph(name))
        assert words, name
        assert words == re.findall(r"<text[^>]*>([^<]*)</text>", kept(figures, name)), f"stale: draw.py {name}"


RESPONSES = {
    "frf_good": ("valid", False), "frf_stribeck": ("valid", True), "frf_lag": ("model_rejected", False),
    "frf_zero": ("not_identifiable", True), "frf_backlash": ("model_rejected", True),
    "frf_resonance": ("valid_wide", False), "frf_quantised": ("valid_wide", False),
    "frf_saturation": ("model_rejected", True),
}
"""Verdict of each picture's machine, and whether distortion is detected."""


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.heavy if name == "frf_stribeck" else pytest.mark.long) for name in RESPONSES])
def test_pictures_of_the_frequency_response_have_the_words_of_the_pictures(name):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (pip install '.[report]')")
    module = script("frequency_response")
    assert module.CASES.keys() == RESPONSES.keys()
    document = module.document(name)
    assert (document["verdict"], document["frequency_response"]["distortion"]["detected"]) == RESPONSES[name]
    words = re.compile(r"<text[^>]*>([^<]*)</text>")
    kept_picture = (module.IMAGES / f"{name}.svg").read_text(encoding="utf-8")
    assert words.findall(module.picture(document)) == words.findall(kept_picture), f"stale: draw {name}"


@pytest.fixture(scope="module")
def graphs():
    """Return the script of the good and bad graphs."""
    return script("graphs")


CHEAP = {"pairs_bad", "trend_bad", "impedance_bad"}
PICTURED = [
    "run_good", "run_limit", "run_zero", "run_quantised", "run_warming", "estimates_bad", "lines_lag",
    "budget_noise", "friction_bend", "friction_warming", "impedance_good", "impedance_bad", "open_loop_good",
    "open_loop_bad", "step_good", "step_bad", "verified_step_good", "verified_step_bad", "reflection", "modes",
    "stick_slip", "map", "schedule_good", "schedule_bad", "string_close_good", "string_close_bad", "bit_speed_good",
    "bit_speed_bad", "severity_good", "severity_bad", "bodies_good", "bodies_bad", "pairs_good", "pairs_bad",
    "sensor_good", "sensor_bad", "linearity_good", "linearity_bad", "trend_good", "trend_bad", "compare_good",
    "compare_filter", "compare_inertia",
]
PAGE = ROOT / "docs" / "reference" / "graphs.md"
MOST_BYTES = 90_000


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.heavy if name in CHEAP else pytest.mark.long) for name in PICTURED])
def test_a_good_or_bad_graph_has_the_words_of_its_picture(graphs, name):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (pip install '.[report]')")
    words = re.compile(r"<text[^>]*>([^<]*)</text>")
    drawn, shown = words.findall(graphs.picture(name)), words.findall(kept(graphs, f"graph_{name}"))
    assert drawn == shown, f"stale: graphs.py {name}"


TEXTS = ["live", "angle_good", "angle_bad", "backlash"]


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.heavy if name == "backlash" else pytest.mark.long) for name in TEXTS])
def test_a_text_of_a_simulated_fault_is_that_of_the_page(graphs, name):
    page = PAGE.read_text(encoding="utf-8")
    drawn, shown = (NUMBER.sub("#", one) for one in (graphs.with_text(page, name, graphs.TEXTS[name]()), page))
    assert drawn == shown, f"stale: graphs.py {name}"


def test_torque_over_angle_and_backlash_have_an_example_of_a_simulated_fault(graphs):
    """No graph shows them: the page has the rows of the card."""
    page = PAGE.read_text(encoding="utf-8")
    assert list(graphs.TEXTS) == TEXTS
    for name in TEXTS:
        assert f"<!-- {name} -->\n```text\n" in page, name


def test_each_good_and_bad_graph_is_small_and_on_the_page(graphs):
    page = PAGE.read_text(encoding="utf-8")
    assert list(graphs.PICTURES) == PICTURED
    assert {one.graph for one in graphs.PICTURES.values()} <= set(GRAPHS)
    for name in PICTURED:
        assert f"](../images/graph_{name}.svg)" in page, name
        assert (graphs.IMAGES / f"graph_{name}.svg").stat().st_size <= MOST_BYTES, name


def test_each_graph_has_a_section_with_an_example_and_what_to_do():
    sections = dict(part.split("\n", 1) for part in PAGE.read_text(encoding="utf-8").split("\n## ")[1:])
    for name, graph in GRAPHS.items():
        assert "](../images/" in sections[graph.section] or "```text" in sections[graph.section], name
        assert ("| good | " in sections[graph.section] and "| bad" in sections[graph.section]) or name == "budget", name


def test_each_row_of_the_table_of_graphs_is_shown_somewhere():
    """`Picture` refuses an unknown name when its caption is read. A name that no code uses would be an unused row."""
    patterns = ("report/*.py", "cli/trend.py", "service/templates/*.html")
    places = [path.read_text(encoding="utf-8") for pattern in patterns for path in (ROOT / "tdhil").glob(pattern)
              if path.name != "graphs.py"]
    for name in GRAPHS:
        assert any(f'"{name}"' in text or f"graphs.{name}." in text for text in places), name
    for text in places:
        assert set(re.findall(r'\bPicture\(\s*"(\w+)"', text)) <= set(GRAPHS)


@pytest.mark.heavy
@pytest.mark.one_worker("figures")
def test_the_card_on_the_pages_is_that_of_the_run(figures):
    for page in figures.WITH_CARD:
        text = page.read_text(encoding="utf-8")
        assert "<!-- card -->" in text
        drawn, shown = (NUMBER.sub("#", one) for one in (figures.with_card(text), text))
        assert drawn == shown, f"stale card on {page.name}: python docs/figures/draw.py card"


@pytest.mark.heavy
@pytest.mark.one_worker("figures")
def test_the_page_on_the_json_document_names_every_key(figures):
    page = (ROOT / "docs" / "reference" / "json.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(\w+)`", "\n".join(line.split(" | ")[0] for line in page.splitlines() if "| `" in line)))
    assert set(figures.run()[1]) - named == set()


def test_every_figure_is_tried_here(figures):
    assert set(figures.FORMULA) == {"slope_bends", "model_choice", "what_stops"}
    assert set(figures.RUN) == {"five_stages", "uncertainty_budget"}


def test_a_moved_line_is_found():
    assert same("<a x='1.0'/>", "<a x='1.4'/>")
    assert not same("<a x='1.0'/>", "<a x='3.0'/>")
    assert not same("<a x='1.0'>J</a>", "<a x='1.0'>K</a>")
