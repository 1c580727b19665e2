"""`tdhil profiles`: the table, a page of one profile, and wrong files."""

import io
import sys

import pytest

from drivers.errors import PreflightRefused
from profiles.library import load_profile, profile_names, profile_path
from profiles.modbus import ModbusProfile
from tdhil.cli.main import main
from tdhil.session.overrides import require_accepted
from tests.path.path_runs import tdhil


def test_the_table_has_every_profile_that_ships():
    done = tdhil("profiles")
    assert done.code == 0
    shown = "".join(done.out.split())
    assert all(name in shown for name in profile_names())
    document = tdhil("profiles", "--json").document
    assert [one["name"] for one in document["profiles"]] == list(profile_names())
    (generic,) = [one for one in document["profiles"] if one["name"] == "generic/cia402"]
    assert generic["modes"] == "speed, torque"
    assert generic["watchdog"] == "heartbeat, then quick stop"
    assert generic["entries"] == {"verified": 5, "likely": 6, "unverified": 0}


@pytest.mark.heavy(but_first=5)
@pytest.mark.parametrize("name", profile_names())
def test_a_page_is_complete(name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    profile = load_profile(name)
    done = tdhil("profiles", "show", name)
    assert done.code == 0, done.err
    for one in profile.parameters:
        assert one.title in done.out
        if one.require is not None and one.advice:
            assert one.advice in done.out
    if (loop := profile.speed_controller) is not None:
        assert all(one.title in done.out for one in (loop.gain, loop.integral, *loop.notch))
    assert ("for the gains of tdhil tune" in done.out) is (loop is not None and not loop.simulated_only)
    for hint in profile.hints:
        assert hint in done.out
    for level in ("likely", "unverified"):
        for entry in profile.below(level):
            assert entry in done.out
    if isinstance(profile, ModbusProfile):
        for register in [profile.cycle.speed.register_, profile.cycle.status.register_]:
            assert f"{register.address} ({register.address:04X}h)" in done.out
            assert (register.reference or "") in done.out
        assert all((one.advice or "") in done.out for one in profile.filters)
    document = tdhil("profiles", "show", name, "--json").document
    assert document["profile"]["name"] == name
    assert len(document["not_verified"]) == len(profile.below("likely")) + len(profile.below("unverified"))


def test_a_page_fits_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for name in ("abb/acs880-enhanced", "siemens/s120-canopen"):
        assert max(map(len, tdhil("profiles", "show", name).out.splitlines())) <= 80


@pytest.mark.parametrize("columns", [80, 60, 40])
def test_the_table_is_short_and_cuts_no_word(columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    lines = tdhil("profiles").out.splitlines()
    assert max(map(len, lines)) <= max(columns, 56) and len(lines) <= len(profile_names()) + 8
    assert {line.split(" ")[0] for line in lines} >= set(profile_names())
    (fcan,) = (line.split() for line in lines if line.startswith("abb/acs880-fcan"))
    assert fcan[:4] == ["abb/acs880-fcan", "canopen", "no", "0/6/3"]
    assert (" ".join(fcan[4:]) == "heartbeat → coast") == (columns == 80)
    assert "V/L/U: number of entries that are verified, likely, unverified." in " ".join(" ".join(lines).split())


def test_an_unknown_name_lists_similar_names():
    done = tdhil("profiles", "show", "generic/modbuss")
    assert done.code == 2
    assert "did you mean 'generic/modbus' or" in done.err


@pytest.mark.parametrize(("asked", "wanted"), [
    ("abb", "abb/"), ("ABB", "abb/"), ("siemens/", "siemens/"), ("siem", "siemens/"), ("abb/acs880", "abb/acs880"),
    ("acs880", "abb/acs880"), ("generic", "generic/"),
])
def test_a_vendor_name_shows_its_profiles(asked, wanted, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    done = tdhil("profiles", "show", asked)
    assert done.code == 0, done.err
    names = [name for name in profile_names() if name.startswith(wanted)]
    assert len(names) > 1
    assert [name for name in profile_names() if name in done.out] == names
    assert [one["name"] for one in tdhil("profiles", "show", asked, "--json").document["profiles"]] == names


@pytest.mark.parametrize(("asked", "name"), [
    ("nanotec", "nanotec/c5-e"), ("c5", "nanotec/c5-e"), ("MS300", "delta/ms300"),
])
def test_a_unique_prefix_selects_its_profile(asked, name):
    done = tdhil("profiles", "show", asked)
    assert done.code == 0, done.err
    assert done.out.startswith(f"{name}: ")
    assert tdhil("profiles", "show", asked, "--json").document["profile"]["name"] == name


@pytest.mark.parametrize(("asked", "meant"), [
    ("simens", "siemens/"), ("epso4", "maxon/epos4"), ("generic/cia401", "generic/cia402"), ("schnieder", "schneider/"),
])
def test_a_misspelt_name_lists_similar_names(asked, meant):
    done = tdhil("profiles", "show", asked)
    assert done.code == 2
    assert f"did you mean '{meant}" in done.err


def test_no_title_suggests_that_a_real_drive_is_simulated():
    """On Modbus the title is the only name of a peer. It is in the heading of preflight and in the prompt."""
    for name in profile_names():
        assert "simulat" not in load_profile(name).title.lower(), name


def test_shipped_profiles_are_valid():
    done = tdhil("profiles", "check", *profile_names())
    assert done.code == 0, done.err
    assert len(done.out.splitlines()) == len(profile_names())
    assert "generic/modbus: ok, generic/modbus on modbus" in done.out


def test_every_problem_is_a_line_with_its_place(tmp_path):
    text = profile_path("generic/modbus").read_text(encoding="utf-8")
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace("word_order: high_first ", "word_order: highfirst ").replace("rate_hz: 100.0",
                                                                                          "rate: 100.0"), "utf-8")
    at = {word: number for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
          for word in ("highfirst", "rate: 100.0") if word in line}
    done = tdhil("profiles", "check", path, "generic/cia402")
    assert done.code == 2
    lines = done.err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith(f"{path}:{at['highfirst']}: line.word_order: ")
    assert lines[1].startswith(f"{path}:{at['rate: 100.0']}: ")
    assert "generic/cia402: ok" in done.out                        # a wrong file hides no other one
    document = tdhil("profiles", "check", "--json", path).document
    assert (document["ok"], document["exit_code"], len(document["problems"])) == (False, 2, 2)
    assert document["problems"][0]["line"] == at["highfirst"]


@pytest.mark.parametrize("content", ["", "bus: profibus\n", "- a\n", "bus: canopen\neds: 3\n"])
def test_no_traceback_for_any_file(tmp_path, content):
    path = tmp_path / "mine.yaml"
    path.write_text(content)
    done = tdhil("profiles", "check", path)
    assert done.code == 2
    assert "Traceback" not in done.err
    assert str(path) in done.err
    assert tdhil("profiles", "check", tmp_path / "none.yaml").code == 2


def test_an_eds_that_is_not_there(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(profile_path("generic/cia402").read_text(encoding="utf-8"), encoding="utf-8")
    done = tdhil("profiles", "check", path)
    assert done.code == 2
    assert "no file 'cia402.eds' beside" in done.err


def test_a_profile_is_started_from_an_eds(tmp_path, monkeypatch):
    """The shipped EDS is used. Missing entries are named, no file is overwritten, and the profile is valid."""
    monkeypatch.chdir(tmp_path)
    source = profile_path("generic/cia402").parent / "cia402.eds"
    done = tdhil("profiles", "import", source)
    assert done.code == 0, done.err
    path = tmp_path / "cia402.yaml"
    assert "Look up in the drive's manual: identity, modes, quick_stop, torque, watchdog" in done.out
    assert tdhil("profiles", "check", path).code == 0
    before = path.read_bytes()
    again = tdhil("profiles", "import", source)
    assert (again.code, path.read_bytes()) == (2, before)
    assert "already exists and was not overwritten. Name another file, or move the existing one" in again.err
    document = tdhil("profiles", "import", source, "-o", "mine.yaml", "--json").document
    assert document["file"] == "mine.yaml"
    assert document["unverified"] == ["identity", "modes", "quick_stop", "torque", "watchdog"]
    assert (tmp_path / "mine.yaml").read_bytes() == before


def test_a_real_drive_is_refused_for_entries_missing_in_an_eds(tmp_path):
    """Before motion, every entry that the file does not contain needs its own override."""
    path = tmp_path / "mine.yaml"
    tdhil("profiles", "import", profile_path("generic/cia402").parent / "cia402.eds", "-o", path)
    profile = load_profile(str(path))
    with pytest.raises(PreflightRefused) as caught:
        require_accepted(profile, ("likely",))
    for name in ("identity", "modes", "quick_stop", "torque", "watchdog"):
        assert f"--accept-unverified {name}" in str(caught.value)
    require_accepted(profile, ("likely", "identity", "modes", "quick_stop", "torque", "watchdog"))


@pytest.mark.parametrize(("content", "at"), [
    ("[DeviceInfo]\nVendorNumber=\n", ":2: VendorNumber is empty"), ("", ": has no section [DeviceInfo]"),
])
def test_a_damaged_eds_gives_one_line_and_no_profile(tmp_path, content, at):
    path = tmp_path / "drive.eds"
    path.write_text(content)
    done = tdhil("profiles", "import", path, "-o", tmp_path / "mine.yaml")
    assert done.code == 2
    assert f"{path}{at}" in done.err
    assert "Traceback" not in done.err
    assert not (tmp_path / "mine.yaml").exists()


@pytest.mark.parametrize(("output", "words"), [
    ("mine.txt", "must end in .yaml"), ("no/such/mine.yaml", "can't be written"), ("no/such/mine.yaml", "TDH-206"),
])
def test_invalid_destinations_of_a_profile(tmp_path, output, words):
    done = tdhil("profiles", "import", profile_path("generic/cia402").parent / "cia402.eds", "-o", tmp_path / output)
    assert done.code == 2
    assert words in done.err


class Gone(io.StringIO):
    """Pipe whose reader closes early, as with `tdhil profiles show … | head`."""

    def write(self, text):
        raise BrokenPipeError(32, "Broken pipe")


@pytest.mark.parametrize("command", [("profiles",), ("profiles", "show", "generic/modbus")])
def test_a_reader_that_closes_early_is_no_error(command, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", Gone())
    assert main([*command]) == 141
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("name", "said", "unsaid"), [
    ("siemens/g120", "RTU 19200 baud 8E1", "TCP port"), ("abb/acs880-enhanced", "TCP port 502", "baud"),
])
def test_a_line_that_the_drive_does_not_have_is_not_offered(name, said, unsaid, tmp_path):
    (line,) = [line for line in tdhil("profiles", "show", name).out.splitlines() if line.startswith("  line")]
    assert said in line and unsaid not in line
    tdhil("rig", "new", tmp_path / "rig.yaml", "--profile", name, "--load", "none")
    (blank,) = [line for line in (tmp_path / "rig.yaml").read_text().splitlines() if line.startswith("#modbus:")]
    assert ("host:" in blank, "serial:" in blank) == ("TCP" in said, "RTU" in said)
