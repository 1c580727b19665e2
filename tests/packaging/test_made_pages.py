"""Reference pages that are made from code: they agree with the present code."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from tdhil.cli.main import build_parser
from tdhil.errors import ExitCode

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "docs" / "reference"


@pytest.fixture(scope="module")
def made():
    spec = importlib.util.spec_from_file_location("made_pages", ROOT / "docs" / "made_pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["candidates.md", "command-line.md", "drives.md", "exit-codes.md", "figures.md",
                                  "http-api.md"])
def test_the_page_is_what_the_code_makes_of_it(made, name):
    if name == "http-api.md":
        pytest.importorskip("jinja2", reason="jinja2 is not installed (pip install '.[service]')")
    assert made.PAGES[name]() == (REFERENCE / name).read_text(encoding="utf-8"), "stale: python docs/made_pages.py"


def test_every_exit_code_is_explained(made):
    page = (REFERENCE / "exit-codes.md").read_text(encoding="utf-8")
    explained = re.findall(r"^\| (\d+) \|", page, re.MULTILINE)
    assert {int(code) for code in explained} == {int(code) for code in ExitCode}


def test_every_command_has_a_part(made):
    page = (REFERENCE / "command-line.md").read_text(encoding="utf-8")
    commands = made._commands(build_parser(None))
    assert len(commands) > 15
    assert [name for name in commands if f"\n## tdhil {name}\n" not in page] == []
