"""Scrubbing: no name, path, address or serial number of the input is in any byte of an archive, decompressed."""

from __future__ import annotations

import json
import string
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tdhil.evidence import make_evidence
from tdhil.evidence.leaks import LEAKS, leaks_in, without_leaks
from tdhil.evidence.log_scrub import LogScrub
from tdhil.evidence.statement import PublisherStatement
from tdhil.recording import CHANNELS, CLASSES, COMMAND, messages_of, read_frames, read_run
from tdhil.recording.log_format import Event
from tdhil.recording.mcap_container import Container
from tdhil.recording.mcap_recovery import Contents, walk
from tests.evidence.small_runs import LSS, PROFILE, RESULT, SERIAL, configuration, found, write_run

STATEMENT = PublisherStatement("The Institute", ("log", "result", "identity"), None, "", False)
NAMES = ("first", "last", "rig", "host", "user", "folder", "file", "note", "secret", "key", "field", "mail",
         "calibrated", "customer", "order", "place", "text")
WORD = st.text(string.ascii_lowercase, min_size=6, max_size=12).map(lambda text: f"q{text}x")
FOLDER = "/ho" "me"      # split, so that no home path is in the tree


def seeded(path: Path, words: dict[str, str], serial: int) -> Path:
    """Write a log with each word at every possible place."""
    w, home = words, f"{FOLDER}/{words['user']}/{words['folder']}"
    run = configuration(
        operator=f"{w['first']} {w['last']}", note=f"at {w['note']}", customer=f"{w['customer']} AS",
        order_number=f"{w['order']} 7", place=w["place"], rig_file=f"{home}/{w['file']}.yaml",
        options={"log": {"value": f"{home}/run.mcap", "source": f"{w['file']}.yaml:3"},
                 "place": {"value": w["text"], "source": "--place"},
                 "rate_hz": {"value": "250", "source": f"{w['file']}.yaml:3"}},
        bus={"host": {"value": f"{w['host']}.example.org", "source": "--host"}, "port": {"value": "502", "source": "-"},
             "password": {"value": w["secret"], "source": "--bus-kwargs"}},
        later_entry={"who": w["first"], w["key"]: 1},
        unverified=[f"seen by {w['first'].upper()} on {w['host']}", f"C:\\Users\\{w['user']}\\x", f"{w['mail']}@ab.de"],
        converted=[["limits.torque_nm", "400 Nm", f"{w['file']}.yaml:7"]],
        torque_calibration={"date": "2026-01-01", "drive": {"serial": serial + 1, "name": w["rig"]},
                            "runs": [{"log": f"{home}/{w['calibrated']}.mcap", "sha256": "0" * 64}]},
        profile=PROFILE | {"speed": {"source": f"read by {w['last']}, {home}/m.pdf", "confidence": "likely"}},
        bench={"name": w["rig"], "limits": {"torque_nm": 400.0}, "profile": f"{home}/p.yaml",
               "modbus": {"host": w["host"], "serial": f"/dev/{w['key']}"}},
    )
    run["identity"] = {**run["identity"], "serial": serial}
    result = {**RESULT, "operator": w["first"], "note": w["note"], "customer": w["customer"],
              "order_number": w["order"], "place": w["place"], "log": f"{home}/run.mcap", "date": run["started"],
              "rig": {"name": w["rig"], "file": f"{home}/{w['file']}.yaml"}, "drive": {"serial": serial},
              "connection": f"host {w['host']}", "uploaded": {"by": w["last"]}}
    events = (
        Event(0.6, "warning", f"the drive of {w['rig']} has serial {serial}, {serial:X}h; token={w['secret']}",
              f'File "{home}/a.py", line 3, in {w["field"]}'),
        Event(0.65, "note", f"for {w['customer']}, order {w['order']}, at {w['place']}"),
        Event(0.7, "note", f"see {home}/x, {w['host']}:502 and ssh://{w['user']}@{w['host']}"),
    )
    write_run(path, run, events=events, result=result, serial=serial)
    return with_more(path, w)


def with_more(path: Path, words: dict[str, str]) -> Path:
    """Return the same log with an unknown field in each command."""
    unknown = b"\xfa\x01" + bytes([len(words["field"])]) + words["field"].encode()       # field 31, a text
    with path.with_suffix(".more").open("wb", buffering=0) as file:
        container = Container(file)
        for channel, payload in messages_of(path):
            container.add(channel, 1, payload + unknown if channel == COMMAND else payload)
        container.close_chunk()
        container.finish()
    path.with_suffix(".more").replace(path)
    return path


def every_byte(archive: bytes, log: bytes, at: Path) -> bytes:
    """Return the archive and the decompressed chunks of its log."""
    at.write_bytes(log)
    with at.open("rb") as file:
        chunks = [one.data for one in walk(file, len(log)) if isinstance(one, Contents)]
    assert chunks
    return archive + b"".join(chunks)


@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.too_slow], phases=[Phase.generate])
@given(st.lists(WORD, min_size=len(NAMES), max_size=len(NAMES), unique=True), st.integers(10**6, 2**32 - 2))
def test_no_private_text_of_the_input_is_in_any_byte(drawn, serial):
    words = dict(zip(NAMES, drawn, strict=True))
    with TemporaryDirectory() as folder:
        log = seeded(Path(folder) / "run.mcap", words, serial)
        assert all(word.encode() in every_byte(b"", log.read_bytes(), Path(folder) / "in")
                   for word in drawn)
        made = make_evidence(log, STATEMENT, (), conclude=found)
        told = every_byte(made.archive, made.members["run.mcap"], Path(folder) / "out").lower()
    private = [name for name, word in words.items() if word.encode() in told]
    private += [text for text in (str(serial), f"{serial:x}", str(serial + 1)) if text.encode() in told]
    private += [order for order in ("little", "big") if serial.to_bytes(4, order) in told]
    assert private == []


@pytest.fixture
def scrubbed(tmp_path):
    words = dict(zip(NAMES, (f"q{name}x" for name in NAMES), strict=True))
    log = seeded(tmp_path / "run.mcap", words, SERIAL)
    made = make_evidence(log, STATEMENT, (), conclude=found)
    (tmp_path / "scrubbed.mcap").write_bytes(made.members["run.mcap"])
    return log, tmp_path / "scrubbed.mcap", made


def test_data_for_the_identification_are_kept(scrubbed):
    before, after = (read_run(path) for path in scrubbed[:2])
    for name in ("time_s", "speed_rad_s", "torque_nm", "fresh"):
        assert (getattr(before.recording, name) == getattr(after.recording, name)).all()
    assert before.stages == after.stages
    assert after.recording.gear_ratio == 2.0
    assert after.configuration["identify"] == before.configuration["identify"]
    assert after.configuration["bench"]["limits"] == {"torque_nm": 400.0}
    assert after.configuration["bus"] == {"port": {"value": "502", "source": "-"}}
    assert after.configuration["started"] == "2026-03-01T10:00:00+00:00"      # the offset would name a region
    assert after.configuration["converted"] == [["limits.torque_nm", "400 Nm", "rig.yaml"]]
    assert after.configuration["profile"]["torque"] == PROFILE["torque"]
    assert after.configuration["profile"]["speed"]["source"] == "read by <name>, <path>"
    assert [one.text for one in after.events if one.kind == "note"] == [
        "for <name>, order <name>, at <name>", "see <path>, <name>:502 and <address>"]


def test_equal_drives_stay_equal_and_different_ones_different(scrubbed):
    run = read_run(scrubbed[1]).configuration
    assert run["identity"]["serial"] == 1 and run["torque_calibration"]["drive"]["serial"] == 2
    frames = [one.data for one in read_frames(scrubbed[1])]
    assert [one[4:] for one in frames[:2]] == [b"\1\0\0\0", b"\0\0\0\0"]
    assert [one[0] for one in frames[2:]] == [one[1] for one in LSS]
    assert [one[1:5] for one in frames[2:]] == [b"\1\0\0\0"] * 3 + [bytes(4)]
    assert [one[5:] for one in frames[2:]] == [one[2] for one in LSS]


@pytest.mark.parametrize(("identifier", "data"), [
    (0x7E5, "5d00000000000000"),                # the request has no number
    (0x7E4, "5c07000000000000"), (0x7E5, "5107000000080200"),           # a revision
    (0x181, "43d2029649000000"), (0x7E4, "5dd2"), (0x7E4, ""),
])
def test_other_frames_are_kept(identifier, data):
    assert LogScrub(configuration()).frame(bytes.fromhex(data), identifier).hex() == data


def test_scrubbing_again_changes_nothing(scrubbed):
    again = LogScrub(read_run(scrubbed[1]).configuration)
    assert all(again.message(channel, payload) == payload for channel, payload in messages_of(scrubbed[1]))


def test_the_rig_s_name_is_kept_if_permitted(tmp_path):
    log = write_run(tmp_path / "run.mcap", configuration(bench={"name": "Rig 7 of Acme", "limits": {}},
                                                         unverified=["seen on Rig 7 of Acme"]))
    permitted = PublisherStatement("The Institute", ("log", "rig"), None, "", False)
    for statement, name in ((STATEMENT, None), (permitted, "Rig 7 of Acme")):
        made = make_evidence(log, statement, (), conclude=found)
        (tmp_path / "out.mcap").write_bytes(made.members["run.mcap"])
        bench = read_run(tmp_path / "out.mcap").configuration["bench"]
        assert bench.get("name") == name
        assert (b"Acme" in made.archive) is False        # the log is compressed, and no other member names the rig


def test_a_word_that_the_publisher_names_is_removed_everywhere():
    scrub = LogScrub(configuration(), ["North Yard", "bearing"])
    assert scrub.value({"a": ["the NORTH YARD rig"], "bearing": "bearings"}) == {"a": ["the <name> rig"],
                                                                               "<name>": "bearings"}


@pytest.mark.parametrize("text", [
    "J in kg·m², B in N·m·s/rad, 6040+6071+60FF at 1018h:4, 12:30:45, 2026-11-27T16:26:31+00:00",
    "see 1600h, 1A00h (ok); 5FFEh:2; found 10/20; profile generic/cia402; ISO 13528:2022; std::vector",
    "rig.yaml:7 and run.mcap; https://www.abb.com/doc/3AUA0000098062; torque and/or speed; 1/(J s)",
])
def test_normal_texts_are_no_leak(text):
    assert without_leaks(text) == text and leaks_in([text]) == ()


@pytest.mark.parametrize(("text", "kind"), [
    ("-----BEGIN RSA PRIVATE KEY-----", "private key"), ("AKIAABCDEFGHIJKLMNOP", "access key"),
    ("Authorization: Bearer abcdefghijklmnop", "web token"), ("password: hunter2", "password"),
    ("mqtt://user:pw@broker", "address with a login"), ("jane.doe@acme.com", "e-mail address"),
    (f"at {FOLDER}/jane/x", "path"), ("C:\\Users\\jane", "path"), ("\\\\server\\share\\x", "path"),
    ("file:///x/y", "path"), ("192.168.1.20", "IP address"), ("fe80::1ff:fe23", "IP address"),
    ("00:1b:44:11:3a:b7", "MAC address"), ("plc7.plant.local", "name of a computer"), ("acme-rig.yaml", "file"),
])
def test_a_leak_is_found_and_removed(text, kind):
    assert kind in leaks_in([text])
    assert leaks_in([without_leaks(text)]) == ()
    assert without_leaks(without_leaks(text)) == without_leaks(text)


def test_the_mark_of_each_kind_of_leak_is_no_leak():
    assert leaks_in([one.mark for one in LEAKS]) == ()


def test_every_channel_can_be_scrubbed():
    scrub = LogScrub(configuration())
    for channel, (_, name) in CHANNELS.items():
        payload = CLASSES[name]().SerializeToString()
        if name == "Text":
            payload = CLASSES[name](json=json.dumps({})).SerializeToString()
        assert scrub.message(channel, payload) == payload
