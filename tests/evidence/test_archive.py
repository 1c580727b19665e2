"""Contract of an archive: same bytes for the same content, detection of each change, and refused inputs."""

from __future__ import annotations

import hashlib
import json
import struct
import zipfile
from dataclasses import replace
from io import BytesIO

import pytest

from tdhil.config import OF_EVIDENCE, EvidenceOptions, form_options
from tdhil.errors import UsageError
from tdhil.evidence import (
    agreement_of,
    check_evidence,
    make_evidence,
    shown_entries,
    statement_in,
    statement_of,
    wrong_in,
)
from tdhil.evidence.archive import MEMBERS, LogFacts, archive_of, members_in, members_of, problems_of_members
from tdhil.evidence.statement import PublisherStatement, ReferenceInertia, parts_in, serial_hmac
from tdhil.file_kind import MAGIC
from tdhil.recording.log_format import Event
from tests.evidence.small_runs import RESULT, configuration, found, write_run

REFERENCE = ReferenceInertia(105.0, 1.0, "weighed", "disc of 480 kg, radius 0.66 m")
STATEMENT = PublisherStatement("The Institute", ("log", "result", "identity"), REFERENCE, "0x0170", False)
FACTS = LogFacts(configuration(), ("watchdog: required 500 ms, found 500 ms (ok) 1016h",), False, torque_mode=True)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return make_evidence(write_run(tmp_path_factory.mktemp("log") / "run.mcap"), STATEMENT, (), conclude=found)


def problems(archive, sha256="", conclude=found):
    return check_evidence(archive, sha256, conclude=conclude).problems


def changed(made, name, data):
    return archive_of({**made.members, name: data})


# -- the bytes


def test_the_same_content_has_the_same_bytes(made, tmp_path):
    again = make_evidence(write_run(tmp_path / "other.mcap"), STATEMENT, (), conclude=found)
    assert again.archive == made.archive
    assert made.sha256 == hashlib.sha256(made.archive).hexdigest()
    assert tuple(made.members) == MEMBERS == tuple(zipfile.ZipFile(BytesIO(made.archive)).namelist())


def test_an_archive_passes_its_check(made):
    whole = check_evidence(made.archive, made.sha256, conclude=found)
    assert (whole.problems, whole.notes) == ((), ())
    assert "no digest" in check_evidence(made.archive, conclude=found).notes[0]


def test_the_members_follow_from_log_and_statement():
    members = members_of(FACTS, b"log", STATEMENT, RESULT, "1.2.3")
    assert problems_of_members(members) == ()
    assert members_in(archive_of(members)) == members
    assert json.loads(members["parameters.json"]) == [
        {"name": "watchdog", "required": "500 ms", "found": "500 ms", "outcome": "ok", "where": "1016h"}]
    assert json.loads(members["identity.json"])["firmware"] == "0x0170"
    assert "firmware         0x0170\n" in members["README.txt"].decode()
    text = members["README.txt"].decode()
    for part in ("This run is of a real drive", "The Institute", "log, result, identity", "may not be       rig",
                 "agrees: J is -1.0 % from the reference", "disc of 480 kg", "--check"):
        assert part in text, part
    assert "SIMULATED" in members_of(replace(FACTS, simulated=True), b"", STATEMENT, RESULT, "1")["README.txt"].decode()


# -- tampering


@pytest.mark.parametrize("name", MEMBERS)
def test_a_change_of_any_member_is_found(made, name):
    data = made.members[name]
    assert any(name in one for one in problems(changed(made, name, data.replace(b"a", b"b", 1)[:-1] + b" ")))
    assert any(name in one for one in problems(archive_of(
        {other: part for other, part in made.members.items() if other != name})))
    assert "SHA-256" in problems(changed(made, name, data + b" "), made.sha256)[0]


@pytest.mark.parametrize(("name", "before", "after"), [
    ("identity.json", b"EPOS4", b"EPOS5"), ("parameters.json", b"500 ms", b"900 ms"),
    ("profile.json", b"likely", b"verified"), ("result.json", b"104.0", b"105.0"),
    ("README.txt", b"real drive", b"true drive"), ("statement.json", b"weighed", b"drawing"),
])
def test_a_member_that_is_changed_with_its_digest_is_found(made, name, before, after):
    data = made.members[name].replace(before, after)
    assert data != made.members[name]
    manifest = json.loads(made.members["manifest.json"])
    manifest["members"][name] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    members = {**made.members, name: data, "manifest.json": (json.dumps(manifest, ensure_ascii=False, indent=1)
                                                             + "\n").encode()}
    assert problems_of_members(members) == ()
    assert problems(archive_of(members)) != ()


def test_another_log_with_all_digests_right_is_found_by_the_replay(made):
    other = {**RESULT, "inertia_kg_m2": {**RESULT["inertia_kg_m2"], "value": 110.0}}
    assert problems(made.archive, conclude=lambda log: other) == (
        "the result does not follow from run.mcap: inertia_kg_m2.value is 110.0, not 104.0",)
    assert "verdict" in problems(made.archive, conclude=lambda log: RESULT | {"verdict": "valid_wide"})[0]


WHOLE = RESULT | {
    "coulomb_nm": {"value": 61.2, "low": 57.9, "high": 64.5}, "speed_lag_s": {"value": 0.39, "low": 0.37, "high": 0.42},
    "skew_s": {"value": 1e-9, "low": -0.002, "high": 0.002}, "torque_scale_rel_sd": 0.02, "samples_used": 3000,
    "inertia_main_shaft_kg_m2": {"value": 416.0, "low": 412.0, "high": 420.0}, "residual": {"p_value": 0.36},
    "acceptance": {"verdict": "fail", "checks": [{"name": "inertia", "passed": False}]}, "warnings": ["one", "two"],
    "backlash": [], "second_opinions": [{"inertia_kg_m2": {"value": 102.0}, "note": "4 changes of speed"}],
}


def changed_at(document, place, value):
    """Return the document with another value at this place, or without it for the value None."""
    name, _, rest = place.partition(".")
    if isinstance(document, list):
        return [changed_at(one, rest, value) if number == int(name) else one for number, one in enumerate(document)]
    if not rest:
        return {key: one for key, one in document.items() if key != name} | ({} if value is None else {name: value})
    return document | {name: changed_at(document[name], rest, value)}


@pytest.mark.parametrize(("place", "value", "said"), [
    ("coulomb_nm.value", 30.0, "coulomb_nm.value is 61.2, not 30.0"),
    ("speed_lag_s.high", 0.40, "speed_lag_s.high is 0.42, not 0.4"),
    ("torque_scale_rel_sd", 0.005, "torque_scale_rel_sd is 0.02, not 0.005"),
    ("inertia_main_shaft_kg_m2.value", 415.9, "inertia_main_shaft_kg_m2.value is 416.0, not 415.9"),
    ("residual.p_value", 0.96, "residual.p_value is 0.36, not 0.96"),
    ("samples_used", 10**400, "samples_used is 3000, not 1000"),
    ("acceptance.verdict", "pass", "acceptance.verdict is 'fail', not 'pass'"),
    ("acceptance.checks", [], "acceptance.checks is [{'name': 'inertia', 'passed': False}], not []"),
    ("acceptance", None, "'acceptance' is found and not stated"), ("praise", "x", "'praise' is stated and not found"),
    ("warnings", ["one", "three"], "warnings is 'two', not 'three'"),
])
def test_every_part_of_the_stated_result_follows_from_the_log(tmp_path, place, value, said):
    """Friction, lags, torque scale, J at the main shaft, residual and acceptance were not compared."""
    stated = changed_at(WHOLE, place, value)
    log = write_run(tmp_path / "run.mcap", result=WHOLE)
    forged = make_evidence(log, STATEMENT, (), conclude=lambda log: stated).archive
    (problem,) = problems(forged, conclude=lambda log: WHOLE)
    assert problem.startswith(f"the result does not follow from run.mcap: {said}")


@pytest.mark.parametrize(("place", "value"), [
    ("coulomb_nm.value", 61.2 * (1 + 1e-9)), ("skew_s.value", -1e-9), ("backlash", None),
    ("second_opinions.0.note", "4 changes"),
])
def test_a_result_may_differ_in_rounding_and_in_keys_of_a_later_state(tmp_path, place, value):
    log = write_run(tmp_path / "run.mcap", result=WHOLE)
    archive = make_evidence(log, STATEMENT, (), conclude=lambda log: changed_at(WHOLE, place, value)).archive
    assert problems(archive, conclude=lambda log: WHOLE) == ()


@pytest.mark.parametrize(("place", "value", "said"), [
    ("coulomb_nm.value", 61.5, ""), ("coulomb_nm.value", 70.0, "coulomb_nm.value is 61.2, not 70.0"),
    ("acceptance.verdict", "pass", "acceptance.verdict is 'fail', not 'pass'"), ("warnings", ["one", "2"], ""),
    ("acceptance", None, ""), ("praise", "x", ""),
])
def test_a_result_of_another_version_may_have_other_texts_and_keys(tmp_path, monkeypatch, place, value, said):
    log = write_run(tmp_path / "run.mcap", result=WHOLE)
    monkeypatch.setattr("tdhil.evidence.making.__version__", "0.0.9")
    archive = make_evidence(log, STATEMENT, (), conclude=lambda log: changed_at(WHOLE, place, value)).archive
    monkeypatch.undo()
    assert [one.rpartition("run.mcap: ")[2] for one in problems(archive, conclude=lambda log: WHOLE)] == (
        [said] if said else [])


def test_bytes_beside_the_members_are_found(made):
    assert "outside its members" in problems(made.archive + b"x")[0] or "another program" in problems(
        made.archive + b"x")[0]
    out = BytesIO(made.archive)
    with zipfile.ZipFile(out, "a") as file:
        file.comment = b"by Jane"
    assert "outside its members" in problems(out.getvalue())[0]
    assert any("does not belong" in one for one in problems(changed(made, "more.txt", b"x")))
    assert problems(b"PK nothing") != ()


def with_record(log: bytes, opcode: int, body: bytes) -> bytes:
    """Return the log with one more record after its header."""
    (length,) = struct.unpack_from("<Q", log, len(MAGIC) + 1)
    at = len(MAGIC) + 9 + length
    return log[:at] + struct.pack("<BQ", opcode, len(body)) + body + log[at:]


@pytest.mark.parametrize(("opcode", "named"), [(0x09, "an attachment"), (0x0C, "metadata"), (0x0D, "record 0Dh")])
def test_an_attachment_or_metadata_in_the_log_is_found_and_removed(made, tmp_path, opcode, named):
    log = with_record(made.members["run.mcap"], opcode, b"\4\0\0\0Jane")
    assert any(named in one for one in problems(changed(made, "run.mcap", log)))
    (tmp_path / "run.mcap").write_bytes(with_record(write_run(tmp_path / "a.mcap").read_bytes(), opcode, b"Jane"))
    with pytest.raises(UsageError, match=named):
        make_evidence(tmp_path / "run.mcap", STATEMENT, (), conclude=found)


def test_a_log_that_was_not_scrubbed_is_found(made, tmp_path):
    log = write_run(tmp_path / "run.mcap", configuration(operator="Jane Doe"))
    assert any("names, serial numbers" in one for one in problems(changed(made, "run.mcap", log.read_bytes())))


@pytest.mark.parametrize("text", ["/srv/acme/x.pdf", "jane@acme.com", "password: hunter2", "10.1.2.3"])
def test_a_private_text_in_the_statement_is_refused_and_not_repeated(tmp_path, text):
    log = write_run(tmp_path / "run.mcap")
    with pytest.raises(UsageError, match="private text") as caught:
        make_evidence(log, replace(STATEMENT, reference=replace(REFERENCE, note=f"see {text}")), (), conclude=found)
    assert text not in str(caught.value)


# -- completeness, and refused inputs


@pytest.mark.parametrize(("change", "said"), [
    ({"identity": None}, "the identity"), ({"profile": None}, "the profile"), ({"stop": None}, "stop was confirmed"),
    ({"ended": {"kind": "LimitHit", "what": "speed"}}, "the end of the run"),
    ({"trace": {"assumed": []}}, "a trace of another tool"), ({"faults": ["sto@hold"]}, "a rehearsal"),
])
def test_missing_parts_are_named(tmp_path, change, said):
    run = {name: value for name, value in configuration(**change).items() if value is not None}
    with pytest.raises(UsageError, match=said):
        make_evidence(write_run(tmp_path / "run.mcap", run), STATEMENT, (), conclude=found)


def test_a_run_without_stage_5_or_a_truncated_log_is_refused(tmp_path):
    log = write_run(tmp_path / "run.mcap", stages=("setup", "speed"))
    with pytest.raises(UsageError, match="stage acquire"):
        make_evidence(log, STATEMENT, (), conclude=found)
    log.write_bytes(write_run(tmp_path / "b.mcap").read_bytes()[:-100])
    with pytest.raises(UsageError, match="cut off"):
        make_evidence(log, STATEMENT, (), conclude=found)


def test_a_simulated_run_is_refused_unless_it_is_marked(tmp_path):
    run = configuration()
    run["identity"]["simulated"] = True
    result = RESULT | {"simulated": True}
    log = write_run(tmp_path / "run.mcap", run, simulated=True, result=result)
    with pytest.raises(UsageError, match="simulated drive"):
        make_evidence(log, STATEMENT, (), conclude=lambda log: result)
    marked = make_evidence(log, replace(STATEMENT, simulated=True), (), conclude=lambda log: result)
    assert marked.members["README.txt"].startswith(b"SIMULATED")
    assert json.loads(marked.members["manifest.json"])["shown"] == {}
    with pytest.raises(UsageError, match="marked as simulated"):
        make_evidence(write_run(tmp_path / "real.mcap"), replace(STATEMENT, simulated=True), (), conclude=found)


def test_a_number_that_scrubbing_would_change_is_an_error(tmp_path):
    from tdhil.errors import LogError

    log = write_run(tmp_path / "run.mcap")
    with pytest.raises(LogError, match="would change the result"):
        make_evidence(log, STATEMENT, (), conclude=lambda log: RESULT | {"verdict": "not_identifiable"})


# -- the statement


@pytest.mark.parametrize(("given", "names"), [
    ({}, ["publisher", "publish"]),
    ({"publisher": "A", "publish": "log,photo"}, ["publish"]),
    ({"publisher": "A", "publish": "log", "reference_inertia_kg_m2": 104.0},
     ["reference_sd_kg_m2", "reference_method", "reference_note"]),
    ({"publisher": "A", "publish": "log", "reference_inertia_kg_m2": 104.0, "reference_sd_kg_m2": 1.0,
      "reference_method": "weighed"}, ["reference_note"]),
    ({"publisher": "A", "publish": "log", "reference_note": "a drawing"}, ["reference_inertia_kg_m2"]),
    ({"publisher": "A" * 201, "publish": "log", "reference_inertia_kg_m2": -1.0, "reference_sd_kg_m2": -1.0,
      "reference_method": "guessed", "reference_note": "x"},
     ["publisher", "reference_inertia_kg_m2", "reference_sd_kg_m2", "reference_method"]),
    ({"publisher": "A", "publish": "all"}, []),
])
def test_everything_that_is_missing_or_wrong_is_named_at_once(given, names):
    assert [name for name, _ in wrong_in(EvidenceOptions(**given))] == names


def test_a_statement_is_read_back_as_it_is():
    assert statement_in(json.loads(json.dumps(STATEMENT.plain()))) == STATEMENT
    given = EvidenceOptions(publisher=" The  Institute", publish="result log,identity", firmware="0x0170",
                            **{f"reference_{name}": value for name, value in vars(REFERENCE).items()})
    assert statement_of(given) == STATEMENT
    assert parts_in("all") == ("log", "result", "identity", "rig")
    for wrong in ({}, {**STATEMENT.plain(), "more": 1}, {**STATEMENT.plain(), "publisher": ""}):
        with pytest.raises(ValueError, match=r"entries|publisher"):
            statement_in(wrong)


def test_each_option_is_on_the_form_of_the_service():
    """The option for simulated runs is not on the form, since the service detects them."""
    assert [one.name for one in form_options("evidence")] == [
        one.name for one in OF_EVIDENCE if one.name != "simulated"]
    assert all(one.help and one.api is True for one in OF_EVIDENCE)


def test_a_serial_number_has_a_keyed_hash_or_none(tmp_path):
    identity = configuration()["identity"]
    first, second = serial_hmac(b"k" * 32, identity), serial_hmac(b"l" * 32, identity)
    assert len(first) == 64 and first != second
    assert serial_hmac(b"k" * 32, {**identity, "serial": 0}) == ""
    keyed = make_evidence(write_run(tmp_path / "run.mcap"), STATEMENT, (), serial_key=b"k" * 32, conclude=found)
    assert json.loads(keyed.members["statement.json"])["serial_hmac_sha256"] == first
    assert problems(keyed.archive, keyed.sha256) == ()


# -- conclusions


@pytest.mark.parametrize(("reference", "agrees"), [(104.0, True), (107.5, True), (109.5, False), (90.0, False)])
def test_agreement_is_the_en_score(reference, agrees):
    statement = replace(STATEMENT, reference=replace(REFERENCE, inertia_kg_m2=reference))
    result = agreement_of(statement, RESULT)
    assert result.agrees is agrees
    assert result.score == pytest.approx(abs(104.0 - reference) / (4.0**2 + (1.959964 * 1.0) ** 2) ** 0.5, rel=1e-6)
    assert agreement_of(replace(STATEMENT, reference=None), RESULT) is None


def shown(run=None, statement=STATEMENT, result=RESULT, torque_mode=True):
    return set(shown_entries(run or configuration(), statement, result, torque_mode=torque_mode))


def test_a_run_is_evidence_for_entries_with_an_observed_effect():
    assert shown() == {"modes", "quick_stop", "speed", "torque"}       # not the watchdog, which was read back only
    assert shown(torque_mode=False) == {"quick_stop", "speed", "torque"}
    assert shown(configuration(speed_unit={})) == {"modes", "quick_stop", "torque"}
    assert shown(configuration(stop={"confirmed": False})) == {"modes", "speed", "torque"}
    assert shown(statement=replace(STATEMENT, reference=None)) == {"modes", "quick_stop", "speed"}
    far, vague = replace(REFERENCE, inertia_kg_m2=90.0), replace(REFERENCE, sd_kg_m2=20.0)
    for one in (far, vague):
        assert "torque" not in shown(statement=replace(STATEMENT, reference=one))
    assert shown(result=RESULT | {"simulated": True}) == set()
    assert shown(result=RESULT | {"verdict": "not_identifiable"}) == {"quick_stop", "speed"}


def test_an_event_of_a_mode_is_its_evidence(tmp_path):
    log = write_run(tmp_path / "run.mcap", events=(Event(0.6, "note", "torque mode confirmed"),))
    made = make_evidence(log, STATEMENT, (), conclude=found)
    assert set(json.loads(made.members["manifest.json"])["shown"]) == {"modes", "quick_stop", "speed", "torque"}


@pytest.mark.parametrize(("stated", "firmware", "line"), [
    ("", "V2.1", "the drive reports V2.1 (100Ah)"), ("0x0170", "0x0170", "0x0170; the drive reports V2.1 (100Ah)"),
])
def test_the_firmware_is_that_of_the_statement_or_of_the_drive(stated, firmware, line):
    run = {**FACTS.run, "identity": {**FACTS.run["identity"], "firmware": "V2.1"}}
    members = members_of(replace(FACTS, run=run), b"log", replace(STATEMENT, firmware=stated), RESULT, "1.2.3")
    identity = json.loads(members["identity.json"])
    assert (identity["firmware"], identity["firmware_reported"]) == (firmware, "V2.1")
    assert f"firmware         {line}\n" in members["README.txt"].decode()
