"""Existing files are never overwritten, and every refusal has the same text: `tdhil.errors.existing_file`."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.new_file import whole_or_none
from tdhil.service.client import Client

ROOT = Path(__file__).parents[2]
TEXT = "already exists and was not overwritten. Name another file, or move the existing one"
VARIANTS = re.compile(r"there already|already exists and|left (?:as it is|unchanged|alone)|not overwritten")
OTHERWISE = {"errors.py", "session/log_files.py"}
"""The function itself, and the refusal of a file that is no log, since an older log gets another name."""


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


def test_no_other_text_refuses_an_existing_file():
    found = [f"{path.relative_to(ROOT / 'tdhil')}: {text}" for path in sorted((ROOT / "tdhil").rglob("*.py"))
             for text in re.findall(r'UsageError\(\s*f?"([^"]*)"', path.read_text(encoding="utf-8"))
             if VARIANTS.search(text) and str(path.relative_to(ROOT / "tdhil")) not in OTHERWISE]
    assert found == []


@pytest.mark.parametrize("ended_by", [OSError("No space left on device"), KeyboardInterrupt()])
def test_a_file_whose_writing_ends_early_is_removed(tmp_path, ended_by):
    """The rows before a full disk, or before Ctrl-C, passed for the whole file."""
    target = tmp_path / "run.csv"
    with pytest.raises(type(ended_by)), whole_or_none(target), target.open("x") as file:
        file.write("time_s\n")
        raise ended_by
    assert not target.exists()
    target.write_text("kept")
    with pytest.raises(FileExistsError), whole_or_none(target):
        target.open("x")
    assert target.read_text() == "kept"
