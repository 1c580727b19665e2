"""No file is overwritten, and every refusal has the same text: `tdhil.errors.existing_file`."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.service.client import Client

ROOT = Path(__file__).parents[2]
TEXT = "already exists and was not overwritten. Name another file, or move the existing one"
VARIANTS = re.compile(r"there already|already exists and|left (?:as it is|unchanged|alone)|not overwritten")
OTHERWISE = {"errors.py", "session/log_files.py"}
"""The function itself, and the refusal of a file that is no log: an older log is kept under another name."""


@pytest.mark.parametrize("command", [
    "scan --simulate --write there.yaml", "export run.mcap --to csv -o there.csv", "frf run.mcap --out there.csv",
    "support run.mcap -o there.zip", "evidence run.mcap --publisher A --publish all -o there.zip",
    "rig new there.yaml --load none --name A", "replay run.mcap --report there.html", "fleet . --out there.csv",
])
def test_each_command_refuses_in_the_same_words(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.mcap").write_bytes(b"\x89MCAP0\r\n")
    there = tmp_path / next(one for one in command.split() if one.startswith("there"))
    there.write_text("mine")
    assert main(command.split()) == 2
    said = " ".join(capsys.readouterr().err.split())
    text = TEXT.replace("already exists", "is a file that no fleet wrote") if command.startswith("fleet") else TEXT
    assert f"{there.name}: {text}" in said and "TDH-205" in said
    assert there.read_text() == "mine"


def test_the_client_refuses_before_it_asks_for_the_file(tmp_path):
    (tmp_path / "log.mcap").write_text("mine")
    with pytest.raises(UsageError, match=TEXT):
        Client("http://127.0.0.1:9").download("20260101-000000-000000", "log.mcap", tmp_path / "log.mcap")
    assert (tmp_path / "log.mcap").read_text() == "mine"


def test_no_other_text_says_so():
    found = [f"{path.relative_to(ROOT / 'tdhil')}: {text}" for path in sorted((ROOT / "tdhil").rglob("*.py"))
             for text in re.findall(r'UsageError\(\s*f?"([^"]*)"', path.read_text(encoding="utf-8"))
             if VARIANTS.search(text) and str(path.relative_to(ROOT / "tdhil")) not in OTHERWISE]
    assert found == []
