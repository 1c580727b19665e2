"""Archives in `evidence/`: each passes its check with its digest, is replayed, and supports the entries naming it."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import pytest

from profiles.library import load_profile, profile_names
from tdhil.evidence import NEEDED, check_evidence, covered_entries, members_in, statement_in
from tdhil.evidence.drives import entries_of

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "evidence"
RECEIVED = sorted(FOLDER.glob("*.zip"))
LARGEST_EXAMPLE = 1_000_000
NAMED = re.compile(r"evidence/([\w.-]+\.zip)")


def digests() -> dict[str, str]:
    rows = (line.split() for line in (FOLDER / "SHA256SUMS").read_text().splitlines())
    return {name: digest for digest, name in rows}


def document(path: Path, name: str):
    return json.loads(members_in(path.read_bytes())[name])


def claims(profile) -> dict[str, str]:
    """Return the entries of a profile that name an archive as their source, with the name of the archive."""
    return {name: named[1] for name, part in profile.items()
            if isinstance(part, dict) and (named := NAMED.search(str(part.get("source", ""))))}


def test_each_archive_has_its_digest_and_the_other_way_round():
    assert RECEIVED
    assert {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in RECEIVED} == digests()


@pytest.mark.parametrize("path", RECEIVED, ids=lambda path: path.name)
def test_an_archive_is_whole_permitted_and_without_private_texts(path):
    assert check_evidence(path.read_bytes(), digests()[path.name], conclude=None).problems == ()
    assert set(statement_in(document(path, "statement.json")).publish) >= NEEDED


@pytest.mark.heavy
@pytest.mark.parametrize("path", RECEIVED, ids=lambda path: path.name)
def test_an_archive_is_identified_again_from_its_log(path):
    assert check_evidence(path.read_bytes(), digests()[path.name]).problems == ()


def test_the_example_is_small_and_marked_and_supports_no_entry():
    (example,) = [path for path in RECEIVED if document(path, "manifest.json")["simulated"]]
    assert example.name == "simulated-example.zip" and example.stat().st_size < LARGEST_EXAMPLE
    assert members_in(example.read_bytes())["README.txt"].startswith(b"SIMULATED")
    assert document(example, "manifest.json")["shown"] == {}
    page = (ROOT / "docs" / "reference" / "drives.md").read_text("utf-8")
    assert example.name in page.partition("## SIMULATED")[2] and example.name not in page.partition("## SIMULATED")[0]


@pytest.mark.parametrize("name", profile_names())
def test_an_entry_that_names_an_archive_is_shown_by_it(name):
    """An entry that an archive supports must have the confidence verified."""
    today = load_profile(name).model_dump(mode="json", by_alias=True)
    for entry, archive in claims(today).items():
        assert entry in covered(FOLDER / archive, today), f"{name}: {entry} is not shown by {archive}"
    for path in RECEIVED:
        if document(path, "profile.json")["name"] == name:
            behind = [one for one in covered(path, today) if today[one]["confidence"] != "verified"]
            assert behind == [], f"{path.name} shows them: confidence: verified, source: evidence/{path.name}"


def covered(path: Path, today) -> dict[str, str]:
    return covered_entries(document(path, "profile.json"), document(path, "manifest.json")["shown"], today)


def test_an_entry_is_covered_while_it_keeps_its_values():
    profile = {"speed": {"rpm_per_lsb": 0.1, "source": "manual", "confidence": "likely"}, "name": "a/b"}
    verified = {"speed": {"rpm_per_lsb": 0.1, "source": "evidence/a.zip", "confidence": "verified"}}
    assert dict(entries_of(profile)) == {"speed": {"rpm_per_lsb": 0.1}}
    assert covered_entries(profile, {"speed": "seen", "torque": "x"}, verified) == {"speed": "seen"}
    assert claims(verified) == {"speed": "a.zip"} and claims(profile) == {}
    verified["speed"]["rpm_per_lsb"] = 1.0
    assert covered_entries(profile, {"speed": "seen"}, verified) == {}
    assert covered_entries(profile, {"speed": "seen"}, None) == {}
