"""Plain texts of the tree: openings of docstrings, words, sentences of at most 30 words, links that resolve.

`tests/packaging/language.py` has the rules, and lists its findings when it is run. The tree does not follow them
everywhere yet, so each room has a ceiling for the rest. A ceiling is lowered when a room is reworded, never raised.
"""

from __future__ import annotations

import ast
import re
import unicodedata
from functools import cache
from pathlib import Path

import pytest

from tests.packaging.language import EXCEPTIONS, OPENINGS, WORDS, Finding, counted, findings, of_page, paragraphs

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
MOST_EXCEPTIONS = 5

CEILINGS: dict[tuple[str, str], int] = {}
"""Findings left in each room, by kind. Each was counted before the room was reworded."""


@pytest.fixture(scope="module")
def counts():
    return counted()


@pytest.mark.heavy(each_share=True)
def test_no_room_gets_less_plain(counts):
    """A new text follows the rules; `python -m tests.packaging.language ROOM` lists what a room has."""
    above = {key: (number, CEILINGS.get(key, 0)) for key, number in counts.items() if number > CEILINGS.get(key, 0)}
    assert above == {}


@pytest.mark.heavy(each_share=True)
@pytest.mark.parametrize("room", ["tdhil", "drivers", "sim_bus", "profiles"])
def test_a_percentage_has_a_space_before_its_sign(room):
    """The SI brochure (5.4.7) requires it. The format ``{share:.1%}`` prints no space; ``{100 * share:.1f} %`` does."""
    for path in sorted((ROOT / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FormattedValue) and isinstance(node.format_spec, ast.JoinedStr):
                spec = "".join(str(part.value) for part in node.format_spec.values if isinstance(part, ast.Constant))
                assert not spec.endswith("%"), f"{path.relative_to(ROOT)}:{node.lineno}"


def test_the_ceilings_are_of_rooms_that_exist():
    assert {room for room, _ in CEILINGS if room != "pages" and not (ROOT / room).is_dir()} == set()
    assert {kind for _, kind in CEILINGS} <= {"opening", "word", "long"}


def test_the_exceptions_are_few_and_exist():
    assert len(EXCEPTIONS) <= MOST_EXCEPTIONS
    assert [name for name, reason in EXCEPTIONS.items() if not (ROOT / name).is_file() or not reason] == []


def test_the_rules_find_their_cases(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.packaging.language.ROOT", tmp_path)
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("The drive says what he wants.\n\n" + "word " * 31 + ".\n\n```\nhis her\n```\n`his` one.\n")
    found = list(of_page(page))
    assert [(one.kind, one.line) for one in found] == [("word", 1), ("long", 3)]
    assert list(paragraphs("a\nb\n* c\n\n| d |\n")) == [(1, "a b"), (3, "* c"), (5, "| d |")]
    assert "Whoever" in OPENINGS and any("somebody" in pattern for pattern in WORDS)
    assert Finding("tdhil/cli/main.py", 1, "word", "his").room == "tdhil/cli"
    assert Finding("README.md", 1, "word", "his").room == "pages"
    assert callable(findings)


@cache
def anchors(page: Path) -> frozenset[str]:
    """Return the anchors of the headings of a page, in the form of Python-Markdown."""
    seen: dict[str, int] = {}
    found = set(re.findall(r'(?:id|name)="([^"]+)"', page.read_text(encoding="utf-8")))
    for _, row in paragraphs(page.read_text(encoding="utf-8")):
        if (heading := re.match(r"#+\s+(.*)$", row)) is None:
            continue
        text = re.sub(r"\]\([^)]*\)|[`*\[\]]", "", heading[1])
        text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
        slug = re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower())
        number = seen.get(slug, 0)
        seen[slug] = number + 1
        found.add(f"{slug}_{number}" if number else slug)
    return frozenset(found)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_each_link_of_a_page_resolves(page):
    lost = []
    for line, paragraph in paragraphs(page.read_text(encoding="utf-8")):
        for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)", re.sub(r"`[^`]*`", "", paragraph)):
            if re.match(r"[a-z]+:", target):
                continue
            file = page if not target else page.parent / target
            if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file.resolve())):
                lost.append(f"{line}: {target}#{anchor}")
    assert lost == []
