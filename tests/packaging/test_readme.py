"""README: its commands parse, its files load, and its links resolve."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest

from tdhil.cli.main import build_parser
from tdhil.config.rig import require_limits
from tests.rigs import loaded_rig

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = sorted([ROOT / "README.md", *ROOT.glob("CONTRIBUTING.md"), *(ROOT / "docs").rglob("*.md")])


GUIDES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("tutorials/*.md")),
          *sorted((ROOT / "docs").glob("how-to/*.md"))]
NOT_COMPLETE = ("…", "$EDITOR")                 # a command that states this


def blocks(language: str, text: str = README) -> list[str]:
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```$", text, re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", block, flags=re.MULTILINE) for indent, block in found]


def tdhil_commands(page: Path = ROOT / "README.md") -> list[str]:
    text = page.read_text(encoding="utf-8")
    lines = "\n".join(blocks("sh", text)).replace("\\\n", " ").replace("&&\n", "&& ").splitlines()
    parts = [part.strip() for line in lines for part in line.split("&&")]
    return [part for part in parts if re.match(r"(\S*/)?tdhil ", part) and not any(one in part for one in NOT_COMPLETE)]


def test_there_are_commands_to_check():
    every = [command for page in GUIDES for command in tdhil_commands(page)]
    for name in ("identify", "replay", "simulate", "scan", "doctor", "serve", "fleet", "tune"):
        assert any(f"tdhil {name}" in command for command in every)


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_parse(page):
    for command in tdhil_commands(page):
        words = shlex.split(command, comments=True)[1:]
        for end in (">", "&"):
            if end in words:
                words = words[: words.index(end)]
        namespace = build_parser(words[0]).parse_args(words)
        assert callable(namespace.run), command


def test_a_benchmark_on_a_page_has_the_options_that_the_page_names():
    named = [(script, option) for page in PAGES
             for script, words in re.findall(r"`python (benchmarks/\w+\.py)( [^`]+)`", page.read_text(encoding="utf-8"))
             for option in re.findall(r"--[a-z-]+", words)]
    assert ("benchmarks/waiting_time.py", "--click") in named
    assert [(script, option) for script, option in named
            if f'"{option}"' not in (ROOT / script).read_text(encoding="utf-8")] == []


def test_the_readme_is_one_page():
    assert len(README.splitlines()) <= 160


def test_the_options_it_names_are_in_the_help():
    text = build_parser("identify").format_help() + _help_of("identify")
    for option in set(re.findall(r"`(--[a-z-]+)[ `|]", README)) - {"--hub"}:
        assert option in text, option


def _help_of(command: str) -> str:
    parser = build_parser(command)
    (commands,) = [action for action in parser._actions if action.dest == "command"]
    return commands.choices[command].format_full_help()  # type: ignore[index,union-attr]


def test_rig_yaml_loads(tmp_path):
    page = ROOT / "docs" / "how-to" / "connect-a-canopen-drive.md"
    (text,) = blocks("yaml", page.read_text(encoding="utf-8"))
    assert require_limits(loaded_rig(tmp_path, text)).torque_nm == 400


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_an_extra_is_installed_from_the_clone_or_from_a_folder(page):
    """The pages install the clone, not a package with this name from another source."""
    lines = page.read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if re.search(r"pip install .*\btdhil\b", line) and "--find-links" not in line] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_resolve(page):
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


def test_code_fits_80_columns():
    assert [line for language in ("sh", "yaml", "text") for block in blocks(language)
            for line in block.splitlines() if len(line) > 80] == []


@pytest.mark.parametrize("name", ["try", "test"])
def test_marked_command_is_one_command(name):
    (text,) = re.findall(rf"^<!-- command: {name} -->\n```sh\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)
    assert subprocess.run(["bash", "-n", "-c", text]).returncode == 0
    assert not re.search(r"(?<!&&)(?<!\\)\n(?!\Z)", text), "the lines must be joined, so that a failure ends it"


def test_ci_runs_the_same_command():
    if not (path := ROOT / ".ci" / "run").exists():
        pytest.skip("a source distribution has no .ci/run")
    script = path.read_text(encoding="utf-8")
    assert "command_of test" in script
    assert "pip install -q --no-compile -e '.[test]'" not in script
