"""`tdhil evidence`: required inputs, written files, and the end of its check."""

from __future__ import annotations

from functools import partial

import pytest

from tdhil.evidence import check_evidence, make_evidence
from tests.evidence.small_runs import found, write_run
from tests.path.path_runs import tdhil

STATED = ("--publisher", "The Institute", "--publish", "log,result,identity")


@pytest.fixture
def log(tmp_path, monkeypatch):
    monkeypatch.setattr("tdhil.evidence.making.make_evidence", partial(make_evidence, conclude=found))
    monkeypatch.setattr("tdhil.evidence.making.check_evidence", partial(check_evidence, conclude=found))
    return write_run(tmp_path / "run.mcap")


def test_an_archive_is_made_with_its_digest_and_passes_its_check(log, tmp_path):
    done = tdhil("evidence", log, *STATED)
    assert done.code == 0, done.err
    archive = tmp_path / "run.evidence.zip"
    digest, name = (tmp_path / "run.evidence.zip.sha256").read_text().split()
    assert name == archive.name and done.out.split()[0] == digest
    passed = tdhil("evidence", "--check", archive, "--sha256", f" {digest.upper()}")
    assert passed.code == 0 and "passes" in passed.out
    again = tdhil("evidence", log, *STATED)
    assert again.code == 2 and "not overwritten" in again.err


def test_an_archive_that_was_changed_ends_with_12_and_a_code(log, tmp_path):
    assert tdhil("evidence", log, *STATED).code == 0
    archive = tmp_path / "run.evidence.zip"
    archive.write_bytes(archive.read_bytes().replace(b"EPOS4", b"EPOS5"))
    done = tdhil("evidence", "--check", archive, "--sha256", "0" * 64)
    assert done.code == 12 and "DOES NOT PASS" in done.out
    assert "the archive was changed" in done.err and "TDH-1202" in done.err


def test_permission_is_never_assumed(log, tmp_path):
    done = tdhil("evidence", log)
    assert done.code == 2 and "--publisher: is missing" in done.err and "--publish too" in done.err
    assert "TDH-239" in done.err and not (tmp_path / "run.evidence.zip").exists()


@pytest.mark.parametrize(("words", "said"), [
    ((), "no log is named"), (("--check", "none.zip"), "can't be read"), (("none.mcap", *STATED), "does not exist"),
    (("--check", "y.zip", "--publisher", "A", "--serial-key", "k"), "--publisher --serial-key: has no effect"),
    (("x.mcap", "--check", "y.zip"), "makes no archive"), (("x.mcap", "--sha256", "00"), "--sha256"),
    (("--check", "y.zip", "--sha256", "3f0c…"), "'3f0c…' is not a SHA-256, which has 64 hexadecimal digits"),
    (("--check", "y.zip", "--sha256", ""), "Nothing was checked"),
])
def test_usage_errors_are_reported(words, said):
    done = tdhil("evidence", *words)
    assert done.code == 2 and said in done.err


def test_a_key_that_is_too_short_is_refused(log, tmp_path):
    (tmp_path / "key").write_bytes(b"short")
    done = tdhil("evidence", log, *STATED, "--serial-key", tmp_path / "key")
    assert done.code == 2 and "at least 32" in done.err
