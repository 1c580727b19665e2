"""A file of another kind is named before it is read as a log, a table or rig.yaml."""

import pytest

from profiles import DataFileError
from tdhil.cli.main import main
from tdhil.config import load_rig
from tdhil.errors import UsageError, exit_code
from tdhil.session import read

RESULT = b'{"verdict": "valid", "tdhil": "1.0"}'
MCAP = b"\x89MCAP0\r\n" + bytes(300_000)
KINDS = [
    ("result.json", RESULT, "is a result of tdhil, not a log. Give the log: run.mcap"),
    ("other.json", b'{"a": 1}', "is a JSON file, not a log"),
    ("rig.yaml", b"# not verified, in this profile; a, b\nname: bench\n", "is a YAML file, not a log"),
    ("first.html", b"\xef\xbb\xbf <!DOCTYPE html>\na { b: c, d }", "is an HTML page, not a log"),
    ("first.pdf", b"%PDF-1.7 a,b,c", "is a PDF file, not a log"),
]


@pytest.mark.parametrize(("name", "content", "said"), KINDS)
def test_a_replay_names_the_kind_of_the_file(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UsageError) as caught:
        read(tmp_path / name)
    assert said in str(caught.value) and exit_code(caught.value) == 2


@pytest.mark.parametrize(("name", "content", "said"), [
    ("first.mcap", MCAP, "first.mcap: is a log. --rig needs rig.yaml"),
    ("result.json", RESULT, "is a result of tdhil. --rig needs rig.yaml"),
    ("first.html", b"<html>", "is an HTML page. --rig needs rig.yaml"),
])
def test_a_rig_names_the_kind_of_the_file(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataFileError) as caught:
        load_rig(tmp_path / name)
    assert said in str(caught.value)


def test_a_rig_in_the_form_of_json_is_read(tmp_path):
    (tmp_path / "rig.yaml").write_text('{"name": "bench 3"}')
    assert load_rig(tmp_path / "rig.yaml").name == "bench 3"


def test_compare_checks_all_files_before_it_identifies_one(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("tdhil.fleet.trend.identified", None)
    (tmp_path / "first.mcap").write_bytes(MCAP)
    for name, content, said in (("result.json", RESULT, "is a result of tdhil, not a log"),
                                ("notes.txt", b"a", "is not a log of tdhil (MCAP)")):
        (tmp_path / name).write_bytes(content)
        assert main(["compare", str(tmp_path / "first.mcap"), str(tmp_path / name)]) == 2
        shown = capsys.readouterr().err
        assert said in shown and "Give the log: tdhil compare before.mcap after.mcap" in shown
