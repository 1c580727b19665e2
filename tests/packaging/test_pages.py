"""Pages made of README, docs/ and docstrings; .ci/run builds them in one step."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def hooks():
    pytest.importorskip("mkdocs", reason="mkdocs is not installed (pip install '.[docs]'); .ci/run has it")
    import mkdocs_hooks

    return mkdocs_hooks


def test_the_front_door_is_documented_name_by_name():
    from tdhil import api

    page = (ROOT / "docs" / "reference" / "python" / "index.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^::: tdhil\.api\.(\w+)$", page, re.MULTILINE)) == set(api.__all__)


def test_contributing_names_existing_files_and_tests():
    """The check covers every path and every test, except for those with VENDOR, MODEL, NAME or BUS."""
    rooms = "tdhil|drivers|sim_bus|profiles|tests|benchmarks|docs|examples"
    names = [name for name in re.findall(rf"`((?:{rooms})/[^`\s]*)`", CONTRIBUTING) if not re.search("[A-Z]{3}", name)]
    assert len(names) > 80
    for name in names:
        path, _, test = name.partition("::")
        assert (ROOT / path).exists(), name
        assert not test or f"def {test.partition('[')[0]}(" in (ROOT / path).read_text(encoding="utf-8"), name


@pytest.mark.parametrize("option", ["excitation", "model", "mode", "drive"])
def test_the_page_on_rig_yaml_names_every_choice(option):
    from tdhil.cli.main import build_parser

    parser = build_parser("identify")
    (commands,) = [action for action in parser._actions if action.dest == "command"]
    (choices,) = [action.choices for action in commands.choices["identify"]._actions if action.dest == option]
    text = (ROOT / "docs" / "reference" / "rig.md").read_text(encoding="utf-8")
    (row,) = re.findall(rf"^\| `(?:run\.)?{option}` .*$", text, re.MULTILINE)
    assert [name for name in choices if f"`{name}`" not in row] == []


def test_a_link_to_a_file_of_the_repository_leads_to_its_page(hooks):
    assert hooks.relinked("[a](docs/reference/rig.md#bus)", "", "index.md") == (
        "[a](reference/rig.md#bus)")
    assert hooks.relinked("[a](../README.md)", "docs", "rig.md") == "[a](index.md)"
    assert hooks.relinked("[a](../../examples/rig.yaml)", "docs/reference", "reference/rig.md") == (
        "[a](../repository/examples/rig.yaml.md)")
    fenced = "```\n[a](docs/reference/rig.md)\n```\n"
    for same in ("[a](https://example.org/x)", "[a](no-such-file.md)", "[a](#here)", fenced):
        assert hooks.relinked(same, "", "index.md") == same


def test_a_link_to_a_folder_ends_the_build(hooks):
    from mkdocs.exceptions import PluginError

    with pytest.raises(PluginError, match="folder tests"):
        hooks.relinked("[a](tests)", "", "index.md")


@pytest.mark.parametrize("text", [
    '<script src="https://cdn.example/x.js"></script>', "<img alt=x src='//cdn.example/x.png'>",
    '<link rel="stylesheet" href="https://fonts.example/css">', '@import "https://fonts.example/css";',
    "a { background: url(https://cdn.example/x.png) }",
])
def test_external_resources_are_found(hooks, text):
    assert hooks.loaded_from_elsewhere(text)


def test_links_to_follow_are_not_loaded(hooks):
    assert hooks.loaded_from_elsewhere('<a href="https://example.org">x</a><script src="assets/x.js"></script>') == []


def test_blocks_and_comments_of_docstrings(hooks):
    assert hooks.plain_blocks("A.\n\n::\n\n    x = 1\n") == "A.\n\n\n    x = 1\n"
    assert hooks.plain_blocks("One cycle::\n\n    x\n") == "One cycle:\n\n    x\n"
