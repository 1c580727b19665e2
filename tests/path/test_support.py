"""`tdhil support`, `tdhil rig new`, `tdhil docs`: support archive, new rig file, folder of the documentation."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import pytest

from drivers.errors import PreflightRefused
from profiles.library import profile_names
from tdhil.cli.support import Scrub
from tdhil.config.rig import load_rig, require_limits
from tdhil.recording.log_format import Event
from tdhil.recording.log_reader import Ours, messages, read_run
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.recording import Stage
from tests.path.path_runs import tdhil
from tests.rigs import rig_file

USER, HOST = "janedoe", "drilling-laptop-7"
HOMES = "/ho" "me"      # split, so that no home path is in the tree
HOME, MAC = f"{HOMES}/{USER}", "/Us" "ers"
TELLING = ("janedoe", "drilling-laptop-7", "hunter2", "sesame", "Jane Doe", f"{MAC}/other", "C:\\Users\\third")


@pytest.fixture
def log(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", HOME)
    monkeypatch.setenv("SECRET_TOKEN", "hunter2")
    monkeypatch.setattr("getpass.getuser", lambda: USER)
    monkeypatch.setattr("socket.gethostname", lambda: HOST)
    path = tmp_path / "run.mcap"
    with RunWriter(path, epoch_ns=0, block=True) as writer:
        writer.configuration({
            "tdhil": "0.1.0",
            "operator": "Jane Doe",
            "rig_file": f"{HOME}/rigs/rig.yaml",
            "options": {"log": {"value": f"{HOME}/rigs/run.mcap", "source": "--log"}},
            "bus": {"password": {"value": "hunter2", "source": "--bus-kwargs"}, "url": "tcp://jd:hunter2@192.0.2.1"},
            "profile": {"name": "generic/cia402", "source": f"manual, {MAC}/other/manual.pdf"},
            "bench": {"limits": {"torque_nm": 400.0}},
            "identify": {"model": "auto"},
        }, {"gear_ratio": 2.0})
        writer.stage(Stage("setup", 0.0, 1.5, "aborted", f"on {HOST}"))
        writer.event(Event(1.0, "failure", f"no such file {HOME}/x (token=sesame)",
                           'File "C:\\Users\\third\\tdhil\\cli.py", line 3'))
        writer.result({"log": f"{HOME}/run.mcap", "verdict": "valid"})
    return path


def texts(archive: Path, folder: Path) -> dict[str, str]:
    with zipfile.ZipFile(archive) as file:
        file.extractall(folder)
        names = file.namelist()
    found = {name: (folder / name).read_text("utf-8") for name in names if name != "run.mcap"}
    if "run.mcap" in names:
        run = read_run(folder / "run.mcap")
        found["run.mcap"] = repr((run.configuration, run.events, run.stages, run.result))
        parts = [one.payload for one in messages(folder / "run.mcap") if isinstance(one, Ours)]
        found["every message"] = b"\n".join(parts).decode("utf-8", "replace")
    return found


def test_the_archive_contains_all_required_data_and_no_user_name(log, tmp_path):
    rig = rig_file(tmp_path, f"# bench of Jane, {USER}@{HOST}\nnode: 3\n# password: hunter2\n")
    done = tdhil("support", log, "--rig", rig)
    assert done.code == 0, done.err
    found = texts(tmp_path / "run.support.zip", tmp_path / "out")
    assert found.keys() >= {"versions.json", "doctor.txt", "rig.yaml", "run.mcap", "log.json", "events.txt",
                            "profile.json", "bench.json", "configuration.json"}
    for name, text in found.items():
        assert not any(word in text for word in TELLING), name
    assert json.loads(found["profile.json"])["name"] == "generic/cia402"
    assert json.loads(found["bench.json"])["limits"]["torque_nm"] == 400.0
    assert "~/rigs/rig.yaml" in found["configuration.json"]
    assert "numpy" in json.loads(found["versions.json"])["libraries"]
    assert "SECRET_TOKEN" not in found["versions.json"]
    kept = read_run(tmp_path / "out" / "run.mcap")
    assert kept.complete
    assert kept.recording.gear_ratio == 2.0
    assert [(stage.name, stage.outcome) for stage in kept.stages] == [("setup", "aborted")]


def test_it_overwrites_no_file_and_needs_a_log(log, tmp_path):
    other = tmp_path / "mine.zip"
    other.write_text("mine")
    done = tdhil("support", log, "-o", other)
    assert (done.code, other.read_text()) == (2, "mine")
    assert tdhil("support", tmp_path / "none.mcap").code == 2


def test_an_unreadable_log_is_left_out(tmp_path, monkeypatch):
    broken = tmp_path / "run.mcap"
    broken.write_bytes(b"\x89MCAP0\r\n" + b"janedoe" * 40)
    done = tdhil("support", broken)
    assert done.code == 3, done.err
    assert "run.mcap" not in texts(tmp_path / "run.support.zip", tmp_path / "out")


def test_numbers_of_the_log_are_unchanged(log):
    scrub = Scrub(home=HOME, names=[USER])
    assert scrub.message(1, b"\x01janedoe") == b"\x01janedoe"      # samples, commands and frames contain no text
    assert scrub.text(f"/opt/janedoes {HOMES}/x/y") == f"/opt/janedoes {HOMES}/<user>/y"


# -- rig new --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", profile_names())
def test_a_new_rig_loads_and_permits_no_real_motion_until_it_is_completed(tmp_path, profile):
    path = tmp_path / "rig.yaml"
    done = tdhil("rig", "new", path, "--profile", profile, "--load", "none")
    assert done.code == 0, done.err
    bench = load_rig(path)
    assert (bench.profile, bench.load.kind, bench.bus.interface, bench.modbus.host) == (profile, "none", None, None)
    with pytest.raises(PreflightRefused, match="no machine limits"):
        require_limits(bench)
    assert "limits: speed_min_rad_s, speed_max_rad_s" in done.err
    filled = path.read_text().replace("#limits", "limits")
    for key in ("speed_min_rad_s", "speed_max_rad_s", "torque_nm", "time_s", "quick_stop_rad_s2", "probe_torque_nm",
                "probe_travel_rad"):
        filled = filled.replace(f"#  {key}: ", f"  {key}: {5 if key == 'speed_max_rad_s' else 1} ")
    path.write_text(filled)
    assert require_limits(load_rig(path)).speed_max_rad_s == 5


def test_a_string_is_refused_until_its_torques_are_stated(tmp_path):
    path = tmp_path / "rig.yaml"
    assert tdhil("rig", "new", path, "--load", "string").code == 0
    done = tdhil("identify", "--dry-run", "--rig", path)
    assert done.code == 2
    assert "make_up_torque_nm" in done.err
    path.write_text(path.read_text().replace("#make_up_torque_nm:", "make_up_torque_nm: 900")
                    .replace("#torque_ramp_nm_s:", "torque_ramp_nm_s: 50"))
    assert load_rig(path).load.kind == "string"


@pytest.mark.parametrize(("typed", "name"), [("bench 3\n", "bench 3"), ("\n", None)])
def test_the_name_is_requested_at_a_terminal(tmp_path, monkeypatch, typed, name):
    class Keyboard(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr("sys.stdin", Keyboard(typed))
    done = tdhil("rig", "new", tmp_path / "rig.yaml", "--load", "none")
    assert done.code == 0 and "Name of this rig" in done.err
    assert load_rig(tmp_path / "rig.yaml").name == name
    assert ("name: the rig's own name" in done.err) is (name is None)


def test_the_load_is_never_assumed(tmp_path):
    assert tdhil("rig", "new", tmp_path / "rig.yaml").code == 2
    assert not (tmp_path / "rig.yaml").exists()


def test_a_rig_is_never_overwritten(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text("mine")
    assert (tdhil("rig", "new", path, "--load", "none").code, path.read_text()) == (2, "mine")


# -- docs -----------------------------------------------------------------------------------------------------


def test_docs_names_the_folder():
    done = tdhil("docs")
    assert done.code == 0
    folder = Path(done.out.splitlines()[0])
    assert (folder / "docs" / "reference" / "rig.md").is_file()
    assert (folder / "examples" / "rig.yaml").is_file()
    assert "docs/reference/rig.md" in done.out
